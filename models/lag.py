"""Delay and first-order lag of a sampled signal, exact for straight lines between the samples."""

from __future__ import annotations

import numpy as np


def delayed(signal: np.ndarray, delay: float, dt: float) -> np.ndarray:
    """`signal(t - delay)` (N,) on the samples' own clock of period `dt` s; the first value holds before the start."""
    n = np.arange(len(signal), dtype=float)
    return np.interp(n - delay / dt, n, signal)


def lagged(signal: np.ndarray, tau: float, dt: float) -> np.ndarray:
    """Response (N,) of `tau y' + y = signal`, started in equilibrium, first-order hold between samples of `dt` s."""
    if tau <= 1e-3 * dt:
        return signal
    a = np.exp(-dt / tau)
    mean = tau / dt * (1.0 - a)
    now, before = 1.0 - mean, mean - a
    taps = int(np.ceil(12.0 * tau / dt)) + 2
    decay = a ** np.arange(taps)
    kernel = now * decay
    kernel[1:] += before * decay[:-1]
    kernel[-1] += 1.0 - kernel.sum()
    padded = np.concatenate([np.full(taps - 1, signal[0]), signal])
    return np.convolve(padded, kernel, mode="valid")
