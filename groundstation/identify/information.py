"""How much a flight tells on what was left open: the evidence expected on each question, and the width of intervals.

Every question is between two explanations of what was seen (or one explanation and nothing). What one says the
accelerometer would read on a manoeuvre, less the nearest that the other can say with its parameters free, is their
separation: twice the log likelihood ratio to be expected, the T-optimality of Atkinson & Fedorov ("The design of
experiments for discriminating between two rival models", Biometrika 62, 1975).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trueflight.groundstation.identify.fitting import (
    HAC_LAG,
    SCALE,
    UNMODELLED,
    MeasuredFlights,
    critical_value,
    fit,
    free_parameters,
    shifted_clock,
    variance_per_independent_sample,
)
from trueflight.groundstation.identify.manoeuvres import RATE, hover
from trueflight.groundstation.identify.questions import OpenQuestions, Pair
from trueflight.groundstation.identify.search import STRONG_EVIDENCE
from trueflight.groundstation.measured.measurement import measure
from trueflight.groundstation.results import Diagnosis
from trueflight.models.effect import Effect
from trueflight.models.flight import Flight
from trueflight.models.prediction import Chain
from trueflight.models.vehicle import Vehicle

ENOUGH = 45.0
"""Evidence at which a question counts as answered: 99 times in 100 it will then be above `STRONG_EVIDENCE`, since it
spreads by twice its root."""
PRECISE = 0.2
"""Half width of a 95 % interval over the size of the parameter, at which it counts as known."""


@dataclass(frozen=True)
class Question:
    """Two explanations, each a tuple of effects' names (empty: nothing but what is known), and the evidence expected
    from the flight at hand (`before`, None without one) and from the planned one."""

    one: tuple[str, ...]
    other: tuple[str, ...]
    before: float | None
    after: float

    @property
    def answered(self) -> bool:
        """Whether the planned flight will tell them apart."""
        return self.after > STRONG_EVIDENCE


@dataclass(frozen=True)
class Precision:
    """A parameter, the size it is planned for and the half width of its 95 % interval, before and after."""

    effect: str
    parameter: str
    unit: str
    value: float
    before: float | None
    after: float


class Study:
    """How much a flight says on each open question.

    Information is one matrix of inner products over time, of C columns: what is fitted anyhow, then for each candidate
    its Jacobian and what it adds at its planned size, over the variance of an independent second.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        questions: OpenQuestions,
        diagnosis: Diagnosis | None,
        effects_directory: str | None,
    ) -> None:
        self.vehicle, self.questions, self.directory = vehicle, questions, effects_directory
        self.known, self.candidates = questions.known, questions.candidates
        self.density = self._density(diagnosis)
        self._layout()

    def _density(self, diagnosis: Diagnosis | None) -> float:
        """Variance of the residual times its correlation time, (m/s²)² s: what one second of evidence costs."""
        if diagnosis is None:
            return float(UNMODELLED**2 * HAC_LAG + 0.05**2 / RATE)
        m = measure(diagnosis.flight, diagnosis.bandwidth)
        problem = MeasuredFlights((m,), self.directory, diagnosis.model.network_chain())
        fitted = fit(problem, list(diagnosis.model.terms), refit=[])
        return variance_per_independent_sample(problem, fitted.residual) * float(np.median(np.diff(m.t)))

    def _layout(self) -> None:
        """Where each column stands, and the weight of each parameter's prior, by its spread."""
        at = 0
        spread: list[float] = []
        motion = MeasuredFlights((measure(hover(self.vehicle)),), self.directory).survey
        period = 1.0 / RATE

        def places(names: Sequence[str], values: Sequence[dict[str, float]]) -> list[int]:
            nonlocal at
            found = []
            for name, value in zip(names, values, strict=True):
                for free in free_parameters(self.known[name], motion, value, period):
                    found.append(at)
                    spread.append(free.spread)
                    at += 1
            return found

        settled = [t for t in self.questions.settled if self.known[t.effect].parameters]
        self.nuisance = places([t.effect for t in settled], [dict(t.values) for t in settled])
        self.clock = at
        self.nuisance.append(at)
        spread.append(period)
        at += 1
        self.own: list[list[int]] = []
        self.size: list[int] = []
        for c in self.candidates:
            self.own.append(places(c.names, c.values))
            self.size.append(at)
            spread.append(np.inf)
            at += 1
        self.count, self.spread = at, np.array(spread)

    def nothing(self) -> np.ndarray:
        """The information of no flight."""
        return np.zeros((self.count, self.count))

    def information(self, flight: Flight) -> np.ndarray:
        """Inner products (C, C) of all columns over a flight, in units of the evidence."""
        m = measure(flight)
        problem = MeasuredFlights((m,), self.directory)
        period = float(np.median(np.diff(m.t)))
        settled: list[tuple[Effect, dict[str, float]]] = [
            (self.known[t.effect], dict(t.values)) for t in self.questions.settled
        ]
        base = problem.predict(settled)
        columns = np.zeros((base.size, self.count))

        def slopes(chain: Chain, positions: Sequence[int], first: int) -> None:
            here, place = problem.predict(chain), iter(positions)
            for index in range(first, len(chain)):
                effect, values = chain[index]
                for free in free_parameters(effect, problem.survey, values, period):
                    name, step = free.parameter.name, 0.01 * free.spread
                    if values[name] + step > free.high:
                        step = -step
                    moved = [
                        *chain[:index],
                        (effect, {**values, name: values[name] + step}),
                        *chain[index + 1 :],
                    ]
                    columns[:, next(place)] = ((problem.predict(moved) - here) / step).ravel()

        with_parameters = [link for link in settled if link[0].parameters]
        without = [link for link in settled if not link[0].parameters]
        slopes([*without, *with_parameters], self.nuisance[:-1], len(without))
        if not any(effect.shifts_clock for effect, _ in settled):
            later = shifted_clock(self.vehicle.command_delay + 0.5 * period)
            columns[:, self.clock] = ((problem.predict([*settled, later]) - base) / (0.5 * period)).ravel()
        for c, own, size in zip(self.candidates, self.own, self.size, strict=True):
            added = [(self.known[n], dict(v)) for n, v in zip(c.names, c.values, strict=True)]
            columns[:, size] = (problem.predict([*settled, *added]) - base).ravel()
            slopes([*settled, *added], own, len(settled))
        return columns.T @ columns * period / self.density

    def evidence(self, information: np.ndarray, one: int, other: int | None) -> float:
        """Twice the log likelihood ratio expected for candidate `one` against `other` where `one` is true."""
        free = [*self.nuisance, *([] if other is None else self.own[other])]
        seen = self.size[one]
        inner = information[np.ix_(free, free)] + np.diag(self.spread[free] ** -2.0)
        cross = information[free, seen]
        return float(max(0.0, information[seen, seen] - cross @ np.linalg.solve(inner, cross)))

    def worth(self, information: np.ndarray) -> float:
        """How well all is answered: a sum of logarithms, in which no question counts beyond `ENOUGH` and no parameter
        beyond a half width of `PRECISE`."""
        questions = sum(
            math.log1p(min(self.evidence(information, i, j), ENOUGH)) for i, j in self.questions.all_pairs
        )
        sharpness = sum(math.log1p(min(x, 1.0 / PRECISE) ** 2) for x in self._sharpness(information))
        return float(questions + sharpness)

    def answered(self, information: np.ndarray) -> bool:
        """Whether every question is answered, and every parameter known."""
        sure = all(self.evidence(information, i, j) >= ENOUGH for i, j in self.questions.all_pairs)
        return sure and all(x >= 1.0 / PRECISE for x in self._sharpness(information))

    def _sharpness(self, information: np.ndarray) -> list[float]:
        """Size over standard half width of each parameter of each candidate."""
        found: list[float] = []
        for c, own in zip(self.candidates, self.own, strict=True):
            sizes = [
                max(
                    abs(values[p.name] - p.neutral_for(self.vehicle)),
                    abs(p.typical - p.neutral_for(self.vehicle)),
                )
                for name, values in zip(c.names, c.values, strict=True)
                for p in self.known[name].parameters
            ]
            found += [x / (1.96 * s) for x, s in zip(sizes, self._deviations(information, own), strict=True)]
        return found

    def _deviations(self, information: np.ndarray, own: list[int]) -> np.ndarray:
        """Standard deviation of a candidate's parameters, beside all that is fitted anyhow."""
        free = [*self.nuisance, *own]
        inner = information[np.ix_(free, free)] + np.diag(self.spread[free] ** -2.0)
        return np.sqrt(np.maximum(np.diag(np.linalg.inv(inner))[len(self.nuisance) :], 0.0))

    def answers(self, before: np.ndarray | None, after: np.ndarray) -> tuple[Question, ...]:
        """The questions with their answers; of two rivals the harder way round."""
        found: dict[Pair, Question] = {}
        for i, j in self.questions.all_pairs:
            key = (i, j) if j is None else (min(i, j), max(i, j))
            asked = Question(
                self.candidates[i].names,
                () if j is None else self.candidates[j].names,
                None if before is None else self.evidence(before, i, j),
                self.evidence(after, i, j),
            )
            if key not in found or asked.after < found[key].after:
                found[key] = asked
        return tuple(found.values())

    def precision(
        self, before: np.ndarray | None, after: np.ndarray, seconds: float | None, planned: float
    ) -> tuple[Precision, ...]:
        """Half widths of the 95 % intervals of each candidate's parameters, with all that is fitted anyhow."""
        found = []
        for c, own in zip(self.candidates, self.own, strict=True):
            labels = [(n, p) for n in c.names for p in self.known[n].parameters]
            values = [
                v[p.name] for v, n in zip(c.values, c.names, strict=True) for p in self.known[n].parameters
            ]
            halves = []
            for information, duration in ((before, seconds), (after, planned)):
                if information is None or duration is None:
                    halves.append([None] * len(own))
                    continue
                statistical = critical_value(duration) * self._deviations(information, own)
                halves.append(np.hypot(statistical, SCALE * np.array(values)).tolist())
            for (name, p), value, was, will in zip(labels, values, *halves, strict=True):
                found.append(Precision(name, p.name, p.unit, value, was, will))
        return tuple(found)
