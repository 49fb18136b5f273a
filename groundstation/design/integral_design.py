"""The paper's third controller: LQR with an integral of the position error, as near to the LQR as it can be.

The paper compares with an LQR that integrates, its gains chosen so that its response on the linear model is nearest
to the LQR's. Nearest of all is no integral, and next to it one beside far higher gains; so the problem needs what the
integral is there for and what it may cost. Here: a constant disturbance is gone (5 % of what the plain LQR keeps for
ever) within `REMOVAL` settling times of the position loop, at the bandwidth of the LQR (crossover with the vehicle's
delay and lag), with its least phase margin. Subject to that, three gains an axis minimise the mean squared difference
to the LQR's position, over a step of the reference of 1 m and over a smooth translation of 1 m, on the linear model
with the attitude loop (13). Responses are exact (matrix exponentials); the optimiser is SLSQP (Kraft, DFVLR-FB 88-28,
1988) from several starts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from trueflight.groundstation.design.linear_design import (
    ACCELERATION,
    PHASE_MARGIN,
    Loop,
    actuation,
    loop_figures,
    loops,
    wrapped_margin,
)
from trueflight.models.design import Design, IntegralGains
from trueflight.models.errors import InputError
from trueflight.models.trajectory import min_jerk, transfer_time
from trueflight.models.vehicle import GRAVITY, Vehicle

REMOVAL = (2.0, 3.0, 4.0, 6.0, 8.0)
"""Settling times of the position loop within which a constant disturbance must be gone: the first that the phase
margin allows. Faster than two, the integral is no longer an addition to the loop but a part of it."""
REMAINDER = 0.05
"""What may be left then, as a share of what the plain LQR keeps for ever."""
_FLIGHT = min_jerk(
    (0.0,) * 4, (1.0, 0.0, 0.0, 0.0), transfer_time((0.0,) * 4, (1.0, 0.0, 0.0, 0.0), math.inf, ACCELERATION)
)
TRANSLATION = np.array([math.factorial(n) * c for n, c in enumerate(_FLIGHT.coefficients[0])])
"""The smooth translation of 1 m (minimum jerk, at the acceleration the design is made for): its position and five
derivatives at the beginning, m/s^n."""
TRANSLATION_SAMPLES = 32
"""Samples it lasts."""
STEP = _FLIGHT.duration / TRANSLATION_SAMPLES
"""s between two samples of a response."""
STARTS = (0.1, 0.2, 0.4, 0.8)
"""Where the optimiser starts: the LQR's poles with one more here, in units of its natural frequency."""


@dataclass(frozen=True)
class IntegralLoop:
    """What the integral loop of one axis ("horizontal", "vertical") does.

    `loop` as of `linear_design.loops`. After a step of disturbance acceleration the position error falls for good
    below 5 % of what the LQR keeps after `removal` s (asked for: `allowed` s); its largest value is `peak` times
    what the LQR keeps. `step_distance` and `translation_distance` are the RMS differences to the LQR's position, m,
    over a step and a smooth translation of 1 m, over twice the allowed time.
    """

    loop: Loop
    allowed: float
    removal: float
    peak: float
    step_distance: float
    translation_distance: float


@dataclass(frozen=True)
class _Axis:
    """One axis in accelerations: the LQR's gains `p` (1/s²) and `v` (1/s), the attitude pole `k` (1/s, None where
    acceleration follows at once), and the actuation seen by the loop, `late` (W,) at `w` (W,) rad/s, and what
    `settling` s the LQR takes."""

    name: str
    p: float
    v: float
    k: float | None
    w: np.ndarray
    late: np.ndarray
    settling: float


def with_integral(design: Design, vehicle: Vehicle) -> Design:
    """`design` with its integral loop. Raises `InputError` where no gains remove a disturbance and keep the
    margin."""
    horizontal, vertical = (_best(axis) for axis in _axes(design, vehicle))
    k_eta, k_i = np.zeros((3, 6)), np.zeros((3, 3))
    for row, column, unit, (p, v, i) in (
        (1, 0, 1.0 / GRAVITY, horizontal),
        (0, 1, -1.0 / GRAVITY, horizontal),
        (2, 2, design.mass, vertical),
    ):
        k_eta[row, column], k_eta[row, column + 3], k_i[row, column] = unit * p, unit * v, unit * i
    rows = [tuple(tuple(float(f"{x:.9g}") for x in row) for row in gains) for gains in (k_eta, k_i)]
    return replace(design, integral=IntegralGains(*rows))


def integral_loops(design: Design, vehicle: Vehicle) -> tuple[IntegralLoop, ...]:
    """What the integral loop of a design does, horizontally and vertically. Raises `InputError` where it has
    none."""
    if design.integral is None:
        raise InputError("design: it has no integral loop; make it again with `groundstation design`")
    k_eta, k_i = np.array(design.integral.K_eta), np.array(design.integral.K_i)
    found = []
    for axis, row, column, unit in zip(
        _axes(design, vehicle), (1, 2), (0, 2), (GRAVITY, 1 / design.mass), strict=True
    ):
        gains = unit * np.array([k_eta[row, column], k_eta[row, column + 3], k_i[row, column]])
        found.append(_judge(axis, gains))
    return tuple(found)


def _axes(design: Design, vehicle: Vehicle) -> tuple[_Axis, _Axis]:
    k_zeta, k_eta = np.array(design.K_zeta), np.array(design.K_eta)
    delay, lag = actuation(vehicle, design.rate)
    w = np.geomspace(0.05, 100.0, 800)
    late = np.exp(-1j * w * delay) / (1 + 1j * w * lag)
    inner = k_zeta[0, 0] / (1j * w) * late
    settling = {loop.name: loop.settling_time for loop in loops(design, vehicle)}
    return (
        _Axis(
            "horizontal",
            GRAVITY * k_eta[1, 0],
            GRAVITY * k_eta[1, 3],
            k_zeta[0, 0],
            w,
            inner / (1 + inner),
            settling["horizontal"],
        ),
        _Axis(
            "vertical",
            k_eta[2, 2] / design.mass,
            k_eta[2, 5] / design.mass,
            None,
            w,
            late,
            settling["vertical"],
        ),
    )


def _best(axis: _Axis) -> np.ndarray:
    """Gains (p, v, i) of one axis, in 1/s², 1/s, 1/s³."""
    for factor in REMOVAL:
        found = _nearest(axis, factor * axis.settling)
        if found is not None:
            return found
    raise InputError(
        f"design: no integral in the {axis.name} loop removes a disturbance within {REMOVAL[-1]:g} settling times "
        f"and keeps {PHASE_MARGIN:.0f} degrees of phase margin; lower --bandwidth"
    )


def _nearest(axis: _Axis, allowed: float) -> np.ndarray | None:
    """The gains nearest to the LQR that remove a disturbance within `allowed` s; None where none do."""
    from scipy.optimize import minimize

    samples, after = math.ceil(2.0 * allowed / STEP), math.floor(allowed / STEP)
    lqr = np.array([axis.p, axis.v, 0.0])
    lqr_step, lqr_translation, _ = _responses(axis, lqr, samples)
    limit, _ = _crossover(axis, lqr)
    unit = np.array([axis.p, axis.v, axis.p**1.5])

    @lru_cache(maxsize=8)  # cost and constraints are asked for one after the other at the same gains
    def judged(x: tuple[float, ...]) -> tuple[float, np.ndarray]:
        """Cost, and what must not be negative: what is left of the disturbance, bandwidth, margin."""
        gains = unit * np.array(x)
        step, translation, left = _responses(axis, gains, samples)
        square = np.mean((step - lqr_step) ** 2) + np.mean((translation - lqr_translation) ** 2)
        crossover, margin = _crossover(axis, gains)
        room = 1.0 - (axis.p / REMAINDER * left[after:]) ** 2
        # The logarithm makes the optimiser's tolerance relative, however small the distance.
        return math.log(float(square)), np.append(
            room, [1.0 - crossover / limit, margin / PHASE_MARGIN - 1.0]
        )

    best, least = None, math.inf
    for place in STARTS:
        extra = place * math.sqrt(axis.p)
        start = np.array([axis.p + extra * axis.v, axis.v + extra, extra * axis.p]) / unit
        found = minimize(
            lambda x: judged(tuple(x))[0],
            start,
            method="SLSQP",
            bounds=[(0.1, 3.0), (0.1, 3.0), (1e-3, 3.0)],
            constraints={"type": "ineq", "fun": lambda x: judged(tuple(x))[1]},
            options={"maxiter": 100, "ftol": 1e-7},
        )
        cost, room = judged(tuple(found.x))
        gains = unit * found.x
        if room.min() > -2e-3 and np.roots(_step_response(axis, gains)[1]).real.max() < 0.0 and cost < least:
            best, least = gains, cost
    return best


def _judge(axis: _Axis, gains: np.ndarray) -> IntegralLoop:
    lqr = np.array([axis.p, axis.v, 0.0])
    samples = math.ceil(2.0 * REMOVAL[-1] * axis.settling / STEP)
    left = axis.p * np.abs(_responses(axis, gains, samples)[2])
    last = int(np.flatnonzero(left > REMAINDER)[-1])
    removal = STEP * (last + float((left[last] - REMAINDER) / (left[last] - left[last + 1])))
    allowed = axis.settling * next((f for f in REMOVAL if removal <= f * axis.settling + STEP), REMOVAL[-1])
    samples = math.ceil(2.0 * allowed / STEP)
    ours, theirs = _responses(axis, gains, samples), _responses(axis, lqr, samples)
    step, translation = (
        float(np.sqrt(np.mean((a - b) ** 2))) for a, b in zip(ours[:2], theirs[:2], strict=True)
    )
    loop = loop_figures(axis.name, axis.w, _open_loop(axis, gains), *_step_response(axis, gains))
    return IntegralLoop(loop, allowed, removal, float(left.max()), step, translation)


def _open_loop(axis: _Axis, gains: np.ndarray) -> np.ndarray:
    p, v, i = gains
    s = 1j * axis.w
    return (p + v * s + i / s) / s**2 * axis.late


def _step_response(axis: _Axis, gains: np.ndarray) -> tuple[list[float], list[float]]:
    """Numerator and denominator from reference position (alone) to position in the ideal loop."""
    p, v, i = (float(x) for x in gains)
    if axis.k is None:
        return [p, i], [1.0, v, p, i]
    return [axis.k * p, axis.k * i], [1.0, axis.k, axis.k * v, axis.k * p, axis.k * i]


def _responses(axis: _Axis, gains: np.ndarray, samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position (samples,) every `STEP` s from rest: after a step of the reference of 1 m, through the smooth
    translation of 1 m, and under a constant disturbance of 1 m/s².

    The reference with its derivatives and the disturbance are states too (integral, x, v, with an attitude loop the
    acceleration; r and five derivatives; disturbance): all is one matrix exponential, exact at the samples.
    """
    from scipy.linalg import expm

    p, v, i = gains
    n = 3 if axis.k is None else 4
    asked = np.zeros(n + 7)
    asked[:3], asked[n : n + 3] = (-i, -p, -v), (p, v, 1.0)
    a = np.zeros((n + 7, n + 7))
    a[0, 1], a[0, n], a[1, 2] = 1.0, -1.0, 1.0
    if axis.k is None:
        a[2] = asked
    else:
        a[2, 3] = 1.0
        a[3] = axis.k * asked
        a[3, 3] -= axis.k
    a[2, -1] += 1.0
    a[n : n + 5, n + 1 : n + 6] = np.eye(5)
    step = expm(a * STEP)
    # Powers of the step by doubling: all samples in a few products.
    powers = np.eye(n + 7)[None]
    while len(powers) < samples:
        powers = np.concatenate([powers, powers @ (powers[-1] @ step)])
    still, moving, disturbed = np.zeros((3, n + 7))
    still[n], disturbed[-1] = 1.0, 1.0
    moving[n : n + 6] = TRANSLATION
    there = powers[TRANSLATION_SAMPLES] @ moving
    there[n : n + 6] = still[n : n + 6]
    x = powers[:, 1]
    translation = np.concatenate([x[:TRANSLATION_SAMPLES] @ moving, x @ there])
    return (x @ still)[:samples], translation[:samples], (x @ disturbed)[:samples]


def _crossover(axis: _Axis, gains: np.ndarray) -> tuple[float, float]:
    """Last crossover of the loop with delay and lag (rad/s) and its phase margin (degrees), found between the
    frequencies so that both are smooth in the gains."""
    loop = _open_loop(axis, gains)
    size, phase = np.log(np.abs(loop)), np.unwrap(np.angle(loop))
    above = np.flatnonzero(size >= 0.0)
    if above.size == 0 or above[-1] == len(size) - 1:
        return float(axis.w[-1]), -180.0
    last = above[-1]
    share = size[last] / (size[last] - size[last + 1])
    crossover = axis.w[last] * (axis.w[last + 1] / axis.w[last]) ** share
    return float(crossover), wrapped_margin(float(phase[last] + share * (phase[last + 1] - phase[last])))
