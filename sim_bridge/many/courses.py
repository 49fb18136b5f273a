"""The references of many flights: for each control tick where each vehicle should be, sampled in blocks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trueflight.models.trajectory import ReferenceSample, Trajectory
from trueflight.sim_bridge.plan import Plan, legs_of

_AT_A_TIME = 512  # ticks that are sampled together


@dataclass(frozen=True)
class References:
    """Where N vehicles should be: vectors (3, N) in m, m/s and m/s² of the home frame, `yaw` (N,) rad."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    yaw: np.ndarray

    @staticmethod
    def of(rows: np.ndarray) -> References:
        """From rows (10, N)."""
        return References(rows[:3], rows[3:6], rows[6:9], rows[9])


class _Course:
    """The ticks of one flight: which leg each belongs to, and at what time of it (s)."""

    def __init__(self, plan: Plan, period: float) -> None:
        legs = legs_of(plan)
        self._legs: list[Trajectory] = [plan.trajectory, *legs]
        counts, offsets = [_ticks_below(0, period, plan.settle - 1e-9)], [plan.settle]
        offset, tick = plan.settle, counts[0]
        for leg in legs:
            count = _ticks_below(tick, period, leg.duration, offset)
            counts.append(count)
            offsets.append(offset)
            tick += count
            offset += leg.duration
        self._ends, self._offsets, self._period = np.cumsum(counts), offsets, period
        self.ticks = tick
        self.settling = math.ceil(plan.settle / period - 1e-9)

    def leg_at(self, tick: int) -> tuple[Trajectory, float]:
        """The leg of a tick, and the time in it; the last ones for what comes after."""
        index = min(int(np.searchsorted(self._ends, tick, "right")), len(self._legs) - 1)
        return self._legs[index], tick * self._period - self._offsets[index]

    def rows(self, begin: int, count: int, ahead: float, out: np.ndarray) -> None:
        """References (count, 10) of `count` ticks from `begin` on, `ahead` s later than each."""
        ticks = np.arange(begin, begin + count)
        index = np.minimum(np.searchsorted(self._ends, ticks, "right"), len(self._legs) - 1)
        for i in np.unique(index):
            where = index == i
            t = ticks[where] * self._period - self._offsets[i] + ahead
            sampled = self._legs[i].sample(t)
            out[where, :3], out[where, 3:6] = sampled.position, sampled.velocity
            out[where, 6:9], out[where, 9] = sampled.acceleration, sampled.yaw


def _ticks_below(tick: int, period: float, end: float, offset: float = 0.0) -> int:
    """How many ticks from this one on are earlier than `end` s after `offset`."""
    first = max(math.floor((end + offset) / period) - 1, tick)
    while first * period - offset < end:
        first += 1
    while first > tick and not (first - 1) * period - offset < end:
        first -= 1
    return first - tick


class Courses:
    """The references of N flights. `ticks` (N,) tells how many each has, `settling` (N,) how many of them before its
    trajectory begins; after its end a flight's reference goes on as its last leg ends."""

    def __init__(self, plans: Sequence[Plan], period: float) -> None:
        # Flights of one course have one, which is then sampled once.
        known: dict[tuple[int, int, float], _Course] = {}
        keys = [(id(plan.trajectory), plan.repeat, plan.settle) for plan in plans]
        self._courses = [
            known.setdefault(key, known.get(key) or _Course(plan, period))
            for key, plan in zip(keys, plans, strict=True)
        ]
        self.ticks = np.array([course.ticks for course in self._courses])
        self.settling = np.array([course.settling for course in self._courses])
        self._period = period
        self._last: dict[str, np.ndarray] = {}
        self._blocks: dict[str, tuple[int, np.ndarray, np.ndarray]] = {}

    def leg_at(self, flight: int, tick: int) -> tuple[Trajectory, float]:
        """The leg of a tick of one flight, and the time in it (s)."""
        return self._courses[flight].leg_at(tick)

    def at(self, tick: int) -> References:
        """The references of this tick."""
        return References.of(self.rows("now", tick, np.zeros(len(self._courses))))

    def rows(self, name: str, tick: int, ahead: np.ndarray) -> np.ndarray:
        """References (10, N) at `ahead` (N,) s from this tick; a block of them is kept by `name` while `ahead` is the
        same, and what differs is sampled alone."""
        begin, known, block = self._blocks.get(name, (-1, np.empty(0), np.empty((0, 0, 0))))
        last = self._last.get(name)
        settled = last is not None and np.array_equal(last, ahead) and not np.array_equal(known, ahead)
        if begin < 0 or settled or not begin <= tick < begin + _AT_A_TIME:
            self._blocks[name] = begin, known, block = tick, ahead.copy(), self._sampled(tick, ahead)
        rows: np.ndarray = block[tick - begin]
        other = np.flatnonzero(known != ahead)
        self._last[name] = ahead
        if len(other):
            rows = rows.copy()
            for i in other.tolist():
                leg, t = self._courses[i].leg_at(tick)
                rows[:, i] = _flat(leg.at(t + float(ahead[i])))
        return rows

    def _sampled(self, tick: int, ahead: np.ndarray) -> np.ndarray:
        pairs = list(zip(self._courses, ahead.tolist(), strict=True))
        slots = {pair: slot for slot, pair in enumerate(dict.fromkeys(pairs))}
        sampled = np.empty((len(slots), _AT_A_TIME, 10))
        for (course, later), slot in slots.items():
            course.rows(tick, _AT_A_TIME, later, sampled[slot])
        which = np.array([slots[pair] for pair in pairs])
        turned = np.ascontiguousarray(sampled.transpose(1, 2, 0))
        return turned if len(slots) == len(pairs) else turned[:, :, which]


def _flat(sample: ReferenceSample) -> tuple[float, ...]:
    return (*sample.position, *sample.velocity, *sample.acceleration, sample.yaw)
