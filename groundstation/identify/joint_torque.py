"""The angular acceleration of several flights of one vehicle in one fit: what no vehicle file knows well is fitted to
each flight, what is the vehicle's to all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from trueflight.groundstation.identify.adequacy import ABOVE
from trueflight.groundstation.identify.differences import rows_of_flights
from trueflight.groundstation.identify.fitting import (
    Fit,
    FreeParameter,
    critical_value,
    robust_covariance,
)
from trueflight.groundstation.identify.ownership import BY_FILE, Ownership
from trueflight.groundstation.identify.search import Choice
from trueflight.groundstation.identify.spans import EVERYWHERE, Span, Value, Values, number
from trueflight.groundstation.identify.torque import OfRotation, TorqueProblem
from trueflight.groundstation.measured.measurement import Rotation
from trueflight.groundstation.results import RotationalRms
from trueflight.models.effect import FLIGHT, Effect, Parameter
from trueflight.models.model import Term
from trueflight.models.vehicle import Vehicle

ROUNDS = 12


@dataclass(frozen=True)
class JointTorque(OfRotation):
    """The angular acceleration of several flights: the `Problem` of a search.

    `flights` are the same problem of each flight alone; `whose` and `apart` as in `JointForce`.
    """

    flights: tuple[TorqueProblem, ...]
    whose: Ownership = BY_FILE
    apart: bool = False

    @property
    def effects(self) -> Mapping[str, Effect]:
        """Every effect on the torque by name."""
        return self.flights[0].effects

    @property
    def included(self) -> tuple[str, ...]:
        """Names of those of the model."""
        return self.flights[0].included

    @cached_property
    def each(self) -> tuple[Span, ...]:
        """The flights, as spans."""
        return tuple(Span(flight=k) for k in range(len(self.flights)))

    @cached_property
    def choices(self) -> tuple[Choice, ...]:
        """The candidates; of an exclusive effect one for each parameter."""
        shared = self.flights[0].choices
        return (*shared, *(replace(c, spans=self.each) for c in shared if self.apart))

    @property
    def axes(self) -> int:
        """Axes that are measured."""
        return len(self.measurements[0].axes)

    @property
    def settled(self) -> tuple[Choice, ...]:
        """None: nothing else tells of the torque."""
        return ()

    @property
    def measurements(self) -> tuple[Rotation, ...]:
        """As in `identify.fitting.Measured`."""
        return tuple(p.turning.rotation for p in self.flights)

    @cached_property
    def blocks(self) -> np.ndarray:
        """Number of the held-out block of each sample (K,)."""
        numbers, offset = [], 0
        for p in self.flights:
            numbers.append(p.blocks + offset)
            offset += int(p.blocks.max()) + 1
        return np.concatenate(numbers)

    @cached_property
    def weight(self) -> np.ndarray:
        """Of each used sample and axis (K, A), s²/rad: as each flight alone has it."""
        return np.concatenate([np.tile(p.weight, (len(p.blocks), 1)) for p in self.flights])

    @cached_property
    def rows(self) -> list[slice]:
        """The used samples of each flight."""
        return rows_of_flights(self)

    def unit(self) -> float:
        """Squared error worth one independent sample, in units of the weighted residual."""
        return 1.0

    def held_on(self, choice: Choice, parameter: Parameter) -> tuple[Span, ...]:
        """The flights one by one for what is their own, and all of them at once for what is the vehicle's."""
        own = self.whose.of(self.effects[choice.effect], parameter.name) == FLIGHT
        return choice.spans or (self.each if own else (EVERYWHERE,))

    def _own(self, choices: Sequence[Choice]) -> list[tuple[str, Parameter, Span]]:
        return [
            (c.effect, p, span)
            for c in choices
            for p in self.effects[c.effect].parameters
            if p.name in c.parameters
            for span in self.held_on(c, p)
        ]

    def fit(self, choices: tuple[Choice, ...], near: Fit | None = None) -> Fit:
        """Each flight's nuisances and the effects of `choices`, fitted together; weighted residuals."""
        own = self._own(choices)
        names = [[name for name, _ in p.turning.nuisances] for p in self.flights]
        before = np.cumsum([0, *(len(n) for n in names)])
        x = np.zeros(before[-1] + len(own))
        for start in before[:-1]:
            x[start : start + self.axes] = 1.0  # the gains of the control torque
        for _ in range(ROUNDS):
            jacobian, residual = self._linearised(x, own, before)
            flat = jacobian.reshape(residual.size, -1)
            step = np.linalg.lstsq(flat.T @ flat, flat.T @ residual.ravel(), rcond=1e-14)[0]
            x = x + step
            if np.max(np.abs(step) / (np.abs(x) + 1e-6)) < 1e-6:
                break
        jacobian, residual = self._linearised(x, own, before)
        neutral = {name: self.effects[name].neutral(self._vehicle) for name, _, _ in own}
        free = [
            FreeParameter(n, _nuisance(n), 0.0, -np.inf, np.inf, 0.0, nuisance=True, flat=True, span=span)
            for span, all_ in zip(self.each, names, strict=True)
            for n in all_
        ]
        free += [
            FreeParameter(n, p, 0.0, p.low, p.high, neutral[n][p.name], flat=True, span=span)
            for n, p, span in own
        ]
        covariance, _ = robust_covariance(self, -jacobian, residual, np.zeros(len(free)))
        rotations = self.measurements
        seconds = sum(float(r.used.sum()) * float(np.median(np.diff(r.t))) for r in rotations)
        fitted = Fit((), tuple(free), x, covariance, critical_value(seconds), -jacobian, residual)
        return self._with_terms(fitted, choices, own)

    @property
    def _vehicle(self) -> Vehicle:
        return self.flights[0].turning.motion.vehicle

    def _linearised(
        self, x: np.ndarray, own: Sequence[tuple[str, Parameter, Span]], before: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivative of the weighted prediction (K, A, F + P) and residual (K, A) at `x`."""
        fixed, axes = int(before[-1]), self.axes
        jacobian = np.zeros((len(self.blocks), axes, len(x)))
        residual = np.empty((len(self.blocks), axes))
        for k, (p, rows) in enumerate(zip(self.flights, self.rows, strict=True)):
            mine = slice(int(before[k]), int(before[k + 1]))
            linear = np.stack([c for _, c in p.turning.nuisances], axis=2) * p.weight[None, :, None]
            gains = x[mine][:axes]
            part = jacobian[rows]
            part[:, :, mine] = linear
            predicted = linear @ x[mine]
            for i, (name, parameter, span) in enumerate(own):
                if span.flight not in (None, k):
                    continue
                shape = p.column(name, parameter) * p.weight
                part[:, :, fixed + i] = shape * gains
                value = x[fixed + i]
                predicted = predicted + value * shape * gains
                for axis in range(axes):  # an effect's torque, too, goes through the axis' gain
                    part[:, axis, mine.start + axis] += value * shape[:, axis]
            residual[rows] = p.turning.measured * p.weight - predicted
        return jacobian, residual

    def _with_terms(
        self, fitted: Fit, choices: Sequence[Choice], own: Sequence[tuple[str, Parameter, Span]]
    ) -> Fit:
        """The fit with its effects' values and intervals."""
        terms, first = [], len(fitted.free) - len(own)
        spanned: dict[str, Values] = {}
        for choice in choices:
            values = dict(self.effects[choice.effect].neutral(self._vehicle))
            rest, intervals, differ = dict(values), {}, dict[str, Value]()
            for p in {p.name for n, p, _ in own if n == choice.effect}:
                at = [i for i, (n, q, _) in enumerate(own) if n == choice.effect and q.name == p]
                parts = [(own[i][2], float(fitted.estimate[first + i])) for i in at]
                values[p], intervals[p] = parts[-1][1], fitted.interval(first + at[-1])
                if parts != [(EVERYWHERE, parts[0][1])]:
                    differ[p] = number(parts, rest[p])
            if differ:
                spanned[choice.effect] = differ
            terms.append(Term(choice.effect, values, intervals))
        return replace(fitted, terms=tuple(terms), spanned=spanned)

    def contribution(self, here: Fit, choice: Choice, through: str | None = None) -> np.ndarray:
        """What the choice at its typical size adds to the weighted angular acceleration, (K A, P)."""
        columns = []
        for name, parameter, span in self._own([choice]):
            column = np.zeros((len(self.blocks), self.axes))
            for k, (p, rows) in enumerate(zip(self.flights, self.rows, strict=True)):
                if span.flight in (None, k):
                    column[rows] = parameter.typical * p.column(name, parameter) * p.weight
            columns.append(column.ravel())
        return np.column_stack(columns)

    @property
    def noise(self) -> np.ndarray:
        """Weighted noise of each axis (A,), RMS over the flights."""
        return np.asarray(np.sqrt(np.mean([(_noise(p) * p.weight) ** 2 for p in self.flights], axis=0)))

    def only_noise(self, here: Fit) -> bool:
        """Whether no axis of any flight has much more left than its noise."""
        return all(
            np.all(np.sqrt(np.mean((here.residual[rows] / p.weight) ** 2, axis=0)) < ABOVE * _noise(p))
            for p, rows in zip(self.flights, self.rows, strict=True)
        )

    def rms(self, before: Fit, after: Fit) -> RotationalRms:
        """Residual of the rotors' torque alone, and of what was found, rad/s² over all axes and flights."""
        was, left = (float(np.sqrt(np.mean((f.residual / self.weight) ** 2))) for f in (before, after))
        rotations = self.measurements
        noise = float(np.sqrt(np.mean([np.mean(_noise(p) ** 2) for p in self.flights])))
        return RotationalRms(was, left, noise, min(r.bandwidth for r in rotations), rotations[0].source)


def one_choice_each(choices: Sequence[Choice]) -> tuple[Choice, ...]:
    """The candidates without numbers of their own for each flight."""
    return tuple(dict.fromkeys(replace(c, spans=()) for c in choices))


def _noise(problem: TorqueProblem) -> np.ndarray:
    rotation = problem.turning.rotation
    return rotation.noise[list(rotation.axes)]


def _nuisance(name: str) -> Parameter:
    return Parameter(name, "1", "fitted beside every effect", 0.0, 1.0, -np.inf, np.inf)
