"""A tick of the flight record from what the control thread knows."""

from __future__ import annotations

from typing import NamedTuple

from trueflight.companion.latest import Latest
from trueflight.companion.odometry import Odometry
from trueflight.companion.outcome import Outcome
from trueflight.models.record_pb2 import Tick


class Known(NamedTuple):
    """What `Latest` said at a tick, where a tick tells of it."""

    battery_voltage: float
    rotor_speed: tuple[float, ...]
    flight_mode: str
    armed: bool
    specific_force: tuple[float, float, float] | None


def known_now(latest: Latest) -> Known:
    """What is known at this moment."""
    return Known(
        latest.battery_voltage, latest.rotor_speed, latest.flight_mode, latest.armed, latest.specific_force
    )


def make_tick(odometry: Odometry, latest: Known, outcome: Outcome, latency: float) -> Tick:
    """The protobuf tick; positions in the home frame, `latency` in s from odometry to the setpoint handed
    over.
    """
    tick = Tick(
        vehicle_time_us=odometry.vehicle_time_us,
        host_time_ns=odometry.host_time_ns,
        battery_voltage=latest.battery_voltage,
        rotor_speed=latest.rotor_speed,
        flight_mode=latest.flight_mode,
        armed=latest.armed,
        phase=outcome.phase,
        guard=outcome.guard,
        controller=outcome.controller,
        model=outcome.model,
        trajectory=outcome.trajectory,
        interval=outcome.interval,
        latency=latency,
        age=outcome.age,
        overtaken=odometry.overtaken,
        inference=outcome.inference,
        setpoint_sent=outcome.step is not None,
        shadow=outcome.shadow,
    )
    if outcome.learning is not None:
        outcome.learning.write(tick)
    if outcome.shadow:
        _set(tick.shadow_raw, outcome.shadow_raw)
    _set(tick.position, outcome.position)
    _set(tick.velocity, odometry.velocity)
    _set(tick.angular_velocity, odometry.angular_velocity)
    q = tick.quaternion
    q.w, q.x, q.y, q.z = odometry.quaternion
    force = latest.specific_force
    if force is not None:
        _set(tick.specific_force, force)
    reference, step = outcome.reference, outcome.step
    if reference is not None:
        _set(tick.position_reference, reference.position)
        _set(tick.velocity_reference, reference.velocity)
        _set(tick.acceleration_reference, reference.acceleration)
        tick.yaw_reference = reference.yaw
    if step is not None:
        tick.feedback.thrust = step.feedback.thrust
        _set(tick.feedback.body_rate, step.feedback.body_rate)
        _set(tick.correction, step.correction)
        _set(tick.correction_raw, step.correction_raw)
        _set(tick.trim, step.trim)
        _set(tick.body_rate_command, step.command.body_rate)
        tick.thrust_command = step.thrust_command
    return tick


def _set(vector, values: tuple[float, float, float]) -> None:  # type: ignore[no-untyped-def]
    vector.x, vector.y, vector.z = values
