"""Averages over stretches of time: what is slow is kept, what is many becomes few."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def bins(t: np.ndarray, width: float) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Times (M,) at which stretches of `width` s begin that hold any of the sorted times `t` (K,), and a function that
    averages columns (K, k) over them."""
    number = ((t - t[0]) / width).astype(int)
    start = np.flatnonzero(np.diff(number, prepend=-1))
    size = np.diff(np.append(start, len(t)))

    def average(columns: np.ndarray) -> np.ndarray:
        return np.add.reduceat(columns, start, axis=0) / size[:, None]

    return t[start], average
