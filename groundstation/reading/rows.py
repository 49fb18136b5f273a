"""The rows of a flight in order and whole: what is out of order, repeated or missing is sorted, left out or filled,
and told in a note."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from trueflight.groundstation.reading.uniform import MOST_LOST, continuous_quaternion
from trueflight.models.errors import InputError
from trueflight.models.flight import COLUMNS

MOST_MISSING = 0.02
SHUFFLED = 0.02
"""Share of repeated times above which sorted rows are not one flight."""
LONG = 50
"""Rows in a stretch, and rows that come too late after it, from which on a logger began again."""
BETWEEN = 0.06
"""s; values known this often or more are interpolated in rows between them."""
HELD = (
    "battery_voltage",
    "position_reference",
    "velocity_reference",
    "acceleration_reference",
    "yaw_reference",
)
"""Columns that loggers write at a lower rate than the others: their last value is held."""

MOST, MOST_US = 1e18, 4e18
"""What no number of a log reaches, and no time in us that 64 bits hold."""


def in_order(
    t: np.ndarray, columns: dict[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray, list[str]]:
    """Rows sorted by time, the order they came in (N,), and a note: only where single rows were out of order, or all
    were shuffled. Where a logger started again two stretches would interleave; `check_clock` refuses those."""
    order = np.argsort(t, kind="stable")
    back = int(np.sum(np.diff(t) < 0)) if np.all(np.isfinite(t)) else 0
    if not back:
        return t, columns, np.arange(len(t)), []
    late = int(np.sum(t < np.maximum.accumulate(t)))
    began_again = len(t) / (back + 1) >= LONG and late >= LONG * back
    repeated = np.mean(np.diff(t[order]) <= 0) > SHUFFLED
    if began_again or repeated:
        return t, columns, np.arange(len(t)), []
    note = f"the rows were not in order of time ({back} steps back) and were sorted"
    return t[order], {name: column[order] for name, column in columns.items()}, order, [note]


def without_duplicates(
    t: np.ndarray, columns: dict[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    """Rows with a new time only (the first of each); the clock must not go backwards."""
    keep = np.concatenate([[True], np.diff(t) > 0])
    if np.all(keep):
        return t, columns, []
    note = f"{int(np.sum(~keep))} rows with a duplicated time were left out"
    return t[keep], {name: column[keep] for name, column in columns.items()}, [note]


def complete(
    t: np.ndarray, columns: dict[str, np.ndarray], place: Callable[[int], str]
) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    """Rows without missing values: low-rate columns hold their last value, few incomplete rows become gaps.

    A column that is logged in some of the rows, but often, is interpolated between them. Raises `InputError` where
    more than a quarter of a column is missing all the same.
    """
    notes: list[str] = []
    out = dict(columns)
    bad = np.zeros(len(t), dtype=bool)
    for name, column in columns.items():
        missing = ~whole(column)
        if not np.any(missing):
            continue
        if name in HELD and not np.all(missing):
            out[name] = held(column)
            notes.append(
                f"{COLUMNS[name][2]}: the last value is held in {100 * missing.mean():.0f} % of the rows"
            )
        elif missing.mean() > MOST_MISSING:
            out[name], missing = _filled(t, column, missing)
            if missing.mean() > MOST_LOST:
                raise InputError(
                    f"{place(int(np.argmax(missing)))}: {COLUMNS[name][2]} ({', '.join(COLUMNS[name][0])}) is "
                    f"missing in {100 * missing.mean():.0f} % of the rows, here first; log all columns at one rate, "
                    "or cut the flight"
                )
            if np.any(np.isfinite(out[name]) & ~np.isfinite(column)):
                notes.append(f"{COLUMNS[name][2]} is logged in some rows only and interpolated between them")
            bad |= missing
        else:
            bad |= missing
    if np.any(bad):
        notes.append(f"{int(bad.sum())} rows with missing values were left out")
        t, out = t[~bad], {name: column[~bad] for name, column in out.items()}
    return t, out, notes


def _filled(t: np.ndarray, column: np.ndarray, missing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A column with the rows between near known ones interpolated, and which (N,) are still missing."""
    known = np.flatnonzero(~missing)
    if len(known) < 2:
        return column, missing
    values = column[known]
    attitude = (
        column.ndim == 2
        and column.shape[1] == 4
        and bool(np.allclose(np.linalg.norm(values, axis=1), 1.0, atol=0.02))
    )
    flat = (continuous_quaternion(values) if attitude else values).reshape(len(known), -1)
    between = np.stack([np.interp(t, t[known], one) for one in flat.T], -1).reshape(column.shape)
    if attitude:
        between /= np.maximum(np.linalg.norm(between, axis=1, keepdims=True), 1e-12)
    after = np.clip(np.searchsorted(known, np.arange(len(t))), 1, len(known) - 1)
    near = t[known[after]] - t[known[after - 1]] <= BETWEEN
    inside = (np.arange(len(t)) > known[0]) & (np.arange(len(t)) < known[-1])
    fill = missing & near & inside
    out = np.where(fill if column.ndim == 1 else fill[:, None], between, column)
    return out, missing & ~fill


def whole(column: np.ndarray) -> np.ndarray:
    """In which rows of a column (N,) or (N, k) all numbers are finite, (N,)."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.isfinite(column if column.ndim == 1 else sum(column.T))


def possible(column: np.ndarray) -> np.ndarray:
    """A column (N,) as a log holds it, with NaN for what damage alone makes: what is infinite, beyond `MOST`, or a NaN
    that signals, of which numpy warns where it is used. Whole numbers, and texts, are as they are."""
    if column.dtype.kind != "f":
        return column
    with np.errstate(invalid="ignore", over="ignore"):
        good = np.abs(column) < MOST
        return column if np.all(good) else np.where(good, column, column.dtype.type(np.nan))


def as_us(t: np.ndarray) -> np.ndarray:
    """Times (N,) in us as whole numbers; -1 where one cannot be a time."""
    return np.where(np.abs(t) < MOST_US, t, -1.0).astype(np.int64)


def held(column: np.ndarray) -> np.ndarray:
    """A column (N,) or (N, k) whose missing rows hold the last value (the first one before it)."""
    known = whole(column)
    if not np.any(known) or np.all(known):
        return column
    rows = np.maximum.accumulate(np.where(known, np.arange(len(column)), 0))
    first = int(np.argmax(known))
    rows[:first] = first
    return column[rows]


def without_empty_attitude(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A quaternion of four zeros is none: the estimator had not started."""
    q = columns.get("quaternion")
    if q is None or not np.any(empty := np.all(q == 0.0, axis=1)):
        return columns
    return {**columns, "quaternion": np.where(empty[:, None], np.nan, q)}


def without_dead_battery(columns: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], list[str]]:
    """A voltage of zero or less is none: whoever flies has one. Told in a note; all of them: no voltage at all."""
    volts = columns.get("battery_voltage")
    if volts is None or not np.any(dead := volts <= 0.0):
        return columns, []
    if np.all(dead | ~np.isfinite(volts)):
        return {k: v for k, v in columns.items() if k != "battery_voltage"}, [
            "no battery voltage is above 0 V: left out"
        ]
    note = f"{int(dead.sum())} battery voltages of 0 V or less count as missing"
    return {**columns, "battery_voltage": np.where(dead, np.nan, volts)}, [note]


def continuous(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns with a unit, sign-continuous quaternion."""
    if (q := columns.get("quaternion")) is None:
        return columns
    unit = q / np.linalg.norm(q, axis=1, keepdims=True)
    return {**columns, "quaternion": continuous_quaternion(unit)}
