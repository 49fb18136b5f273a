"""Reference trajectories: what a flight is asked to do, as position, velocity, acceleration and yaw over
time.

A trajectory lives in a frame whose origin is *home*: the ground under the vehicle at arming, axes of the
world (ENU). So z is height above ground, yaw is the world's, and whoever flies it adds the home position. It
is made of segments of two kinds: polynomials of time (holds, minimum-jerk transfers, tables of setpoints) and
curves whose phase runs up smoothly, cruises and runs down again (circles, spirals, lemniscates). The same
formulas serve the control loop (plain floats, a few microseconds a sample) and the ground (arrays).

Minimum-jerk transfers: Flash and Hogan, "The coordination of arm movements", J. Neuroscience 5(7), 1985.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

_BLOCK = 500

Vector = tuple[float, float, float]
Waypoint = tuple[float, float, float, float]
"""x, y, z in m and yaw in rad."""

MIN_JERK_SPEED = 1.875
"""Peak speed of a minimum-jerk transfer over its mean speed."""
MIN_JERK_ACCELERATION = 10.0 / math.sqrt(3.0)
"""Peak acceleration of a minimum-jerk transfer in units of distance / duration²."""


class ReferenceSample(NamedTuple):
    """The reference at one time: m, m/s, m/s² in the axes of the world (ENU) from home; yaw in rad, yaw rate
    rad/s.
    """

    position: Vector
    velocity: Vector
    acceleration: Vector
    yaw: float
    yaw_rate: float


@dataclass(frozen=True)
class ReferenceColumns:
    """The reference at N times: `t` (N,) s, position, velocity, acceleration (N, 3) ENU from home, yaw (N,)
    rad.
    """

    t: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    yaw: np.ndarray


@dataclass(frozen=True)
class Polynomial:
    """x, y, z, yaw as polynomials of the segment's own time: four rows of six coefficients, lowest power
    first.
    """

    duration: float
    coefficients: tuple[tuple[float, ...], ...]

    def evaluate(self, t: Any, xp: Any) -> tuple[tuple[Any, Any, Any], ...]:
        """Value, first and second derivative of each of the four channels at `t` (float or array)."""
        out = []
        for c0, c1, c2, c3, c4, c5 in self.coefficients:
            value = c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5))))
            first = c1 + t * (2 * c2 + t * (3 * c3 + t * (4 * c4 + t * 5 * c5)))
            second = 2 * c2 + t * (6 * c3 + t * (12 * c4 + t * 20 * c5))
            out.append((value, first, second))
        return tuple(out)


@dataclass(frozen=True)
class Wave:
    """One channel of a curve over its phase s: `offset + slope s + (amplitude + growth s) sin(frequency s +
    phase)`.
    """

    offset: float
    slope: float = 0.0
    amplitude: float = 0.0
    growth: float = 0.0
    frequency: float = 0.0
    phase: float = 0.0


@dataclass(frozen=True)
class Curve:
    """Four waves over a phase s that runs from 0 to 1: smoothly up during `ramp` s, at constant rate, and
    down again.

    The rate of s follows a cubic smoothstep during the ramps, so that velocity and acceleration are
    continuous and zero at both ends.
    """

    duration: float
    ramp: float
    waves: tuple[Wave, Wave, Wave, Wave]

    def evaluate(self, t: Any, xp: Any) -> tuple[tuple[Any, Any, Any], ...]:
        """Value, first and second derivative of each of the four channels at `t` (float or array)."""
        s, rate, change = self._phase(t) if xp is math else self._phases(t)
        out: list[tuple[Any, Any, Any]] = []
        for w in self.waves:
            if xp is math and w.amplitude == 0.0 and w.growth == 0.0:
                out.append((w.offset + w.slope * s, w.slope * rate, w.slope * change))
                continue
            angle = w.frequency * s + w.phase
            sin, cos = xp.sin(angle), xp.cos(angle)
            size = w.amplitude + w.growth * s
            value = w.offset + w.slope * s + size * sin
            slope = w.slope + w.growth * sin + size * w.frequency * cos
            bend = 2 * w.growth * w.frequency * cos - size * w.frequency**2 * sin
            out.append((value, slope * rate, bend * rate * rate + slope * change))
        return tuple(out)

    def _phase(self, t: float) -> tuple[float, float, float]:
        cruise = 1.0 / (self.duration - self.ramp)  # both ramps together cover the phase of one at full rate
        backwards = t > self.duration - self.ramp
        elapsed = self.duration - t if backwards else t
        if elapsed >= self.ramp:
            return cruise * (elapsed - 0.5 * self.ramp), cruise, 0.0
        x = elapsed / self.ramp
        s = cruise * self.ramp * x * x * x * (1 - 0.5 * x)
        rate, change = cruise * x * x * (3 - 2 * x), cruise * 6 * x * (1 - x) / self.ramp
        return (1.0 - s, rate, -change) if backwards else (s, rate, change)

    def _phases(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `_phase`, for times (n,)."""
        cruise = 1.0 / (self.duration - self.ramp)
        backwards = t > self.duration - self.ramp
        elapsed = np.where(backwards, self.duration - t, t)
        cruising = elapsed >= self.ramp
        x = np.where(cruising, 0.0, elapsed) / (self.ramp or 1.0)
        s = np.where(
            cruising, cruise * (elapsed - 0.5 * self.ramp), cruise * self.ramp * x * x * x * (1 - 0.5 * x)
        )
        rate = np.where(cruising, cruise, cruise * x * x * (3 - 2 * x))
        change = cruise * 6 * x * (1 - x) / (self.ramp or 1.0)
        # A cruise is never told backwards.
        back = backwards & ~cruising
        return np.where(back, 1.0 - s, s), rate, np.where(back, -change, change)


Segment = Polynomial | Curve


class SetpointTable(Sequence[Segment]):
    """Polynomials kept as arrays, for long tables: durations (N,) s, coefficients (N, 4, 6)."""

    def __init__(self, durations: np.ndarray, coefficients: np.ndarray) -> None:
        self.durations, self.coefficients = durations, coefficients
        self._last: tuple[int, Polynomial] | None = None

    def __len__(self) -> int:
        return len(self.durations)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return tuple(self[i] for i in range(*index.indices(len(self))))
        last = self._last
        if last is None or last[0] != index:
            rows = tuple(map(tuple, self.coefficients[index].tolist()))
            last = self._last = (index, Polynomial(float(self.durations[index]), rows))
        return last[1]

    def at_all(self, index: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Value, first and second derivative (3, n, 4) of the polynomials `index` (n,) at their own times `t` (n,)."""
        c0, c1, c2, c3, c4, c5 = self.coefficients[index].transpose(2, 0, 1)
        t = t[:, None]
        return np.array(
            [
                c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5)))),
                c1 + t * (2 * c2 + t * (3 * c3 + t * (4 * c4 + t * 5 * c5))),
                2 * c2 + t * (6 * c3 + t * (12 * c4 + t * 20 * c5)),
            ]
        )


@dataclass(frozen=True)
class Trajectory:
    """A named, finite reference in the home frame (ENU axes, z above ground).

    `at` is for the control loop, `sample` for arrays. Before 0 and after `duration` the ends hold still.
    """

    name: str
    segments: Sequence[Segment]
    parameters: dict[str, float | str] = field(default_factory=dict)
    known_extent: tuple[Vector, Vector, float, float] | None = None
    """Bounds, greatest speed and acceleration, where somebody has worked them out already."""

    @cached_property
    def _ends(self) -> list[float]:
        if isinstance(self.segments, SetpointTable):
            return np.cumsum(self.segments.durations).tolist()
        return [float(x) for x in np.cumsum([s.duration for s in self.segments])]

    @cached_property
    def duration(self) -> float:
        """Length in s."""
        return self._ends[-1]

    def at(self, t: float) -> ReferenceSample:
        """The reference `t` s after the start."""
        still = t < 0.0 or t >= self.duration
        t = min(max(t, 0.0), self.duration)
        index = min(bisect_right(self._ends, t), len(self.segments) - 1)
        segment = self.segments[index]
        local = min(t - (self._ends[index - 1] if index else 0.0), segment.duration)
        x, y, z, yaw = segment.evaluate(local, math)
        if still:
            return ReferenceSample((x[0], y[0], z[0]), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), yaw[0], 0.0)
        return ReferenceSample((x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2]), yaw[0], yaw[1])

    def sample(self, t: np.ndarray) -> ReferenceColumns:
        """The reference at times `t` (N,) s after the start."""
        t = np.atleast_1d(np.asarray(t, dtype=float))
        inside = np.clip(t, 0.0, self.duration)
        index = np.minimum(np.searchsorted(self._ends, inside, side="right"), len(self.segments) - 1)
        values = np.zeros((3, len(t), 4))
        if isinstance(self.segments, SetpointTable):
            begins = np.where(index > 0, np.take(self._ends, index - 1), 0.0)
            local = np.minimum(inside - begins, self.segments.durations[index])
            values[:] = self.segments.at_all(index, local)
            index = index[:0]
        for i in np.unique(index):
            where = index == i
            begin = self._ends[i - 1] if i else 0.0
            local = np.minimum(inside[where] - begin, self.segments[i].duration)
            for channel, derivatives in enumerate(self.segments[i].evaluate(local, np)):
                for order in range(3):
                    values[order, where, channel] = derivatives[order]
        values[1:, (t < 0.0) | (t >= self.duration)] = 0.0
        return ReferenceColumns(t, values[0, :, :3], values[1, :, :3], values[2, :, :3], values[0, :, 3])

    @cached_property
    def start(self) -> Waypoint:
        """Where it begins: x, y, z (m, home frame) and yaw (rad)."""
        s = self.at(0.0)
        return (*s.position, s.yaw)

    @cached_property
    def end(self) -> Waypoint:
        """Where it ends: x, y, z (m, home frame) and yaw (rad)."""
        s = self.at(self.duration)
        return (*s.position, s.yaw)

    @cached_property
    def extent(self) -> tuple[Vector, Vector, float, float]:
        """Lowest and highest x, y, z, greatest speed and acceleration, sampled every 20 ms and in each segment."""
        if self.known_extent is not None:
            return self.known_extent
        ends = np.array(self._ends)
        times = np.unique(
            np.concatenate(
                [np.arange(0.0, self.duration, 0.02), ends, 0.5 * (ends + np.append(0.0, ends[:-1]))]
            )
        )
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        speed = acceleration = 0.0
        for begin in range(0, len(times), _BLOCK):  # in pieces: neither memory nor the interpreter for long
            columns = self.sample(times[begin : begin + _BLOCK])
            low = np.minimum(low, columns.position.min(axis=0))
            high = np.maximum(high, columns.position.max(axis=0))
            speed = max(speed, float(np.linalg.norm(columns.velocity, axis=1).max()))
            acceleration = max(acceleration, float(np.linalg.norm(columns.acceleration, axis=1).max()))
        return tuple(map(float, low)), tuple(map(float, high)), speed, acceleration  # type: ignore[return-value]

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        """Lowest and highest x, y, z (m, home frame) of the reference, sampled every 20 ms."""
        return self.extent[0], self.extent[1]

    @property
    def max_speed(self) -> float:
        """Greatest reference speed, m/s."""
        return self.extent[2]

    @property
    def max_acceleration(self) -> float:
        """Greatest reference acceleration, m/s²."""
        return self.extent[3]


def hold(at: Waypoint, duration: float) -> Polynomial:
    """Stand still at a waypoint for `duration` s."""
    return Polynomial(duration, tuple((x, 0.0, 0.0, 0.0, 0.0, 0.0) for x in at))


def min_jerk(begin: Waypoint, end: Waypoint, duration: float) -> Polynomial:
    """Minimum-jerk transfer of `duration` s from rest at `begin` to rest at `end` (Flash and Hogan 1985, equation
    2)."""
    rows = []
    for a, b in zip(begin, end, strict=True):
        d = b - a
        rows.append((a, 0.0, 0.0, 10 * d / duration**3, -15 * d / duration**4, 6 * d / duration**5))
    return Polynomial(duration, tuple(rows))


def transfer_time(
    begin: Waypoint, end: Waypoint, speed: float, acceleration: float, yaw_rate: float = 1.5
) -> float:
    """Duration in s of a minimum-jerk transfer from `begin` to `end` that keeps below `speed` (m/s), `acceleration`
    (m/s²) and `yaw_rate` (rad/s).
    """
    distance = math.dist(begin[:3], end[:3])
    turn = abs(end[3] - begin[3])
    return max(
        MIN_JERK_SPEED * distance / speed,
        math.sqrt(MIN_JERK_ACCELERATION * distance / acceleration),
        MIN_JERK_SPEED * turn / yaw_rate,
        0.2,
    )


def transfer(begin: Waypoint, end: Waypoint, speed: float, acceleration: float) -> Trajectory:
    """A trajectory straight from `begin` to `end`, turning the shorter way, below `speed` (m/s) and `acceleration`
    (m/s²)."""
    turn = (end[3] - begin[3] + math.pi) % (2 * math.pi) - math.pi
    end = (*end[:3], begin[3] + turn)
    return Trajectory("transfer", (min_jerk(begin, end, transfer_time(begin, end, speed, acceleration)),))


def path(
    waypoints: Sequence[Waypoint], speed: float, acceleration: float, pause: float = 0.0
) -> list[Segment]:
    """Minimum-jerk transfers from waypoint to waypoint of `waypoints`, below `speed` (m/s) and `acceleration` (m/s²),
    with a `pause` (s) at each but the first."""
    segments: list[Segment] = []
    for begin, end in pairwise(waypoints):
        segments.append(min_jerk(begin, end, transfer_time(begin, end, speed, acceleration)))
        if pause > 0.0:
            segments.append(hold(end, pause))
    return segments


def quintics(durations: np.ndarray, states: np.ndarray) -> SetpointTable:
    """Quintic Hermite segments of `durations` (N,) s between `states` (N + 1, 4, 3): value, first and second derivative
    of each of four channels."""
    d = durations[:, None]
    (p0, v0, a0), (p1, v1, a1) = (part.transpose(2, 0, 1) for part in (states[:-1], states[1:]))
    p, v, a = p1 - p0 - v0 * d - 0.5 * a0 * d * d, v1 - v0 - a0 * d, a1 - a0
    powers = (
        p0,
        v0,
        0.5 * a0,
        10 * p / d**3 - 4 * v / d**2 + 0.5 * a / d,
        -15 * p / d**4 + 7 * v / d**3 - a / d**2,
        6 * p / d**5 - 3 * v / d**4 + 0.5 * a / d**3,
    )
    return SetpointTable(durations, np.stack(powers, axis=-1))
