"""A diagnosis while the vehicle flies: the window, what is told and when, records played again."""

import json
from dataclasses import replace

import programs
import pytest
from dropped import DROPPED, QUAD5, dropped_payload
from json_schemas import valid

from trueflight.groundstation.live.said import GONE, PERSISTS, Said, follow
from trueflight.groundstation.live.window import Window, flight_of
from trueflight.groundstation.results import Change, EffectVerdict, OverTime, ParameterEstimate, Stretch
from trueflight.models.model import rigid_body_model
from trueflight.models.record import read_messages
from trueflight.models.record_pb2 import Tick
from trueflight.models.vehicle import load_vehicle


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    return dropped_payload(tmp_path_factory.mktemp("flown") / "dropped.mcap")


# --- the window -----------------------------------------------------------------------------------------------------


def ticks_of(*times, phase="mission"):
    return [Tick(vehicle_time_us=round(1e6 * t), phase=phase) for t in times]


def test_the_window_holds_the_last_seconds_of_one_flight():
    window = Window(20.0)
    window.take(ticks_of(1.0, 2.0, phase="idle"))
    window.take(ticks_of(*(3.0 + 0.1 * k for k in range(300))))
    assert window.covered == pytest.approx(20.0) and window.now == pytest.approx(29.9) and window.flight == 1
    window.take(ticks_of(40.0, phase="idle"))
    window.take(ticks_of(*(41.0 + 0.1 * k for k in range(11))))
    assert (window.flight, window.now) == (2, pytest.approx(1.0))


def test_a_hole_is_seen_and_filled_in_whatever_order_its_ticks_come():
    window = Window(20.0)
    window.take(ticks_of(*(0.1 * k for k in range(50))))
    window.take(ticks_of(*(8.0 + 0.1 * k for k in range(20))))
    (hole,) = window.holes()
    assert (1e-6 * hole.start, 1e-6 * hole.stop) == (pytest.approx(4.9), pytest.approx(8.0))
    late = ticks_of(*(5.0 + 0.1 * k for k in range(30)))
    assert window.fill([*reversed(late), *late]) == 30
    assert window.holes() == []


def test_ticks_become_the_flight_that_the_reader_makes_of_the_record(flown):
    ticks, _ = read_messages(flown)
    window = Window(20.0)
    window.take(ticks)
    vehicle = load_vehicle(QUAD5)
    flight = flight_of(window.snapshot("quad5", vehicle, rigid_body_model(vehicle)))
    assert flight.duration == pytest.approx(20.0, abs=0.1)
    assert flight.t[-1] == pytest.approx(
        1e-6 * (ticks[-1].vehicle_time_us - ticks[0].vehicle_time_us), abs=0.05
    )
    assert flight.has("position", "quaternion", "specific_force", "thrust_command")


# --- what is told ---------------------------------------------------------------------------------------------------


def a_look(stop, moment=None, name="thrust_gain", others=()):
    """A look at the last 30 s in which an effect changes at a moment, or nothing does."""
    if moment is None:
        return Said("quad5", 1, stop - 30.0, stop, 0.3)
    number = ParameterEstimate("gain", 1.1, 1.09, 1.11, "1")
    over = OverTime(
        (Stretch(stop - 30.0, moment, (number,)), Stretch(moment, stop, (number,))),
        (Change(moment, moment - 0.2, moment + 0.2),),
    )
    verdict = EffectVerdict(
        name, "missing", 1, 0.9, 0.0, (number,), others, "add it", confidence=0.99, over_time=over
    )
    return Said("quad5", 1, stop - 30.0, stop, 0.3, effects=(verdict,))


def told_of(looks):
    alerts, told = (), []
    for look in looks:
        alerts, news = follow(alerts, look)
        told += [(look.stop, alert) for alert in news]
    return alerts, told


def test_a_change_is_told_once_and_only_after_it_persists():
    _, told = told_of([a_look(50.0 + k, 41.0) for k in range(20)])
    ((when, alert),) = told
    assert when == 50.0 + PERSISTS - 1 and alert.first == 50.0
    assert "thrust_gain changed at 41.0 s:" in alert.text


def test_what_one_look_sees_and_the_next_does_not_is_never_told():
    _, told = told_of([a_look(50.0 + k, 41.0 if k % PERSISTS else None) for k in range(20)])
    assert told == []


def test_a_change_is_one_whatever_it_is_called():
    looks = [a_look(50.0 + k, 41.0 + 0.1 * k, ("thrust_gain", "battery_sag")[k % 2]) for k in range(6)]
    _, told = told_of(looks)
    assert len(told) == 1


def test_a_change_that_is_not_seen_any_more_is_taken_back_and_one_that_left_the_window_is_not():
    seen = [a_look(50.0 + k, 41.0) for k in range(5)]
    _, told = told_of([*seen, *(a_look(55.0 + k) for k in range(GONE))])
    assert [alert.taken_back for _, alert in told] == [False, True]
    alerts, told = told_of([*seen, *(a_look(66.0 + k) for k in range(3 * GONE))])
    assert [alert.taken_back for _, alert in told] == [False] and alerts[0].told is not None


def test_a_look_that_could_not_be_made_says_nothing_about_changes():
    seen = [a_look(50.0 + k, 41.0) for k in range(2)]
    _, told = told_of([*seen, replace(a_look(52.0), error="too short"), a_look(53.0, 41.0)])
    assert len(told) == 1


# --- records played again -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def looks(flown):
    """What a program reads of the flight, a line a document."""
    done = programs.run("groundstation", "monitor", "--replay", flown, "--speed", 0, "--json")
    assert done.returncode == 0, done.stderr
    return [valid("groundstation monitor", json.loads(line)) for line in done.stdout.splitlines()]


def test_a_dropped_payload_is_told_with_its_moment(looks):
    (alert,) = [one for one in looks if one["kind"] == "alert"]
    assert alert["low"] - 0.2 <= DROPPED <= alert["high"] + 0.2
    assert "thrust_gain" in (alert["effect"], *alert["or_else"])
    assert alert["told"] - DROPPED < 12.0


def test_before_the_drop_it_is_named_and_told_as_of_one_size(looks):
    before = [
        one for one in looks if one["kind"] == "look" and one["window"][1] < DROPPED and not one["error"]
    ]
    assert before
    last = {e["name"]: e for e in before[-1]["effects"]}
    gain = last["thrust_gain"]
    assert gain["verdict"] == "missing" and gain["changes"] == []
    assert gain["parameters"]["gain"]["low"] <= 1.0 / 1.12 <= gain["parameters"]["gain"]["high"]
    first = next(e for e in before[0]["effects"] if e["name"] == "thrust_gain")["parameters"]["gain"]
    assert (
        gain["parameters"]["gain"]["high"] - gain["parameters"]["gain"]["low"] < first["high"] - first["low"]
    )


def test_what_the_flight_has_not_shown_yet_is_told_with_what_to_fly(looks):
    look = next(one for one in looks if one["kind"] == "look" and not one["error"])
    unseen = [e for e in look["effects"] if e["verdict"] == "not_excited"]
    assert unseen and all("fly" in e["advice"] for e in unseen)


def test_a_file_that_is_no_record_is_one_line(tmp_path):
    (tmp_path / "flight.mcap").write_text("nothing")
    done = programs.run("groundstation", "monitor", "--replay", tmp_path / "flight.mcap", "--no-view")
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "flight.mcap" in done.stderr
