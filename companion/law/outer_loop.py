"""What the controllers after other papers share: the design's gains as accelerations, thrust as a vector, filters.

They ask for an acceleration in the world, turn the thrust vector towards it exactly, and leave turning to the
attitude loop of the linear design, so that what differs between two of them is the outer loop alone.
"""

from __future__ import annotations

import math
from collections import deque

from trueflight.companion.law.control import (
    ZERO,
    Attitude,
    ControlLaw,
    State,
    Vector,
)
from trueflight.models.trajectory import ReferenceSample
from trueflight.models.vehicle import GRAVITY

LONGEST_STEP = 0.1  # s of integration and fading in one tick, so that a gap in the odometry gives no jump
AUTHORITY = 8.0
"""m/s², the most that an adaptive part may add on an axis of the world: as much as the tilt limit leaves (g tan 0.7 =
8.3), so that it is the vehicle that limits them."""


class OuterLoop:
    """The position loop of a design in accelerations: stiffness 1/s² and damping 1/s along x, y, z of the heading
    frame."""

    def __init__(self, law: ControlLaw) -> None:
        k, mass = law.design.K_eta, law.vehicle.mass
        self._law = law
        self.stiffness: Vector = (GRAVITY * k[1][0], -GRAVITY * k[0][1], k[2][2] / mass)
        self.damping: Vector = (GRAVITY * k[1][3], -GRAVITY * k[0][4], k[2][5] / mass)

    def wanted(self, state: State, yaw: float, reference: ReferenceSample) -> Vector:
        """Acceleration (m/s², world) by which the reference is reached as the linear design reaches it."""
        c, s = math.cos(yaw), math.sin(yaw)
        (ex, ey, ez), (dx, dy, dz) = errors(state, reference)
        (a, b, d), (e, f, g) = self.stiffness, self.damping
        ahead = -a * (c * ex + s * ey) - e * (c * dx + s * dy)
        aside = -b * (c * ey - s * ex) - f * (c * dy - s * dx)
        x, y, z = reference.acceleration
        return x + c * ahead - s * aside, y + s * ahead + c * aside, z - d * ez - g * dz

    def attitude(self, acceleration: Vector, yaw: float) -> Attitude:
        """Roll, pitch and thrust that give an acceleration (m/s², world), within the limits.

        Thrust points along (sin theta cos phi, -sin phi, cos theta cos phi) of the heading frame.
        """
        c, s = math.cos(yaw), math.sin(yaw)
        x, y, z = acceleration
        ahead, aside, up = c * x + s * y, c * y - s * x, max(z + GRAVITY, 0.1 * GRAVITY)
        pitch = math.atan2(ahead, up)
        roll = math.atan2(-aside, math.hypot(ahead, up))
        thrust = self._law.vehicle.mass * math.sqrt(ahead * ahead + aside * aside + up * up)
        return self._law.limited(roll, pitch, thrust)


def errors(state: State, reference: ReferenceSample) -> tuple[Vector, Vector]:
    """Position (m) and velocity (m/s) minus the reference's, world."""
    (px, py, pz), (rx, ry, rz) = state.position, reference.position
    (vx, vy, vz), (wx, wy, wz) = state.velocity, reference.velocity
    return (px - rx, py - ry, pz - rz), (vx - wx, vy - wy, vz - wz)


def bounded(vector: Vector, most: float = AUTHORITY) -> Vector:
    """A vector with each component within `most`."""
    x, y, z = vector
    return min(most, max(-most, x)), min(most, max(-most, y)), min(most, max(-most, z))


class LowPass:
    """A second-order low-pass of a vector: two equal poles at `frequency` Hz, exact for values that hold for a tick."""

    def __init__(self, frequency: float, start: Vector | None = None) -> None:
        self._rate = 2.0 * math.pi * frequency
        self._first = start
        self._second = start or ZERO

    def step(self, value: Vector, dt: float) -> Vector:
        """The filtered vector `dt` s later; it begins at `start`, without one with the first value."""
        if self._first is None:
            self._first = self._second = value
        share = 1.0 - math.exp(-self._rate * min(LONGEST_STEP, max(0.0, dt)))
        self._first = first = mixed(self._first, value, share)
        self._second = mixed(self._second, first, share)
        return self._second

    @property
    def slope(self) -> Vector:
        """How fast the filtered vector changes, per s."""
        (a, b, c), (x, y, z), rate = self._first or self._second, self._second, self._rate
        return rate * (a - x), rate * (b - y), rate * (c - z)


def mixed(one: Vector, other: Vector, share: float) -> Vector:
    """`share` of the way from one vector to another."""
    a, b, c = one
    x, y, z = other
    return a + share * (x - a), b + share * (y - b), c + share * (z - c)


class ActingThrust:
    """The specific thrust that acts now (m/s², along the body's z axis), by what was commanded, its delay and its lag:
    those of the vehicle file, until others are known."""

    def __init__(self, law: ControlLaw) -> None:
        vehicle = law.vehicle
        self._mass = vehicle.mass
        self.delay, self.lag = vehicle.command_delay, vehicle.motor_time_constant
        self._waiting: deque[tuple[float, float]] = deque()
        self._due = self._acting = vehicle.weight
        self._clock = 0.0

    def step(self, dt: float) -> float:
        """Its value `dt` s later."""
        dt = min(LONGEST_STEP, max(0.0, dt))
        self._clock += dt
        while self._waiting and self._waiting[0][0] <= self._clock - self.delay + 1e-9:
            self._due = self._waiting.popleft()[1]
        share = 1.0 - math.exp(-dt / self.lag) if self.lag > 0.0 else 1.0
        self._acting += share * (self._due - self._acting)
        return self._acting / self._mass

    def commanded(self, thrust: float) -> None:
        """A thrust (N) goes out now."""
        self._waiting.append((self._clock, thrust))
