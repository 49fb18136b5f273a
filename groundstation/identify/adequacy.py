"""Is what is left only noise? Judged as a whole, over time and over frequency, whatever can be predicted in it.

The residual of each axis is held against the noise that its sensor alone would leave behind the same filter: its size,
its spectrum from one period a flight to the band's edge, and its course. What is well above is a misfit, with when,
how fast and along which axes. While there is one, the residual is no noise that averages out, and evidence has to be
weighed with its own spectrum (`identify.doubt`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from trueflight.groundstation.identify.spectrum import own_period
from trueflight.groundstation.measured.bins import bins
from trueflight.groundstation.measured.measurement import Measurement
from trueflight.groundstation.results import Misfit
from trueflight.models.frames import rotate

ABOVE = 1.5
"""Times the noise from which a residual is a misfit: the noise of a sensor is known from its own log to about a
quarter, and laws of the catalogue leave as much again."""
MATERIAL = 0.05
"""m/s² RMS beyond the noise from which it is told: 5 mg, a tenth of what turns up as an error of a metre in five
seconds."""
SLOW = 10.0
"""Periods a flight below which a misfit is told as slow."""
MOST = 0.5
"""Part of a misfit that one description must hold to be told as its course."""


@dataclass(frozen=True)
class Spectrum:
    """Variance of one column by frequency: `power` (F,) sums to the mean square of the used samples, `noise` (F,) is
    what the sensor alone would leave."""

    frequency: np.ndarray
    power: np.ndarray
    noise: np.ndarray


def misfits(m: Measurement, residual: np.ndarray) -> tuple[Misfit, ...]:
    """Axes on which `residual` (K, A) is well above the noise of `m`, the largest first; in world axes where a misfit
    of the horizontal ones is simpler told there."""
    noise = m.noise[list(m.axes)]
    rms = np.sqrt(np.mean(residual**2, axis=0))
    beyond = np.sqrt(np.maximum(rms**2 - noise**2, 0.0))
    if not np.any((rms > ABOVE * noise) & (beyond > MATERIAL)):
        return ()
    found = []
    for frame, columns, names in _views(m, residual):
        told = [_described(m, columns[:, i], float(noise[i]), frame, "xyz"[a]) for i, a in names]
        found.append([x for x in told if x is not None])
    # told in the frame in which fewer words hold more of it
    best = max(found, key=lambda told: sum(x.rms**2 * (1.0 + x.held) for x in told))
    return tuple(sorted(best, key=lambda x: -x.rms))


def excess(m: Measurement, residual: np.ndarray) -> float:
    """Part of the squared residual (K, A) that is beyond the noise, 0 to 1."""
    total = float(np.mean(residual**2, axis=0).sum())
    return max(0.0, 1.0 - float(np.sum(m.noise[list(m.axes)] ** 2)) / max(total, 1e-30))


def spectrum_of(m: Measurement, column: np.ndarray, noise: float) -> Spectrum:
    """The spectrum of a column (K,) of the used samples; stretches that do not count hold nothing."""
    period = float(np.median(np.diff(m.t)))
    placed = np.zeros(len(m.t))
    placed[m.used] = column
    power = np.abs(np.fft.rfft(placed)) ** 2
    power[1:] *= 2.0
    power = power / max(power.sum(), 1e-30) * float(np.mean(column**2))
    frequency = np.fft.rfftfreq(len(placed), period)
    return Spectrum(frequency, power, noise**2 * _shape(m, frequency))


def _shape(m: Measurement, frequency: np.ndarray) -> np.ndarray:
    """How white noise of the sensor spreads behind the filter, summing to one; differentiated it grows with the
    frequency."""
    passed = 1.0 / (1.0 + (frequency / m.bandwidth) ** 8) ** 2
    passed = passed if m.flight.specific_force is not None else passed * frequency**2
    return np.asarray(passed / max(passed.sum(), 1e-30))


def _views(m: Measurement, residual: np.ndarray) -> list[tuple[str, np.ndarray, list[tuple[int, int]]]]:
    """The residual in body axes, and in the world's where it can be turned there: frame, columns, (column, axis)."""
    body = ("body", residual, list(enumerate(m.axes)))
    if m.axes != (0, 1, 2) or m.flight.quaternion is None:
        return [body]
    turned = rotate(m.flight.quaternion[m.rows][m.used], residual)
    return [body, ("world", turned, [(0, 0), (1, 1), (2, 2)])]


def _described(m: Measurement, column: np.ndarray, noise: float, frame: str, axis: str) -> Misfit | None:
    """One axis' misfit in words: two levels, a line, or the band and the stretch that hold most of it."""
    rms = float(np.sqrt(np.mean(column**2)))
    beyond = float(np.sqrt(max(rms**2 - noise**2, 0.0)))
    if rms <= ABOVE * noise or beyond <= MATERIAL:
        return None
    spectrum = spectrum_of(m, column, noise)
    told, held = max(
        (_constant(column, beyond), _levels(m, column, beyond), _line(m, column, spectrum, beyond)),
        key=lambda pair: pair[1],
    )
    low, high = _band(spectrum)
    if held < MOST:
        told, held = _fast(m, column, low, high), 0.0
    text = f"{beyond:.2f} m/s² on {frame} {axis} beyond the noise of {noise:.2g}: {told}"
    return Misfit(frame, axis, beyond, noise, low, high, held, text)


def _constant(column: np.ndarray, beyond: float) -> tuple[str, float]:
    mean = float(np.mean(column))
    return f"a constant of {mean:.2f} m/s²", min(mean**2 / beyond**2, 1.0)


def _levels(m: Measurement, column: np.ndarray, beyond: float) -> tuple[str, float]:
    """One level before a moment and another after: the best moment, and the part of the misfit that both levels
    hold."""
    t, averaged = bins(m.t[m.used], 1.0)
    y = averaged(column[:, None])[:, 0]
    if len(y) < 6:
        return "", 0.0
    count = np.arange(1, len(y))
    sums = np.cumsum(y)
    before, after = sums[:-1] / count, (sums[-1] - sums[:-1]) / (len(y) - count)
    held = (count * before**2 + (len(y) - count) * after**2) / len(y)
    held[:2] = held[-2:] = 0.0
    k = int(np.argmax(held))
    # two levels are one more number than a constant, and have to hold clearly more
    gained = float(held[k] - np.mean(y) ** 2)
    text = f"slow: {before[k]:+.2f} m/s² before {t[k + 1]:.0f} s, {after[k]:+.2f} after"
    return text, min(float(held[k]) / beyond**2, 1.0) if gained > 0.2 * beyond**2 else 0.0


def _line(m: Measurement, column: np.ndarray, s: Spectrum, beyond: float) -> tuple[str, float]:
    """A narrow peak of the spectrum above four periods a flight, and the part of the misfit that it holds."""
    first = 4.0 * s.frequency[1]
    above = np.where(s.frequency >= first, np.maximum(s.power - s.noise, 0.0), 0.0)
    smooth = ndimage.uniform_filter1d(above, 5, mode="constant")
    k = int(np.argmax(smooth))
    f = float(s.frequency[k])
    width = max(2.5 * s.frequency[1], 0.12 * f)
    near = np.abs(s.frequency - f) <= width
    held = float(above[near].sum()) / beyond**2
    core = slice(max(k - 2, 0), k + 3)
    f = float(np.average(s.frequency[core], weights=above[core] + 1e-30))
    # a smooth spectrum holds as much in the same width beside it
    beside = (np.abs(s.frequency - f) <= 3.0 * width) & ~near & (s.frequency >= first)
    if above[beside].sum() > 0.5 * above[near].sum():
        return "", 0.0
    own = ", at which the flight itself repeats" if own_period(m.flight, f) else ""
    return f"{f:.2g} Hz{_course(m, column, f)}{own}", min(held, 1.0)


def _course(m: Measurement, column: np.ndarray, f: float) -> str:
    """Whether a line swells and dies away over the flight."""
    from scipy import signal  # dear to load, and few flights have a line

    period = float(np.median(np.diff(m.t)))
    placed = np.zeros(len(m.t))
    placed[m.used] = column
    if f > 0.4 / period:
        return ""
    sos = signal.butter(2, [0.7 * f, min(1.4 * f, 0.49 / period)], "bandpass", fs=1.0 / period, output="sos")
    envelope = np.abs(signal.hilbert(signal.sosfiltfilt(sos, placed)))[m.used]
    low, high = np.quantile(envelope, [0.1, 0.9])
    if high < 2.5 * low:
        return ", steady"
    _, averaged = bins(m.t[m.used], max(1.0 / f, 1.0))
    course = averaged(envelope[:, None])[:, 0]
    # what is struck rises at once and dies slowly
    rises = np.diff(course)
    struck = float(np.mean((rises - rises.mean()) ** 3)) > 0.5 * float(np.std(rises)) ** 3
    return ", it comes at once and dies away" if struck else ", it comes and goes"


def _band(s: Spectrum) -> tuple[float, float]:
    """The frequencies between which the middle four fifths of what is beyond the noise lie, Hz."""
    above = np.maximum(s.power - s.noise, 0.0)
    share = np.cumsum(above) / max(float(above.sum()), 1e-30)
    low, high = np.searchsorted(share, [0.1, 0.9])
    return float(s.frequency[low]), float(s.frequency[min(high, len(share) - 1)])


def _fast(m: Measurement, column: np.ndarray, low: float, high: float) -> str:
    """How fast it is, and the stretch that holds most of it, where one does."""
    duration = float(m.t[-1] - m.t[0])
    how = "slow, " if high < SLOW / duration else ""
    how += f"below {high:.2g} Hz" if low < 2.0 / duration else f"{low:.2g} to {high:.2g} Hz"
    t, averaged = bins(m.t[m.used], 1.0)
    energy = averaged(column[:, None] ** 2)[:, 0]
    length = max(1, len(energy) // 5)
    sums = np.convolve(energy, np.ones(length), mode="valid")
    k = int(np.argmax(sums))
    if sums[k] > 0.6 * energy.sum():
        return f"{how}, most of it between {t[k]:.0f} and {t[k + length - 1] + 1.0:.0f} s"
    return how
