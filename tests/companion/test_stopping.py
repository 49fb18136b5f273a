"""Every reason to stop a flight, one at a time: from which number on, what follows, and what is said.

Times are told by the vehicle's clock in eighths of a second, which are exact: what is at a limit is not beyond it.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace

import pytest

from trueflight.companion.latest import Latest
from trueflight.companion.odometry import Odometry
from trueflight.companion.outcome import LANDING, MISSION, Outcome
from trueflight.companion.resets import Reset
from trueflight.companion.stopping import (
    LAND,
    RETURN,
    SILENCE,
    TELL,
    ReasonsToStop,
    Safety,
    Stop,
    motors_cut,
    taken_over,
)
from trueflight.models.reference import trajectory

SAFETY = Safety(
    fence_radius=5.0,
    fence_height=4.0,
    land_voltage=0.75,
    battery_patience=2.0,
    odometry_gap=0.25,
    jump=0.5,
    reset=1.0,
    reset_turn=0.25,
    late=0.125,
    late_patience=0.5,
    stale=0.5,
    lost=2.0,
)
VOLTAGE = 16.0
EIGHTH = 125_000
RESTING = Odometry(10_000_000, 0, (0.0,) * 3, (0.0,) * 3, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3, 0)
NOTHING_MOVED = Reset((0.0, 0.0, 0.0), 0.0, True)


@dataclass
class Watched:
    """A flight in which all is well, and what its reasons to stop say of it, an eighth of a second a tick."""

    reasons: ReasonsToStop = field(default_factory=lambda: ReasonsToStop(SAFETY, VOLTAGE))
    latest: Latest = field(default_factory=lambda: Latest(battery_voltage=VOLTAGE, flight_mode="OFFBOARD"))
    odometry: Odometry = RESTING

    def look(
        self,
        *,
        interval: float = 0.125,
        position: tuple[float, float, float] = (0.0, 0.0, 1.0),
        reference: tuple[float, float, float] = (0.0, 0.0, 1.0),
        age: float = 0.0,
        phase: str = MISSION,
        disagrees: str = "",
        land_asked: bool = False,
        **odometry: object,
    ) -> tuple[Stop, ...]:
        now = self.odometry.vehicle_time_us + EIGHTH
        self.odometry = self.odometry._replace(vehicle_time_us=now)
        out = Outcome(phase, interval, position, age=age)
        told = self.odometry._replace(**odometry)
        return self.reasons.look(told, out, self.latest, reference, disagrees, land_asked)

    def lasting(self, ticks: int, **seen: object) -> list[tuple[Stop, ...]]:
        return [self.look(**seen) for _ in range(ticks)]


def tilted(roll: float) -> tuple[float, float, float, float]:
    return (math.cos(0.5 * roll), math.sin(0.5 * roll), 0.0, 0.0)


def pitched(pitch: float) -> tuple[float, float, float, float]:
    return (math.cos(0.5 * pitch), 0.0, math.sin(0.5 * pitch), 0.0)


def test_where_all_is_well_there_is_no_reason_to_stop() -> None:
    assert set(Watched().lasting(100)) == {()}


# What the autopilot says


@pytest.mark.parametrize(
    ("latest", "cut"),
    [
        (Latest(killed=True, flight_mode="OFFBOARD"), True),
        (Latest(flight_mode="TERMINATION"), True),
        (Latest(flight_mode="OFFBOARD"), False),
        (Latest(flight_mode="POSCTL"), False),
    ],
)
def test_cut_motors_are_the_kill_switch_or_the_termination(latest: Latest, cut: bool) -> None:
    expected = Stop(SILENCE, "kill_switch", "the motors were cut: silent") if cut else None
    assert motors_cut(latest) == expected


def test_whoever_chose_another_mode_than_offboard_wins_and_is_named() -> None:
    assert taken_over(Latest(flight_mode="OFFBOARD")) is None
    assert taken_over(Latest(flight_mode="OFFBOARD", failsafe=True)) is None
    assert taken_over(Latest(flight_mode="POSCTL")) == Stop(
        SILENCE, "pilot_takeover", "POSCTL was chosen by the pilot or a ground station: silent"
    )
    assert taken_over(Latest(flight_mode="LAND", failsafe=True)) == Stop(
        SILENCE, "failsafe", "LAND was chosen by the autopilot's failsafe: silent"
    )


def test_what_the_autopilot_told_just_now_stands_in_brackets() -> None:
    latest = Latest(flight_mode="LAND", killed=True)
    latest.notices.append((time.monotonic(), "battery critical"))
    for failsafe in (False, True):
        latest.failsafe = failsafe
        stop = taken_over(latest)
        assert stop is not None
        assert stop.text.endswith(" (battery critical): silent")
    cut = motors_cut(latest)
    assert cut is not None
    assert cut.text == "the motors were cut (battery critical): silent"


@pytest.mark.parametrize("mode", ["LAND", "POSCTL", "UNKNOWN"])
def test_in_another_mode_somebody_else_flies_and_nothing_is_judged(mode: str) -> None:
    flight = Watched()
    flight.latest.flight_mode = mode
    assert set(flight.lasting(20, quaternion=tilted(3.0), position=(99.0, 0.0, 0.0), disagrees="x")) == {()}


def test_mode_and_arming_are_unknown_after_two_and_a_half_seconds_without_a_word() -> None:
    reasons, odometry = ReasonsToStop(SAFETY, VOLTAGE), Watched().odometry
    assert not reasons.mode_unknown(odometry, Latest()), "an autopilot that never told the time of it"
    limit = odometry.vehicle_time_us - 2_500_000
    assert not reasons.mode_unknown(odometry, Latest(mode_time_us=limit))
    assert reasons.mode_unknown(odometry, Latest(mode_time_us=limit - 1))
    started = odometry._replace(vehicle_time_us=1_000_000)
    assert not reasons.mode_unknown(started, Latest(mode_time_us=0)), "an autopilot that has just started"


def test_after_a_gap_mode_and_arming_are_unknown_until_told_again() -> None:
    reasons, odometry = ReasonsToStop(SAFETY, VOLTAGE), Watched().odometry
    before = Latest(mode_time_us=odometry.vehicle_time_us - 1)
    reasons.hear(odometry, 0.25)
    reasons.hear(odometry._replace(overtaken=1), 0.5)
    reasons.hear(odometry._replace(overtaken=3), 1.0)
    assert not reasons.mode_unknown(odometry, before), "at the limit, and counting those overtaken, is no gap"
    reasons.hear(odometry, 0.2501)
    assert reasons.mode_unknown(odometry, before)
    assert not reasons.mode_unknown(odometry, Latest(mode_time_us=odometry.vehicle_time_us))
    reasons.begin()
    assert not reasons.mode_unknown(odometry, before), "that was another flight"


# What the odometry says


def test_odometry_that_is_stale_is_answered_by_nothing() -> None:
    reasons = ReasonsToStop(SAFETY, VOLTAGE)
    assert reasons.stale(0.5) is None
    text = "the odometry to answer to is 0.75 s old, 0.5 s are allowed: silent"
    assert reasons.stale(0.75) == Stop(SILENCE, "stale", text)


@pytest.mark.parametrize("turned", [tilted, pitched])
@pytest.mark.parametrize("land_asked", [False, True])
def test_a_vehicle_that_tumbles_for_more_than_half_a_second_gets_nothing_more(
    turned, land_asked: bool
) -> None:
    tumbled = Stop(SILENCE, "tumbled", "tilted by more than 80 degrees: silent")
    flight = Watched()
    for angle in (1.41, -1.41, 3.0):
        first = [()] * 5  # since the first of them half a second has passed, and not more
        flight.look(land_asked=land_asked)
        assert flight.lasting(5, quaternion=turned(angle), land_asked=land_asked) == first
        assert flight.look(quaternion=turned(angle), land_asked=land_asked) == (tumbled,)
    flight.look(land_asked=land_asked)
    for _ in range(5):
        assert set(flight.lasting(5, quaternion=turned(2.0), land_asked=land_asked)) == {()}
        assert flight.look(land_asked=land_asked) == (), "upright in between"
    assert set(flight.lasting(20, quaternion=turned(1.39), land_asked=land_asked)) == {()}


def test_half_a_second_of_tumbling_is_half_a_second() -> None:
    flight = Watched()
    flight.look(quaternion=tilted(2.0))
    begun = flight.odometry.vehicle_time_us
    flight.odometry = flight.odometry._replace(vehicle_time_us=begun + 499_000 - EIGHTH)
    assert flight.look(quaternion=tilted(2.0)) == ()
    flight.odometry = flight.odometry._replace(vehicle_time_us=begun + 501_000 - EIGHTH)
    assert [stop.kind for stop in flight.look(quaternion=tilted(2.0))] == ["tumbled"]


def test_turned_about_the_vertical_a_vehicle_has_not_tumbled() -> None:
    assert set(Watched().lasting(20, quaternion=(0.0, 0.0, 0.0, 1.0))) == {()}


@pytest.mark.parametrize(
    ("interval", "overtaken", "stop"),
    [
        (0.25, 0, None),
        (0.0, 0, None),
        (0.375, 0, Stop(LAND, "odometry_gap", "odometry was missing for 0.38 s")),
        (1.5, 2, Stop(LAND, "odometry_gap", "odometry was missing for 0.50 s")),
        (-0.01, 0, Stop(LAND, "odometry_gap", "odometry was going back in time")),
        (0.5, 1, Stop(TELL, "stalled", "this machine stood still for 0.50 s; 1 messages were overtaken")),
    ],
)
def test_a_gap_in_the_odometry_lands_and_one_of_our_own_is_told(interval, overtaken, stop) -> None:
    assert Watched().look(interval=interval, overtaken=overtaken) == (() if stop is None else (stop,))


def test_late_odometry_lands_after_a_while() -> None:
    flight = Watched()
    assert set(flight.lasting(20, age=0.125)) == {()}, "as old as is allowed"
    late = Stop(LAND, "late", "setpoints answer to odometry that is 0.25 s old; 0.125 s are allowed")
    for _ in range(3):
        assert set(flight.lasting(5, age=0.25)) == {()}
        flight.look()
    assert flight.lasting(6, age=0.25) == [()] * 5 + [(late,)]


def test_odometry_that_came_late_counts_as_well_as_an_answer_that_left_late() -> None:
    flight = Watched()
    flight.odometry = flight.odometry._replace(age=0.25)
    assert [stop.kind for stop in sum(flight.lasting(6), ())] == ["late"]


def test_a_jump_that_the_estimator_did_not_tell_of_lands() -> None:
    flight = Watched()
    for moved, turned, kind, what in (
        ((0.75, 0.0, 0.0), 0.0, "position_jump", "the position jumped by 0.75 m (0.75, 0.00, 0.00)"),
        ((0.5, 0.0, 0.0), 0.5, "heading_jump", ""),
        ((0.0, 0.0, 0.0), -0.5, "heading_jump", "the heading jumped by -29 degrees"),
    ):
        reset = Reset(moved, turned, False)
        flight.reasons.reset = reset
        (stop,) = flight.look()
        assert (stop.act, stop.kind) == (LAND, kind)
        assert stop.text == f"{what or reset.text}, and the estimator told of no reset"
        assert flight.look() == (), "it is judged once"


@pytest.mark.parametrize(
    ("moved", "turned", "act", "says"),
    [
        ((1.0, 0.0, 0.0), 0.25, TELL, "; home and reference are carried over"),
        ((0.0, 0.0, 0.0), 0.0, TELL, ""),
        ((0.0, 0.0, 1.25), 0.0, LAND, ""),
        ((0.0, 0.0, 0.0), 0.26, LAND, ""),
        ((0.0, 0.0, 0.0), -0.26, LAND, ""),
    ],
)
def test_a_reset_that_the_estimator_told_of_is_carried_over_up_to_a_size(
    moved, turned, act: str, says: str
) -> None:
    flight = Watched()
    flight.reasons.reset = reset = Reset(moved, turned, True)
    text = f"the estimator was reset: {reset.text}{says}"
    assert flight.look() == (Stop(act, "estimator_reset", text),)


def test_sensors_that_disagree_with_the_odometry_land() -> None:
    assert Watched().look(disagrees="the gyroscope says otherwise") == (
        Stop(LAND, "odometry_disagrees", "the gyroscope says otherwise"),
    )


# Where it is


@pytest.mark.parametrize(
    ("position", "outside"),
    [
        ((3.0, -4.0, 1.0), False),  # on the fence
        ((0.0, 0.0, 4.0), False),
        ((3.0, -4.1, 1.0), True),
        ((-5.1, 0.0, 1.0), True),
        ((0.0, 0.0, 4.1), True),
    ],
)
def test_outside_the_fence_it_lands(position, outside: bool) -> None:
    found = Watched().look(position=position, reference=position)
    assert found == ((Stop(LAND, "geofence", "outside the geofence"),) if outside else ())


def test_too_far_from_its_reference_it_is_lost() -> None:
    assert Watched().look(position=(0.0, 0.0, 1.0), reference=(0.0, 2.0, 1.0)) == ()
    found = Watched().look(position=(0.0, 0.0, 1.0), reference=(0.0, 2.1, 1.0))
    assert found == (Stop(LAND, "lost", "more than 2 m from the reference"),)


# What it flies on


def test_a_battery_that_stays_low_brings_it_home() -> None:
    flight = Watched()
    low = Stop(RETURN, "battery_low", "battery at 11.9 V")
    flight.latest.battery_voltage = 12.0
    assert set(flight.lasting(40)) == {()}, "at three quarters of the nominal voltage"
    for _ in range(3):
        flight.latest.battery_voltage = 11.9
        assert set(flight.lasting(17)) == {()}
        flight.latest.battery_voltage = 12.1
        flight.look()
    flight.latest.battery_voltage = 11.9
    assert flight.lasting(18) == [()] * 17 + [(low,)]
    assert flight.look(phase=LANDING) == (), "it lands already"
    flight.latest.battery_voltage = 0.5
    assert [stop.kind for stop in flight.look()] == ["battery_low"], "however low it is"


def test_a_voltage_that_nobody_told_is_not_low() -> None:
    flight = Watched()
    flight.latest.battery_voltage = 0.0
    assert set(flight.lasting(40)) == {()}


# Several at once


def test_once_the_autopilot_is_asked_to_land_only_a_tumbling_vehicle_matters() -> None:
    flight = Watched()
    flight.reasons.reset = Reset((9.0, 0.0, 0.0), 0.0, False)
    everything = {"interval": 9.0, "position": (99.0, 0.0, 0.0), "age": 9.0, "disagrees": "x"}
    assert flight.look(land_asked=True, **everything) == ()
    assert flight.look() == (), "the reset was of then"


def test_the_first_reason_ends_the_flight_and_what_is_only_told_comes_before_it() -> None:
    flight = Watched()
    kinds = [
        stop.kind for stop in flight.look(interval=0.5, overtaken=1, position=(9.0, 0.0, 1.0), disagrees="x")
    ]
    assert kinds == ["stalled", "odometry_disagrees"]
    flight.reasons.reset = NOTHING_MOVED
    told = flight.look(interval=0.5, overtaken=1, position=(9.0, 0.0, 1.0))
    assert [(stop.act, stop.kind) for stop in told] == [
        (TELL, "stalled"),
        (TELL, "estimator_reset"),
        (LAND, "geofence"),
    ]
    flight.reasons.reset = Reset((9.0, 0.0, 0.0), 0.0, True)
    told = flight.look(interval=0.5, overtaken=1, disagrees="x")
    assert [(stop.act, stop.kind) for stop in told] == [(TELL, "stalled"), (LAND, "estimator_reset")]
    flight.reasons.reset = Reset((9.0, 0.0, 0.0), 0.0, True)
    assert [stop.kind for stop in flight.look(interval=0.5, disagrees="x")] == ["odometry_gap"]


def test_a_new_flight_begins_without_what_lasted_in_the_one_before() -> None:
    flight = Watched()
    flight.latest.battery_voltage = 11.0
    flight.lasting(13)
    flight.lasting(4, quaternion=tilted(2.0), age=0.25)
    flight.reasons.reset = NOTHING_MOVED
    flight.reasons.begin()
    assert set(flight.lasting(5, quaternion=tilted(2.0), age=0.25)) == {()}


# Before it flies


def test_a_reference_stays_above_ground_and_inside_the_fence_in_every_corner() -> None:
    path = trajectory("circle", radius=2.0, height=1.0)
    (x0, y0, _), (x1, y1, z1) = path.bounds
    assert SAFETY.check_trajectory(path) == ""
    corner = math.hypot(max(-x0, x1), max(-y0, y1))
    fits = replace(SAFETY, fence_radius=corner, fence_height=z1)
    assert fits.check_trajectory(path) == "", "up to the fence"
    radius = replace(fits, fence_radius=0.99 * corner)
    assert radius.check_trajectory(path) == (
        f"it may go {corner:.1f} m from home, the fence ends at {0.99 * corner:g} m"
    )
    height = replace(fits, fence_height=0.5)
    assert height.check_trajectory(path) == f"it climbs to {z1:.1f} m, the fence ends at 0.5 m"


@dataclass(frozen=True)
class Box:
    """A reference that fills a box, of which only the bounds are asked."""

    bounds: tuple[tuple[float, float, float], tuple[float, float, float]]


@pytest.mark.parametrize(
    ("low", "high", "reason"),
    [
        ((-3.0, 0.0, 0.05), (0.0, 4.0, 4.0), ""),
        ((0.0, -4.0, 1.0), (3.0, 0.0, 1.0), ""),
        ((0.0, 0.0, 0.04), (1.0, 1.0, 1.0), "it goes down to 0.04 m above ground; keep it above 0.05 m"),
        ((0.0, 0.0, 1.0), (1.0, 1.0, 4.5), "it climbs to 4.5 m, the fence ends at 4 m"),
        ((-3.1, 0.0, 1.0), (0.0, 4.0, 1.0), "it may go 5.1 m from home, the fence ends at 5 m"),
        ((-1.0, -4.0, 1.0), (3.1, 1.0, 1.0), "it may go 5.1 m from home, the fence ends at 5 m"),
        ((-1.0, -1.0, 1.0), (3.0, 4.1, 1.0), "it may go 5.1 m from home, the fence ends at 5 m"),
    ],
)
def test_a_box_of_references_is_judged_by_its_furthest_corner(low, high, reason: str) -> None:
    assert SAFETY.check_trajectory(Box((low, high))) == reason
