"""Mean and maximum over a moving window. scipy.ndimage has them, and takes longer to load than most flights to read."""

from __future__ import annotations

import numpy as np


def moving_mean(column: np.ndarray, width: int) -> np.ndarray:
    """Mean of a column (N,) or (N, k) over `width` rows around each, mirrored at its ends; of an even width one more
    row is before than behind."""
    before, behind = width // 2, width - width // 2 - 1
    sides = ((before + 1, behind), *[(0, 0)] * (column.ndim - 1))
    total = np.cumsum(np.pad(column, sides, mode="symmetric"), axis=0, dtype=float)
    return np.asarray((total[width:] - total[:-width]) / width)


def moving_maximum(column: np.ndarray, width: int) -> np.ndarray:
    """Greatest value of a column (N,) within `width` rows around each, of those that there are."""
    before, behind = width // 2, width - width // 2 - 1
    greatest = np.pad(column, (before, behind), constant_values=-np.inf)
    span = 1
    while span < width:  # the greatest of two windows that overlap is that of both
        step = min(span, width - span)
        greatest = np.maximum(greatest[:-step], greatest[step:])
        span += step
    return greatest
