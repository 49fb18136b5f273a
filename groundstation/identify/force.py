"""The specific force of flights against a model and more effects: what a search for missing effects fits."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from trueflight.groundstation.identify.fitting import (
    Fit,
    MeasuredFlights,
    fit,
    free_parameters,
    robust_covariance,
    with_clock,
)
from trueflight.groundstation.identify.search import Choice, State, evidence, sizes, whole
from trueflight.groundstation.identify.spans import EVERYWHERE, Span, Values, held, moments_of, number
from trueflight.groundstation.measured.measurement import Measurement
from trueflight.models.effect import Effect, Parameter, Stage
from trueflight.models.effects import catalogue
from trueflight.models.flight import Flight
from trueflight.models.model import Model, Term

MATERIAL_ACCELERATION = 0.02
"""m/s² RMS; smaller effects are within the bias stability of a MEMS accelerometer (2 mg)."""

ADEQUATE = 1.25
"""Times the noise up to which what is left may be noise alone: the noise is known to about a quarter."""


@dataclass(frozen=True)
class ForceProblem:
    """The specific force of `flights` against a model and more effects: the `Problem` of a search.

    `turning` are the effects found in the rotation: they act on the thrust, too, and are not fitted to it once more.
    Those of them that change in flight have the values `turning_in_time`.
    `on_the_way` are those that rotor speeds have shown to act before the rotors, `beside_all` those fitted in every
    state without being judged, `only` tells which effects are looked for.
    """

    flights: MeasuredFlights
    base: Model
    held_out: MeasuredFlights | None = None
    turning: tuple[Term, ...] = ()
    on_the_way: tuple[Term, ...] = ()
    beside_all: tuple[str, ...] = ()
    turning_in_time: Mapping[str, Values] = field(default_factory=dict)
    only: Callable[[Effect], bool] = lambda _: True

    @cached_property
    def effects(self) -> Mapping[str, Effect]:
        """Every effect by name."""
        return catalogue(self.base.effects_directory)

    @cached_property
    def included(self) -> tuple[str, ...]:
        """Names of the effects of the model."""
        return self.base.names()

    @cached_property
    def choices(self) -> tuple[Choice, ...]:
        """The effects that the flights have the measurements for."""
        return tuple(
            whole(e)
            for n, e in self.effects.items()
            if n not in self.included and self._measurable(e) and self.only(e)
        )

    @property
    def settled(self) -> tuple[Choice, ...]:
        """What rotor speeds have shown."""
        return tuple(whole(self.effects[t.effect]) for t in self.on_the_way)

    @property
    def flight(self) -> Flight:
        """The flight, or its first part."""
        return self.flights.measurements[0].flight

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """As in `identify.fitting.Measured`."""
        return self.flights.measurements

    @cached_property
    def blocks(self) -> np.ndarray:
        """Number of the held-out block of each sample (K,)."""
        return self.flights.blocks()

    @cached_property
    def samples(self) -> int:
        """Samples times axes."""
        return int(self.flights.measured().size)

    def unit(self) -> float:
        """As in `identify.fitting.Measured`."""
        return self.flights.unit()

    @cached_property
    def mean_square_before(self) -> float:
        """Mean squared error of the base model as it stands, (m/s²)²."""
        return mean_square_before(self.flights, self.base)

    def _measurable(self, effect: Effect) -> bool:
        return not effect.rotational and bool(effect.parameters) and not effect.lacks(self.flight)

    def at_rest(self, effect: Effect) -> dict[str, float]:
        """Parameter values without effect, placed where it would act on this flight."""
        placed = effect.typical(self.flights.survey)
        neutral = effect.neutral(self.flights.vehicle)
        return {p.name: placed[p.name] if p.structural else neutral[p.name] for p in effect.parameters}

    # --- fitting --------------------------------------------------------------------------------------------

    def fit(self, choices: tuple[Choice, ...], near: Fit | None) -> Fit:
        """The base model with `choices`, all of `choices` fitted, begun at `near`."""
        start = {} if near is None else {t.effect: t.values for t in near.terms}
        added = [c.effect for c in choices]
        free = (*self.beside_all, *added)
        terms = [*self.base.terms, *self.turning, *(Term(n, start.get(n, {})) for n in free)]
        terms = self._placed(terms, added)
        spans = self._spans(choices)
        given = self.turning_in_time
        fitted = fit(self.flights, terms, refit=free, spans=spans, given=given, near=near)
        if through := [n for n in added if self._new_to(start, n, added)]:
            # what acts through another can balance it far from the best fit: begin once more from "none of it"
            other = fit(self.flights, self._anew(terms, through), refit=free, spans=spans, given=given)
            fitted = other if evidence(self, other, fitted) > 0.0 else fitted
        return fitted

    def _new_to(self, start: Mapping[str, Mapping[str, float]], name: str, added: Sequence[str]) -> bool:
        """Whether an effect acts through another, and both were not fitted together at the `start`."""
        through = set(self.effects[name].acts_through)
        return bool(through) and not {name, *(through & set(added))} <= set(start)

    def _spans(self, choices: Sequence[Choice]) -> dict[tuple[str, str], tuple[Span, ...]]:
        """The spans of every number that holds not everywhere, by effect and parameter; where an effect acts does not
        differ between them."""
        return {
            (c.effect, p.name): c.spans for c in choices if c.spans for p in sizes(self.effects[c.effect], c)
        }

    def spans_of(self, here: Fit) -> dict[tuple[str, str], tuple[Span, ...]]:
        """The spans of the numbers of a fit, to fit them again."""
        found: dict[tuple[str, str], tuple[Span, ...]] = {}
        for f in here.free:
            if f.span != EVERYWHERE:
                key = (f.effect, f.parameter.name)
                found[key] = (*found.get(key, ()), f.span)
        return found

    def _anew(self, terms: list[Term], through: Sequence[str]) -> list[Term]:
        """`terms` with the effects `through` at none of it, and those that they act through at their typical size."""
        carriers = {n for name in through for n in self.effects[name].acts_through} - set(self.included)
        values = {n: self.effects[n].typical(self.flights.survey) for n in carriers}
        values |= {n: self.at_rest(self.effects[n]) for n in through}
        return [replace(t, values=values.get(t.effect, t.values)) for t in terms]

    def _placed(self, terms: list[Term], added: Sequence[str]) -> list[Term]:
        """`terms` with those effects that may end in a wrong optimum begun where they explain most."""
        for name in added:
            if (starts := self.effects[name].starts_for) is None:
                continue
            tried = [
                [replace(t, values=dict(place)) if t.effect == name else t for t in terms]
                for place in (
                    *(t.values for t in terms if t.effect == name and t.values),
                    *starts(self.flights.survey),
                )
            ]
            terms = min(tried, key=self._start_error)
        return terms

    def _start_error(self, terms: list[Term]) -> float:
        """Squared error before any fit; effects without a value yet at none of it."""
        chain = [(self.effects[t.effect], t.values or self.at_rest(self.effects[t.effect])) for t in terms]
        return float(np.sum((self.flights.measured() - self.flights.predict(chain)) ** 2))

    # --- linearised -----------------------------------------------------------------------------------------

    def linearised_gain(self, here: Fit, step: tuple[Choice, ...]) -> float:
        """Reduction of the squared error by the step, linearised at the current optimum and at its typical size, at the
        best of the places where it may act."""
        starts = self.effects[step[-1].effect].starts_for
        places = [] if starts is None else starts(self.flights.survey)
        return max(self._gain_at(here, step, place) for place in ({}, *places))

    def _gain_at(self, here: Fit, step: tuple[Choice, ...], place: Mapping[str, float]) -> float:
        values = here.values
        chain: list[tuple[Effect, Values]] = [(self.effects[n], v) for n, v in values.items()]
        base = self.flights.measured() - here.residual
        columns = []
        for choice in step:
            effect = self.effects[choice.effect]
            at = {p.name: place[p.name] for p in effect.parameters if p.structural and p.name in place}
            none = self.at_rest(effect) | at
            present = values.get(effect.name, none) | at
            rest = [(e, v) for e, v in chain if e.name != effect.name]
            for p in sizes(effect):
                to = p.typical if p.typical != present[p.name] else p.typical * 1.5
                columns += self._moved([*rest], effect, present, (p, to), none, self.held_on(choice, p), base)
            chain = [*rest, (effect, effect.typical(self.flights.survey) | at)]
            base = self.flights.predict(chain) if len(step) > 1 else base
        matrix = np.column_stack([here.jacobian.reshape(self.samples, -1), *columns])
        residual = here.residual.ravel()
        solution = np.linalg.lstsq(
            matrix.T @ matrix + 1e-9 * np.eye(matrix.shape[1]), matrix.T @ residual, rcond=None
        )[0]
        return float(residual @ matrix @ solution)

    def contribution(self, here: Fit, choice: Choice, through: str | None = None) -> np.ndarray:
        """What the effect at its typical size changes in the predicted specific force, (K A, P): one column for each
        number, in each of its spans."""
        values: dict[str, Values] = dict(here.values)
        effect = self.effects[choice.effect]
        if through is not None:
            values[through] = self.effects[through].typical(self.flights.survey)
        rest = [(self.effects[n], v) for n, v in values.items() if n != effect.name]
        neutral = self.at_rest(effect)
        base = self.flights.predict([*rest, (effect, neutral)])
        columns = []
        for p in sizes(effect):
            columns += self._moved(
                rest, effect, neutral, (p, p.typical), neutral, self.held_on(choice, p), base
            )
        return np.column_stack(columns)

    def held_on(self, choice: Choice, parameter: Parameter) -> tuple[Span, ...]:
        """The spans on which a candidate has a number of its own."""
        return choice.spans or (EVERYWHERE,)

    def _moved(
        self,
        rest: Sequence[tuple[Effect, Values]],
        effect: Effect,
        values: Values,
        to: tuple[Parameter, float],
        elsewhere: Mapping[str, float],
        spans: Sequence[Span],
        base: np.ndarray,
    ) -> list[np.ndarray]:
        """What one number of `effect` changes in the prediction when it is set, beside `rest`, in each of its spans."""
        name, value = to[0].name, to[1]
        if all(span == Span(span.flight) for span in spans):  # flights know nothing of each other
            everywhere = (self.flights.predict([*rest, (effect, {**values, name: value})]) - base).ravel()
            flight = np.repeat(self.flights.flight_of_rows, base.shape[1])
            return [
                everywhere if s.flight is None else np.where(flight == s.flight, everywhere, 0.0)
                for s in spans
            ]
        moved = ({**values, name: number([(span, value)], elsewhere[name])} for span in spans)
        return [(self.flights.predict([*rest, (effect, m)]) - base).ravel() for m in moved]

    def adequate(self, here: Fit) -> bool:
        """Whether no axis has much more left than its noise."""
        noise = self.flights.measurements[0].noise[list(self.flights.measurements[0].axes)]
        left = np.sqrt(np.mean(here.residual**2, axis=0))
        return here.residual.shape[1] != len(noise) or bool(np.all(left < ADEQUATE * noise))

    def push_of_air(self, here: Fit) -> float | None:
        """The acceleration that a metre per second of wind gives beside what is fitted, 1/s; None where no drag is."""
        for effect in self.effects.values():
            own = sizes(effect)
            if effect.stage is Stage.AIR and own and effect.needs_yaw and all(p.unit == "m/s" for p in own):
                if effect.lacks(self.flight):
                    return None
                speeds = np.array([p.typical for p in own])
                pushes = self.contribution(here, whole(effect)) / speeds
                push = float(np.sqrt(np.mean(np.sum(pushes**2, axis=0)) / len(here.residual)))
                return push if push > 0.0 else None
        return None

    def scale_of_thrust(self, here: Fit) -> tuple[tuple[str, ...], np.ndarray] | None:
        """The effects that scale the thrust as a whole, and what they change in the prediction (K A,)."""
        scales = tuple(n for n, e in self.effects.items() if e.scales_rotors)
        if not scales:
            return None
        return scales, self.contribution(here, whole(self.effects[scales[0]]))[:, 0]

    def beside(self, here: Fit, choice: Choice) -> Fit | None:
        """The effect beside all that is fitted, by one Gauss-Newton step from the present optimum; None for an effect
        on the history of the command or one that acts by its square, which are far from linear."""
        effect = self.effects[choice.effect]
        if effect.stage is Stage.COMMAND or any(p.even for p in effect.parameters):
            return None
        rest = self.at_rest(effect)
        own = [
            replace(f, span=span)
            for f in free_parameters(effect, self.flights.survey)
            if not f.parameter.structural
            for span in self.held_on(choice, f.parameter)
        ]
        free = (*here.free, *own)
        scale = np.array([f.parameter.typical - rest[f.parameter.name] for f in own])
        columns = -self.contribution(here, choice) / scale
        jacobian = np.concatenate([here.jacobian, columns.reshape(*here.residual.shape, len(own))], axis=2)
        start = np.concatenate([here.estimate, [rest[f.parameter.name] for f in own]])
        weight = np.sqrt(self.unit()) / np.array([f.spread for f in free])
        flat = jacobian.reshape(self.samples, -1)
        pull = weight**2 * (start - np.array([f.neutral for f in free]))
        step = -np.linalg.solve(flat.T @ flat + np.diag(weight**2), flat.T @ here.residual.ravel() + pull)
        residual = here.residual + jacobian @ step
        covariance, critical = robust_covariance(self.flights, jacobian, residual, weight)
        return Fit(here.terms, free, start + step, covariance, critical, jacobian, residual, here.spanned)

    # --- what is enough -------------------------------------------------------------------------------------

    def matters(self, with_: State, without: State, step: tuple[Choice, ...]) -> bool:
        """Whether the step takes away more than `MATERIAL_ACCELERATION`, RMS, on held-out blocks."""
        size = np.sqrt(max(without.cv_total - with_.cv_total, 0.0) / len(self.blocks))
        return bool(size > MATERIAL_ACCELERATION)

    def visible(self, energy: float) -> bool:
        """Whether it is more than `MATERIAL_ACCELERATION`, RMS."""
        return bool(np.sqrt(energy / len(self.blocks)) > MATERIAL_ACCELERATION)

    def held_out_error(self, fitted: Fit) -> float | None:
        """Squared error on the held-out flight, (m/s²)²."""
        if self.held_out is None:
            return None
        # as the vehicle was at one time of the flight: which, nobody tells
        moments = {t for f in fitted.free for t in (f.span.start, f.span.stop) if np.isfinite(t)}
        moments |= {t for v in self.turning_in_time.values() for t in moments_of(v)}
        measured, errors = self.held_out.measured(), []
        for start in (-np.inf, *sorted(moments)):
            chain = [(self.effects[n], held(v, 0, start)) for n, v in fitted.values.items()]
            errors.append(float(np.sum((measured - self.held_out.predict(chain)) ** 2)))
        return min(errors)


def mean_square_before(flights: MeasuredFlights, base: Model) -> float:
    """Mean squared error of the base model as it stands, nothing refitted but the clock, nothing learnt acting."""
    flights = replace(flights, known=None)
    chain = with_clock(flights.measurements[0], base.chain())
    alone = [(effect, values) for effect, values in chain if effect.stage is not Stage.REMAINDER]
    return float(np.mean((flights.measured() - flights.predict(alone)) ** 2))
