"""Body rates from a logged attitude, where no gyroscope was logged."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trueflight.groundstation.measured.low_pass import density
from trueflight.models.flight import Flight

ORDER = 3
"""Of the polynomial that is fitted to the attitude around each sample (Savitzky & Golay, Anal. Chem. 36, 1964)."""
HEADROOM = 2.5
"""Times the bandwidth of the angular acceleration at which the polynomial lets half of the power pass: below the
bandwidth itself it takes less than a percent."""
ABOVE_NOISE = 4.0
"""Times the power of the attitude's noise, at the frequency of which, twice differentiated, motion is seen in it."""
SLOWEST = 1.0
"""Hz below which an attitude's angular acceleration is not used: no rotor is told from another so slowly."""


@dataclass(frozen=True)
class AttitudeRate:
    """`rate` (N, 3) rad/s, body axes, of an attitude; it holds up to `band` Hz, above which the attitude's noise has
    the greater part. `rough` (N, 3) is the same by plain differences, whose noise is that of the attitude."""

    rate: np.ndarray
    rough: np.ndarray
    band: float


def turned_by(quaternion: np.ndarray, steps: int) -> np.ndarray:
    """Rotation vector (N - steps, 3), rad, body axes, that leads from each attitude (N, 4) to that `steps` later."""
    a, b = (quaternion[:-steps], quaternion[steps:]) if steps else (quaternion, quaternion)
    w = np.sum(a * b, axis=1)
    v = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] - np.cross(a[:, 1:], b[:, 1:])
    v = np.where(w[:, None] < 0.0, -v, v)
    size = np.linalg.norm(v, axis=1)
    angle = 2.0 * np.arctan2(size, np.abs(w))
    # the logarithm of a unit quaternion: twice the vector where it is small
    return v * np.where(size > 1e-12, angle / np.maximum(size, 1e-12), 2.0)[:, None]


def rate_from_attitude(
    quaternion: np.ndarray, dt: float, pieces: list[slice], bandwidth: float
) -> AttitudeRate | None:
    """Body rates of unit quaternions (N, 4), body to world, on a clock of `dt` s within `pieces` without a gap; None
    where the attitude shows no motion above its noise at `SLOWEST` Hz.

    Around each sample a cubic is fitted to the logarithm of the attitude relative to that sample, whose slope there is
    the body rate. `bandwidth` in Hz is that of what will be made of them.
    """
    fs = 1.0 / dt
    # half of the power passes at (ORDER + 1) / (3.2 half - 4.6) of the Nyquist frequency
    # (Schafer, IEEE Signal Processing Magazine 28(4), 2011)
    half = max(2, round(((ORDER + 1) * fs / (2.0 * HEADROOM * bandwidth) + 4.6) / 3.2))
    rate, rough = (np.zeros((len(quaternion), 3)) for _ in range(2))
    for piece in pieces:
        part = quaternion[piece]
        if len(part) < 2 * half + 2:
            continue
        rate[piece] = _slope(part, half, dt)
        rough[piece] = _slope(part, 1, dt)
    band = _band(max((rough[p] for p in pieces), key=len), fs, bandwidth)
    return None if band < SLOWEST else AttitudeRate(rate, rough, band)


def _slope(quaternion: np.ndarray, half: int, dt: float) -> np.ndarray:
    """Slope (N, 3), rad/s, of a polynomial through the attitudes up to `half` samples away; ends hold."""
    from scipy import signal  # dear to load, and most flights have a gyroscope

    taps = signal.savgol_coeffs(2 * half + 1, min(ORDER, 2 * half), deriv=1, delta=dt, use="dot")
    n = len(quaternion)
    slope = np.zeros((n, 3))
    for j in range(1, half + 1):
        step = turned_by(quaternion, j)  # from k to k + j; seen from k + j it is the same vector, backwards
        slope[half : n - half] += taps[half + j] * step[half : n - half]
        slope[half : n - half] -= taps[half - j] * step[half - j : n - half - j]
    slope[:half], slope[n - half :] = slope[half], slope[n - half - 1]
    return slope


def _band(rough: np.ndarray, fs: float, bandwidth: float) -> float:
    """Hz up to which the attitude moves by more than its noise, at most `bandwidth`; the noise is that of the upper end
    of its spectrum, where nothing turns a vehicle."""
    frequency, power = density(rough, fs, min(len(rough), round(4.0 * fs)))
    with np.errstate(divide="ignore", invalid="ignore"):
        # a rate's spectrum over that of a difference of white noise: the attitude's own
        attitude = power / (np.sin(2.0 * np.pi * frequency / fs) * fs)[:, None] ** 2
    inner = (frequency > 0.25) & (frequency < 0.45 * fs)
    frequency, attitude = frequency[inner], attitude[inner]
    noise = np.median(attitude[frequency > 0.35 * fs], axis=0)
    seen = attitude > ABOVE_NOISE * noise
    edges = [frequency[-1] if s.all() else frequency[int(np.argmin(s))] for s in seen[:, noise > 0.0].T]
    return float(min(bandwidth, max(edges, default=frequency[-1])))


def that_turns(flight: Flight, pieces: list[slice], bandwidth: float) -> tuple[Flight, AttitudeRate | None]:
    """The flight with body rates from its attitude, and what they are; as it is with a gyroscope, or without both."""
    if flight.angular_velocity is not None or flight.quaternion is None:
        return flight, None
    found = rate_from_attitude(flight.quaternion, flight.dt, pieces, bandwidth)
    return (flight, None) if found is None else (replace(flight, angular_velocity=found.rate), found)
