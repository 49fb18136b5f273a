"""An effect that changes by and by, and everything else beside it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trueflight.groundstation.identify.changes import Drift, columns_of
from trueflight.groundstation.identify.fitting import Fit
from trueflight.groundstation.identify.force import ForceProblem
from trueflight.groundstation.identify.search import Choice, Search, State
from trueflight.groundstation.identify.steps import Course, Wander
from trueflight.groundstation.identify.verdicts import MISSING, POSSIBLE
from trueflight.groundstation.results import DriftingParameter, EffectVerdict, OverTime
from trueflight.models.effect import Effect
from trueflight.models.model import Term

ROUNDS = 2
"""Times that the course is found beside the fit and the fit beside the course: effects act through each other."""


def beside_drift(problem: ForceProblem, found: State, drift: Drift) -> tuple[Search, State, OverTime]:
    """A search, a state of it and a course: of the problem in which what drifts is known, and constant beside that."""
    choice, here, course, wander = drift.choice, found.fit, drift.course, drift.wander
    for _ in range(ROUNDS):
        around = course.added(wander.course)
        beside = replace(problem, flights=replace(problem.flights, known=around))
        search = Search(beside)
        state = search.state(found.choices)
        here = state.fit
        course = Course(
            problem, replace(here, residual=here.residual + around), columns_of(problem, here, choice)
        )
        flat = course.added(np.ones_like(wander.course))
        wander = course.wander(course.unit(flat, here.residual))
    return search, state, _told(here, choice, wander)


def possible(effect: Effect, told: OverTime) -> bool:
    """Whether the interval of every drifting number reaches into its physical range throughout the flight."""
    ranges = {p.name: (p.low, p.high) for p in effect.parameters}
    return all(
        bool(np.all(d.high >= ranges[d.name][0]) and np.all(d.low <= ranges[d.name][1])) for d in told.drift
    )


def _told(here: Fit, choice: Choice, wander: Wander) -> OverTime:
    drift = []
    for j, i in enumerate(here.sizes(choice.effect)):
        parameter = here.free[i].parameter
        scale = parameter.typical - here.free[i].neutral
        value = here.estimate[i] + scale * wander.course[:, j]
        known = here.critical * float(np.sqrt(max(here.covariance[i, i], 0.0)))
        half = np.hypot(abs(scale) * 1.96 * wander.spread[:, j], known)
        drift.append(
            DriftingParameter(parameter.name, parameter.unit, wander.times, value, value - half, value + half)
        )
    return OverTime(drift=tuple(drift))


def at_the_end(terms: tuple[Term, ...], name: str, told: OverTime) -> tuple[Term, ...]:
    """Terms with the drifting effect as it was at the end of the flight."""
    last = {d.name: float(d.value[-1]) for d in told.drift}
    ends = {d.name: (float(d.low[-1]), float(d.high[-1])) for d in told.drift}
    return tuple(
        replace(t, values={**t.values, **last}, intervals={**t.intervals, **ends}) if t.effect == name else t
        for t in terms
    )


def drifting(verdict: EffectVerdict, drift: Drift) -> EffectVerdict:
    """The verdict on an effect that drifts: its course tells that it is there, and what else could take it."""
    others = tuple(dict.fromkeys((*verdict.indistinguishable_from, *drift.rivals)))
    sure = not drift.rivals and not verdict.rests_on and not verdict.undetermined
    advice = "add what holds now to the model" if sure else verdict.advice
    return replace(
        verdict, verdict=MISSING if sure else POSSIBLE, indistinguishable_from=others, advice=advice
    )
