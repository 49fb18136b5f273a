"""One even clock: duplicated samples, lost samples and gaps.

Filters and open-loop predictions need even sampling. A flight whose intervals are uneven is interpolated onto
its median period; intervals longer than a gap are never bridged: the flight falls into segments there.
"""

from __future__ import annotations

import itertools

import numpy as np

from trueflight.models.errors import InputError

GAP_PERIODS = 4.5
GAP_SECONDS = 0.05
MOST_LOST = 0.25
UNEVEN = 0.25
"""An interval that differs from the median by more than this share makes the clock uneven."""


def gap_length(dt: float) -> float:
    """The interval (s) from which on samples count as separated by a gap: 50 ms, or 4.5 sample periods."""
    return max(GAP_SECONDS, GAP_PERIODS * dt)


def segments(t: np.ndarray) -> tuple[slice, ...]:
    """The unbroken stretches of a flight's clock `t` (N,), as slices; what is computed across samples
    (filters, derivatives, predictions) must stay within one."""
    steps = np.diff(t)
    breaks = np.flatnonzero(steps > gap_length(float(np.median(steps)))) + 1
    edges = [0, *breaks.tolist(), len(t)]
    return tuple(slice(a, b) for a, b in itertools.pairwise(edges))


def even_clock(
    t: np.ndarray, columns: dict[str, np.ndarray], origin: str, most_lost: float = MOST_LOST
) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    """Put columns (N, ...) of a strictly increasing clock `t` (N,) on even sampling within each segment.

    Quaternions (a column of that name) keep their sign continuous and their norm 1. Returns the new clock,
    the new columns and notes on what was done. Raises `InputError` where more than the share
    `most_lost` of the samples is lost.
    """
    notes: list[str] = []
    steps = np.diff(t)
    dt = float(np.median(steps))
    parts = segments(t)
    lost = float(np.sum(np.maximum(steps / dt - 1.0, 0.0)) * dt / (t[-1] - t[0]))
    if lost > most_lost:
        worst = int(np.argmax(steps))
        raise InputError(
            f"{origin}: {100 * lost:.0f} % of the samples are lost, most in {steps[worst]:.2f} s after "
            f"t = {t[worst]:.2f} s; cut the flight there, or log at a rate that the logger holds"
        )
    if len(parts) > 1:
        longest = int(np.argmax(steps))
        notes.append(
            f"{len(parts) - 1} gap{'s' if len(parts) > 2 else ''} in the log, the longest "
            f"{steps[longest]:.2f} s "
            f"at t = {t[longest]:.2f} s; nothing is computed across"
        )
    within = np.concatenate([np.diff(t[part]) for part in parts])
    uneven = np.abs(within / dt - 1.0) > UNEVEN
    if not np.any(uneven):
        return t, columns, notes
    notes.append(
        f"{int(np.sum(uneven))} uneven sample intervals ({1e3 * within.min():.1f} to "
        f"{1e3 * within.max():.1f} ms): "
        f"interpolated onto an even clock of {1 / dt:.0f} Hz"
    )
    clocks: list[np.ndarray] = []
    pieces: dict[str, list[np.ndarray]] = {name: [] for name in columns}
    for part in parts:
        old = t[part]
        clock = old[0] + dt * np.arange(int(np.floor((old[-1] - old[0]) / dt + 1e-9)) + 1)
        clocks.append(clock)
        for name, column in columns.items():
            pieces[name].append(interpolate(clock, old, column[part], unit_quaternion=name == "quaternion"))
    joined = {name: np.concatenate(piece) for name, piece in pieces.items()}
    return np.concatenate(clocks), joined, notes


def interpolate(
    clock: np.ndarray, t: np.ndarray, column: np.ndarray, *, unit_quaternion: bool = False
) -> np.ndarray:
    """A column (N,) or (N, k) given at `t` (N,), linearly interpolated at `clock` (M,); truth values stay
    so."""
    if column.dtype == bool:
        return column[np.clip(np.searchsorted(t, clock, side="right") - 1, 0, len(t) - 1)]
    if column.ndim == 1:
        return np.interp(clock, t, column)
    if unit_quaternion:
        column = continuous_quaternion(column)
    out = np.stack([np.interp(clock, t, axis) for axis in column.T], -1)
    return out / np.linalg.norm(out, axis=1, keepdims=True) if unit_quaternion else out


def slopes(t: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Derivative of a column (N, k) on an even clock `t` (N,), within each segment."""
    out = np.zeros_like(column)
    for part in segments(t):
        if part.stop - part.start > 1:
            out[part] = np.gradient(column[part], t[part], axis=0)
    return out


def trend(t: np.ndarray, column: np.ndarray, reach: float) -> np.ndarray:
    """Derivative of a column (N, k) on an even clock `t` (N,): of the straight line through what is within `reach` s
    before and after (Savitzky & Golay, Anal. Chem. 36, 1964), within each segment. A centimetre of noise at 100 Hz is
    0.7 m/s between neighbours, and 4 cm/s over a tenth of a second on either side."""
    out = slopes(t, column)
    half = round(reach / float(np.median(np.diff(t))))
    if half < 2:
        return out
    k = np.arange(-half, half + 1)
    weights = k / float(np.sum(k**2)) / float(np.median(np.diff(t)))
    for part in segments(t):
        if part.stop - part.start > 2 * half:
            inner = np.stack([np.correlate(axis, weights, "valid") for axis in column[part].T], axis=-1)
            out[part] = np.pad(inner, ((half, half), (0, 0)), mode="edge")
    return out


def continuous_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4) with signs chosen so that neighbours are near each other (q and -q are one
    attitude)."""
    flips = np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0
    signs = np.where(np.concatenate([[0], np.cumsum(flips)]) % 2 == 1, -1.0, 1.0)
    return quaternion * signs[:, None]
