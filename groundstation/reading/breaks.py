"""Steps that the other sensors did not feel: a velocity or heading that jumps, an impact between two samples."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from trueflight.groundstation.reading.plausible import body_rate
from trueflight.groundstation.reading.uniform import gap_length, segments
from trueflight.models.frames import rotate
from trueflight.models.vehicle import GRAVITY

WITHIN = 0.15
"""s that a step may take: a log's own rate is interpolated to that of the others."""
SURE = 10.0
"""Standard deviations of its own noise, by the median, from which on a step is one."""
CHI_MEDIAN = {1: 0.67449, 3: 1.53817}
"""Median length of a vector of so many standard normal numbers."""
LEAST = {"velocity": 0.5, "position": 0.5, "heading": float(np.radians(8.0))}
"""m/s, m, rad; smaller steps are corrections that every estimator makes."""
UNITS = {"velocity": "m/s", "position": "m", "heading": "degrees"}
GLITCH = 2.0
"""s from a step to the one back, within which what lies between is a glitch."""
BACK = 0.3
"""Share of the largest step that may stay after the one back."""


@dataclass(frozen=True)
class Step:
    """A step of `what` ("velocity", "position", "heading") from row `first` to `last`, by `size` (m/s, m, rad).

    `glitch` is True where it came back within that time; otherwise what it changed stayed.
    """

    what: str
    first: int
    last: int
    size: float
    glitch: bool

    def overlaps(self, other: Step) -> bool:
        """Whether the two share rows."""
        return self.first <= other.last and other.first <= self.last

    def told(self, t: np.ndarray) -> str:
        """One sentence, with the time in s."""
        shown = np.degrees(self.size) if self.what == "heading" else self.size
        amount = f"{abs(shown):.2g} {UNITS[self.what]}"
        if self.glitch:
            return (
                f"a glitch of the {self.what} ({amount}) from t = {t[self.first]:.2f} to {t[self.last]:.2f} s, which "
                "no other sensor felt: left out"
            )
        why = {"velocity": "an impact, or an estimator's reset", "position": "an estimator's reset"}
        return (
            f"the {self.what} jumps by {amount} at t = {t[self.first]:.2f} s, which no other sensor felt "
            f"({why.get(self.what, 'a reset')}): nothing is computed across"
        )


def steps(t: np.ndarray, columns: dict[str, np.ndarray], flying: np.ndarray) -> list[Step]:
    """Steps of velocity against accelerometer and attitude, position against velocity, heading against the gyroscope.

    The clock `t` (N,) is even within its stretches; columns by the names of `models.flight.COLUMNS`.
    """
    p, v, q = columns.get("position"), columns.get("velocity"), columns.get("quaternion")
    f, w = columns.get("specific_force"), columns.get("angular_velocity")
    found: list[Step] = []
    dt = float(np.median(np.diff(t)))
    if v is not None and q is not None and f is not None:
        world = rotate(q, f) - [0.0, 0.0, GRAVITY]
        found += _steps("velocity", t, np.diff(v, axis=0) - 0.5 * (world[1:] + world[:-1]) * dt, flying)
    if p is not None and v is not None:
        found += _steps("position", t, np.diff(p, axis=0) - 0.5 * (v[1:] + v[:-1]) * dt, flying)
    if q is not None and w is not None:
        beyond = body_rate(q[:-1], q[1:], dt) * dt - 0.5 * (w[1:] + w[:-1]) * dt
        found += _steps("heading", t, rotate(q[:-1], beyond)[:, 2:], flying)
    return found


def without(t: np.ndarray, found: list[Step]) -> np.ndarray:
    """Rows to keep (N,): a glitch is left out, and around any other step enough that the clock has a gap there."""
    keep = np.ones(len(t), dtype=bool)
    dt = float(np.median(np.diff(t)))
    gap = int(np.ceil(gap_length(dt) / dt)) + 1
    for step in found:
        short = max(gap - (step.last - step.first), 0)
        keep[max(step.first - short // 2, 0) : step.last + 1 + short - short // 2] = False
    return keep


def told(t: np.ndarray, found: list[Step]) -> list[str]:
    """Notes: the first two of each kind in full, the others counted."""
    notes = []
    for what in LEAST:
        for glitch in (True, False):
            some = [s for s in found if s.what == what and s.glitch == glitch]
            notes += [s.told(t) for s in some[:2]]
            if len(some) > 2:
                notes.append(
                    f"... and {len(some) - 2} more {'glitches' if glitch else 'jumps'} of the {what}"
                )
    return notes


def _steps(what: str, t: np.ndarray, unfelt: np.ndarray, flying: np.ndarray) -> list[Step]:
    """Steps of what the others did not feel from sample to sample, (N - 1, k)."""
    width = max(1, round(WITHIN / float(np.median(np.diff(t)))))
    total = np.concatenate([np.zeros((1, unfelt.shape[1])), np.cumsum(unfelt, axis=0)])
    spans: list[tuple[int, int]] = []
    for scale in dict.fromkeys((1, width)):
        rows = _large(what, t, total, scale, flying)
        spans += [
            (first, last)
            for first, last in _groups(rows, scale)
            if not any(a <= last and first <= b for a, b in spans)
        ]
    return list(_paired(what, t, total, sorted(spans)))


def _paired(what: str, t: np.ndarray, total: np.ndarray, spans: list[tuple[int, int]]) -> Iterator[Step]:
    """Steps from spans (first, last row) of too large a change: there and back within `GLITCH` is one glitch."""
    k = 0
    while k < len(spans):
        first, last = spans[k]
        back = next((j for j in range(k, len(spans)) if _came_back(t, total, first, spans[j][1])), None)
        if back is not None:
            end = spans[back][1]
            largest = float(np.linalg.norm(total[first : end + 1] - total[first], axis=1).max())
            yield Step(what, first, end, largest, True)
            k = back + 1
            continue
        change = total[last] - total[first]
        yield Step(
            what, first, last, float(change[0]) if len(change) == 1 else float(np.linalg.norm(change)), False
        )
        k += 1


def _came_back(t: np.ndarray, total: np.ndarray, first: int, last: int) -> bool:
    away = np.linalg.norm(total[first : last + 1] - total[first], axis=1)
    return bool(t[last] - t[first] <= GLITCH and away[-1] < BACK * away.max())


def _large(what: str, t: np.ndarray, total: np.ndarray, scale: int, flying: np.ndarray) -> np.ndarray:
    """Rows from which `total` (N, k) changes too much within `scale` samples."""
    change = np.linalg.norm(total[scale:] - total[:-scale], axis=1)
    whole = np.zeros(len(change), dtype=bool)
    for part in segments(t):
        whole[part.start : max(part.stop - scale, part.start)] = True
    whole &= flying[scale:] & flying[:-scale]
    if not np.any(whole):
        return np.array([], dtype=int)
    noise = float(np.median(change[whole]) / CHI_MEDIAN[total.shape[1]])
    return np.flatnonzero(whole & (change > max(SURE * noise, LEAST[what])))


def _groups(rows: np.ndarray, scale: int) -> list[tuple[int, int]]:
    """Rows from which a change is too large, gathered into (first, last row of the change)."""
    if not rows.size:
        return []
    parts = np.split(rows, np.flatnonzero(np.diff(rows) > max(scale, 2)) + 1)
    return [(int(part[0]), int(part[-1]) + scale) for part in parts]
