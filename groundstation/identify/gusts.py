"""Gusts: air that moves by itself, told by its size and its time constant.

What wind does about its mean is a process of its own, no effect of the vehicle's state: Dryden's spectrum along the
flight path is that of noise through a first-order lag (MIL-F-8785C). Its size and time constant are those of the
likeliest such spectrum beside the noise of the sensor (Whittle, Ark. Mat. 2, 1953), and it is only told where that
spectrum is like the one that is left.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from trueflight.groundstation.identify.adequacy import ABOVE, MATERIAL, spectrum_of
from trueflight.groundstation.measured.measurement import Measurement
from trueflight.groundstation.results import Gusts, ParameterEstimate, Unexplained
from trueflight.models.frames import rotate

FASTEST = 0.2
"""s: what is quicker is vibration or a control loop, not the air."""
PERIODS = 6.0
"""Time constants that a flight holds at least: slower is a drift."""
BANDS = 8
"""Parts of the frequencies, in equal ratios, in which the spectrum must be like that of gusts."""
ALIKE = 1e-3
"""Probability that gusts are said to be none."""
SURE = 1.96


UPWARDS = 0.5
"""Most of what is left upwards over what is left sideways, both RMS beyond the noise: drag gives gusts little hold
there."""


def gusts_of(m: Measurement, residual: np.ndarray, remains: Unexplained, push: float | None) -> Gusts | None:
    """The gusts in a residual (K, 3) of the used samples; None where what `remains` is none. `push` is the acceleration
    that a metre per second of wind gives, 1/s, None where no drag is known."""
    lines = [x for x in remains.misfit if x.held and x.axis != "z"]
    if not remains.misfit or lines or m.axes != (0, 1, 2) or m.flight.quaternion is None:
        return None
    world = rotate(m.flight.quaternion[m.rows][m.used], residual)
    noise = float(np.sqrt(np.mean(m.noise[:2] ** 2)))
    rms = np.sqrt(np.mean(world**2, axis=0))
    beyond = np.sqrt(np.maximum(rms**2 - np.array([noise, noise, m.noise[2]]) ** 2, 0.0))
    sideways = float(np.sqrt(np.mean(beyond[:2] ** 2)))
    if np.any(rms[:2] < ABOVE * noise) or sideways < MATERIAL or beyond[2] > UPWARDS * sideways:
        return None
    spectra = [spectrum_of(m, world[:, i], noise) for i in (0, 1)]
    f = spectra[0].frequency
    passed = 1.0 / (1.0 + (f / m.bandwidth) ** 8) ** 2
    found = process_of(f, [s.power for s in spectra], [s.noise for s in spectra], passed)
    if found is None:
        return None
    size = ParameterEstimate("acceleration", found.size, found.size_low, found.size_high, "m/s^2")
    time_constant = ParameterEstimate("time_constant", found.time_constant, found.low, found.high, "s")
    return Gusts(size, time_constant, None if not push else found.size / push)


def told_as_gusts(remains: Unexplained, gusts: Gusts) -> Unexplained:
    """What remains with the gusts in the place of the axes on which they are seen."""
    theirs = {x.text for x in remains.misfit}
    return replace(
        remains,
        where=(gusts.text, *(w for w in remains.where if w not in theirs)),
        advice="the air moves by itself: nothing in the model can foresee it; fly in calmer air for a closer look",
    )


@dataclass(frozen=True)
class Process:
    """Noise through a first-order lag: standard deviation `size` and `time_constant` in s, each with its 95 %
    interval."""

    size: float
    size_low: float
    size_high: float
    time_constant: float
    low: float
    high: float


def process_of(
    frequency: np.ndarray, powers: Sequence[np.ndarray], noises: Sequence[np.ndarray], passed: np.ndarray
) -> Process | None:
    """The process that made columns of the spectra `powers` (F,) beside `noises` (F,), behind a filter that has
    `passed` (F,) of the power; None where these are no spectra of gusts.

    Powers at each `frequency` (F,) in Hz sum to the variance of the column.
    """
    step = float(frequency[1] - frequency[0])
    inside = (frequency > 0.0) & (passed > 0.1)
    f, through = frequency[inside], passed[inside]
    observed = np.maximum(np.array([p[inside] for p in powers]), 1e-30)
    floor = np.maximum(np.array([n[inside] for n in noises]), 1e-30)

    def expected(x: np.ndarray) -> np.ndarray:
        size, tau, noise = np.exp(x)
        # one-sided density of an Ornstein-Uhlenbeck process
        lagged = 4.0 * size**2 * tau / (1.0 + (2.0 * np.pi * f * tau) ** 2) * step
        return lagged * through + noise * floor

    def cost(x: np.ndarray) -> float:
        e = expected(x)
        # the noise of a sensor is known to about a quarter
        return float(np.sum(np.log(e) + observed / e) + 0.5 * (x[2] / 0.5) ** 2)

    total = float(np.sqrt(max(np.mean(np.sum(observed - floor, axis=1)), 1e-12)))
    starts = [np.array([np.log(total), np.log(tau), 0.0]) for tau in (0.3, 1.0, 3.0)]
    from scipy import optimize  # dear to load

    found = min((optimize.minimize(cost, s, method="Nelder-Mead") for s in starts), key=lambda r: r.fun)
    size, tau, _ = np.exp(found.x)
    duration = 1.0 / step
    if not FASTEST <= tau <= duration / PERIODS or not _alike(f, observed, expected(found.x)):
        return None
    spread = np.sqrt(np.diag(np.linalg.pinv(_curvature(cost, found.x))).clip(0.0))
    low, high = np.exp(found.x - SURE * spread), np.exp(found.x + SURE * spread)
    return Process(*map(float, (size, low[0], high[0], tau, low[1], high[1])))


def _alike(f: np.ndarray, observed: np.ndarray, expected: np.ndarray) -> bool:
    """Whether power over what is expected is one in every band, within chance and a quarter."""
    ratio = observed / expected
    edges = np.geomspace(f[0], f[-1] * 1.0001, BANDS + 1)
    for low, high in itertools.pairwise(edges):
        at = (f >= low) & (f < high)
        count = int(at.sum()) * len(observed)
        if not count:
            continue
        mean = float(ratio[:, at].mean())
        above = special.gammaincc(count, count * mean / 1.5)
        below = special.gammainc(count, count * mean * 1.5)
        if min(above, below) < ALIKE / BANDS:
            return False
    return True


def _curvature(cost: Callable[[np.ndarray], float], x: np.ndarray, step: float = 0.02) -> np.ndarray:
    """Second derivatives (n, n) of a function at its minimum, by central differences."""
    n, eye = len(x), step * np.eye(len(x))
    out = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            out[i, j] = (
                cost(x + eye[i] + eye[j]) - cost(x + eye[i] - eye[j]) - cost(x - eye[i] + eye[j])
                + cost(x - eye[i] - eye[j])
            ) / (4.0 * step**2)  # fmt: skip
    return out
