"""Manoeuvres that a planned flight is made of, and how the vehicle would fly them.

Each begins and ends at rest in one place. How the vehicle moves is predicted by its linear closed loop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trueflight.groundstation.design.linear_response import Reference, expected_behaviour
from trueflight.models.design import Design
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.frames import rotate_inverse
from trueflight.models.reference import trajectory
from trueflight.models.trajectory import Segment, Trajectory, Waypoint, hold, min_jerk, path
from trueflight.models.vehicle import GRAVITY, Vehicle

RATE = 50.0
"""Hz at which manoeuvres are predicted."""


@dataclass(frozen=True)
class Limits:
    """Where and how the planned flight may go: m around home, m above ground, m/s, m/s², s altogether."""

    radius: float = 3.0
    low: float = 0.4
    high: float = 2.5
    speed: float = 3.0
    acceleration: float = 5.0
    duration: float = 40.0

    def __post_init__(self) -> None:
        if self.high - self.low < 0.5:
            raise InputError(
                f"--low {self.low:g} --high {self.high:g}: give at least 0.5 m of height to fly in"
            )


@dataclass(frozen=True)
class Manoeuvre:
    """One manoeuvre of a planned flight, and what it is called."""

    text: str
    segments: tuple[Segment, ...]

    @property
    def trajectory(self) -> Trajectory:
        """Its path, home frame."""
        return Trajectory(self.text, self.segments)


def base_of(limits: Limits) -> Waypoint:
    """Where every manoeuvre begins and ends at rest."""
    return (0.0, 0.0, min(max(limits.low + 0.5, 1.3), limits.high - 0.2), 0.0)


def library(limits: Limits) -> list[Manoeuvre]:
    """Manoeuvres of every kind, within the limits; each begins and ends at rest at `base_of`."""
    base = base_of(limits)
    height, reach, a = base[2], 0.9 * limits.radius, limits.acceleration
    speeds = sorted({0.4 * limits.speed, 0.7 * limits.speed, limits.speed})
    found: list[Manoeuvre] = [Manoeuvre("hover for 3 s", (hold(base, 3.0),))]

    def add(text: str, *segments: Segment) -> None:
        found.append(Manoeuvre(text, segments))

    for degrees in (90, 180):
        turned = (*base[:3], math.radians(degrees))
        time = math.radians(degrees) * 1.875 / 1.2
        add(
            f"turn by {degrees}°, hold 2 s, and back",
            min_jerk(base, turned, time), hold(turned, 2.0), min_jerk(turned, base, time),
        )  # fmt: skip
    for degrees, way in ((0, "along body x"), (90, "along body y"), (45, "diagonally")):
        x, y = reach * math.cos(math.radians(degrees)), reach * math.sin(math.radians(degrees))
        for speed in speeds:
            points = [base, (x, y, height, 0.0), (-x, -y, height, 0.0), base]
            add(f"pass {way} at {speed:.2g} m/s, there and back", *path(points, speed, a))
    for degrees in (90, 180):
        yaw = math.radians(degrees)
        turned, time = (*base[:3], yaw), yaw * 1.875 / 1.2
        for axis, way in ((0.0, "east"), (0.5 * math.pi, "north")):
            x, y = reach * math.cos(axis), reach * math.sin(axis)
            points = [turned, (x, y, height, yaw), (-x, -y, height, yaw), turned]
            add(
                f"yawed by {degrees}°, pass {way} at {limits.speed:.2g} m/s, there and back",
                min_jerk(base, turned, time), *path(points, limits.speed, a), min_jerk(turned, base, time),
            )  # fmt: skip
    top, bottom = (0.0, 0.0, limits.high, 0.0), (0.0, 0.0, limits.low, 0.0)
    for speed in speeds:
        add(f"climb and descend at {speed:.2g} m/s", *path([base, top, bottom, base], speed, a))
    hard = min(2.0 * a, 0.65 * GRAVITY)  # thrust stays well above nothing
    jolt = (0.0, 0.0, min(height + 0.4, limits.high), 0.0)
    add("four hard vertical jolts", *(path([base, jolt], 5.0, hard) + path([jolt, base], 5.0, hard)) * 4)
    if limits.low < 0.8:
        stairs = [base, *((0.0, 0.0, limits.low + step, 0.0) for step in (0.4, 0.2, 0.1, 0.0))]
        add("down in stairs and up again", *path(stairs, 0.8, 2.0, 0.6), *path([bottom, base], 1.0, 2.0))
    ends = [(-0.7 * reach, 0.0, limits.low, 0.0), (0.7 * reach, 0.0, limits.low, 0.0)]
    for speed in (speeds[0], speeds[-1]):
        add(
            f"low pass at {speed:.2g} m/s",
            *path([base, bottom], 1.0, 2.0), *path([bottom, ends[0]], speed, a), *path(ends, speed, a),
            *path([ends[1], bottom], speed, a), *path([bottom, base], 1.0, 2.0),
        )  # fmt: skip
    for speed in speeds[1:]:
        radius = min(0.8 * reach, 1.5)
        turning = trajectory("circle", radius=radius, speed=speed, height=height, laps=2.0)
        out = path([base, (radius, 0.0, height, 0.0)], speed, a)
        back = path([(radius, 0.0, height, 0.0), base], speed, a)
        add(f"two circles at {speed:.2g} m/s", *out, *turning.segments, *back)
    return [m for m in found if _within(m.trajectory, limits)]


def _within(flown: Trajectory, limits: Limits) -> bool:
    (x0, y0, z0), (x1, y1, z1) = flown.bounds
    far = math.hypot(max(abs(x0), abs(x1)), max(abs(y0), abs(y1)))
    slow = flown.max_speed <= 1.01 * max(limits.speed, 1.0)
    return far <= limits.radius and z0 >= limits.low - 1e-6 and z1 <= limits.high + 1e-6 and slow


def as_flown(flown: Trajectory, design: Design, vehicle: Vehicle, voltage: float) -> Flight:
    """The manoeuvre as the linear closed loop would fly it; thrust and attitude are those its acceleration takes."""
    # long enough to be compared, whatever the manoeuvre
    t = np.arange(0.0, max(flown.duration, 5.5), 1.0 / RATE)
    wanted = flown.sample(t)
    reference = Reference(wanted.position, wanted.velocity, wanted.acceleration, wanted.yaw)
    start = (wanted.position[0], np.zeros(3), np.array([0.0, 0.0, wanted.yaw[0]]))
    motion = expected_behaviour(design, t, reference, start)
    force = np.gradient(motion.velocity, t, axis=0) + np.array([0.0, 0.0, GRAVITY])
    thrust = np.linalg.norm(force, axis=1)
    quaternion = _attitude(force / thrust[:, None], motion.zeta[:, 2])
    turn = np.gradient(quaternion, t, axis=0)
    return Flight(
        name=flown.name,
        vehicle=vehicle,
        t=t,
        position=motion.position,
        velocity=motion.velocity,
        quaternion=quaternion,
        angular_velocity=2.0 * _conjugate_product(quaternion, turn),
        specific_force=rotate_inverse(quaternion, force),
        thrust_command=np.array([vehicle.command(vehicle.mass * x) for x in thrust]),
        battery_voltage=np.full(len(t), voltage),
    )


def _attitude(up: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Quaternion (N, 4) of the attitude with body z along `up` (N, 3), world, and this yaw (N,)."""
    roll_pitch = np.column_stack([-np.sin(yaw), np.cos(yaw), np.zeros_like(yaw)])
    x = np.cross(roll_pitch, up)
    x /= np.linalg.norm(x, axis=1)[:, None]
    y = np.cross(up, x)
    w = 0.5 * np.sqrt(np.maximum(1.0 + x[:, 0] + y[:, 1] + up[:, 2], 1e-9))
    first = (
        np.column_stack([4 * w * w, y[:, 2] - up[:, 1], up[:, 0] - x[:, 2], x[:, 1] - y[:, 0]])
        / (4 * w)[:, None]
    )
    # half a turn from the world the formula above divides by zero; about z there is another
    z = 0.5 * np.sqrt(np.maximum(1.0 - x[:, 0] - y[:, 1] + up[:, 2], 1e-9))
    second = (
        np.column_stack([x[:, 1] - y[:, 0], up[:, 0] + x[:, 2], y[:, 2] + up[:, 1], 4 * z * z])
        / (4 * z)[:, None]
    )
    quaternion = np.where((w > z)[:, None], first, second)
    flips = np.cumprod(np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0.0, -1.0, 1.0))
    quaternion[1:] *= flips[:, None]
    return quaternion / np.linalg.norm(quaternion, axis=1)[:, None]


def _conjugate_product(q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Vector part (N, 3) of conj(q) r."""
    return q[:, :1] * r[:, 1:] - r[:, :1] * q[:, 1:] - np.cross(q[:, 1:], r[:, 1:])


def hover(vehicle: Vehicle) -> Flight:
    """A hover of six seconds, for what needs a flight to be asked at all."""
    n = round(6.0 * RATE)
    return Flight(
        name="hover",
        vehicle=vehicle,
        t=np.arange(n) / RATE,
        position=np.tile([0.0, 0.0, 1.3], (n, 1)),
        velocity=np.zeros((n, 3)),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        angular_velocity=np.zeros((n, 3)),
        specific_force=np.tile([0.0, 0.0, GRAVITY], (n, 1)),
        thrust_command=np.full(n, vehicle.hover_thrust),
        battery_voltage=np.full(n, vehicle.nominal_voltage),
    )
