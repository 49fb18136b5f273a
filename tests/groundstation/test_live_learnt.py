"""What a companion learns in flight is told while it flies: which number, how large, since when, what it may be."""

import json
from pathlib import Path

import programs
import pytest
from json_schemas import valid

from trueflight.groundstation.live.learnt import HELD, Followed, Learnt
from trueflight.groundstation.reading import read_flight
from trueflight.models import contract
from trueflight.models.design import load_design
from trueflight.models.export import export_onnx
from trueflight.models.model import Model, Term
from trueflight.models.record_pb2 import Tick
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.in_process import record
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.truth.hidden import choose

VEHICLE = load_vehicle("models/vehicles/quad5/vehicle.toml")
DESIGN = load_design(Path("models/vehicles/quad5/design.json"), VEHICLE)
DRAG = Model(
    VEHICLE, (Term("rigid_body", {}), Term("rotor_drag", {"x": 0.3, "y": 0.36})), name="drag", version=1
)
ZERO = 5_000_000


def ticks_of(numbers, names="thrust_gain.gain", acts=lambda t: t > 0.0, deviation=0.01, begin=0.0):
    """Ticks of 0.1 s, in each of them the number that acts."""
    return [
        Tick(
            vehicle_time_us=ZERO + round(1e6 * (begin + 0.1 * k)),
            phase="mission",
            learning="acting" if acts(begin + 0.1 * k) else "shadow",
            learnt_names=names,
            learnt=[number],
            learnt_deviation=[deviation],
            learnt_acting=[number],
        )
        for k, number in enumerate(numbers)
    ]


def test_a_number_that_left_what_was_deployed_is_told_once_it_stays_away():
    (told,) = Followed().take(ticks_of([1.0] * 50 + [0.9] * 100), 1, ZERO)
    assert (told.effect, told.parameter, told.unit) == ("thrust_gain", "gain", "1")
    assert (told.deployed, told.value, told.deviation) == (1.0, 0.9, 0.01)
    assert told.since == pytest.approx(5.0) and told.time == pytest.approx(5.0 + HELD)
    assert told.text == (
        "learnt on board: thrust_gain gain 0.9 [0.88, 0.92] since 5.0 s, 1 as deployed: thrust_gain, or mass, payload, "
        "thrust constant?"
    )


@pytest.mark.parametrize(
    "numbers",
    [
        [1.0] * 200,
        [1.0] * 50 + [1.029] * 100,  # within three standard deviations
        [1.0] * 50 + [0.9] * 15 + [1.0] * 100,  # a second and a half
        [1.0] * 5 + [0.9, 1.0] * 100,  # never stays
    ],
)
def test_what_does_not_leave_or_does_not_stay_away_is_not_told(numbers):
    assert Followed().take(ticks_of(numbers), 1, ZERO) == []


def test_it_is_told_again_when_it_moves_on_and_when_it_comes_back():
    flown = [1.0] * 10 + [0.9] * 100 + [0.8] * 100 + [1.0] * 50
    first, second, third = Followed().take(ticks_of(flown), 1, ZERO)
    assert (first.value, second.value) == (0.9, 0.8)
    assert first.since == second.since == pytest.approx(1.0)
    assert third.ended and third.text == "learnt on board: thrust_gain gain is 1 again, as deployed"


def test_what_was_deployed_is_not_known_to_who_comes_while_it_acts():
    assert Followed().take(ticks_of([0.9] * 100, acts=lambda _: True), 1, ZERO) == []


def test_another_flight_and_another_model_begin_anew():
    followed = Followed()
    assert len(followed.take(ticks_of([1.0] * 10 + [0.9] * 50), 1, ZERO)) == 1
    assert (
        len(followed.take(ticks_of([1.0] * 10 + [0.9] * 50, begin=60.0, acts=lambda t: t > 60.5), 2, ZERO))
        == 1
    )
    new = ticks_of([0.9] * 60, acts=lambda _: False, begin=120.0)
    for tick in new:
        tick.model = "another"
    assert followed.take(new, 2, ZERO) == []  # 0.9 is what that one brought


def test_somebodys_own_effect_is_told_without_unit_and_ticks_of_another_controller_tell_nothing():
    (told,) = Followed().take(ticks_of([0.0] * 10 + [2.0] * 50, names="mine.size"), 1, ZERO)
    assert told == Learnt("mine", "size", "", 0.0, 2.0, 0.01, told.since, told.time)
    assert told.text.endswith("since 1.0 s, 0 as deployed")
    assert Followed().take([Tick(vehicle_time_us=ZERO, phase="mission")] * 3, 1, ZERO) == []


@pytest.fixture(scope="module")
def adaptive(tmp_path_factory):
    path = tmp_path_factory.mktemp("flown") / "excitation.mcap"
    record(Plan(VEHICLE, DESIGN, trajectory("excitation"), choose(["rotor_drag:0.3"], VEHICLE, 3), 3), path)
    return export_onnx(DRAG, read_flight(path), adaptive=True)


def flown(adaptive, path, *hidden):
    plan = Plan(
        VEHICLE,
        DESIGN,
        trajectory("lemniscate"),
        choose(["rotor_drag:0.3", *hidden], VEHICLE, 3),
        3,
        model=adaptive,
        controller=contract.CORRECTED_ADAPTIVE,
        settle=2.0,
    )
    assert record(plan, path).outcome == "finished"
    return str(path)


def test_a_payload_is_named_while_it_flies_and_in_the_recording(adaptive, tmp_path):
    path = flown(adaptive, tmp_path / "payload.mcap", "thrust_gain:0.909@8")
    saved = tmp_path / "live.rrd"
    arguments = ["monitor", "--replay", path, "--speed", "0", "--no-diagnosis"]
    done = programs.run("groundstation", *arguments, "--json", "--save", str(saved))
    lines = [valid("groundstation monitor", json.loads(line)) for line in done.stdout.splitlines()]
    told = [one for one in lines if one["kind"] == "learnt" and one["effect"] == "thrust_gain"]
    assert told and told[0]["value"] == pytest.approx(0.909, abs=3.0 * told[0]["deviation"] + 0.01)
    assert 7.5 < told[0]["since"] < 10.0 and "payload" in told[0]["or_else"]
    assert saved.stat().st_size > 10_000
    done = programs.run("groundstation", *arguments, "--no-view")
    assert "learnt on board: thrust_gain gain 0.9" in done.stdout and "payload" in done.stdout


def test_a_flight_as_the_model_says_names_nothing(adaptive, tmp_path):
    path = flown(adaptive, tmp_path / "plain.mcap")
    done = programs.run(
        "groundstation", "monitor", "--replay", path, "--speed", "0", "--no-diagnosis", "--json"
    )
    assert [one for one in map(json.loads, done.stdout.splitlines()) if one["kind"] == "learnt"] == []
