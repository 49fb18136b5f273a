"""What the flight makes of odometry that is old, stands still or jumps, and of a mode that nobody told."""

from __future__ import annotations

import math

import pytest
from test_flight import Rig, fly, kinds

from trueflight.companion.outcome import LANDING, MISSION, SILENT
from trueflight.companion.stopping import Safety


def hovering() -> Rig:
    rig = Rig()
    rig.take_off(fly("hover", duration=60.0))
    rig.until(MISSION)
    rig.run(1.0)
    return rig


def test_odometry_that_stays_late_lands_and_a_single_late_one_does_not() -> None:
    rig = hovering()
    rig.age = 0.15
    rig.run(0.2)
    rig.age = 0.01
    rig.run(1.0)
    assert rig.flight.phase == MISSION
    rig.age = 0.15
    rig.run(0.5)
    assert rig.flight.phase == LANDING
    assert kinds(rig)[-1] == "late"


def test_nothing_answers_to_stale_odometry_and_nothing_follows() -> None:
    rig = hovering()
    rig.age = 0.6
    assert rig.tick().step is None
    assert rig.flight.phase == SILENT
    rig.age = 0.0
    assert all(out.step is None for out in rig.run(1.0))


def test_a_setpoint_that_took_too_long_does_not_leave() -> None:
    rig = hovering()
    sent = rig.flight.sent
    out = rig.tick()
    assert out.step is not None
    assert not rig.flight.may_leave(out, 2.0)
    assert out.step is None
    assert rig.flight.sent == sent
    assert rig.flight.phase == SILENT
    assert all(out.step is None for out in rig.run(1.0))


def test_nothing_is_sent_while_nobody_tells_the_mode() -> None:
    rig = hovering()
    rig.latest.mode_time_us = rig.time_us
    # PX4's HEARTBEAT comes once a second, and CURRENT_MODE, which 1.14 has not, twice.
    assert all(out.step is not None for out in rig.run(2.5))
    assert rig.tick().step is None
    rig.latest.mode_time_us = rig.time_us
    assert rig.tick().step is not None
    assert rig.flight.phase == MISSION


def test_after_a_lost_link_nothing_is_sent_before_the_mode_is_told() -> None:
    """The autopilot has long taken over, and its odometry may be back sooner than its mode."""
    rig = hovering()
    rig.latest.mode_time_us = rig.time_us
    assert rig.tick(600_000).step is None
    assert all(out.step is None for out in rig.run(0.3))
    assert ("odometry_gap", "odometry was missing for 0.60 s: landing here") in rig.events
    rig.latest.mode_time_us = rig.time_us
    assert rig.tick().step is not None, "it is in Offboard still, and lands"


def test_odometry_that_stands_still_ends_the_flight() -> None:
    rig = hovering()
    rig.still = True
    rig.run(0.4)
    assert rig.flight.phase == LANDING
    assert kinds(rig)[-1] == "odometry_disagrees"


@pytest.mark.parametrize("moved", [(0.9, 0.0, 0.0), (0.0, -0.5, 0.0), (0.3, 0.2, 0.8), (0.0, 0.0, -0.9)])
@pytest.mark.parametrize("turned", [0.0, 0.2, -0.3])
def test_a_reset_that_is_told_is_carried_over(moved: tuple[float, float, float], turned: float) -> None:
    """The same commands after the reset as before: home and the reference's heading have moved along."""
    rig, undisturbed = hovering(), hovering()
    rig.moved, rig.turned, rig.counter = moved, turned, 3
    for _ in range(50):
        out, expected = rig.tick(), undisturbed.tick()
        assert out.step is not None and expected.step is not None
        assert out.position == pytest.approx(expected.position, abs=1e-5)  # the tremble of what is told
        assert out.step.command.thrust == pytest.approx(expected.step.command.thrust, abs=1e-3)
        assert out.step.command.body_rate == pytest.approx(expected.step.command.body_rate, abs=1e-3)
    assert rig.flight.phase == MISSION
    assert kinds(rig)[-1] == "estimator_reset"


@pytest.mark.parametrize(
    ("moved", "turned", "counter", "kind"),
    [
        ((0.0, 0.0, 2.0), 0.0, 1, "estimator_reset"),
        ((0.0, 0.0, 0.0), 0.6, 1, "estimator_reset"),
        ((0.0, 0.0, 0.9), 0.0, 0, "position_jump"),
        ((0.4, 0.0, 0.0), 0.0, 0, "position_jump"),
        ((0.0, 0.0, 0.0), 0.6, 0, "heading_jump"),
    ],
)
def test_a_jump_that_is_too_large_or_untold_lands_here(
    moved: tuple[float, float, float], turned: float, counter: int, kind: str
) -> None:
    rig = hovering()
    before = list(rig.position)
    rig.moved, rig.turned, rig.counter = moved, turned, counter
    rig.run(2.0)  # no autopilot takes over here: the flight holds what it takes for the spot
    assert rig.flight.phase == LANDING
    assert kinds(rig)[-1] == kind
    assert math.dist(rig.position, before) < 0.1, "the vehicle did not follow the jump"


def test_a_moving_vehicle_is_no_jump() -> None:
    rig = Rig(Safety(fence_radius=20.0))
    rig.take_off(fly("lemniscate", speed=3.0))
    rig.until(LANDING)
    assert "position_jump" not in kinds(rig)
