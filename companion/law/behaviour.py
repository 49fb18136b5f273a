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
_States = tuple[float, ...]

_LONGEST_GAP = 0.1
"""s; longer steps are cut, so that a gap in the odometry cannot make the integration unstable."""


class LinearBehaviour:
    """The linear closed loop from a start, one step a tick; `position` (m) and `velocity` (m/s) in the world."""

    def __init__(
        self, design: Design, position: Vector, velocity: Vector, zeta: Vector, reference: ReferenceSample
    ) -> None:
        self._k_eta, self._k_zeta, self._mass = design.K_eta, design.K_zeta, design.mass
        self._states: _States = (*position, *velocity, *zeta)
        self._reference = reference

    @property
    def position(self) -> Vector:
        """Expected position, m, world."""
        x, y, z = self._states[:3]
        return x, y, z

    @property
    def velocity(self) -> Vector:
        """Expected velocity, m/s, world."""
        x, y, z = self._states[3:6]
        return x, y, z

    def step(self, reference: ReferenceSample, dt: float) -> None:
        """Go on by `dt` s to the time of `reference`; in between, references run linearly (midpoint rule)."""
        dt = min(_LONGEST_GAP, max(0.0, dt))
        before, self._reference = self._reference, reference
        states = self._states
        slope = self._slope(states, before, before, 0.0)
        middle = tuple(s + 0.5 * dt * d for s, d in zip(states, slope, strict=True))
        slope = self._slope(middle, before, reference, 0.5)
        self._states = tuple(s + dt * d for s, d in zip(states, slope, strict=True))

    def _slope(
        self, states: _States, before: ReferenceSample, after: ReferenceSample, share: float
    ) -> tuple[float, ...]:
        px, py, pz, vx, vy, vz, roll, pitch, yaw = states
        rx, ry, rz = _between(before.position, after.position, share)
        ux, uy, uz = _between(before.velocity, after.velocity, share)
        ax, ay, az = _between(before.acceleration, after.acceleration, share)
        turn = (after.yaw - before.yaw + math.pi) % (2.0 * math.pi) - math.pi
        wanted_yaw = before.yaw + share * turn
        c, s = math.cos(yaw), math.sin(yaw)
        ex, ey, dx, dy = px - rx, py - ry, vx - ux, vy - uy
        e = (c * ex + s * ey, c * ey - s * ex, pz - rz, c * dx + s * dy, c * dy - s * dx, vz - uz)
        k_roll, k_pitch, k_lift = self._k_eta
        wanted_roll = -_product(k_roll, e) - (c * ay - s * ax) / GRAVITY
        wanted_pitch = -_product(k_pitch, e) + (c * ax + s * ay) / GRAVITY
        lift = -_product(k_lift, e) / self._mass + az
        zx, zy = roll - wanted_roll, pitch - wanted_pitch
        zz = (yaw - wanted_yaw + math.pi) % (2.0 * math.pi) - math.pi
        a, b, d = self._k_zeta
        rates = (
            -(a[0] * zx + a[1] * zy + a[2] * zz),
            -(b[0] * zx + b[1] * zy + b[2] * zz),
            -(d[0] * zx + d[1] * zy + d[2] * zz),
        )
        fx, fy = GRAVITY * pitch, -GRAVITY * roll
        return (vx, vy, vz, c * fx - s * fy, s * fx + c * fy, lift, *rates)


def _between(one: Vector, other: Vector, share: float) -> Vector:
    return (
        one[0] + share * (other[0] - one[0]),
        one[1] + share * (other[1] - one[1]),
        one[2] + share * (other[2] - one[2]),
    )


def _product(k: tuple[float, ...], e: tuple[float, ...]) -> float:
    return k[0] * e[0] + k[1] * e[1] + k[2] * e[2] + k[3] * e[3] + k[4] * e[4] + k[5] * e[5]
