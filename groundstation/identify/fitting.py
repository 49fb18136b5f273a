"""Fitting the parameters of a chain of effects to flights, with intervals that hold under correlated residuals.

Least squares on specific force, body axes, every axis with the same weight, with a weak prior at "no effect" for each
parameter (two typical sizes wide, worth one independent sample): it decides only what the data leave open, such as
thrust gain against accelerometer bias in a hover. Residuals of flight data at 100 Hz are
strongly autocorrelated, so ordinary intervals would be far too narrow: covariances here are Newey-West with a
Bartlett kernel of `HAC_LAG` s, and critical values are the fixed-b ones of Kiefer and Vogelsang (2005), "A new
asymptotic theory for heteroskedasticity-autocorrelation robust tests", Econometric Theory 21, table 1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from types import MappingProxyType
from typing import Protocol

import numpy as np
from scipy import special

from trueflight.groundstation.identify.kept import Kept
from trueflight.groundstation.identify.noisy_inputs import without_noise
from trueflight.groundstation.identify.spans import EVERYWHERE, Span, Value, Values, cut_at, held, number
from trueflight.groundstation.measured.measurement import Measurement
from trueflight.models.effect import Effect, Motion, Parameter, Stage
from trueflight.models.effects import CLOCK, catalogue, effect_named
from trueflight.models.model import Model, Term
from trueflight.models.prediction import (
    Chain,
    apply_effects,
    motion_of_flight,
    parts_of_force,
    separable,
    specific_force,
)
from trueflight.models.vehicle import Vehicle

HAC_LAG = 2.0
"""s of Bartlett kernel: beyond the slowest correlation that a position-controlled quadrotor shows."""
UNMODELLED = 0.02
"""m/s²: slow model error that every flight is granted, for the weight of the prior: 2 mg, the bias stability of a
MEMS accelerometer."""
KEPT_PROMISE = 0.75
"""Part of the promised gain from which on a step's Jacobian is near enough to be kept."""
BLOCK = 5.0
"""s of each held-out block."""


class Sampled(Protocol):
    """Something measured at the times `t` (M,) in s, of which `used` (M,) are compared."""

    @property
    def t(self) -> np.ndarray:
        """Times of all samples (M,), s."""

    @property
    def used(self) -> np.ndarray:
        """Which of them are compared (M,)."""


class Measured(Protocol):
    """What can be fitted: the used samples of all `measurements`, one after the other, are its K rows."""

    @property
    def measurements(self) -> Sequence[Sampled]:
        """The flights, in the order of the rows."""

    def unit(self) -> float:
        """Squared error worth one independent sample."""


@dataclass(frozen=True)
class FreeParameter:
    """One free number of a fit: a parameter of an effect, its start and its bounds, and the span in which it holds;
    `flat` where it has no prior."""

    effect: str
    parameter: Parameter
    start: float
    low: float
    high: float
    neutral: float
    tolerance: float = 0.0
    nuisance: bool = False
    flat: bool = False
    span: Span = EVERYWHERE

    @property
    def number(self) -> tuple[str, str, Span]:
        """What tells it from all others."""
        return self.effect, self.parameter.name, self.span

    @property
    def spread(self) -> float:
        """Standard deviation of the prior: two typical sizes, or half the range where no value is "no effect"."""
        if self.flat:
            return np.inf
        if self.parameter.structural:
            return 0.5 * (self.parameter.high - self.parameter.low)
        return max(2.0 * abs(self.parameter.typical - self.neutral), 1e-6)


@dataclass(frozen=True)
class MeasuredFlights:
    """Measured flights and, for each, the motion that effects act on.

    `always` acts in every prediction and is never fitted: the network of a model. So does `known` (K, A), m/s², behind
    the filters: what changes in flight by and by.
    """

    measurements: tuple[Measurement, ...]
    effects_directory: str | None = None
    always: Chain = ()
    known: np.ndarray | None = None

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle of the flights."""
        return self.measurements[0].flight.vehicle

    def predict(self, chain: Sequence[tuple[Effect, Values]]) -> np.ndarray:
        """Predicted specific force (K, A) of the used samples of all flights, behind each flight's filter.

        Numbers may differ between spans: a flight is put together from what each of its pieces says of it.
        """
        return self.predictor([effect for effect, _ in chain])([values for _, values in chain])

    def predictor(self, effects: Sequence[Effect], keep: int = 0) -> Callable[[Sequence[Values]], np.ndarray]:
        """`predict` as a function of the values of `effects`, for many calls: it keeps the last `keep` pieces, so that
        a number is only predicted anew where it holds."""
        names = [tuple(p.name for p in effect.parameters_of(self.vehicle)) for effect in effects]

        def chain(key: tuple[tuple[float, ...], ...]) -> Chain:
            return [(e, dict(zip(n, k, strict=True))) for e, n, k in zip(effects, names, key, strict=True)]

        def force(flight: int, key: tuple[tuple[float, ...], ...]) -> np.ndarray:
            return self.acting(flight, chain(key))

        piece = lru_cache(maxsize=keep)(force) if keep else force

        def all_of_it(flight: int, key: tuple[tuple[float, ...], ...]) -> np.ndarray:
            return self.seen(flight, chain(key))

        seen = lru_cache(maxsize=keep)(all_of_it) if keep else all_of_it

        def predicted(all_values: Sequence[Values]) -> np.ndarray:
            parts = []
            for flight, m in enumerate(self.measurements):
                t = m.flight.t
                cuts, keys = cut_at(all_values, flight, t), []
                for rows in cuts:
                    here = [held(values, flight, float(t[rows.start])) for values in all_values]
                    keys.append(tuple(tuple(v[k] for k in n) for v, n in zip(here, names, strict=True)))
                if len(keys) == 1:
                    parts.append(seen(flight, keys[0]))
                    continue
                pieces = [piece(flight, key)[rows] for key, rows in zip(keys, cuts, strict=True)]
                parts.append(self.behind_filter(m, np.concatenate(pieces)))
            all_of_it = np.concatenate(parts)
            return all_of_it if self.known is None else all_of_it + self.known

        return predicted

    def acting(self, flight: int, chain: Chain) -> np.ndarray:
        """What the chain makes of all samples of flight number `flight`: specific force (N, 3), body axes, m/s²."""
        return specific_force(
            apply_effects(self.motions[flight], [*chain, *self.always], self.kept[flight].take)
        )

    def seen(self, flight: int, chain: Chain) -> np.ndarray:
        """The used samples (K, A) of what the chain makes of flight number `flight`, behind its filter, part by part:
        those that have been seen before are not filtered again."""
        kept = self.kept[flight]
        if not all(self._separable(effect, flight) for effect, _ in [*chain, *self.always]):
            return self.behind_filter(self.measurements[flight], self.acting(flight, chain))
        parts = parts_of_force(self.motions[flight], [*chain, *self.always], kept.take)
        return np.asarray(sum(map(kept.seen, parts)))

    def _separable(self, effect: Effect, flight: int) -> bool:
        """Whether what an effect does can be seen apart from what others do."""
        if effect.name not in self._asked:
            motion = self.motions[flight]
            self._asked[effect.name] = separable(effect, motion, effect.typical(motion))
        return self._asked[effect.name]

    @cached_property
    def _asked(self) -> dict[str, bool]:
        return {}

    @cached_property
    def kept(self) -> tuple[Kept, ...]:
        """What has been computed of each flight."""
        return tuple(Kept(len(m.flight), partial(self.behind_filter, m)) for m in self.measurements)

    def behind_filter(self, m: Measurement, acting: np.ndarray) -> np.ndarray:
        """The used samples (K, A) of what acts, behind the flight's filter."""
        return m.see(acting)[m.used][:, m.axes]

    @cached_property
    def motions(self) -> tuple[Motion, ...]:
        """Each flight as effects see it, before any of them acts."""
        noisy = {n for e in catalogue(self.effects_directory).values() for n in e.noisy}
        return tuple(motion_of_flight(without_noise(m.flight, noisy)) for m in self.measurements)

    @cached_property
    def flight_of_rows(self) -> np.ndarray:
        """Number of the flight of each used sample (K,)."""
        return np.repeat(np.arange(len(self.measurements)), [int(m.used.sum()) for m in self.measurements])

    @cached_property
    def survey(self) -> Motion:
        """What tells where the flights went: the motion that reached highest."""
        heights = [-np.inf if m.height is None else float(np.max(m.height)) for m in self.motions]
        return self.motions[int(np.argmax(heights))]

    def measured(self) -> np.ndarray:
        """Measured specific force (K, A) of the used samples."""
        return np.concatenate([m.value[m.used][:, m.axes] for m in self.measurements])

    def unit(self) -> float:
        """Squared error worth one independent sample, (m/s²)²: noise and unmodelled error over the correlation time."""
        m = self.measurements[0]
        rate = 1.0 / float(np.median(np.diff(m.t)))
        noise = float(np.mean(m.noise[list(m.axes)] ** 2))
        return noise + UNMODELLED**2 * max(1.0, HAC_LAG * rate)

    def blocks(self) -> np.ndarray:
        """Number of the held-out block of each used sample (K,)."""
        numbers, offset = [], 0
        for m in self.measurements:
            block = ((m.t[m.used] - m.t[0]) / BLOCK).astype(int)
            _, block = np.unique(block, return_inverse=True)
            numbers.append(block + offset)
            offset += int(block.max()) + 1
        return np.concatenate(numbers)


@dataclass(frozen=True)
class Fit:
    """A fitted chain.

    `terms` hold one value of each number, that of its last span, and `values` all of them; `free` the P fitted numbers,
    `estimate` (P,) theirs, `covariance` (P, P); `jacobian` (K, A, P) and `residual` (K, A) at the optimum; `critical`
    the two-sided 95 % factor of `covariance`.
    """

    terms: tuple[Term, ...]
    free: tuple[FreeParameter, ...]
    estimate: np.ndarray
    covariance: np.ndarray
    critical: float
    jacobian: np.ndarray
    residual: np.ndarray
    spanned: Mapping[str, Values] = field(default_factory=dict)

    @property
    def values(self) -> dict[str, dict[str, Value]]:
        """Values by effect and parameter, in the order of the chain; `Piecewise` where they differ between spans."""
        return {t.effect: {**t.values, **self.spanned.get(t.effect, {})} for t in self.terms}

    @property
    def prior_penalty(self) -> float:
        """How far the parameters are from "no effect", in squared standard deviations of the prior."""
        return float(
            sum(((x - f.neutral) / f.spread) ** 2 for x, f in zip(self.estimate, self.free, strict=True))
        )

    @property
    def sse(self) -> float:
        """Sum of squared residuals, (m/s²)²."""
        return float(np.sum(self.residual**2))

    def of(self, effect: str) -> list[int]:
        """Columns of the free numbers that belong to `effect`."""
        return [i for i, f in enumerate(self.free) if f.effect == effect and not f.nuisance]

    def sizes(self, effect: str) -> list[int]:
        """Those of them that have a value of "no effect"."""
        return [i for i in self.of(effect) if not self.free[i].parameter.structural]

    def interval(self, index: int) -> tuple[float, float]:
        """95 % interval of one free number."""
        half = half_width(
            self.free[index], float(self.estimate[index]), self.covariance[index, index], self.critical
        )
        return float(self.estimate[index] - half), float(self.estimate[index] + half)

    def wald(self, effect: str) -> float:
        """p-value that all parameters of `effect` are neutral, from the robust covariance.

        The fixed-b factor of one number is applied to the statistic as a whole.
        """
        columns = self.sizes(effect)
        if not columns:
            return 1.0
        neutral = np.array([self._neutral(i) for i in columns])
        difference = self.estimate[columns] - neutral
        covariance = self.covariance[np.ix_(columns, columns)]
        statistic = float(difference @ np.linalg.pinv(covariance, hermitian=True) @ difference)
        return float(special.chdtrc(len(columns), max(statistic, 0.0) * (1.96 / self.critical) ** 2))

    def _neutral(self, index: int) -> float:
        """Value without effect; for a delay the nearest that the clock's tolerance allows."""
        free = self.free[index]
        return float(
            np.clip(self.estimate[index], free.neutral - free.tolerance, free.neutral + free.tolerance)
        )


SCALE = 0.005
"""Relative 95 % uncertainty of every value, however well a fit is conditioned: sensitivity tolerance of a MEMS
accelerometer or gyroscope (TDK ICM-42688-P datasheet: 0.5 %). No law of the catalogue is truer either."""


def half_width(free: FreeParameter, value: float, variance: float, critical: float) -> float:
    """Half of a 95 % interval around `value`, never below what clock and scale of the sensors allow."""
    scale = 0.0 if free.parameter.structural else SCALE * value
    return float(np.hypot(critical * np.sqrt(max(variance, 0.0)), scale)) + free.tolerance


def critical_value(duration: float) -> float:
    """Two-sided 95 % factor for a Bartlett kernel of `HAC_LAG` over `duration` s (Kiefer & Vogelsang 2005)."""
    b = min(1.0, HAC_LAG / max(duration, HAC_LAG))
    return 1.9600 + 2.9694 * b + 0.4160 * b**2 - 0.5324 * b**3


def free_parameters(
    effect: Effect, motion: Motion, start: Mapping[str, float] | None = None, period: float = 0.0
) -> list[FreeParameter]:
    """The numbers of `effect` to fit to a flight, on a clock of `period` s.

    Bounds reach a little beyond the plausible range, so that data may contradict
    the effect instead of resting on its bound."""
    free = []
    sizes = effect.typical(motion)
    for p in effect.parameters:
        typical = sizes[p.name]
        neutral = typical if p.structural else p.neutral_for(motion.vehicle)
        within = effect.stage is Stage.COMMAND or p.even or p.structural
        margin = 0.0 if within else 2.0 * abs(p.typical - neutral)
        value = (start or {}).get(p.name, neutral + 0.3 * (typical - neutral))
        low, high = p.low - margin, p.high + margin
        tolerance = period * p.clock_samples
        value = float(np.clip(value, low + 1e-9, high - 1e-9))
        free.append(FreeParameter(effect.name, p, value, low, high, neutral, tolerance))
    return free


def fit(
    problem: MeasuredFlights,
    terms: Sequence[Term],
    refit: Sequence[str] | None = None,
    clock: bool = True,
    tolerance: float = 1e-6,
    pinned: Mapping[tuple[str, str, Span], float] | None = None,
    spans: Mapping[tuple[str, str], tuple[Span, ...]] | None = None,
    given: Mapping[str, Values] | None = None,
    near: Fit | None = None,
) -> Fit:
    """Fit the parameters of `terms` (all of them, or the effects named in `refit`) to the flights.

    With `clock`, the delay between the columns is free within one sample of what the vehicle file says: no log's
    clock is better than that, and a shift must not be taken for drag. Each parameter that `spans` names, by effect and
    parameter, is fitted once for each of its spans; outside of them it is without effect. `pinned` holds numbers, by
    effect, parameter and span, where they are; `given` are numbers by effect that are not fitted and differ between
    spans. `near` is a fit whose optimum is not far: the clock begins there, and so do the derivatives of the numbers
    that both have.
    """
    effects = {t.effect: effect_named(t.effect, problem.effects_directory) for t in terms}
    fixed = {t.effect: dict(t.values) for t in terms}
    free: list[FreeParameter] = []
    period = max(m.flight.dt for m in problem.measurements)
    for term in terms:
        effect = effects[term.effect]
        if (refit is None or term.effect in refit) and not effect.rotational:
            free += free_parameters(effect, problem.survey, term.values or None, period)
    if clock and not any(effect.shifts_clock for effect in effects.values()):
        (parameter,), believed = CLOCK.parameters, problem.vehicle.command_delay
        low, high = max(0.0, believed - period), believed + period
        begin = (
            next((x for f, x in zip(near.free, near.estimate, strict=True) if f.nuisance), believed)
            if near
            else believed
        )
        free.append(FreeParameter(CLOCK.name, parameter, begin, low, high, believed, period, nuisance=True))
        effects[CLOCK.name] = CLOCK
    free = [
        replace(f, span=span)
        for f in free
        for span in (spans or {}).get((f.effect, f.parameter.name), (EVERYWHERE,))
    ]
    numbers, pinned = [f.number for f in free], pinned or {}
    neutral_of = {(f.effect, f.parameter.name): f.neutral for f in free}
    free = [f for f in free if f.number not in pinned]
    measured = problem.measured()
    predict = problem.predictor(list(effects.values()), _pieces(problem, numbers))

    def all_values(x: np.ndarray) -> dict[str, dict[str, Value]]:
        fitted = {**pinned, **{f.number: float(value) for f, value in zip(free, x, strict=True)}}
        values: dict[str, dict[str, Value]] = {
            name: {**fixed.get(name, {}), **(given or {}).get(name, {})} for name in effects
        }
        for (name, parameter), neutral in neutral_of.items():
            parts = [(n[2], fitted[n]) for n in numbers if n[:2] == (name, parameter)]
            values[name][parameter] = number(parts, neutral)
        return values

    def residual(x: np.ndarray) -> np.ndarray:
        return (measured - predict(list(all_values(x).values()))).ravel()

    weight = np.sqrt(problem.unit()) / np.array([f.spread for f in free])
    neutral = np.array([f.neutral for f in free])
    known = (
        {f.number: column for f, column in _columns(near) if near.residual.shape == measured.shape}
        if near
        else {}
    )
    if free:
        estimate, flat, jacobian = _minimise(residual, free, weight, neutral, tolerance, known)
    else:
        estimate, flat, jacobian = np.zeros(0), residual(np.zeros(0)), np.zeros((measured.size, 0))
    k, a = measured.shape
    shaped = jacobian.reshape(k, a, len(free))
    covariance, critical = robust_covariance(problem, shaped, flat.reshape(k, a), weight)
    last = {name: dict(fixed.get(name, {})) for name in effects}
    for n, value in pinned.items():
        last[n[0]][n[1]] = value
    intervals: dict[str, dict[str, tuple[float, float]]] = {name: {} for name in effects}
    for i, f in enumerate(free):
        half = half_width(f, float(estimate[i]), covariance[i, i], critical)
        last[f.effect][f.parameter.name] = float(estimate[i])
        intervals[f.effect][f.parameter.name] = (float(estimate[i] - half), float(estimate[i] + half))
    fitted = tuple(
        Term(name, last[name], intervals[name] or (terms[i].intervals if i < len(terms) else {}))
        for i, name in enumerate(effects)
    )
    spanned = all_values(estimate) if given or any(n[2] != EVERYWHERE for n in numbers) else {}
    return Fit(fitted, tuple(free), estimate, covariance, critical, shaped, flat.reshape(k, a), spanned)


def _columns(near: Fit) -> list[tuple[FreeParameter, np.ndarray]]:
    """The free numbers of a fit with their columns (K A,) of the Jacobian."""
    return [(f, near.jacobian[:, :, i].ravel()) for i, f in enumerate(near.free)]


def _pieces(problem: MeasuredFlights, numbers: Sequence[tuple[str, str, Span]]) -> int:
    """How many predictions of pieces are worth keeping: those of the point at which one number after the other is
    moved, and as many on the way to the next; none where every number holds everywhere."""
    spans = {n[2] for n in numbers} - {EVERYWHERE}
    return 4 * (len(problem.measurements) + 2 * len(spans)) if spans else 0


def _minimise(
    residual: Callable[[np.ndarray], np.ndarray],
    free: Sequence[FreeParameter],
    weight: np.ndarray,
    neutral: np.ndarray,
    tolerance: float,
    known: Mapping[tuple[str, str, Span], np.ndarray],
    most: int = 25,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bounded Levenberg-Marquardt (Nocedal & Wright, Numerical Optimization, 2nd ed., ch. 10): estimate, residual there
    and Jacobian beside it.

    Nearly all effects are linear in their parameters, so that two steps are enough; a step that meets a bound is taken
    again with that number held. While steps do what their Jacobian promises, it is only brought up to date with what
    they changed (Broyden, Math. Comput. 19, 1965); the last step goes by one that was computed where it begins. The
    first may have columns that are `known` from nearby.
    """
    low = np.array([f.low for f in free])
    high = np.array([max(f.high, f.low + 1e-9) for f in free])
    spread = np.array([f.spread for f in free])
    x = np.clip(np.array([f.start for f in free]), low, high)
    flat = residual(x)

    def cost_of(x: np.ndarray, flat: np.ndarray) -> float:
        return float(flat @ flat + np.sum((weight * (x - neutral)) ** 2))

    cost, damping = cost_of(x, flat), 1e-8
    jacobian, exact = _jacobian(residual, x, free, flat, known), not known
    for _ in range(most):
        normal = jacobian.T @ jacobian + np.diag(weight**2)
        slope = jacobian.T @ flat + weight**2 * (x - neutral)
        moved = there_already = False
        for _ in range(8 if exact else 2):
            step = _bounded_step(normal + damping * np.diag(np.diag(normal)), slope, x, low, high)
            promised = -float(step @ (2.0 * slope + normal @ step))
            there_already = promised < 0.1 * tolerance * cost
            if there_already:
                break
            tried = residual(x + step)
            there = cost_of(x + step, tried)
            if there <= cost:
                moved = True
                break
            damping = max(damping, 1e-6) * 30.0
        if exact and (there_already or not moved):
            break
        if not moved:
            jacobian, exact = _jacobian(residual, x, free, flat), True
            continue
        gained = cost - there
        change = tried - flat
        x, flat, cost, damping = x + step, tried, there, damping / 10.0
        small = gained < tolerance * cost or bool(np.all(np.abs(step) < 1e-5 * spread))
        if small and exact and bool(np.all(np.abs(step) < 0.05 * spread)):
            break
        if small or gained < KEPT_PROMISE * promised:
            ending = small and exact
            jacobian, exact = _jacobian(residual, x, free, flat), True
            if ending:
                break
        else:
            length = step / spread**2
            jacobian = jacobian + np.outer(change - jacobian @ step, length / (length @ step))
            exact = False
    return x, flat, jacobian if exact else _jacobian(residual, x, free, flat)


def _bounded_step(
    normal: np.ndarray, slope: np.ndarray, x: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """The step to the minimum of a quadratic within bounds, by holding what runs into one."""
    step = np.zeros_like(x)
    loose = np.ones(len(x), dtype=bool)
    for _ in range(len(x)):
        inner = normal[np.ix_(loose, loose)]
        rest = slope[loose] + normal[np.ix_(loose, ~loose)] @ step[~loose]
        step[loose] = -np.linalg.lstsq(inner, rest, rcond=1e-14)[0]
        over = loose & ((x + step < low) | (x + step > high))
        if not over.any():
            break
        step[over] = np.clip(x + step, low, high)[over] - x[over]
        loose &= ~over
        if not loose.any():
            break
    return step


def _jacobian(
    residual: Callable[[np.ndarray], np.ndarray],
    x: np.ndarray,
    free: Sequence[FreeParameter],
    base: np.ndarray,
    known: Mapping[tuple[str, str, Span], np.ndarray] = MappingProxyType({}),
) -> np.ndarray:
    """Forward differences with steps of a hundredth of each prior's width, away from the upper bound; columns that are
    `known` as they are."""
    columns = np.empty((base.size, len(x)))
    for i, f in enumerate(free):
        if f.number in known:
            columns[:, i] = known[f.number]
            continue
        step = 0.01 * f.spread
        if x[i] + step > f.high:
            step = -step
        moved = x.copy()
        moved[i] += step
        columns[:, i] = (residual(moved) - base) / step
    return columns


def robust_covariance(
    problem: Measured, jacobian: np.ndarray, residual: np.ndarray, prior: np.ndarray
) -> tuple[np.ndarray, float]:
    """Newey-West sandwich covariance (P, P) of least squares with `jacobian` (K, A, P), `residual` (K, A) and weights
    `prior` (P,) of the prior's rows, and its fixed-b factor for 95 %."""
    k, a, p = jacobian.shape
    flat = jacobian.reshape(k * a, p)
    pull = np.diag(prior**2)
    bread = np.linalg.pinv(flat.T @ flat + pull, hermitian=True)
    scores = np.einsum("kap,ka->kp", jacobian, residual)
    meat, offset, seconds = pull * problem.unit(), 0, 0.0
    for m in problem.measurements:
        # the samples in their places in time, with zeros for those left out, so that lags are lags
        placed = np.zeros((len(m.t), p))
        placed[m.used] = scores[offset : offset + int(m.used.sum())]
        period = float(np.median(np.diff(m.t)))
        if p:
            meat += bartlett_sum(placed, max(1, round(HAC_LAG / period)))
        offset += int(m.used.sum())
        seconds += float(m.used.sum()) * period
    covariance = bread @ meat @ bread * (k / max(k - p, 1))
    return covariance, critical_value(seconds)


def bartlett_sum(scores: np.ndarray, lags: int) -> np.ndarray:
    """Newey-West's sum (P, P) over `scores` (N, P): their products at all distances up to `lags`, Bartlett weights
    (Newey & West, Econometrica 55, 1987). Written as squares of sums over a window that is as long."""
    sums = np.cumsum(np.pad(scores, ((lags + 1, lags), (0, 0))), axis=0)
    windows = sums[lags + 1 :] - sums[: -lags - 1]
    return np.asarray(windows.T @ windows) / (lags + 1)


def variance_per_independent_sample(problem: Measured, residual: np.ndarray) -> float:
    """Variance of `residual` (K, A) that counts for slow regressors: Bartlett kernel of `HAC_LAG` s, mean over axes,
    and never less than the plain mean square."""
    total, offset = 0.0, 0
    for m in problem.measurements:
        count = int(m.used.sum())
        placed = np.zeros((len(m.t), residual.shape[1]))
        placed[m.used] = residual[offset : offset + count]
        lag = max(1, round(HAC_LAG / float(np.median(np.diff(m.t)))))
        sums = np.cumsum(np.pad(placed, ((lag, lag), (0, 0))), axis=0)
        total += float(np.sum((sums[lag:] - sums[:-lag]) ** 2)) / lag
        offset += count
    return max(total, float(np.sum(residual**2))) / residual.size


def shifted_clock(delay: float) -> tuple[Effect, dict[str, float]]:
    """A whole delay of so many s between command and measurement, as a link of a chain."""
    (parameter,) = CLOCK.parameters
    return CLOCK, {parameter.name: delay}


def with_clock(measurement: Measurement, chain: Chain) -> Chain:
    """The chain with the delay between the flight's columns set as well as one sample of freedom allows.

    A shift of the clock belongs to a log, not to a model: every comparison finds it anew.
    """
    if any(effect.shifts_clock for effect, _ in chain):
        return chain
    from scipy import optimize  # dear to load

    problem = MeasuredFlights((measurement,))
    believed, period = problem.vehicle.command_delay, measurement.flight.dt
    measured = problem.measured()

    def error(value: float) -> float:
        return float(np.sum((measured - problem.predict([*chain, shifted_clock(value)])) ** 2))

    found = optimize.minimize_scalar(
        error,
        bounds=(max(0.0, believed - period), believed + period),
        method="bounded",
        options={"xatol": 0.02 * period},
    )
    return [*chain, shifted_clock(float(found.x))]


def block_errors(fit_: Fit, blocks: np.ndarray) -> np.ndarray:
    """Sum of squared residuals of each block (B,), predicted by parameters fitted without that block.

    One Gauss-Newton step from the common optimum, exact for effects that are linear in their parameters; those that say
    where an effect acts are far from it, and stay.
    """
    count = int(blocks.max()) + 1
    moved = [i for i, f in enumerate(fit_.free) if not f.parameter.structural]
    p = len(moved)
    augmented = np.concatenate([fit_.jacobian[:, :, moved], fit_.residual[:, :, None]], axis=2)
    gram = np.zeros((count, p + 1, p + 1))
    for b in range(count):
        part = augmented[blocks == b].reshape(-1, p + 1)
        gram[b] = part.T @ part
    total = gram.sum(axis=0)
    errors = np.empty(count)
    bounds_low = np.array([fit_.free[i].low for i in moved]) - fit_.estimate[moved]
    bounds_high = np.array([fit_.free[i].high for i in moved]) - fit_.estimate[moved]
    for b in range(count):
        rest = total - gram[b]
        # residual(x + d) is about residual + J d
        step = -np.linalg.lstsq(
            rest[:p, :p] + 1e-9 * np.diag(np.diag(rest[:p, :p]) + 1e-12), rest[:p, p], rcond=None
        )[0]
        step = np.clip(step, bounds_low, bounds_high)
        errors[b] = gram[b, p, p] + 2 * step @ gram[b, :p, p] + step @ gram[b, :p, :p] @ step
    return errors


def model_of(fit_: Fit, base: Model) -> Model:
    """The base model with the fitted terms; the clock's shift, a nuisance, stays out."""
    nuisance = {f.effect for f in fit_.free if f.nuisance}
    return base.with_terms(tuple(t for t in fit_.terms if t.effect not in nuisance))
