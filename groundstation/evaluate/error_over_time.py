"""The residual of a comparison along the flight, as curves and colours show it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trueflight.groundstation.results import Comparison


def rolling_rms(residual: np.ndarray, used: np.ndarray, width: int) -> np.ndarray:
    """RMS (N,) per axis of a residual (N, 3) over `width` samples; nan where little of them counts."""
    square = np.where(used, np.nanmean(np.where(used[:, None], residual, 0.0) ** 2, axis=1), 0.0)
    window = np.ones(max(width, 1))
    total, count = np.convolve(square, window, "same"), np.convolve(used.astype(float), window, "same")
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count > 0.3 * len(window), np.sqrt(total / count), np.nan)


@dataclass(frozen=True)
class ErrorOverTime:
    """The rolling RMS (N,) of a comparison's residual, m/s², and the value at which its colours end."""

    comparison: Comparison
    values: np.ndarray
    highest: float
    smoothing: float  # s


def error_over_time(comparison: Comparison, smoothing: float, highest: float | None = None) -> ErrorOverTime:
    """The residual of `comparison`, RMS over `smoothing` s; colours end at its greatest value unless told."""
    values = rolling_rms(comparison.residual, comparison.used, round(smoothing / comparison.flight.dt))
    finite = values[np.isfinite(values)]
    if highest is None:
        highest = float(finite.max()) if finite.size else 1.0
    return ErrorOverTime(comparison, values, highest, smoothing)
