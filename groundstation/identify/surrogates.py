"""Made-up residuals that know nothing of the flight: what a structure must beat to be called one."""

from __future__ import annotations

import numpy as np

BURST = 1.0
"""s of residual that keep their sign together when signs are drawn: slower wander is kept by the random phases."""


def random_phases(
    residual: np.ndarray, burst: np.ndarray, count: int, rng: np.random.Generator
) -> np.ndarray:
    """(M, count, A): residuals (M, A) with the same spectra and cross spectra and random phases.

    Prichard & Theiler, "Generating surrogate data for time series with several simultaneously measured variables",
    Phys. Rev. Lett. 73, 1994.
    """
    spectrum = np.fft.rfft(residual, axis=0)
    turn = np.exp(2j * np.pi * rng.random((len(spectrum), count)))
    turn[0] = 1.0
    return np.fft.irfft(spectrum[:, None, :] * turn[:, :, None], n=len(residual), axis=0)


def random_signs(residual: np.ndarray, burst: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """(M, count, A): residuals (M, A) with the sign of each `burst` (M,) drawn anew, all axes alike.

    The wild cluster bootstrap of Cameron, Gelbach & Miller, Rev. Econ. Stat. 90, 2008.
    """
    signs = rng.choice([-1.0, 1.0], (int(burst.max()) + 1, count))
    return residual[:, None, :] * signs[burst][:, :, None]
