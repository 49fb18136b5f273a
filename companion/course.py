"""Where a flight should be: the leg that is flown, since when, and the reference that it gives now.

Everything in the *home frame*: axes of the world (ENU), origin on the ground below the vehicle at arming, so that z is
height above ground. Where the estimate jumps the vehicle does not: home and the reference's heading go along with it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable

from trueflight.companion.mission import Leg
from trueflight.companion.odometry import Odometry, Vector
from trueflight.companion.resets import Reset
from trueflight.models.trajectory import ReferenceSample, Waypoint

_SETTLED_DISTANCE, _SETTLED_SPEED = 0.15, 0.25


class Course:
    """The legs of one flight, one after another; belongs to the control thread. Times in s of the vehicle's clock.

    `leg` is None before takeoff and after the flight. `now` is told with every odometry message. `here` is the last
    reference, in the heading that the estimator had then.
    """

    def __init__(self) -> None:
        self.home: Vector = (0.0, 0.0, 0.0)
        self.leg: Leg | None = None
        self.here: Waypoint = (0.0, 0.0, 0.0, 0.0)
        self.now = 0.0
        self._legs: deque[Leg] = deque()
        self._begin = 0.0
        self._turned = 0.0
        """rad by which resets have turned the heading since takeoff, and with it the reference's."""

    def forget(self) -> None:
        """Nothing is flown any more; home stays."""
        self.leg = None
        self._legs.clear()

    def clear(self) -> None:
        """Begin anew: nothing has turned yet."""
        self.forget()
        self._turned = 0.0

    def set_home(self, position: Vector, yaw: float) -> None:
        """Home is here (m, world; heading in rad)."""
        self.home = position
        self.here = (0.0, 0.0, 0.0, yaw)

    def plan(self, legs: Iterable[Leg]) -> None:
        """What comes after the leg that is flown now, instead of anything planned before."""
        self._legs.clear()
        self._legs.extend(legs)

    def next(self) -> Leg | None:
        """Fly the next leg from now on; None where none is left, and the last one goes on."""
        if not self._legs:
            return None
        return self.switch(self._legs.popleft())

    def switch(self, leg: Leg) -> Leg:
        """Fly this leg from now on."""
        self.leg, self._begin = leg, self.now
        return leg

    def position(self, odometry: Odometry) -> Vector:
        """m, home frame."""
        (x, y, z), (hx, hy, hz) = odometry.position, self.home
        return x - hx, y - hy, z - hz

    def carry(self, reset: Reset) -> None:
        """Where the estimate has jumped, home and the reference's heading go with it."""
        (hx, hy, hz), (dx, dy, dz) = self.home, reset.moved
        self.home = hx + dx, hy + dy, hz + dz
        self._turned += reset.turned

    @property
    def late(self) -> float:
        """s by which the time of the leg is over; negative before."""
        assert self.leg is not None
        return self.now - self._begin - self.leg.trajectory.duration

    def flown(self, position: Vector, velocity: Vector, hold: bool) -> bool:
        """Whether a leg whose time is over may end: the vehicle is at its end and at rest, or waited for enough.

        While `hold` it is waited for in any case.
        """
        leg = self.leg
        assert leg is not None
        there = math.dist(position, leg.trajectory.end[:3]) < _SETTLED_DISTANCE
        still = math.hypot(*velocity) < _SETTLED_SPEED
        return self.late >= leg.settle or (there and still and not hold)

    def reference(self) -> ReferenceSample:
        """Where the vehicle should be now."""
        reference = self.preview(0.0)
        self.here = (*reference.position, reference.yaw)
        return reference

    def preview(self, ahead: float) -> ReferenceSample:
        """The reference of this leg `ahead` s from now; it holds still after the leg's end."""
        assert self.leg is not None
        reference = self.leg.trajectory.at(self.now - self._begin + ahead)
        return reference._replace(yaw=reference.yaw + self._turned) if self._turned else reference
