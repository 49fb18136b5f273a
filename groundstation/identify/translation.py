"""Which physical effect is missing from a model, from one flight and, better, a held-out one.

The specific force of the flight against what the model's chain of effects predicts; `identify.search` finds what is
missing, `identify.verdicts` says it. What the rotation of the vehicle shows is found first, and what rotor speeds show
between command and rotors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from trueflight.groundstation.identify.fitting import (
    Fit,
    Problem,
    fit,
    free_parameters,
    model_of,
    robust_covariance,
    with_clock,
)
from trueflight.groundstation.identify.rates import judge_rates
from trueflight.groundstation.identify.remainder import unexplained
from trueflight.groundstation.identify.rotation import RotationalFindings, judge_rotation
from trueflight.groundstation.identify.rotors import RotorProblem, has_rotor_speeds
from trueflight.groundstation.identify.search import Choice, Search, State, evidence, sizes, whole
from trueflight.groundstation.identify.verdicts import (
    MISSING,
    NOT_EXCITED,
    Scale,
    also_possible,
    by_weight,
    included,
    judge,
    unmeasured,
)
from trueflight.groundstation.measured.measurement import Measurement, measure
from trueflight.groundstation.results import Diagnosis, EffectVerdict
from trueflight.models.effect import Effect, Stage
from trueflight.models.effects import catalogue
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.model import Model, Term

MATERIAL_ACCELERATION = 0.02
"""m/s² RMS; smaller effects are within the bias stability of a MEMS accelerometer (2 mg)."""
LONG, PART = 240.0, 20.0
"""s of flight beyond which effects are looked for in parts of so many s, as much altogether, spread evenly; what is
found is fitted to all of the flight and dropped where that does not support it."""


def diagnose(
    flight: Flight,
    base: Model,
    validation: Flight | None = None,
    bandwidth: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Find the effects that `base` lacks on `flight`, checked on held-out blocks and on `validation`.

    A network of `base` is held as it is: what it has learnt is not missing any more.

    Raises `InputError` where the flight lacks the columns for any comparison, or is too short.
    """

    def measured(*measurements: Measurement) -> Problem:
        return Problem(measurements, base.effects_directory, base.network_chain())

    all_of_it = measured(measure(flight, bandwidth))
    held_out = None if validation is None else measured(measure(validation, bandwidth))
    progress("looking at the rotation")
    rotation = judge_rotation(flight, base.names(), base.effects_directory)
    entire = ForceProblem(all_of_it, base, held_out, rotation.terms)
    parts = _spread(flight, bandwidth) if flight.duration > LONG else ()
    looked_at = replace(entire, flights=measured(*parts)) if parts else entire
    if has_rotor_speeds(flight):
        progress("looking between command and rotors")
        looked_at = replace(looked_at, on_the_way=_on_the_way(looked_at))
        entire = entire if parts else looked_at
    search = Search(looked_at, progress)
    found = search.select()
    if not parts:
        return _report(search, found, search, rotation)
    progress("fitting what was found to the whole flight")
    everything = Search(entire, progress)
    kept = everything.settle(found.choices)
    return _report(search, search.state(kept.choices), everything, rotation)


def _on_the_way(problem: ForceProblem) -> tuple[Term, ...]:
    """The effects that rotor speeds show between command and rotor.

    None where they leave more of the rotors' thrust unexplained than the accelerometer's noise: there the rotors did
    not follow the collective (a saturated mixer), and prove nothing.
    """
    base, flights = problem.base, problem.flights
    path = ForceProblem(
        RotorProblem(flights.measurements, base.effects_directory),
        base,
        only=lambda effect: effect.before_rotors,
        beside_all=tuple(n for n, e in problem.effects.items() if e.scales_rotors and n not in base.names()),
    )
    found = Search(path, tried=len(problem.choices)).select()
    left = np.sqrt(found.fit.sse / path.samples)
    floor = min(float(m.noise[2]) for m in flights.measurements)
    return tuple(t for t in found.fit.terms if t.effect in found.names) if left < floor else ()


def _spread(flight: Flight, bandwidth: float | None) -> tuple[Measurement, ...]:
    """Parts of `PART` s, evenly spread over a long flight; those that cannot be compared are left out."""
    rows = round(PART / flight.dt)
    found = []
    for start in np.linspace(0, len(flight) - rows, round(LONG / PART)).astype(int):
        try:
            found.append(measure(flight.part(slice(start, start + rows)), bandwidth))
        except InputError:
            continue
    return tuple(found)


@dataclass(frozen=True)
class ForceProblem:
    """The specific force of `flights` against a model and more effects: the `Problem` of a search.

    `turning` are the effects found in the rotation: they act on the thrust, too, and are not fitted to it once more.
    `on_the_way` are those that rotor speeds have shown to act before the rotors, `beside_all` those fitted in every
    state without being judged, `only` tells which effects are looked for.
    """

    flights: Problem
    base: Model
    held_out: Problem | None = None
    turning: tuple[Term, ...] = ()
    on_the_way: tuple[Term, ...] = ()
    beside_all: tuple[str, ...] = ()
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
        return _mean_square_before(self.flights, self.base)

    def _measurable(self, effect: Effect) -> bool:
        if effect.rotational or (effect.stage is Stage.SENSOR and not self.flight.accelerometer):
            return False
        return bool(effect.parameters) and not effect.lacks(self.flight)

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
        fitted = fit(self.flights, terms, refit=free)
        if through := [n for n in added if self.effects[n].acts_through]:
            # what acts through another can balance it far from the best fit: begin once more from "none of it"
            other = fit(self.flights, self._anew(terms, through), refit=free)
            fitted = other if evidence(self, other, fitted) > 0.0 else fitted
        return fitted

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
        values = {t.effect: dict(t.values) for t in here.terms}
        chain = [(self.effects[n], v) for n, v in values.items()]
        base = self.flights.measured() - here.residual
        columns = []
        for choice in step:
            effect = self.effects[choice.effect]
            at = {p.name: place[p.name] for p in effect.parameters if p.structural and p.name in place}
            neutral = dict(values.get(effect.name, self.at_rest(effect))) | at
            rest = [(e, v) for e, v in chain if e.name != effect.name]
            for p in sizes(effect):
                moved = {**neutral, p.name: p.typical if p.typical != neutral[p.name] else p.typical * 1.5}
                prediction = self.flights.predict([*rest, (effect, moved)])
                columns.append((prediction - base).ravel())
            chain = [*rest, (effect, effect.typical(self.flights.survey) | at)]
            base = self.flights.predict(chain) if len(step) > 1 else base
        matrix = np.column_stack([here.jacobian.reshape(self.samples, -1), *columns])
        residual = here.residual.ravel()
        solution = np.linalg.lstsq(
            matrix.T @ matrix + 1e-9 * np.eye(matrix.shape[1]), matrix.T @ residual, rcond=None
        )[0]
        return float(residual @ matrix @ solution)

    def contribution(self, here: Fit, choice: Choice, through: str | None = None) -> np.ndarray:
        """What the effect at its typical size changes in the predicted specific force, (K A, P): one column each."""
        values = {t.effect: dict(t.values) for t in here.terms}
        effect = self.effects[choice.effect]
        if through is not None:
            values[through] = self.effects[through].typical(self.flights.survey)
        rest = [(self.effects[n], v) for n, v in values.items() if n != effect.name]
        neutral = self.at_rest(effect)
        base = self.flights.predict([*rest, (effect, neutral)])
        moved = ({**neutral, p.name: p.typical} for p in sizes(effect))
        return np.column_stack([(self.flights.predict([*rest, (effect, m)]) - base).ravel() for m in moved])

    def beside(self, here: Fit, choice: Choice) -> Fit | None:
        """The effect beside all that is fitted, by one Gauss-Newton step from the present optimum; None for an effect
        on the history of the command or one that acts by its square, which are far from linear."""
        effect = self.effects[choice.effect]
        if effect.stage is Stage.COMMAND or any(p.even for p in effect.parameters):
            return None
        rest = self.at_rest(effect)
        own = [f for f in free_parameters(effect, self.flights.survey) if not f.parameter.structural]
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
        return Fit(here.terms, free, start + step, covariance, critical, jacobian, residual)

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
        chain = [(self.effects[t.effect], t.values) for t in fitted.terms]
        return float(np.sum((self.held_out.measured() - self.held_out.predict(chain)) ** 2))


# --- the diagnosis ------------------------------------------------------------------------------------------------


def _report(search: Search, found: State, everything: Search, rotation: RotationalFindings) -> Diagnosis:
    """The verdicts; figures of what was found are those of the whole flight, which `everything` sees."""
    problem, entire = _force(search), _force(everything)
    here = everything.state(found.choices).fit
    m, base = entire.flights.measurements[0], entire.base
    verdicts, rate_terms = _verdicts(search, found, here, entire, rotation)
    left = float(np.sqrt(here.sse / entire.samples))
    final = model_of(here, base)
    shift = [float(here.estimate[i]) for i, f in enumerate(here.free) if f.nuisance]
    held_out, after = entire.held_out, entire.held_out_error(here)
    return Diagnosis(
        flight=m.flight,
        base=base,
        model=final.with_terms((*final.terms, *rate_terms)),
        rms_before=float(np.sqrt(entire.mean_square_before)),
        rms_after=left,
        # noise cannot leave more than what is left: a vibration is stronger beyond the pass band than in it
        noise_floor=min(float(np.sqrt(np.mean(m.noise[list(m.axes)] ** 2))), left),
        bandwidth=m.bandwidth,
        axes=m.axes,
        validation_before=None if held_out is None else float(np.sqrt(_mean_square_before(held_out, base))),
        validation_after=None
        if held_out is None or after is None
        else float(np.sqrt(after / held_out.measured().size)),
        clock_shift=shift[0] - problem.flights.vehicle.command_delay if shift else None,
        effects=tuple(verdicts),
        unexplained=unexplained(m, here.residual),
        left_out=m.left_out,
        rotational=rotation.rms,
    )


def _force(search: Search) -> ForceProblem:
    assert isinstance(search.problem, ForceProblem)
    return search.problem


def _verdicts(
    search: Search, found: State, here: Fit, entire: ForceProblem, rotation: RotationalFindings
) -> tuple[list[EffectVerdict], list[Term]]:
    """The verdicts on all effects of the catalogue, and the terms of what the body rates show."""
    problem, base = _force(search), entire.base
    before = problem.mean_square_before
    scale = Scale(
        before * problem.samples, lambda share: f": {np.sqrt(max(share, 0.0) * before):.3f} m/s² RMS"
    )
    named, absent = judge(search, found, here, scale, lambda name: _seen_as(problem, name, here))
    candidates = {c.effect for c in problem.choices}
    others = [
        unmeasured(e, e.lacks(problem.flight))
        for n, e in problem.effects.items()
        if n not in candidates and n not in base.names() and not e.rotational
    ]
    later = _later(problem, found.names, here)
    rates, terms = judge_rates(entire.flight, base.names(), base.effects_directory, later)
    unseen = tuple(
        v.name for v in absent if v.verdict == NOT_EXCITED and problem.effects[v.name].stage is Stage.COMMAND
    )
    if unseen:
        rates = [also_possible(v, unseen) if v.verdict == MISSING else v for v in rates]
    rank, turning = len(named), []
    for verdict in (*rotation.verdicts, *rates):
        rank += verdict.rank is not None
        turning.append(replace(verdict, rank=None if verdict.rank is None else rank))
    return [*map(included, base.names()), *named, *by_weight(absent), *others, *turning], terms


def _later(problem: ForceProblem, found: Sequence[str], here: Fit) -> float:
    """s by which rotors were found to follow their command later than believed: the rate loop is built on them."""
    terms = {t.effect: t for t in here.terms if t.effect in found} | {t.effect: t for t in problem.on_the_way}
    return sum(
        max(0.0, float(term.values[p.name]) - p.neutral_for(problem.flights.vehicle))
        for name, term in terms.items()
        for p in problem.effects[name].parameters
        if problem.effects[name].stage is Stage.COMMAND
    )


def _seen_as(problem: ForceProblem, name: str, fitted: Fit) -> tuple[str, ...]:
    """Rotational effects that may be what `name` shows by less than neutral, where the flight lacks the columns to
    tell."""
    return tuple(
        e.name
        for e in problem.effects.values()
        if name in e.seen_as
        and e.lacks(problem.flight)
        and all(fitted.estimate[i] < fitted.free[i].neutral for i in fitted.of(name))
    )


def _mean_square_before(flights: Problem, base: Model) -> float:
    """Mean squared error of the base model as it stands, nothing refitted but the clock, nothing learnt acting."""
    chain = with_clock(flights.measurements[0], base.chain())
    alone = [(effect, values) for effect, values in chain if effect.stage is not Stage.REMAINDER]
    return float(np.mean((flights.measured() - flights.predict(alone)) ** 2))
