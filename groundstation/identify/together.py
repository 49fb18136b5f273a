"""One vehicle, several flights, one diagnosis: which effects are missing, what is the vehicle's, and what differs.

The search is that of one flight (`identify.search`), over the specific force and the angular acceleration of all.
A number of the vehicle is one for all flights, so that flights in different winds tell one drag; wind, offsets of the
sensor and the clock are each flight's own. Every number of the vehicle that was found is then asked whether it is the
same in all flights; one that is not is fitted to each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from threadpoolctl import threadpool_limits

from trueflight.groundstation.identify.differences import asked, fitted_anew
from trueflight.groundstation.identify.doubt import Weighing
from trueflight.groundstation.identify.fitting import Fit, MeasuredFlights, model_of
from trueflight.groundstation.identify.force import MATERIAL_ACCELERATION, mean_square_before
from trueflight.groundstation.identify.joint_force import JointForce, plain
from trueflight.groundstation.identify.joint_torque import JointTorque, one_choice_each
from trueflight.groundstation.identify.ownership import BY_FILE, Ownership
from trueflight.groundstation.identify.remainder import unexplained
from trueflight.groundstation.identify.rotation import that_turns
from trueflight.groundstation.identify.rotors import has_rotor_speeds
from trueflight.groundstation.identify.rotors_apart import doubted
from trueflight.groundstation.identify.search import Choice, Search, State
from trueflight.groundstation.identify.spans import Piecewise
from trueflight.groundstation.identify.torque import TorqueProblem, turning_of
from trueflight.groundstation.identify.translation import judged, later, seen_elsewhere, shown_by_rotors
from trueflight.groundstation.identify.verdicts import (
    Scale,
    by_weight,
    included,
    judge,
    unmeasured,
)
from trueflight.groundstation.measured.measurement import measure
from trueflight.groundstation.reading.several import told_apart
from trueflight.groundstation.results import (
    Diagnosis,
    EffectVerdict,
    OneFlight,
    RotationalRms,
    SharedNumber,
    Unexplained,
)
from trueflight.models.effect import Effect, Stage
from trueflight.models.effects import catalogue
from trueflight.models.errors import InputError
from trueflight.models.flight import COLUMNS, Flight
from trueflight.models.model import Model, Term

MOST_FLIGHTS = 24
"""Flights of one fit: every one brings numbers of its own."""
SEARCHED, FITTED = 240.0, 1200.0
"""s of flight, of all flights together, in which effects are looked for, and to which what was found is fitted."""
LEAST = 20.0
"""s of each flight that are looked at, however many there are."""
PART = 10.0
"""s of each part of a flight that is looked at in parts."""
COMPARED = tuple(n for n in COLUMNS if not n.endswith("_reference"))
"""Columns that flights of one fit must have in common: those that say how the vehicle was told and what it did."""


def diagnose_together(
    flights: Sequence[Flight],
    base: Model,
    validation: Flight | None = None,
    bandwidth: float | None = None,
    whose: Ownership = BY_FILE,
    progress: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Find the effects that `base` lacks on several `flights` of its vehicle, in one fit; `validation` is held out.

    `whose` tells whose each number is where it is not as the effects' files say. Flights are in the order of time: what
    changed is held by the last of them.

    Raises `InputError` for flights of different vehicles or with different columns, the same one twice, and as
    `identify.translation.diagnose`.
    """
    check_together(flights)
    flights = told_apart(flights)
    with threadpool_limits(1, user_api="blas"):
        return _Joint(tuple(flights), base, validation, bandwidth, whose, progress).diagnosis()


def check_together(flights: Sequence[Flight]) -> None:
    """Raise `InputError` where flights cannot be fitted together."""
    first, names = flights[0], [f.origin or f.name for f in flights]
    if len(flights) > MOST_FLIGHTS:
        raise InputError(
            f"{len(flights)} flights: at most {MOST_FLIGHTS} are fitted together; 'groundstation survey' takes more"
        )
    for k, flight in enumerate(flights):
        for j in range(k):
            if flight.data_hash and flight.data_hash == flights[j].data_hash:
                same = "given twice" if names[j] == names[k] else f"the same flight as {names[j]}"
                raise InputError(f"{names[k]}: {same}; give it once")
        if flight.vehicle.name != first.vehicle.name:
            raise InputError(
                f"{names[k]} is of vehicle '{flight.vehicle.name}', {names[0]} of '{first.vehicle.name}'; flights of "
                "one vehicle are diagnosed together"
            )
        if replace(flight.vehicle, source="") != replace(first.vehicle, source=""):
            raise InputError(
                f"{names[k]} and {names[0]} believe different things of vehicle '{first.vehicle.name}'; pass one file "
                "for both with --vehicle"
            )
    for name in COMPARED:
        has = [flight.has(name) for flight in flights]
        if any(has) and not all(has):
            without, with_ = names[has.index(False)], names[has.index(True)]
            raise InputError(
                f"{without}: {COLUMNS[name][2]} is missing, which {with_} has; flights with the same columns are "
                "diagnosed together"
            )
    if len({flight.accelerometer for flight in flights}) > 1:
        felt = [flight.accelerometer for flight in flights]
        raise InputError(
            f"{names[felt.index(False)]}: acceleration was not measured by an accelerometer, as in "
            f"{names[felt.index(True)]}; flights with the same columns are diagnosed together"
        )


def thinned(flight: Flight, seconds: float) -> Flight:
    """So many `seconds` of a longer flight, in parts of `PART` s, evenly spread. What follows a cut does not count
    until the vehicle's lags have forgotten it."""
    if flight.duration <= seconds + PART:
        return flight
    rows, count = round(PART / flight.dt), max(1, round(seconds / PART))
    keep, counts = np.zeros(len(flight), dtype=bool), np.ones(len(flight), dtype=bool)
    for start in np.linspace(0, len(flight) - rows, count).astype(int):
        keep[start : start + rows] = True
        counts[start : start + round(0.5 / flight.dt)] = False
    flying = counts if flight.flying is None else flight.flying & counts
    return replace(flight, flying=flying).part(keep)


@dataclass(frozen=True)
class _Rotation:
    """What the rotation of all flights says."""

    verdicts: tuple[EffectVerdict, ...]
    terms: tuple[Term, ...]
    rms: RotationalRms | None
    shared: tuple[SharedNumber, ...]


class _Joint:
    """One joint diagnosis, step by step."""

    def __init__(
        self,
        flights: tuple[Flight, ...],
        base: Model,
        validation: Flight | None,
        bandwidth: float | None,
        whose: Ownership,
        progress: Callable[[str], None],
    ) -> None:
        self.all, self.base, self.bandwidth, self.whose, self.progress = (
            flights, base, bandwidth, whose, progress,
        )  # fmt: skip
        self.names = [f.name for f in flights]
        self.held_out = None if validation is None else self._measured([validation])

    def _measured(self, flights: Sequence[Flight]) -> MeasuredFlights:
        measurements = tuple(measure(f, self.bandwidth) for f in flights)
        return MeasuredFlights(measurements, self.base.effects_directory, self.base.network_chain())

    def _within(self, seconds: float) -> list[Flight]:
        return [thinned(f, max(LEAST, seconds / len(self.all))) for f in self.all]

    def diagnosis(self) -> Diagnosis:
        """The verdicts on all flights together."""
        self.progress("looking at the rotation")
        rotation = self._rotation()
        parts, whole = self._within(SEARCHED), self._within(FITTED)
        looked_at = self._problem(parts, rotation.terms)
        if has_rotor_speeds(self.all[0]):
            self.progress("looking between command and rotors")
            looked_at = replace(looked_at, on_the_way=shown_by_rotors(looked_at))
        found = Search(replace(looked_at, apart=True), self.progress).select()
        self.progress("asking whether the flights differ")
        search, shared = self._differences(looked_at, one_choice_each(found.choices))
        kept = search.settle(one_choice_each(found.choices))
        if all(a is b for a, b in zip(parts, whole, strict=True)):
            return self._report(search, kept, search, rotation, shared)
        self.progress("fitting what was found to all of the flights")
        entire = replace(
            self._problem(whole, rotation.terms),
            on_the_way=looked_at.on_the_way,
            whose=_joint(search).whose,
        )
        everything, shared = self._differences(entire, kept.choices, shared)
        kept = everything.settle(kept.choices)
        search = Search(replace(looked_at, whose=_joint(everything).whose), self.progress)
        return self._report(search, search.state(kept.choices), everything, rotation, shared)

    def _problem(self, flights: Sequence[Flight], turning: tuple[Term, ...]) -> JointForce:
        return JointForce(self._measured(flights), self.base, self.held_out, turning, whose=self.whose)

    def _differences(
        self, problem: JointForce, choices: Sequence[Choice], known: Sequence[SharedNumber] = ()
    ) -> tuple[Search, tuple[SharedNumber, ...]]:
        """The vehicle's numbers, each asked whether it differs; those that do become each flight's own, the most
        evident first, for what differs makes others seem to. With the search in which they are."""
        names, told = [c.effect for c in choices], [n for n in known if n.differs]
        tried = sum(len(problem.effects[n].parameters) for n in names)
        while True:
            search = Search(problem, self.progress)
            fitted = search.state(choices).fit
            answers = asked(problem, fitted, names, self.names, MATERIAL_ACCELERATION, tried)
            differing = [a for a in answers if a.differs]
            if not differing:
                return search, (*(fitted_anew(a, fitted, self.names) for a in told), *answers)
            worst = max(differing, key=lambda a: a.ratio)
            told.append(worst)
            problem = replace(problem, whose=problem.whose.with_own([(worst.effect, worst.parameter)]))

    # --- the rotation ---------------------------------------------------------------------------------------

    def _rotation(self) -> _Rotation:
        base = self.base
        effects = {
            n: e
            for n, e in catalogue(base.effects_directory).items()
            if e.rotational and e.stage is not Stage.RATE
        }
        turns = that_turns(self.all[0])
        missing = {n: e.lacks(turns) for n, e in effects.items() if n not in base.names()}
        measurable = tuple(n for n, columns in missing.items() if not columns)
        turnings = [turning_of(f) for f in self._within(FITTED)] if measurable else []
        told = [t for t in turnings if t is not None]
        same = len({t.rotation.axes for t in told}) == 1
        if not same or len(told) < len(self.all):
            nothing = tuple(unmeasured(effects[n], c) for n, c in missing.items())
            return _Rotation(nothing, (), None, ())
        already = tuple(n for n in effects if n in base.names())
        alone = tuple(TorqueProblem(t, effects, measurable, already) for t in told)
        problem = JointTorque(alone, self.whose)
        choices = one_choice_each(Search(replace(problem, apart=True)).select().choices)
        shared: list[SharedNumber] = []
        while True:
            search = Search(problem)
            here = search.state(choices)
            answers = asked(problem, here.fit, here.names, self.names, 0.0, len(problem.choices))
            answers = tuple(_within_a_set(a, effects[a.effect]) for a in answers)
            differing = [a for a in answers if a.differs]
            if not differing:
                break
            worst = max(differing, key=lambda a: a.ratio)
            shared.append(worst)
            problem = replace(problem, whose=problem.whose.with_own([(worst.effect, worst.parameter)]))
        before, found = search.state(()), search.settle(choices)
        scale = Scale(before.fit.sse, lambda share: "", "rotation")
        doubt = Weighing(problem, found.fit, problem.noise, quiet=problem.only_noise(found.fit))
        named, absent = judge(search, found, found.fit, scale, doubt=doubt)
        named = [doubted(v, alone[-1], found.fit, quiet=True) for v in named]
        others = [unmeasured(effects[n], c) for n, c in missing.items() if n not in measurable]
        # a chain takes numbers that differ between flights as it takes plain ones
        values = cast("dict[str, dict[str, float]]", found.fit.values)
        terms = tuple(replace(t, values=values[t.effect]) for t in found.fit.terms)
        verdicts = tuple(self._by_name(v) for v in (*named, *by_weight(absent), *others))
        return _Rotation(
            verdicts,
            terms,
            problem.rms(before.fit, found.fit),
            (*(fitted_anew(a, found.fit, self.names) for a in shared), *answers),
        )

    # --- what is said ---------------------------------------------------------------------------------------

    def _report(
        self,
        search: Search,
        found: State,
        everything: Search,
        rotation: _Rotation,
        shared: tuple[SharedNumber, ...],
    ) -> Diagnosis:
        entire = _joint(everything)
        here = everything.state(found.choices).fit
        each = [self._one(entire, here, rotation, k) for k in range(len(self.all))]
        noise = np.sqrt(np.mean([m.noise[list(m.axes)] ** 2 for m in entire.flights.measurements], axis=0))
        left_over = _together([f.unexplained for f in each], self.names)
        doubt = Weighing(entire, here, noise) if left_over.misfit else None
        verdicts, rate_terms = self._verdicts(search, found, here, entire, rotation, doubt)
        model, set_aside = self._vehicles(entire, here, found, (*rotation.terms, *rate_terms))
        held_out, last = entire.held_out, entire.flights.measurements[-1]
        checked = None if held_out is None else entire.on_held_out(here)
        left = float(np.sqrt(here.sse / entire.samples))
        return Diagnosis(
            flight=self.all[-1],
            base=self.base,
            model=model,
            rms_before=float(np.sqrt(entire.mean_square_before)),
            rms_after=left,
            noise_floor=min(float(np.sqrt(np.mean(noise**2))), left),
            bandwidth=last.bandwidth,
            axes=last.axes,
            validation_before=None
            if held_out is None
            else float(np.sqrt(mean_square_before(held_out, self.base))),
            validation_after=None if checked is None else float(np.sqrt(np.mean(checked.residual**2))),
            clock_shift=each[-1].clock_shift,
            effects=tuple(verdicts),
            unexplained=left_over,
            left_out=each[-1].left_out,
            rotational=rotation.rms,
            alternatives=tuple(s.names for s in search.near(found)),
            flights=tuple(each),
            shared=tuple(n for n in (*shared, *rotation.shared) if _is_known(n, verdicts)),
            set_aside=set_aside,
            held_out_model=None if checked is None else model_of(checked, self.base),
        )

    def _one(self, entire: JointForce, here: Fit, rotation: _Rotation, k: int) -> OneFlight:
        """What one flight adds."""
        m, residual = entire.flights.measurements[k], here.residual[entire.rows(k)]
        left = float(np.sqrt(np.mean(residual**2)))
        clock = [
            float(here.estimate[i])
            for i, f in enumerate(here.free)
            if f.nuisance and f.span.flight in (None, k)
        ]
        values = here.values
        terms = tuple(
            Term(t.effect, {p: _at(v, k) for p, v in values[t.effect].items()})
            for t in here.terms
            if t.effect not in {f.effect for f in here.free if f.nuisance}
        )
        return OneFlight(
            self.all[k],
            self.base.with_terms(terms),
            float(np.sqrt(mean_square_before(entire.alone(k), self.base))),
            left,
            min(float(np.sqrt(np.mean(m.noise[list(m.axes)] ** 2))), left),
            clock[0] - entire.flights.vehicle.command_delay if clock else None,
            unexplained(m, residual),
            m.left_out,
        )

    def _verdicts(
        self,
        search: Search,
        found: State,
        here: Fit,
        entire: JointForce,
        rotation: _Rotation,
        doubt: Weighing | None,
    ) -> tuple[list[EffectVerdict], list[Term]]:
        """The verdicts on all effects of the catalogue, and the terms of what the body rates show."""
        problem, base = _joint(search), self.base
        named, absent = judged(search, found, here, entire, doubt)
        late = later(problem, found.names, here)
        others, turning, terms = seen_elsewhere(problem, named, absent, rotation.verdicts, self.all[-1], late)
        seen = [self._by_name(v) for v in (*named, *by_weight(absent))]
        return [*map(included, base.names()), *seen, *others, *turning], terms

    def _by_name(self, verdict: EffectVerdict) -> EffectVerdict:
        """The verdict, whose numbers of one flight are told by its name instead of its place."""
        named = tuple(
            replace(p, flight=self.names[int(p.flight)]) if p.flight.isdecimal() else p
            for p in verdict.parameters
        )

        def told(text: str) -> str:
            name, at, flight = text.rpartition("@")
            return f"{name}@{self.names[int(flight)]}" if at and flight.isdecimal() else text

        return replace(
            verdict,
            parameters=named,
            undetermined=tuple(map(told, verdict.undetermined)),
            products=tuple(replace(p, name=told(p.name)) for p in verdict.products),
        )

    def _vehicles(
        self, entire: JointForce, here: Fit, found: State, others: Sequence[Term]
    ) -> tuple[Model, tuple[str, ...]]:
        """The model of what is the vehicle's, and the names of what is not."""
        kept, aside = [], []
        for term in model_of(here, self.base).terms:
            effect = entire.effects[term.effect]
            own = [p.name for p in effect.parameters if p.belongs_to == "flight"]
            if term.effect in self.base.names() or not own:
                kept.append(plain(term))
            else:
                aside.append(term.effect)
        known = {t.effect for t in kept}
        return self.base.with_terms((*kept, *(plain(t) for t in others if t.effect not in known))), tuple(
            aside
        )


def _joint(search: Search) -> JointForce:
    assert isinstance(search.problem, JointForce)
    return search.problem


def _at(value: float | Piecewise, flight: int) -> float:
    return value.at(flight, 0.0) if isinstance(value, Piecewise) else float(value)


def _is_known(number: SharedNumber, verdicts: Sequence[EffectVerdict]) -> bool:
    """Whether the flights determine the number at all: else nothing is said of its being the same."""
    return not any(v.name == number.effect and number.parameter in v.undetermined for v in verdicts)


def _within_a_set(answer: SharedNumber, effect: Effect) -> SharedNumber:
    """The answer, but no difference where it is within what rotors of one set differ by."""
    from trueflight.groundstation.identify.torque import MATERIAL_SIZE

    typical = abs(next(p.typical for p in effect.parameters if p.name == answer.parameter))
    level = None if answer.common is None else answer.common.value
    values = [v.value for v in answer.values]
    level = float(np.mean(values)) if level is None else level
    far = [v.flight for v in answer.values if abs(v.value - level) > MATERIAL_SIZE * typical]
    return replace(answer, apart=tuple(n for n in answer.apart if n in far))


def _together(each: Sequence[Unexplained], names: Sequence[str]) -> Unexplained:
    """What is left of all flights: that of the one with the most, told of each."""
    worst = max(each, key=lambda u: (u.verdict, u.variance_share))
    where = tuple(
        f"{name}: {one.where[0]}" for name, one in zip(names, each, strict=True) if one.verdict and one.where
    )
    misfit = tuple(m for one in each for m in one.misfit)
    return replace(worst, where=where or worst.where, misfit=misfit)
