"""The linear cascade of the paper, in plain floats: position and attitude in, thrust and body rates out.

Position loop (16): `u* = -K_eta eta + inv(A_zeta) x2ref_dot` with `eta` and the reference acceleration turned
into the heading frame and the weight added to the thrust. Attitude loop (13): `zeta_dot = -K_zeta (zeta -
zeta_ref)` with the yaw error wrapped. The paper then sets `Omega = zeta_dot`, which holds at hover only; here
the Euler rates are turned into body rates exactly (Diebel 2006, equation 79), so that a banked vehicle still
turns as the linear design says.

Source: Carvalho, Susbielle, Hably, Dibangoye, Marchand, "Neural Enhanced Control for Quadrotor Linear
Behavior Fitting", ICUAS 2022. World ENU, body FLU, SI units, radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from trueflight.models.design import Design, Matrix
from trueflight.models.trajectory import ReferenceSample
from trueflight.models.vehicle import GRAVITY, Vehicle

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)


class State(NamedTuple):
    """What the loop needs to know of the vehicle.

    Position (m) and velocity (m/s) in the world from any origin that the reference shares, attitude as w, x,
    y, z body to world, height above ground in m, battery voltage in V (0 where unknown), body rates in rad/s and
    the accelerometer's specific force in m/s², both body axes (None where unknown).
    """

    position: Vector
    velocity: Vector
    quaternion: tuple[float, float, float, float]
    height: float
    battery_voltage: float
    angular_velocity: Vector = ZERO
    specific_force: Vector | None = None


class Attitude(NamedTuple):
    """Output of the position loop, the paper's u: roll and pitch in rad, collective thrust in N."""

    roll: float
    pitch: float
    thrust: float


class Command(NamedTuple):
    """Collective thrust in N and body rates in rad/s (FLU)."""

    thrust: float
    body_rate: Vector


@dataclass(frozen=True)
class Limits:
    """What the cascade may ask for: tilt in rad, rates in rad/s, thrust as multiples of the weight."""

    tilt: float = 0.7
    body_rate: float = 6.0
    yaw_rate: float = 2.5
    thrust_low: float = 0.1
    thrust_high: float = 2.2


class ControlStep(NamedTuple):
    """One tick of the law: what the cascade alone would do, the correction, and what goes out.

    `thrust_command` is the normalised collective (0 to 1) of `command.thrust`. `correction` and
    `correction_raw` are error accelerations in m/s², heading frame: all that was applied, and what the live model
    returned. `trim` is the part of the correction that comes from the disturbance observer and the slow trim, not
    from a model.
    """

    feedback: Command
    correction: Vector
    correction_raw: Vector
    command: Command
    thrust_command: float
    trim: Vector = ZERO


IDLE_STEP = ControlStep(Command(0.0, ZERO), ZERO, ZERO, Command(0.0, ZERO), 0.0)
"""No thrust and no rates: what is streamed on the ground before arming."""


def euler(quaternion: tuple[float, float, float, float]) -> Vector:
    """Roll, pitch, yaw in rad (Z-Y-X) of a unit quaternion w, x, y, z; as `models.frames`, for one sample."""
    w, x, y, z = quaternion
    sine = min(1.0, max(-1.0, 2.0 * (w * y - x * z)))
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(sine),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def world_from_body(quaternion: tuple[float, float, float, float], vector: Vector) -> Vector:
    """A vector in body axes turned into the world by the unit quaternion w, x, y, z; as `models.frames.rotate`."""
    w, x, y, z = quaternion
    vx, vy, vz = vector
    # R v = v + 2 q x (q x v + w v)
    a, b, c = y * vz - z * vy + w * vx, z * vx - x * vz + w * vy, x * vy - y * vx + w * vz
    return vx + 2.0 * (y * c - z * b), vy + 2.0 * (z * a - x * c), vz + 2.0 * (x * b - y * a)


def features(
    state: State, yaw: float, attitude: Attitude, voltage: float, wants_yaw: bool = False
) -> list[float]:
    """Features (28) of the paper at the control `attitude`, in the order of `models.contract.FEATURES`."""
    c, s = math.cos(yaw), math.sin(yaw)
    vx, vy, vz = state.velocity
    out = [
        state.height,
        math.cos(attitude.roll),
        math.sin(attitude.roll),
        math.cos(attitude.pitch),
        math.sin(attitude.pitch),
        c * vx + s * vy,
        -s * vx + c * vy,
        vz,
        voltage,
        attitude.thrust,
    ]
    if wants_yaw:
        out += (c, s)
    return out


class ControlLaw:
    """The cascade for one vehicle and one design, with or without a correction.

    It holds no state of its own: what changes from tick to tick is in `companion.law.controllers`. Raises
    `InputError` where the design belongs to another vehicle.
    """

    def __init__(self, vehicle: Vehicle, design: Design, limits: Limits | None = None) -> None:
        design.check(vehicle)
        self.vehicle = vehicle
        self.limits = limits if limits is not None else Limits()
        self.design = design
        self._k_eta = design.K_eta
        self._k_zeta = design.K_zeta
        self._weight = vehicle.weight
        self._thrust_low = self.limits.thrust_low * vehicle.weight
        # Full collective is the most a vehicle has; keep a little so that the mixer can still turn it.
        full = 0.95 * float(vehicle.thrust(1.0))  # type: ignore[arg-type]
        self._thrust_high = min(self.limits.thrust_high * vehicle.weight, full)

    def feedback(
        self,
        state: State,
        yaw: float,
        reference: ReferenceSample,
        gains: Matrix | None = None,
        more: Vector = ZERO,
    ) -> Attitude:
        """Position loop: roll, pitch and thrust that the linear design asks for, within the limits.

        `gains` (3, 6) replace `K_eta`; `more` (rad, rad, N) is added to what they give.
        """
        c, s = math.cos(yaw), math.sin(yaw)
        (px, py, pz), (rx, ry, rz) = state.position, reference.position
        (vx, vy, vz), (wx, wy, wz) = state.velocity, reference.velocity
        ax, ay, az = reference.acceleration
        ex, ey = px - rx, py - ry
        dx, dy = vx - wx, vy - wy
        x, y, z = c * ex + s * ey, c * ey - s * ex, pz - rz
        u, v, w = c * dx + s * dy, c * dy - s * dx, vz - wz
        k = gains if gains is not None else self._k_eta
        a, b, d = k[0], k[1], k[2]
        roll = -(a[0] * x + a[1] * y + a[2] * z + a[3] * u + a[4] * v + a[5] * w)
        pitch = -(b[0] * x + b[1] * y + b[2] * z + b[3] * u + b[4] * v + b[5] * w)
        thrust = -(d[0] * x + d[1] * y + d[2] * z + d[3] * u + d[4] * v + d[5] * w)
        # inv(A_zeta): pitch forward accelerates along x, roll accelerates against y.
        roll -= (c * ay - s * ax) / GRAVITY
        pitch += (c * ax + s * ay) / GRAVITY
        return self.limited(
            roll + more[0], pitch + more[1], self._weight + thrust + self.vehicle.mass * az + more[2]
        )

    def corrected(self, attitude: Attitude, delta: Vector) -> Attitude:
        """(22): `u* - inv(A_zeta) delta` with `delta` in m/s², heading frame, within the limits."""
        return self.limited(
            attitude.roll + delta[1] / GRAVITY,
            attitude.pitch - delta[0] / GRAVITY,
            attitude.thrust - self.vehicle.mass * delta[2],
        )

    def command(self, zeta: Vector, attitude: Attitude, yaw_reference: float) -> Command:
        """Attitude loop: body rates that take roll, pitch, yaw `zeta` (rad) to the ones asked for."""
        return self.turning(zeta, self.euler_rates(zeta, attitude, yaw_reference), attitude.thrust)

    def euler_rates(self, zeta: Vector, attitude: Attitude, yaw_reference: float) -> Vector:
        """(13): rates of roll, pitch and yaw (rad/s) that take `zeta` (rad) to the attitude asked for."""
        ex, ey = zeta[0] - attitude.roll, zeta[1] - attitude.pitch
        ez = (zeta[2] - yaw_reference + math.pi) % (2.0 * math.pi) - math.pi
        a, b, d = self._k_zeta
        return (
            -(a[0] * ex + a[1] * ey + a[2] * ez),
            -(b[0] * ex + b[1] * ey + b[2] * ez),
            -(d[0] * ex + d[1] * ey + d[2] * ez),
        )

    def turning(self, zeta: Vector, rates: Vector, thrust: float) -> Command:
        """Thrust (N) and the body rates that give these rates of roll, pitch, yaw (rad/s) at `zeta`, limited."""
        roll, pitch, _ = zeta
        rate_x, rate_y, rate_z = rates
        sr, cr = math.sin(roll), math.cos(roll)
        sp, cp = math.sin(pitch), math.cos(pitch)
        limit, yaw_limit = self.limits.body_rate, self.limits.yaw_rate
        return Command(
            thrust,
            (
                _clip(rate_x - sp * rate_z, limit),
                _clip(cr * rate_y + sr * cp * rate_z, limit),
                _clip(-sr * rate_y + cr * cp * rate_z, yaw_limit),
            ),
        )

    def step(self, state: State, reference: ReferenceSample) -> ControlStep:
        """One tick of the cascade alone."""
        zeta = euler(state.quaternion)
        plain = self.command(zeta, self.feedback(state, zeta[2], reference), reference.yaw)
        return ControlStep(plain, ZERO, ZERO, plain, self.normalised(plain.thrust))

    def at_limit(self, attitude: Attitude) -> bool:
        """Whether the limits leave no more of tilt or thrust than this."""
        return (
            math.hypot(attitude.roll, attitude.pitch) >= 0.999 * self.limits.tilt
            or not self._thrust_low < attitude.thrust < self._thrust_high
        )

    @property
    def thrust_limits(self) -> tuple[float, float]:
        """The least and the greatest thrust that is asked for, N."""
        return self._thrust_low, self._thrust_high

    def normalised(self, thrust: float) -> float:
        """Normalised collective command (0 to 1) believed to give `thrust` in N."""
        return min(1.0, max(0.0, self.vehicle.command(thrust)))

    def limited(self, roll: float, pitch: float, thrust: float) -> Attitude:
        """Roll and pitch (rad) within the tilt limit, thrust (N) within what the vehicle should give."""
        tilt = math.hypot(roll, pitch)
        if tilt > self.limits.tilt:  # keep the direction: a clipped axis would push the vehicle off its line
            roll, pitch = roll * self.limits.tilt / tilt, pitch * self.limits.tilt / tilt
        low, high = self._thrust_low, self._thrust_high
        if not low <= thrust <= high:  # true for NaN as well: the least thrust then
            thrust = high if thrust > high else low
        return Attitude(roll, pitch, thrust)


def _clip(value: float, limit: float) -> float:
    return value if -limit <= value <= limit else limit if value > limit else -limit  # -limit for NaN
