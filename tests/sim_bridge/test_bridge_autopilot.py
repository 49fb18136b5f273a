"""Modes, arming, failsafes and landing, in simulated time and without a network."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.autopilot import Autopilot, Verdict
from trueflight.sim_bridge.land_detector import Landed
from trueflight.sim_bridge.mavlink.server import pilot_order
from trueflight.sim_bridge.modes import Mode
from trueflight.sim_bridge.parameters import Parameters
from trueflight.sim_bridge.position_control import MotionSetpoint, RateSetpoint, Setpoint, yaw_of
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.truth.hidden import choose


def autopilot(vehicle: Vehicle, hidden: str = "none", **parameters: float) -> Autopilot:
    simulator = Simulator(vehicle, choose([hidden], vehicle, 1), seed=1)
    made = Autopilot(simulator, Parameters(vehicle))
    for name, value in parameters.items():
        assert made.parameters.set(name, value)
    run(made, 1.2)
    return made


def run(pilot: Autopilot, seconds: float, setpoint: Setpoint | None = None) -> None:
    """Let time pass; a setpoint is streamed at 50 Hz."""
    for i in range(round(seconds * 500)):
        if setpoint is not None and i % 10 == 0:
            pilot.offboard(setpoint)
        pilot.step()


def until(pilot: Autopilot, condition: Callable[[], bool], limit: float) -> float:
    """Simulated seconds until a condition holds."""
    begin = pilot.time_us
    while not condition():
        assert pilot.time_us - begin < limit * 1e6, "the condition did not come true"
        pilot.step()
    return (pilot.time_us - begin) * 1e-6


def hovering(vehicle: Vehicle, hidden: str = "none", **parameters: float) -> Autopilot:
    made = autopilot(vehicle, hidden, **parameters)
    assert made.arm() is Verdict.ACCEPTED
    assert made.takeoff() is Verdict.ACCEPTED
    until(made, lambda: made.mode is Mode.HOLD, 10.0)
    run(made, 2.0)
    return made


def offboard(vehicle: Vehicle, **parameters: float) -> Autopilot:
    made = hovering(vehicle, **parameters)
    x, y, z = made.simulator.estimate().position
    setpoint = MotionSetpoint((x, y, z), yaw=0.0)
    made.offboard(setpoint)
    assert made.set_mode(Mode.OFFBOARD) is Verdict.ACCEPTED
    run(made, 0.5, setpoint)
    return made


@pytest.mark.parametrize(
    "hidden", ["none", "thrust_gain:0.85", "motor_lag:0.058", "transport_delay:0.036", "wind:5"]
)
def test_takeoff_hold_and_land_work_whatever_is_hidden(vehicle: Vehicle, hidden: str) -> None:
    made = hovering(vehicle, hidden)
    run(made, 3.0)
    now = made.simulator.estimate()
    assert now.position[2] - made.home[2] == pytest.approx(made.parameters["MIS_TAKEOFF_ALT"], abs=0.35)
    assert made.landed is Landed.IN_AIR
    made.set_mode(Mode.LAND)
    run(made, 0.2)
    assert made.landed is Landed.LANDING
    until(made, lambda: made.landed is Landed.ON_GROUND, 12.0)
    took = until(made, lambda: not made.armed, 4.0)
    assert took == pytest.approx(made.parameters["COM_DISARM_LAND"], abs=0.05)
    assert made.simulator.world.touching


def test_offboard_needs_a_stream(vehicle: Vehicle) -> None:
    made = hovering(vehicle)
    assert made.set_mode(Mode.OFFBOARD) is Verdict.TEMPORARILY_REJECTED
    assert made.mode is Mode.HOLD
    made.offboard(MotionSetpoint((0.0, 0.0, 2.0)))
    run(made, 1.5)  # longer ago than COM_OF_LOSS_T
    assert made.set_mode(Mode.OFFBOARD) is Verdict.TEMPORARILY_REJECTED


def test_offboard_follows_position_and_yaw(vehicle: Vehicle) -> None:
    made = offboard(vehicle)
    run(made, 6.0, MotionSetpoint((1.0, -2.0, 3.0), yaw=2.0))
    now = made.simulator.estimate()
    assert now.position == pytest.approx((1.0, -2.0, 3.0), abs=0.15)
    assert yaw_of(now.quaternion) == pytest.approx(2.0, abs=0.05)


def test_offboard_follows_velocity(vehicle: Vehicle) -> None:
    made = offboard(vehicle)
    nan = float("nan")
    run(made, 3.0, MotionSetpoint((nan, nan, nan), (1.0, 0.5, 0.2), yaw=0.0))
    assert made.simulator.estimate().velocity == pytest.approx((1.0, 0.5, 0.2), abs=0.1)


def test_a_rate_setpoint_acts_in_the_next_step(vehicle: Vehicle) -> None:
    made = offboard(vehicle)
    made.offboard(RateSetpoint(0.5, (0.1, 0.2, 0.3)))
    made.step()
    assert (made.thrust, made.rates) == (0.5, (0.1, 0.2, 0.3))


@pytest.mark.parametrize(
    ("action", "mode"),
    [(0, Mode.LAND), (3, Mode.RTL), (4, Mode.LAND), (5, Mode.HOLD)],
)
def test_silence_ends_offboard_after_the_timeout(vehicle: Vehicle, action: int, mode: Mode) -> None:
    made = offboard(vehicle, COM_OF_LOSS_T=0.5, COM_OBL_RC_ACT=action)
    took = until(made, lambda: made.mode is not Mode.OFFBOARD, 2.0)
    assert took == pytest.approx(0.5, abs=0.04)  # the last setpoint is up to 20 ms old
    assert made.mode is mode
    assert made.failsafe
    if action == 4:
        until(made, lambda: not made.armed, 15.0)
        assert made.simulator.world.touching


def test_silence_with_a_pilot_present_gives_him_position_mode(vehicle: Vehicle) -> None:
    made = offboard(vehicle)
    made.pilot_present = True
    until(made, lambda: made.mode is not Mode.OFFBOARD, 2.0)
    assert made.mode is Mode.POSCTL


def test_setpoints_that_come_back_do_not_take_over_again(vehicle: Vehicle) -> None:
    made = offboard(vehicle, COM_OBL_RC_ACT=4)
    until(made, lambda: made.mode is Mode.LAND, 2.0)
    run(made, 0.5, RateSetpoint(0.5, (0.0, 0.0, 0.0)))
    assert made.mode is Mode.LAND


def test_the_pilot_wins(vehicle: Vehicle) -> None:
    made = offboard(vehicle)
    assert pilot_order(made, "POSCTL")["accepted"]
    before = made.simulator.estimate().position
    run(made, 2.0, RateSetpoint(1.0, (3.0, 0.0, 0.0)))  # a companion that does not stop
    assert made.mode is Mode.POSCTL
    assert made.simulator.estimate().position == pytest.approx(before, abs=0.3)
    assert not pilot_order(made, "SIDEWAYS")["accepted"]


def test_kill_stops_the_motors_in_the_air_for_good(vehicle: Vehicle) -> None:
    made = hovering(vehicle)
    pilot_order(made, "KILL")
    run(made, 0.5)
    assert not made.armed
    assert max(made.simulator.airframe.motion.speeds) < 0.1 * made.simulator.airframe.speed_of(0.38)
    assert made.arm(force=True) is Verdict.TEMPORARILY_REJECTED


def test_disarming_is_denied_in_the_air_unless_forced(vehicle: Vehicle) -> None:
    made = hovering(vehicle)
    assert made.disarm() is Verdict.DENIED
    assert made.armed
    assert made.disarm(force=True) is Verdict.ACCEPTED
    assert not made.armed


def test_arming_is_denied_with_its_reason(vehicle: Vehicle) -> None:
    made = Autopilot(Simulator(vehicle), Parameters(vehicle))
    assert made.arm() is Verdict.TEMPORARILY_REJECTED
    assert "position estimate" in made.notices[-1][1]
    run(made, 1.2)
    made.set_mode(Mode.POSCTL)
    assert made.arm() is Verdict.TEMPORARILY_REJECTED
    assert "manual control" in made.notices[-1][1]
    made.set_mode(Mode.HOLD)
    assert made.arm() is Verdict.ACCEPTED


def test_an_armed_vehicle_that_does_not_take_off_disarms(vehicle: Vehicle) -> None:
    made = autopilot(vehicle)
    made.arm()
    took = until(made, lambda: not made.armed, 15.0)
    assert took == pytest.approx(made.parameters["COM_DISARM_PRFLT"], abs=0.05)


def test_return_comes_home_and_lands(vehicle: Vehicle) -> None:
    made = offboard(vehicle)
    run(made, 6.0, MotionSetpoint((3.0, 2.0, 2.5), yaw=0.0))
    made.set_mode(Mode.RTL)
    until(made, lambda: not made.armed, 60.0)
    x, y, _ = made.simulator.estimate().position
    assert (x, y) == pytest.approx(made.home[:2], abs=0.7)
