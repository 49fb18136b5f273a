"""Effects whose regressor is a noisy measurement itself: least squares finds them too small, unless its noise is taken
off first.

An accelerometer's lever arm goes with the derivative of the gyroscope, whose noise adds to the regressor's own energy
and explains nothing. Each such column is replaced by the best linear estimate of what it measures: every frequency is
kept by the part of its power that is not noise (Wiener). What an estimate of this kind leaves out is uncorrelated with
the estimate, so that least squares on it is no longer attenuated (regression calibration: Carroll, Ruppert, Stefanski &
Crainiceanu, Measurement Error in Nonlinear Models, 2nd ed., 2006, ch. 4).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from trueflight.models.flight import Flight

SMOOTHING = 0.05
"""Width of the band over which power is averaged, as a part of its frequency."""
NARROWEST = 8
"""Frequencies of the mirrored flight on either side that are averaged at least."""
SURE = 2.0
"""Standard deviations by which averaged power must be above the noise to be kept."""


def without_noise(flight: Flight, columns: Iterable[str]) -> Flight:
    """The flight with its columns of these names as the best linear estimate of what they measure."""
    changes: dict[str, Any] = {name: _estimated(flight.column(name)) for name in columns if flight.has(name)}
    return replace(flight, **changes)


def _estimated(column: np.ndarray) -> np.ndarray:
    """Columns (N, k) without the white noise that their third differences show: these leave motion alone, and the
    median is deaf to shocks."""
    n = len(column)
    sigma = np.median(np.abs(np.diff(column, n=3, axis=0)), axis=0) / 0.6745 / np.sqrt(20.0)
    # mirrored, so that both ends meet
    both = np.concatenate([column, column[::-1]])
    spectrum = np.fft.rfft(both, axis=0)
    count = _averaged(len(spectrum))
    power = np.apply_along_axis(_smoothed, 0, np.abs(spectrum) ** 2)
    # what is averaged is itself uncertain, and noise alone must not be kept where it happens to be strong
    noise = 2.0 * n * sigma**2 * (1.0 + SURE / np.sqrt(count))[:, None]
    kept = np.clip(1.0 - noise / np.maximum(power, 1e-30), 0.0, 1.0)
    kept[0] = 1.0
    return np.asarray(np.fft.irfft(spectrum * kept, n=2 * n, axis=0)[:n])


def _averaged(count: int) -> np.ndarray:
    """Frequencies of the flight over which each of `count` of the mirrored one's is averaged, (F,)."""
    return np.maximum(NARROWEST, (0.5 * SMOOTHING * np.arange(count)).astype(int)).astype(float)


def _smoothed(power: np.ndarray) -> np.ndarray:
    """Power (F,) averaged over a band that widens with the frequency."""
    sums = np.concatenate([[0.0], np.cumsum(power)])
    k = np.arange(len(power))
    half = _averaged(len(power)).astype(int)
    low, high = np.maximum(k - half, 0), np.minimum(k + half + 1, len(power))
    return np.asarray((sums[high] - sums[low]) / (high - low))
