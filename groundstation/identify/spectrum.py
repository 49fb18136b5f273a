"""Narrow lines in the spectrum of what a model leaves over: vibration, a loop that oscillates, a load that swings.

Each segment's periodogram is divided by the running median of its own neighbourhood, so that a burst counts no more
than a quiet stretch, and then averaged (Welch 1967). Under noise of a smooth spectrum an average over K independent
segments has a gamma distribution of shape K, which gives each peak its significance, shared by all frequencies and
axes (Bonferroni). Slower than segments resolve, down to a few periods a flight, the periodogram of all of it is held
against its own neighbourhood in the same way.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage, special

from trueflight.groundstation.measured.low_pass import hann
from trueflight.groundstation.measured.measurement import Measurement
from trueflight.groundstation.results import SpectralLine
from trueflight.models.flight import Flight

FAMILY = 0.01
"""Probability that noise shows any line at all."""
SEGMENT = 4.0
"""s of each segment: lines are told apart at 0.5 Hz."""
NEIGHBOURHOOD = 5.0
"""Hz of the running median that tells what noise does here; a peak much wider than a tenth of it is no line."""
LOWEST = 0.5 * NEIGHBOURHOOD
"""Hz below which segments have no neighbourhood: slower lines are looked for in the flight as a whole."""
PERIODS = 4
"""Periods a flight of the slowest line: fewer are a wander."""
WIDE = 0.3
"""Part of a slow line's frequency on either side that is its neighbourhood."""
REPEATS = 5.0
"""Times its neighbourhood at which the flight's own motion counts as a period."""
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
    found += _slow_lines(np.nan_to_num(placed), period, m.axes)
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
    frequency, spectra, count = _spectra(columns, period)
    if count == 0:
        return []
    step = frequency[1]
    inside = (frequency >= lowest) & (frequency <= highest)
    width = max(5, 2 * round(0.5 * NEIGHBOURHOOD / step) + 1)
    # the median of an exponential variable is ln 2 of its mean
    noise = ndimage.median_filter(spectra, (1, width, 1), mode="nearest") / np.log(2.0)
    ratio = np.mean(spectra / np.maximum(noise, 1e-30), axis=0)
    p = special.gammaincc(count, ratio * count) * inside.sum() * len(axes)
    power, floor = spectra.mean(axis=0), noise.mean(axis=0)
    found = []
    for column, axis in enumerate(axes):
        for peak in peaks(np.where(inside, ratio[:, column], 0.0), max(1, round(1.0 / step))):
            # a segment's window spreads a line over three bins
            around = slice(max(peak - 2, 0), peak + 3)
            excess = np.maximum(power[around, column] - floor[around, column], 0.0)
            rms = float(np.sqrt(np.sum(excess) * step))
            if p[peak, column] < FAMILY and rms > MATERIAL:
                f = float(np.average(frequency[around], weights=excess))
                found.append((f, axis, rms, float(p[peak, column])))
    return found


def _slow_lines(
    columns: np.ndarray, period: float, axes: tuple[int, ...]
) -> list[tuple[float, int, float, float]]:
    """Frequency, axis, RMS and p-value of each line below `LOWEST` of columns (N, A), zero where nothing counts."""
    frequency, power = _whole(columns, period)
    inside = (frequency >= PERIODS * frequency[1]) & (frequency < LOWEST)
    found = []
    for column, axis in enumerate(axes):
        ratio = np.where(inside, power[:, column] / _neighbours(frequency, power[:, column]), 0.0)
        for peak in peaks(ratio, PERIODS):
            p = float(np.exp(-ratio[peak])) * int(inside.sum()) * len(axes)
            # the window spreads a line over three frequencies
            around = slice(max(peak - 2, 0), peak + 3)
            rms = float(np.sqrt(power[around, column].sum()))
            if p < FAMILY and rms > MATERIAL:
                f = float(np.average(frequency[around], weights=power[around, column]))
                found.append((f, axis, rms, p))
    return found


def peaks(values: np.ndarray, distance: int) -> list[int]:
    """Where `values` (F,) are greater than on both sides, and than all others so near that are."""
    tops = np.flatnonzero((values[1:-1] > values[:-2]) & (values[1:-1] > values[2:])) + 1
    kept: list[int] = []
    for top in tops[np.argsort(-values[tops], kind="stable")]:
        if all(abs(int(top) - other) >= distance for other in kept):
            kept.append(int(top))
    return sorted(kept)


def _whole(columns: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (F,) and mean square by frequency (F, A) of a flight as a whole, Hann window."""
    window = hann(len(columns))
    power = np.abs(np.fft.rfft((columns - columns.mean(axis=0)) * window[:, None], axis=0)) ** 2
    scale = 2.0 / (len(columns) * np.sum(window**2))
    return np.fft.rfftfreq(len(columns), period), scale * power


def _neighbours(frequency: np.ndarray, power: np.ndarray) -> np.ndarray:
    """What noise does around each frequency (F,): the median over a band that widens with it."""
    out = np.empty(len(power))
    last = int(np.searchsorted(frequency, 2.0 * LOWEST))
    for k in range(len(power)):
        half = max(2 * PERIODS, round(WIDE * k))
        out[k] = np.median(power[max(k - half, 1) : k + half + 1]) if k <= last else np.inf
    return np.maximum(out / np.log(2.0), 1e-30)


def own_period(flight: Flight, frequency: float) -> bool:
    """Whether the flight itself repeats at this frequency, Hz: its references, or its motion without them."""
    columns = flight.position_reference if flight.position_reference is not None else flight.velocity
    if columns is None or frequency > LOWEST:
        return False
    flown = slice(None) if flight.flying is None else flight.flying
    grid, power = _whole(np.nan_to_num(columns[flown]), flight.dt)
    if frequency < 2.0 * grid[1]:
        return False
    near = np.abs(grid - frequency) <= max(1.5 * grid[1], 0.05 * frequency)
    for column in power.T:
        peak = float(column[near].max(initial=0.0))
        beside = (np.abs(grid - frequency) < max(0.5 * frequency, 4.0 * grid[1])) & ~near
        if peak > REPEATS * max(float(np.mean(column[beside])), 1e-30) and peak > 0.01 * float(column.sum()):
            return True
    return False


def _spectra(columns: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Frequencies (F,), power densities (S, F, A) of segments, and how many independent segments they are worth."""
    length = round(SEGMENT / period)
    window = hann(length)
    scale = 2.0 * period / np.sum(window**2)
    good = np.all(np.isfinite(columns), axis=1).astype(int)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good, [0]])))
    spectra = []
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        for begin in range(start, stop - length + 1, length // 2):
            part = columns[begin : begin + length]
            turned = np.fft.rfft((part - part.mean(axis=0)) * window[:, None], axis=0)
            spectra.append(scale * np.abs(turned) ** 2)
    # half-overlapping Hann segments correlate by 1/6
    independent = len(spectra) if len(spectra) < 2 else len(spectra) * 18.0 / 19.0
    frequencies = np.fft.rfftfreq(length, period)
    return frequencies, np.array(spectra).reshape(-1, len(frequencies), columns.shape[1]), independent


def _cause(m: Measurement, frequency: float) -> str:
    """What a line at this frequency may be."""
    flight = m.flight
    rate = 1.0 / flight.dt
    if frequency < LOWEST:
        if own_period(flight, frequency):
            return "the flight itself repeats at that rate: what goes with its motion looks the same"
        return "the flight does not repeat at that rate: gusts, a load that swings, or a loop that does"
    if flight.rotor_speed is not None:
        flying = slice(None) if flight.flying is None else flight.flying
        turns = flight.rotor_speed[flying] / (2.0 * np.pi)
        turning, spread = float(np.nanmedian(turns)), float(np.nanstd(turns))
        for multiple, what in (
            (1, "once a turn of the rotors: one is out of balance"),
            (2, "the blades pass"),
        ):
            f = multiple * turning
            seen = abs(f - rate * round(f / rate))
            if turning > 1.0 and multiple * spread < NEIGHBOURHOOD and abs(seen - frequency) < 1.0:
                alias = f", seen from {f:.0f} Hz by sampling at {rate:.0f} Hz" if f > 0.5 * rate else ""
                return f"vibration, {what}{alias}"
    if flight.angular_velocity is not None and frequency < 0.4 * rate:
        rates = flight.angular_velocity.copy()
        if flight.flying is not None:
            rates[~flight.flying] = np.nan
        grid, spectra, count = _spectra(rates, flight.dt)
        if count:
            power = spectra.mean(axis=0)
            here = int(np.argmin(np.abs(grid - frequency)))
            near = (np.abs(grid - frequency) < 0.5 * NEIGHBOURHOOD) & (grid > LOWEST)
            if np.any(power[max(here - 1, 0) : here + 2] > 5.0 * np.median(power[near], axis=0)):
                return "the body rates swing with it: a control loop oscillates, or a mode of the frame"
    if frequency > m.bandwidth:
        return "vibration above the band of the comparison, perhaps aliased: mount the accelerometer softer"
    return "the body rates do not show it: vibration, perhaps aliased from above half the logging rate"
