"""Narrow lines in the spectrum of what a model leaves over: vibration, or a loop that oscillates.

Welch's averaged periodogram against the running median of its neighbourhood. Under noise of a smooth spectrum the
ratio of an average over K independent segments has a gamma distribution of shape K (Percival & Walden 1993, section
6.17), which gives each peak its significance, shared by all frequencies and axes (Bonferroni).
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage, signal, stats

from groundstation.measurement import Measurement
from groundstation.results import SpectralLine

FAMILY = 0.01
"""Probability that noise shows any line at all."""
SEGMENT = 4.0
"""s of each segment: lines are told apart at 0.5 Hz."""
NEIGHBOURHOOD = 5.0
"""Hz of the running median that tells what noise does here; a peak much wider than a tenth of it is no line."""
LOWEST = 0.75
"""Hz below which the flight's own motion fills the spectrum."""
MATERIAL = 0.03
"""m/s² RMS of a line."""
MOST_LINES = 4


def spectral_lines(measurement: Measurement, residual: np.ndarray) -> tuple[SpectralLine, ...]:
    """Lines of `residual` (K, A), the used samples of `measurement`, and of the raw accelerometer above its bandwidth.

    The strongest first, no more than four.
    """
    m, flight = measurement, measurement.flight
    period = float(np.median(np.diff(m.t)))
    placed = np.full((len(m.t), residual.shape[1]), np.nan)
    placed[m.used] = residual
    found = _lines(placed, period, LOWEST, m.bandwidth, m.axes)
    if flight.specific_force is not None and flight.accelerometer and 0.5 / flight.dt > 1.2 * m.bandwidth:
        raw = flight.specific_force.copy()
        if flight.flying is not None:
            raw[~flight.flying] = np.nan
        found += _lines(raw[:, m.axes], flight.dt, m.bandwidth, 0.5 / flight.dt - 1.0, m.axes)
    lines = [
        SpectralLine(f, "xyz"[a], rms, p, f <= m.bandwidth, _cause(measurement, f)) for f, a, rms, p in found
    ]
    return tuple(sorted(lines, key=lambda line: -line.rms)[:MOST_LINES])


def _lines(
    columns: np.ndarray, period: float, lowest: float, highest: float, axes: tuple[int, ...]
) -> list[tuple[float, int, float, float]]:
    """Frequency, axis, RMS and p-value of each line of columns (N, A), NaN where nothing counts."""
    frequency, power, count = _welch(columns, period)
    if count == 0:
        return []
    step = frequency[1]
    inside = (frequency >= lowest) & (frequency <= highest)
    # the median of a gamma variable is below its mean
    middle = stats.gamma.ppf(0.5, count) / count
    width = max(5, 2 * round(0.5 * NEIGHBOURHOOD / step) + 1)
    found = []
    for column, axis in enumerate(axes):
        noise = ndimage.median_filter(power[:, column], width, mode="nearest") / middle
        ratio = power[:, column] / np.maximum(noise, 1e-30)
        p = stats.gamma.sf(ratio * count, count) * inside.sum() * len(axes)
        # a segment's window spreads a line over three bins
        peaks, _ = signal.find_peaks(np.where(inside, ratio, 0.0), distance=max(1, round(1.0 / step)))
        for peak in peaks:
            around = slice(max(peak - 2, 0), peak + 3)
            excess = np.maximum(power[around, column] - noise[around], 0.0)
            rms = float(np.sqrt(np.sum(excess) * step))
            if p[peak] < FAMILY and rms > MATERIAL:
                found.append((float(np.average(frequency[around], weights=excess)), axis, rms, float(p[peak])))
    return found


def _welch(columns: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Frequencies (F,), power density (F, A) and the number of independent segments it averages."""
    length = round(SEGMENT / period)
    window = signal.windows.hann(length, sym=False)
    scale = 2.0 * period / np.sum(window**2)
    good = np.all(np.isfinite(columns), axis=1).astype(int)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good, [0]])))
    total, count = np.zeros((length // 2 + 1, columns.shape[1])), 0
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        for begin in range(start, stop - length + 1, length // 2):
            part = columns[begin : begin + length]
            spectrum = np.fft.rfft((part - part.mean(axis=0)) * window[:, None], axis=0)
            total += scale * np.abs(spectrum) ** 2
            count += 1
    # half-overlapping Hann segments correlate by 1/6 (Welch 1967)
    independent = count if count < 2 else count * 18.0 / 19.0
    return np.fft.rfftfreq(length, period), total / max(count, 1), independent


def _cause(m: Measurement, frequency: float) -> str:
    """What a line at this frequency may be."""
    flight = m.flight
    rate = 1.0 / flight.dt
    if flight.rotor_speed is not None:
        flying = slice(None) if flight.flying is None else flight.flying
        turning = float(np.nanmedian(flight.rotor_speed[flying])) / (2.0 * np.pi)
        for multiple, what in ((1, "once a turn of the rotors: one is out of balance"), (2, "the blades pass")):
            f = multiple * turning
            seen = abs(f - rate * round(f / rate))
            if turning > 1.0 and abs(seen - frequency) < 0.03 * f:
                alias = f", seen from {f:.0f} Hz by sampling at {rate:.0f} Hz" if f > 0.5 * rate else ""
                return f"vibration, {what}{alias}"
    if flight.angular_velocity is not None and frequency < 0.4 * rate:
        rates = flight.angular_velocity.copy()
        if flight.flying is not None:
            rates[~flight.flying] = np.nan
        f, power, count = _welch(rates, flight.dt)
        if count:
            here = int(np.argmin(np.abs(f - frequency)))
            near = (np.abs(f - frequency) < 0.5 * NEIGHBOURHOOD) & (f > LOWEST)
            if np.any(power[max(here - 1, 0) : here + 2] > 5.0 * np.median(power[near], axis=0)):
                return "the body rates swing with it: a control loop oscillates, or a mode of the frame"
    if frequency > m.bandwidth:
        return "vibration above the band of the comparison, perhaps aliased: mount the accelerometer softer"
    return "the body rates do not show it: vibration, perhaps aliased from above half the logging rate"
