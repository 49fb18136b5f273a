"""A Butterworth low-pass without delay, and the spectrum of a column, by Fourier transform.

Forward and backward in time a filter's gain is the square of its magnitude, and a transform of the whole flight applies
that in a third of the time of the recursion. Nothing here needs scipy.signal, which takes longer to load than a flight
of a minute takes to be filtered a thousand times.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import fft

ORDER = 4
REACH = 6.0
"""Periods of the bandwidth after which nothing of a step is left: less than a millionth."""
SAMPLES = 64
"""Samples after which that is so, however near to half the sampling rate the bandwidth is."""
NOTHING = 1e-13
"""Columns that are no larger than this are rounding errors of zero, whatever their unit is."""


def gain(frequency: np.ndarray, bandwidth: float, fs: float, order: int = ORDER) -> np.ndarray:
    """Factor of the filter at each `frequency` (F,) in Hz, sampled at `fs` Hz: that of a Butterworth filter of an
    `order`, designed by the bilinear transform, forward and backward."""
    with np.errstate(over="ignore"):
        ratio = np.tan(np.pi * np.minimum(frequency / fs, 0.5)) / np.tan(np.pi * bandwidth / fs)
        return np.asarray(1.0 / (1.0 + ratio ** (2 * order)))


def low_pass(
    columns: np.ndarray, bandwidth: float, fs: float, every: int = 1, order: int = ORDER
) -> np.ndarray:
    """Columns (N, k) sampled at `fs` Hz behind the filter of `bandwidth` Hz, every so many rows of them.

    Both ends are continued by a second of their mirror image, turned about the end, and then held.
    """
    n, count = columns.shape
    pad = min(n - 1, int(fs))
    hold = max(0, int(np.ceil(REACH * fs / bandwidth)) - pad, SAMPLES - pad)
    first = hold + pad
    size = fft.next_fast_len(n + 2 * first, real=True)
    out = np.zeros((count, -(-n // every)))
    loud = [j for j, x in enumerate(columns.T) if not float(x @ x) <= n * NOTHING**2]
    if not loud:
        return out.T
    x = columns.T[loud]
    wide = np.empty((len(loud), size))
    wide[:, hold:first] = 2.0 * x[:, :1] - x[:, pad:0:-1]
    wide[:, first : first + n] = x
    wide[:, first + n : first + n + pad] = 2.0 * x[:, -1:] - x[:, -2 : -pad - 2 : -1]
    wide[:, :hold] = wide[:, hold : hold + 1]
    wide[:, first + n + pad :] = wide[:, first + n + pad - 1 : first + n + pad]
    turned = fft.rfft(wide, overwrite_x=True) * _gain(size, bandwidth, fs, order)
    out[loud] = fft.irfft(turned, size, overwrite_x=True)[:, first : first + n : every]
    return out.T


@lru_cache(maxsize=64)
def _gain(size: int, bandwidth: float, fs: float, order: int) -> np.ndarray:
    return gain(fft.rfftfreq(size, 1.0 / fs), bandwidth, fs, order)


def hann(length: int) -> np.ndarray:
    """A periodic Hann window (length,)."""
    return np.asarray(0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length))


def density(columns: np.ndarray, fs: float, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (F,) in Hz and power density (F, k) of columns (N, k): the mean over Hann windows of `length` rows
    that overlap by half (Welch, IEEE Trans. Audio Electroacoust. 15, 1967)."""
    window = hann(length)
    step = length - length // 2
    total = np.zeros((length // 2 + 1, columns.shape[1]))
    starts = range(0, len(columns) - length + 1, step)
    for start in starts:
        part = columns[start : start + length]
        total += np.abs(fft.rfft((part - part.mean(axis=0)) * window[:, None], axis=0)) ** 2
    total *= 1.0 / (len(starts) * fs * np.sum(window**2))
    total[1 : len(total) - (length % 2 == 0)] *= 2.0
    return fft.rfftfreq(length, 1.0 / fs), total
