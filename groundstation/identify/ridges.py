"""Numbers that a flight ties together without determining either: wind and the drag that it acts through.

Where the wind blows across a flight that hardly moves that way, only the force is seen: drag times wind. Along such a
ridge the covariance at the optimum says little. Here the profile likelihood does: a number is held at a value, all
others are fitted again, and the interval is where that costs less than chance allows. One that reaches the end of what
is physically plausible is no interval: the number is not determined, and its product with the other is told instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from trueflight.groundstation.identify.fitting import Fit, fit, variance_per_independent_sample
from trueflight.groundstation.identify.force import ForceProblem
from trueflight.groundstation.identify.search import whole
from trueflight.groundstation.identify.verdicts import MISSING, POSSIBLE
from trueflight.groundstation.results import EffectVerdict, ParameterEstimate

SHARP = 8.0
"""Standard deviations from "no effect" beyond which a number of a product is as good as linear."""
STEPS = (1.0, 2.0, 4.0, 8.0)
"""Half widths of the interval at the optimum at which the profile is asked, until it has left the interval."""
HALVINGS = 3
"""Times that the step in which the profile leaves the interval is halved; the outer end is taken."""
CARRIES = 0.1
"""Overlap of the axes from which one number is said to act through another."""
SPAN = 6.0
"""Most by which the ends of an interval may differ, as a factor, for the number to be called determined."""


@dataclass(frozen=True)
class Ridge:
    """One number of a product by its profile: `low` and `high` as in a 95 % interval, and whether it is `determined`;
    `product` with the number it is tied to. Of several flights, `flight` is that of a number that holds for one."""

    effect: str
    parameter: str
    low: float
    high: float
    determined: bool
    product: ParameterEstimate
    flight: str = ""

    @property
    def where(self) -> str:
        """The flight behind a name, where it holds for one of several."""
        return f"@{self.flight}" if self.flight else ""


def ridges(problem: ForceProblem, here: Fit, found: Sequence[str]) -> tuple[Ridge, ...]:
    """What is known of each number of the effects `found` that act through another, and of those of the others, where
    the flight does not determine both by far."""
    told: list[Ridge] = []
    several = len(problem.flights.measurements) > 1
    for name in found:
        carriers = [n for n in problem.effects[name].acts_through if here.of(n)]
        # of what changes in flight, the last
        last = {(here.free[i].parameter.name, here.free[i].span.flight): i for i in here.sizes(name)}
        shares = _axes_of(problem, here, name, carriers) if several and carriers else {}
        for i in last.values():
            others = [j for n in carriers for j in here.sizes(n)]
            if not others or _sharp(here, i) or not np.any(here.jacobian[:, :, i]):
                continue
            partner = max(others, key=lambda j: abs(_correlation(here, i, j)))
            if several and all(_sharp(here, j) for j in _carrying(here, i, others, shares)):
                continue  # other flights determine them, and beside them the number is as good as linear
            pair = [_ridge(problem, here, i, partner)]
            if not pair[0].determined and not _sharp(here, partner):
                pair.append(_ridge(problem, here, partner, i))
            told += pair
    return tuple(told)


def _axes_of(problem: ForceProblem, here: Fit, name: str, carriers: Sequence[str]) -> dict[int, np.ndarray]:
    """How what each number of an effect does is spread over the measured axes (A,), through `carriers` of a typical
    size: at the size that was found, next to nothing may carry it."""
    own = here.sizes(name)
    through = (problem.contribution(here, whole(problem.effects[name]), n) for n in carriers)
    columns = sum(np.abs(c) for c in through)
    energy = np.sum(np.reshape(columns, (*here.residual.shape, -1)) ** 2, axis=0)
    if energy.shape[1] != len(own):
        return {}
    return {i: energy[:, k] / max(float(energy[:, k].sum()), 1e-30) for k, i in enumerate(own)}


def _carrying(here: Fit, i: int, others: Sequence[int], shares: dict[int, np.ndarray]) -> list[int]:
    """Those of the numbers `others` that act on the axes on which number `i` does."""
    if i not in shares:
        return list(others)
    found = []
    for j in others:
        energy = np.sum(here.jacobian[:, :, j] ** 2, axis=0)
        overlap = float(shares[i] @ energy) / max(float(energy.sum()), 1e-30)
        found += [j] if overlap > CARRIES else []
    return found or list(others)


def with_ridges(verdicts: Sequence[EffectVerdict], told: Sequence[Ridge]) -> list[EffectVerdict]:
    """Verdicts with the intervals of the profiles; what is not determined is told as such, with its product."""
    out = []
    for v in verdicts:
        own = {(r.parameter, r.flight): r for r in told if r.effect == v.name}
        if not own:
            out.append(v)
            continue
        parameters = tuple(
            replace(p, low=own[p.name, p.flight].low, high=own[p.name, p.flight].high)
            if (p.name, p.flight) in own
            else p
            for p in v.parameters
        )
        loose = [r for r in own.values() if not r.determined]
        # no number of a product has another "no effect" than zero
        intervals = [(p.low, p.high) for p in v.parameters if (p.name, p.flight) not in own]
        intervals += [(r.low, r.high) for r in own.values() if r.determined]
        known = any(not low <= 0.0 <= high for low, high in intervals)
        out.append(
            replace(
                v,
                verdict=v.verdict if known or v.verdict != MISSING else POSSIBLE,
                parameters=parameters,
                undetermined=tuple(r.parameter + r.where for r in loose),
                products=tuple(replace(r.product, name=r.product.name + r.where) for r in loose),
            )
        )
    return out


def _sharp(here: Fit, i: int) -> bool:
    return bool(
        abs(here.estimate[i] - here.free[i].neutral) > SHARP * np.sqrt(max(here.covariance[i, i], 0.0))
    )


def _correlation(here: Fit, i: int, j: int) -> float:
    c = here.covariance
    return float(c[i, j] / np.sqrt(max(c[i, i] * c[j, j], 1e-30)))


def _ridge(problem: ForceProblem, here: Fit, i: int, partner: int) -> Ridge:
    free, value = here.free[i], float(here.estimate[i])
    half = here.critical * float(np.sqrt(max(here.covariance[i, i], 0.0)))
    ends = [_end(problem, here, i, side * half) for side in (-1.0, 1.0)]
    low, high = ends[0][0], ends[1][0]
    wide = min(abs(low), abs(high)) * SPAN < max(abs(low), abs(high))
    closed = ends[0][1] and ends[1][1]
    determined = closed and (not wide or low < free.neutral < high)
    if not determined:  # never an interval that excludes "no effect"
        low, high = min(low, free.neutral), max(high, free.neutral)
    return Ridge(free.effect, free.parameter.name, min(low, value), max(high, value), determined,
                 _product(here, i, partner), "" if free.span.flight is None else str(free.span.flight))  # fmt: skip


def _end(problem: ForceProblem, here: Fit, i: int, half: float) -> tuple[float, bool]:
    """Where the profile leaves the interval on one side, and whether it does before what is plausible ends."""
    free, value = here.free[i], float(here.estimate[i])
    unit = variance_per_independent_sample(problem, here.residual)
    bound = free.parameter.low if half < 0.0 else free.parameter.high
    before = (value, 0.0)
    for step in STEPS:
        at = value + step * half
        beyond = (at - bound) * np.sign(half) >= 0.0
        at = bound if beyond else at
        cost = _cost(problem, here, i, at, unit)
        if cost > here.critical**2:
            for _ in range(HALVINGS):
                middle = 0.5 * (before[0] + at)
                there = _cost(problem, here, i, middle, unit)
                if there > here.critical**2:
                    at = middle
                else:
                    before = (middle, there)
            return at, True
        if beyond:
            return bound, False
        before = (at, max(cost, 0.0))
    return before[0], False


def _cost(problem: ForceProblem, here: Fit, i: int, at: float, unit: float) -> float:
    """What holding one number costs, in squared errors of an independent sample."""
    nuisance = {f.effect for f in here.free if f.nuisance}
    terms = [t for t in here.terms if t.effect not in nuisance]
    free = here.free[i]
    fitted = tuple({f.effect for f in here.free if not f.nuisance})
    held = fit(
        problem.flights,
        terms,
        refit=fitted,
        pinned={free.number: at},
        spans=problem.spans_of(here),
        given=problem.turning_in_time,
        near=here,
    )
    return max((held.sse - here.sse) / unit, 0.0)


def _product(here: Fit, i: int, j: int) -> ParameterEstimate:
    """The product of two numbers, with its 95 % interval by the covariance of both."""
    a, b = float(here.estimate[i]), float(here.estimate[j])
    slope, c = np.array([b, a]), here.covariance[np.ix_([i, j], [i, j])]
    half = here.critical * float(np.sqrt(max(slope @ c @ slope, 0.0)))
    one, other = here.free[i], here.free[j]
    name = f"{other.effect}.{other.parameter.name} x {one.effect}.{one.parameter.name}"
    return ParameterEstimate(
        name, a * b, a * b - half, a * b + half, f"{other.parameter.unit} {one.parameter.unit}"
    )
