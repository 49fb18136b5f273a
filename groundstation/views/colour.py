"""Colours that stay apart on a dark and on a light ground, and for colour-blind eyes (Okabe and Ito,
2008)."""

from __future__ import annotations

import numpy as np

Colour = tuple[int, int, int]

MEASURED: Colour = (150, 150, 150)
REFERENCE: Colour = (0, 158, 115)
EXPECTED: Colour = (0, 158, 115)
FLOOR: Colour = (120, 120, 120)
LINEAR: Colour = (213, 94, 0)
NEWEST: Colour = (40, 150, 240)
BETWEEN: tuple[Colour, ...] = ((230, 159, 0), (204, 121, 167), (240, 228, 66))
AXES: tuple[Colour, Colour, Colour] = ((220, 80, 70), (60, 170, 90), (70, 120, 230))
WARNING: Colour = (230, 159, 0)

# From dark violet over red to yellow: lightness rises with the value, so it reads without hue as well.
_SCALE = np.array(
    [[70, 40, 130], [130, 40, 140], [190, 55, 110], [230, 90, 60], [250, 150, 30], [250, 225, 80]],
    dtype=float,
)


def of_version(index: int, count: int) -> Colour:
    """Colour of a model version: the first is the linear model, the last the newest."""
    if index == 0:
        return LINEAR
    if index == count - 1:
        return NEWEST
    return BETWEEN[(index - 1) % len(BETWEEN)]


def of_error(values: np.ndarray, highest: float) -> np.ndarray:
    """Colours (N, 3) uint8 of errors (N,) from 0 to `highest`; missing ones grey."""
    place = np.clip(np.nan_to_num(values) / max(highest, 1e-12), 0.0, 1.0) * (len(_SCALE) - 1)
    low = np.minimum(place.astype(int), len(_SCALE) - 2)
    share = (place - low)[:, None]
    colours = (1 - share) * _SCALE[low] + share * _SCALE[low + 1]
    colours[~np.isfinite(values)] = FLOOR
    return colours.astype(np.uint8)
