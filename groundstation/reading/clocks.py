"""Time stamps of another clock than the others', told by when they were received."""

from __future__ import annotations

import numpy as np

APART = 1.0
"""s between offsets of two clocks; what one computer receives of one clock is never so late."""
DRIFT = 0.1
"""s by which a clock drifts within a recording from which on it is undone; less is looked for later, as a delay."""
STEADY = 0.05
"""s of scatter (by the median) of the times of receipt, above which a drift is not determined."""


def of_one_clock(stamp: np.ndarray, received: np.ndarray) -> np.ndarray:
    """The rows (N,) whose `stamp` counts the clock that most of them count, both (N,) in s; all where nothing tells."""
    if len(stamp) < 3 or np.ptp(received) <= 0.0:
        return np.ones(len(stamp), dtype=bool)
    offset = received - stamp
    order = np.argsort(offset, kind="stable")
    group = np.empty(len(stamp), dtype=int)
    group[order] = np.concatenate([[0], np.cumsum(np.diff(offset[order]) > APART)])
    return np.asarray(group == np.argmax(np.bincount(group)))


def drift_of(stamp: np.ndarray, received: np.ndarray) -> np.ndarray:
    """What has to be added to each `stamp` (N,) in s beyond a constant, for it to run as the times of receipt do: the
    line through the medians of the first and the last third; zero where it is small, or not determined."""
    third = len(stamp) // 3
    still = np.zeros(len(stamp))
    if third < 10:
        return still
    offset = received - stamp
    first, last = slice(0, third), slice(len(stamp) - third, None)
    span = float(np.median(stamp[last]) - np.median(stamp[first]))
    gained = float(np.median(offset[last]) - np.median(offset[first]))
    if span <= 0.0 or abs(gained) * 1.5 < DRIFT:
        return still
    line = gained / span * (stamp - stamp[len(stamp) // 2])
    left = offset - line
    return line if float(np.median(np.abs(left - np.median(left)))) < STEADY else still
