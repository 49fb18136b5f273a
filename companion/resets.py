"""Resets of the estimate: the vehicle stays where it is, and what is known of it jumps.

An estimator that finds out that it was wrong (GPS after a gap, motion capture that comes back) moves its estimate at
once and counts `reset_counter` up. A cascade that follows flies the whole jump in reality, downwards into the ground if
it was upwards. What moved without the vehicle is what velocity and body rate do not explain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from trueflight.companion.odometry import Odometry

Vector = tuple[float, float, float]

_LEAST, _LEAST_TURN = 0.02, 0.02
"""m and rad: a reset that moves less is none to speak of."""
_BETWEEN = 0.1
"""s between two messages: over more than that velocity and rate explain too little to see a jump."""


@dataclass(frozen=True)
class Reset:
    """A jump of the estimate: `moved` m (world ENU), `turned` rad about the vertical; `told` by the reset counter."""

    moved: Vector
    turned: float
    told: bool

    @property
    def distance(self) -> float:
        """m."""
        return math.hypot(*self.moved)

    @property
    def moves(self) -> bool:
        """Whether it moves anything to speak of."""
        return self.distance > _LEAST or abs(self.turned) > _LEAST_TURN

    @property
    def text(self) -> str:
        """In words, such as 'the position jumped by 0.90 m (0.00, 0.00, 0.90)'."""
        parts = []
        if self.distance > _LEAST:
            x, y, z = self.moved
            parts.append(f"the position jumped by {self.distance:.2f} m ({x:.2f}, {y:.2f}, {z:.2f})")
        if abs(self.turned) > _LEAST_TURN:
            parts.append(f"the heading jumped by {math.degrees(self.turned):.0f} degrees")
        return " and ".join(parts) or "nothing moved"


def found_reset(
    odometry: Odometry, previous: Odometry, interval: float, jump: float, turn: float
) -> Reset | None:
    """The reset between two samples `interval` s apart; None where there is none.

    One of which the counter does not tell is seen from `jump` m and `turn` rad on.
    """
    told = odometry.reset_counter != previous.reset_counter
    if not told and not 0.0 < interval < _BETWEEN:
        return None
    half = 0.5 * max(interval, 0.0)
    (x, y, z), (u, v, w) = odometry.position, odometry.velocity
    (x0, y0, z0), (u0, v0, w0) = previous.position, previous.velocity
    x, y, z = x - x0 - half * (u + u0), y - y0 - half * (v + v0), z - z0 - half * (w + w0)
    if told:
        return Reset((x, y, z), _turned(odometry, previous, interval), True)
    if x * x + y * y + z * z > jump * jump:
        return Reset((x, y, z), 0.0, False)
    turned = _turned(odometry, previous, interval)
    return Reset((0.0, 0.0, 0.0), turned, False) if abs(turned) > turn else None


def _turned(odometry: Odometry, previous: Odometry, interval: float) -> float:
    """rad, wrapped: change of the heading less what the body rates made of it."""
    change = _yaw(odometry.quaternion) - _yaw(previous.quaternion)
    w, x, y, z = previous.quaternion
    _, q, r = odometry.angular_velocity
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    level = math.sqrt(max(1.0 - (2.0 * (w * y - x * z)) ** 2, 0.01))  # cosine of the pitch
    rate = (q * math.sin(roll) + r * math.cos(roll)) / level
    return math.remainder(change - rate * max(interval, 0.0), 2.0 * math.pi)


def _yaw(quaternion: tuple[float, float, float, float]) -> float:
    w, x, y, z = quaternion
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
