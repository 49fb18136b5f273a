"""Values that a logger repeats: a sensor of 10 Hz written into rows of 100 Hz is still a sensor of 10 Hz."""

from __future__ import annotations

import numpy as np

from trueflight.groundstation.reading.uniform import continuous_quaternion
from trueflight.models.flight import COLUMNS

MEASURED = ("position", "velocity", "quaternion", "angular_velocity", "specific_force")
"""Columns whose noise never lets them stand still: a row that repeats the one before is no new measurement."""
REPEATED = 0.3
"""Share of repeated rows in the air from which on a column counts as held."""
LONGEST = 1.0
"""s; a value that stays longer is a sensor that stopped, not one that is slow."""


def unheld(
    t: np.ndarray, columns: dict[str, np.ndarray], flying: np.ndarray
) -> tuple[dict[str, np.ndarray], dict[str, float], list[str]]:
    """Columns (N, k) with held values interpolated between the rows in which they were new, the true rate (Hz) of those
    that were held, and a note for each. The clock `t` (N,) is even within its stretches."""
    out, rates, notes = dict(columns), {}, []
    dt = float(np.median(np.diff(t)))
    for name in MEASURED:
        column = columns.get(name)
        if column is None:
            continue
        same = np.concatenate([[False], np.all(column[1:] == column[:-1], axis=1)])
        if not np.any(flying) or np.mean(same[flying]) < REPEATED:
            continue
        new = np.flatnonzero(~same)
        within = flying[new[:-1]]
        periods = np.diff(t[new])[within]
        if len(periods) < 10:
            continue
        rate = 1.0 / float(np.median(periods))
        if rate * dt > 0.75:  # now and then one is repeated: the logger's clock beats with the sensor's
            continue
        values = continuous_quaternion(column[new]) if name == "quaternion" else column[new]
        between = np.stack([np.interp(t, t[new], one) for one in values.T], -1)
        if name == "quaternion":
            between /= np.linalg.norm(between, axis=1, keepdims=True)
        after = np.clip(np.searchsorted(t[new], t, side="right"), 1, len(new) - 1)
        still = (t[new][after] - t[new][after - 1] > LONGEST) | (t > t[new[-1]])
        out[name] = np.where(still[:, None], column, between)
        rates[name] = rate
        notes.append(
            f"{COLUMNS[name][2]}: values are repeated, new ones come at {rate:.3g} Hz only (of {1 / dt:.3g} Hz rows); "
            "interpolated between them"
        )
    return out, rates, notes
