"""PX4's own multicopter position and attitude control, with its default gains.

Position P, velocity PID with feed-forward, acceleration turned into thrust by exact rotation, attitude P on the
quaternion with tilt before yaw, and the estimator of the thrust that hovers, where there is an accelerometer. The
limits are those of this project's cascade, so that no controller has more room than another.

Source: PX4 1.17, `PositionControl.cpp`, `AttitudeControl.cpp` and their parameters' defaults; Brescianini, Hehn,
D'Andrea, "Nonlinear quadrocopter attitude control", ETH Zurich 2013.
"""

from __future__ import annotations

import math

from trueflight.companion.law.control import (
    ZERO,
    Attitude,
    Command,
    ControlLaw,
    ControlStep,
    State,
    Vector,
    euler,
    world_from_body,
)
from trueflight.companion.law.hover_thrust import HoverThrust
from trueflight.companion.law.outer_loop import LONGEST_STEP, LowPass, OuterLoop, errors
from trueflight.companion.law.steps import Preview
from trueflight.models.trajectory import ReferenceSample
from trueflight.models.vehicle import GRAVITY

POSITION = (0.95, 0.95, 1.0)  # MPC_XY_P, MPC_Z_P, 1/s
VELOCITY = (1.8, 1.8, 4.0)  # MPC_XY_VEL_P_ACC, MPC_Z_VEL_P_ACC, 1/s
INTEGRAL = (0.4, 0.4, 2.0)  # MPC_XY_VEL_I_ACC, MPC_Z_VEL_I_ACC, 1/s²
DERIVATIVE = (0.2, 0.2, 0.0)  # MPC_XY_VEL_D_ACC, MPC_Z_VEL_D_ACC
SLOPE_FREQUENCY = 5.0  # MPC_VELD_LP, Hz
TURNING = (6.5, 6.5, 2.8)  # MC_ROLL_P, MC_PITCH_P, MC_YAW_P, 1/s
YAW_WEIGHT = 0.4  # MC_YAW_WEIGHT
IN_THE_AIR = 1.0  # m above the ground, from which on the thrust that hovers is estimated

Quaternion = tuple[float, float, float, float]


class Px4Cascade:
    """One flight of it."""

    def __init__(self, law: ControlLaw) -> None:
        self._law, self._loop = law, OuterLoop(law)
        self._integral = ZERO
        self._slope = LowPass(SLOPE_FREQUENCY)
        self._velocity: Vector | None = None
        self._hover = HoverThrust(law.vehicle.hover_thrust)
        # Of the last tick: acceleration up (m/s²), vertical command (normalised).
        self._asked_up = self._lift = 0.0
        self._flew = False

    def start(self) -> None:
        """Nothing: the integral has learned in the climb."""

    def stop(self) -> None:
        """Nothing."""

    def step(self, state: State, preview: Preview, dt: float) -> ControlStep:
        """One tick."""
        law, reference, zeta = self._law, preview(0.0), euler(state.quaternion)
        dt = min(LONGEST_STEP, max(0.0, dt))
        self._hovers(state, dt)
        asked, error = self._asked(state, reference, dt)
        attitude = self._lifted(self._loop.attitude(asked, zeta[2]))
        self._asked_up = asked[2]
        if not law.at_limit(attitude):
            x, y, z = (i + dt * k * e for i, k, e in zip(self._integral, INTEGRAL, error, strict=True))
            self._integral = (x, y, min(GRAVITY, max(-GRAVITY, z)))
        rates = _turning(state.quaternion, _quaternion(attitude.roll, attitude.pitch, reference.yaw))
        limit, yaw_limit = law.limits.body_rate, law.limits.yaw_rate
        p, q, r = rates
        command = Command(
            attitude.thrust,
            (
                min(limit, max(-limit, p)),
                min(limit, max(-limit, q)),
                min(yaw_limit, max(-yaw_limit, r)),
            ),
        )
        return ControlStep(command, ZERO, ZERO, command, law.normalised(command.thrust))

    def _hovers(self, state: State, dt: float) -> None:
        """Learn what hovers, and keep the thrust as it is: what the new value changes goes into the integral."""
        self._flew = self._flew or state.height > IN_THE_AIR
        if not self._flew or state.specific_force is None or dt <= 0.0:
            return
        before = self._hover.value
        up = world_from_body(state.quaternion, state.specific_force)[2] - GRAVITY
        self._hover.step(up, self._lift, state.velocity, dt)
        x, y, z = self._integral
        z += (self._asked_up + GRAVITY) * (before / self._hover.value - 1.0)
        self._integral = (x, y, min(GRAVITY, max(-GRAVITY, z)))

    def _lifted(self, attitude: Attitude) -> Attitude:
        """An attitude with the thrust by which the vehicle gives what was asked for, as far as is known."""
        vehicle = self._law.vehicle
        thrust = attitude.thrust * self._hover.value / vehicle.hover_thrust
        limited = self._law.limited(attitude.roll, attitude.pitch, thrust)
        upright = math.cos(limited.roll) * math.cos(limited.pitch)
        self._lift = vehicle.hover_thrust * limited.thrust * upright / vehicle.weight
        return limited

    def _asked(self, state: State, reference: ReferenceSample, dt: float) -> tuple[Vector, Vector]:
        """Acceleration asked for (m/s², world), and the error of the velocity (m/s)."""
        off, _ = errors(state, reference)
        if dt > 0.0 and self._velocity is not None:
            u, v, w = (n - b for n, b in zip(state.velocity, self._velocity, strict=True))
            slope = self._slope.step((u / dt, v / dt, w / dt), dt)
        else:
            slope = ZERO
        self._velocity = state.velocity
        error = tuple(
            want - k * e - v
            for want, k, e, v in zip(reference.velocity, POSITION, off, state.velocity, strict=True)
        )
        x, y, z = (
            k * e + i - d * s + a
            for k, e, i, d, s, a in zip(
                VELOCITY, error, self._integral, DERIVATIVE, slope, reference.acceleration, strict=True
            )
        )
        return (x, y, z), (error[0], error[1], error[2])


def _turning(now: Quaternion, wanted: Quaternion) -> Vector:
    """Body rates (rad/s) from one attitude to another, tilt first: yaw is left for what its weight allows."""
    tilted = _shortest(_z_axis(now), _z_axis(wanted))
    reduced = _product(tilted, now)
    # What is left after the tilt is a turn about z.
    mix = _product(_conjugate(reduced), wanted)
    if mix[0] < 0.0:
        mix = (-mix[0], -mix[1], -mix[2], -mix[3])
    w, z = min(1.0, max(-1.0, mix[0])), min(1.0, max(-1.0, mix[3]))
    turn = (math.cos(YAW_WEIGHT * math.acos(w)), 0.0, 0.0, math.sin(YAW_WEIGHT * math.asin(z)))
    error = _product(_conjugate(now), _product(reduced, turn))
    sign = 2.0 if error[0] >= 0.0 else -2.0
    a, b, c = TURNING
    # PX4 scales the yaw gain by the inverse of its weight, so that small errors turn as the gain says.
    return sign * a * error[1], sign * b * error[2], sign * c / YAW_WEIGHT * error[3]


def _z_axis(q: Quaternion) -> Vector:
    w, x, y, z = q
    return 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)


def _shortest(one: Vector, other: Vector) -> Quaternion:
    """The shortest rotation from one unit vector to another that is not its opposite."""
    (a, b, c), (x, y, z) = one, other
    w = 1.0 + a * x + b * y + c * z
    u, v, t = b * z - c * y, c * x - a * z, a * y - b * x
    size = math.sqrt(w * w + u * u + v * v + t * t)
    return (1.0, 0.0, 0.0, 0.0) if size < 1e-6 else (w / size, u / size, v / size, t / size)


def _product(p: Quaternion, q: Quaternion) -> Quaternion:
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def _conjugate(q: Quaternion) -> Quaternion:
    w, x, y, z = q
    return w, -x, -y, -z


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
