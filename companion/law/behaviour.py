"""The expected linear behaviour, beside the flight: where the vehicle would be if it were its linear design.

The nine states (xi, v, zeta) of the hover linearisation (9) under the attitude loop (13) and the position loop
(16) of the paper, driven by the same reference from the same start.
"""

from __future__ import annotations

import math

from trueflight.models.design import Design
from trueflight.models.trajectory import ReferenceSample
from trueflight.models.vehicle import GRAVITY

Vector = tuple[float, float, float]

LONGEST_GAP = 0.1
"""s; longer steps are cut, so that a gap in the odometry cannot make the integration unstable."""


class LinearBehaviour:
    """The linear closed loop from a start, one step a tick; `position` (m) and `velocity` (m/s) in the world."""

    def __init__(
        self, design: Design, position: Vector, velocity: Vector, zeta: Vector, reference: ReferenceSample
    ) -> None:
        self.position, self.velocity = position, velocity
        self._zeta = zeta
        self._k_eta, self._k_zeta, self._mass = design.K_eta, design.K_zeta, design.mass
        self._reference = reference

    def step(self, reference: ReferenceSample, dt: float) -> None:
        """Go on by `dt` s to the time of `reference`; in between, references run linearly (midpoint rule)."""
        dt = min(LONGEST_GAP, max(0.0, dt))
        before, self._reference = self._reference, reference
        position, velocity, zeta = self.position, self.velocity, self._zeta
        half = 0.5 * dt
        acceleration, turning = self._slope(position, velocity, zeta, before)
        midway = _moved(velocity, acceleration, half)
        acceleration, turning = self._slope(
            _moved(position, velocity, half), midway, _moved(zeta, turning, half), _halfway(before, reference)
        )
        self.position = _moved(position, midway, dt)
        self.velocity = _moved(velocity, acceleration, dt)
        self._zeta = _moved(zeta, turning, dt)

    def _slope(
        self, position: Vector, velocity: Vector, zeta: Vector, wanted: ReferenceSample
    ) -> tuple[Vector, Vector]:
        """Acceleration (m/s², world) and the rates of roll, pitch and yaw (rad/s)."""
        (px, py, pz), (rx, ry, rz) = position, wanted.position
        (vx, vy, vz), (ux, uy, uz) = velocity, wanted.velocity
        ax, ay, az = wanted.acceleration
        roll, pitch, yaw = zeta
        c, s = math.cos(yaw), math.sin(yaw)
        ex, ey, dx, dy = px - rx, py - ry, vx - ux, vy - uy
        e = (c * ex + s * ey, c * ey - s * ex, pz - rz, c * dx + s * dy, c * dy - s * dx, vz - uz)
        k_roll, k_pitch, k_lift = self._k_eta
        wanted_roll = -_product(k_roll, e) - (c * ay - s * ax) / GRAVITY
        wanted_pitch = -_product(k_pitch, e) + (c * ax + s * ay) / GRAVITY
        lift = -_product(k_lift, e) / self._mass + az
        zx, zy = roll - wanted_roll, pitch - wanted_pitch
        zz = (yaw - wanted.yaw + math.pi) % (2.0 * math.pi) - math.pi
        a, b, d = self._k_zeta
        rates = (
            -(a[0] * zx + a[1] * zy + a[2] * zz),
            -(b[0] * zx + b[1] * zy + b[2] * zz),
            -(d[0] * zx + d[1] * zy + d[2] * zz),
        )
        fx, fy = GRAVITY * pitch, -GRAVITY * roll
        return (c * fx - s * fy, s * fx + c * fy, lift), rates


def _moved(now: Vector, slope: Vector, dt: float) -> Vector:
    return now[0] + dt * slope[0], now[1] + dt * slope[1], now[2] + dt * slope[2]


def _halfway(before: ReferenceSample, after: ReferenceSample) -> ReferenceSample:
    turn = (after.yaw - before.yaw + math.pi) % (2.0 * math.pi) - math.pi
    return ReferenceSample(
        _mean(before.position, after.position),
        _mean(before.velocity, after.velocity),
        _mean(before.acceleration, after.acceleration),
        before.yaw + 0.5 * turn,
        before.yaw_rate,
    )


def _mean(one: Vector, other: Vector) -> Vector:
    return (
        one[0] + 0.5 * (other[0] - one[0]),
        one[1] + 0.5 * (other[1] - one[1]),
        one[2] + 0.5 * (other[2] - one[2]),
    )


def _product(k: tuple[float, ...], e: tuple[float, ...]) -> float:
    return k[0] * e[0] + k[1] * e[1] + k[2] * e[2] + k[3] * e[3] + k[4] * e[4] + k[5] * e[5]
