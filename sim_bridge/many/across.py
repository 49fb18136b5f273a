"""Numbers of many vehicles as one: a float where all have the same, else an array with one for each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


def across(values: Sequence[Any]) -> Any:
    """Numbers, or nested tuples of them, one for each of N vehicles: the same nest, with arrays (N,) where they
    differ."""
    first = values[0]
    if isinstance(first, tuple):
        return tuple(across([value[i] for value in values]) for i in range(len(first)))
    if all(value == first for value in values):
        return first
    return np.array(values, dtype=float)


def stacked(values: Sequence[Any]) -> np.ndarray:
    """Numbers, or nests of them, one for each of N vehicles, as an array (..., N)."""
    return np.moveaxis(np.array(values, dtype=float), 0, -1).copy()
