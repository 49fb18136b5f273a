"""Which physical effect is missing from a model, from one flight and, better, a held-out one.

The specific force of the flight against what the model's chain of effects predicts; `identify.search` finds what is
missing, `identify.verdicts` says it. What the rotation of the vehicle shows is found first, and what rotor speeds show
between command and rotors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from threadpoolctl import threadpool_limits

from trueflight.groundstation.identify.changes import Drift, in_time, in_words, over_time
from trueflight.groundstation.identify.doubt import Weighing
from trueflight.groundstation.identify.drift import at_the_end, beside_drift, drifting, possible
from trueflight.groundstation.identify.fitting import (
    Fit,
    MeasuredFlights,
    model_of,
)
from trueflight.groundstation.identify.force import ForceProblem, mean_square_before
from trueflight.groundstation.identify.gusts import gusts_of, told_as_gusts
from trueflight.groundstation.identify.lateness import late_instead
from trueflight.groundstation.identify.one_by_one import shares, with_shares
from trueflight.groundstation.identify.rates import judge_rates
from trueflight.groundstation.identify.remainder import how_much_is_left, unexplained
from trueflight.groundstation.identify.ridges import ridges, with_ridges
from trueflight.groundstation.identify.rotation import RotationalFindings, judge_rotation
from trueflight.groundstation.identify.rotors import MeasuredRotors, has_rotor_speeds
from trueflight.groundstation.identify.search import Search, State
from trueflight.groundstation.identify.verdicts import (
    MISSING,
    NOT_EXCITED,
    POSSIBLE,
    Scale,
    also_possible,
    by_weight,
    included,
    judge,
    unmeasured,
)
from trueflight.groundstation.measured.measurement import Measurement, measure
from trueflight.groundstation.reading.actuation import LIFT
from trueflight.groundstation.results import Diagnosis, EffectVerdict, OverTime
from trueflight.models.effect import Stage
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.model import Model, Term

LONG, PART = 240.0, 20.0
"""s of flight beyond which effects are looked for in parts of so many s, as much altogether, spread evenly; what is
found is fitted to all of the flight and dropped where that does not support it."""


def diagnose(
    flight: Flight,
    base: Model,
    validation: Flight | None = None,
    bandwidth: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
    healthy: Sequence[Flight] = (),
) -> Diagnosis:
    """Find the effects that `base` lacks on `flight`, checked on held-out blocks and on `validation`.

    `healthy` are flights of the same vehicle with which the share of each motor is compared.

    A network of `base` is held as it is: what it has learnt is not missing any more.

    Raises `InputError` where the flight lacks the columns for any comparison, or is too short.
    """
    # Its products are small: threads would wait for each other more than they compute.
    with threadpool_limits(1, user_api="blas"):
        return _diagnose(flight, base, validation, bandwidth, progress, healthy)


def _diagnose(
    flight: Flight,
    base: Model,
    validation: Flight | None,
    bandwidth: float | None,
    progress: Callable[[str], None],
    healthy: Sequence[Flight],
) -> Diagnosis:
    def measured(*measurements: Measurement) -> MeasuredFlights:
        return MeasuredFlights(measurements, base.effects_directory, base.network_chain())

    all_of_it = measured(measure(flight, bandwidth))
    held_out = None if validation is None else measured(measure(validation, bandwidth))
    progress("looking at the rotation")
    rotation = judge_rotation(flight, base.names(), base.effects_directory, healthy)
    entire = ForceProblem(all_of_it, base, held_out, rotation.terms, turning_in_time=rotation.spanned)
    parts = _spread(flight, bandwidth) if flight.duration > LONG else ()
    looked_at = replace(entire, flights=measured(*parts)) if parts else entire
    if has_rotor_speeds(flight):
        progress("looking between command and rotors")
        looked_at = replace(looked_at, on_the_way=shown_by_rotors(looked_at))
        entire = entire if parts else looked_at
    search = Search(looked_at, progress)
    found = search.select()
    everything = search
    if parts:
        progress("fitting what was found to the whole flight")
        everything = Search(entire, progress)
        found = everything.settle(found.choices)
    progress("looking for what changes in flight")
    timed = in_time(everything, found)
    kept = everything.agreed_by_held_out(timed.state)
    if timed.drift is not None and timed.drift.choice in kept.choices:
        drift = timed.drift
        beside, wandering, course = beside_drift(entire, kept, drift)
        if possible(entire.effects[drift.choice.effect], course):
            diagnosis = report(beside, wandering, beside, rotation, {drift.choice.effect: course})
            return _with_drift(diagnosis, drift, course)
        # what cannot be is no drift, but may be a change at a moment
        kept = everything.agreed_by_held_out(in_time(everything, found, drifts=False).state)
    return report(search, search.state(kept.choices), everything, rotation)


def _with_drift(diagnosis: Diagnosis, drift: Drift, course: OverTime) -> Diagnosis:
    """The diagnosis with what the drift itself says of its effect, and the model as it is at the end."""
    name = drift.choice.effect
    model = diagnosis.model
    return replace(
        diagnosis,
        effects=tuple(drifting(e, drift) if e.name == name else e for e in diagnosis.effects),
        model=model.with_terms(at_the_end(model.terms, name, course)),
    )


def shown_by_rotors(problem: ForceProblem) -> tuple[Term, ...]:
    """The effects that rotor speeds show between command and rotor.

    None where they leave more of the rotors' thrust unexplained than the accelerometer's noise: there the rotors did
    not follow the collective (a saturated mixer), and prove nothing.
    """
    base, flights = problem.base, problem.flights
    path = ForceProblem(
        MeasuredRotors(flights.measurements, base.effects_directory),
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


def report(
    search: Search,
    found: State,
    everything: Search,
    rotation: RotationalFindings,
    drifts: Mapping[str, OverTime] = MappingProxyType({}),
    structure: bool = True,
) -> Diagnosis:
    """The verdicts; figures of what was found are those of the whole flight, which `everything` sees. Without
    `structure` of what is left only its size is asked, not what it goes with."""
    problem, entire = _force(search), _force(everything)
    here = everything.state(found.choices).fit
    times = {c.effect: t for c in found.choices if (t := over_time(entire, here, c)) is not None}
    times |= drifts
    m, base = entire.flights.measurements[0], entire.base
    remains = unexplained(m, here.residual) if structure else how_much_is_left(m, here.residual)
    gusts = None
    if structure and remains.misfit:
        gusts = gusts_of(m, here.residual, remains, entire.push_of_air(here))
    doubt = Weighing(entire, here, m.noise[list(m.axes)]) if remains.misfit else None
    verdicts, rate_terms = _verdicts(search, found, here, entire, rotation, doubt)
    verdicts = in_words(verdicts, times)
    ended = {v.name for v in verdicts if v.over_time is not None and v.over_time.ended}
    left = float(np.sqrt(here.sse / entire.samples))
    final = model_of(here, base)
    shift = [float(here.estimate[i]) for i, f in enumerate(here.free) if f.nuisance]
    held_out, after = entire.held_out, entire.held_out_error(here)
    return Diagnosis(
        flight=m.flight,
        base=base,
        model=final.with_terms(tuple(t for t in (*final.terms, *rate_terms) if t.effect not in ended)),
        rms_before=float(np.sqrt(entire.mean_square_before)),
        rms_after=left,
        # noise cannot leave more than what is left: a vibration is stronger beyond the pass band than in it
        noise_floor=min(float(np.sqrt(np.mean(m.noise[list(m.axes)] ** 2))), left),
        bandwidth=m.bandwidth,
        axes=m.axes,
        validation_before=None if held_out is None else float(np.sqrt(mean_square_before(held_out, base))),
        validation_after=None
        if held_out is None or after is None
        else float(np.sqrt(after / held_out.measured().size)),
        clock_shift=shift[0] - problem.flights.vehicle.command_delay if shift else None,
        effects=tuple(verdicts),
        unexplained=remains if gusts is None else told_as_gusts(remains, gusts),
        gusts=gusts,
        left_out=m.left_out,
        rotational=rotation.rms,
        alternatives=tuple(s.names for s in search.near(found)),
        shares=rotation.shares,
    )


def _force(search: Search) -> ForceProblem:
    assert isinstance(search.problem, ForceProblem)
    return search.problem


def _verdicts(
    search: Search,
    found: State,
    here: Fit,
    entire: ForceProblem,
    rotation: RotationalFindings,
    doubt: Weighing | None,
) -> tuple[list[EffectVerdict], list[Term]]:
    """The verdicts on all effects of the catalogue, and the terms of what the body rates show."""
    problem, base = _force(search), entire.base
    named, absent = judged(search, found, here, entire, doubt)
    named = [_perhaps_late(search, found, entire, here, v) for v in named]
    both = with_shares([*named, *absent], shares(entire, here, found.names))
    named, absent = both[: len(named)], both[len(named) :]
    turned: Sequence[EffectVerdict] = rotation.verdicts
    if _lacks_thrust(problem, found.names, here):
        turned = or_a_rotor(turned, rotation.nearly)
    late = later(problem, found.names, here)
    others, turning, terms = seen_elsewhere(problem, named, absent, turned, entire.flight, late)
    return [*map(included, base.names()), *named, *by_weight(absent), *others, *turning], terms


def judged(
    search: Search, found: State, here: Fit, entire: ForceProblem, doubt: Weighing | None
) -> tuple[list[EffectVerdict], list[EffectVerdict]]:
    """Verdicts on what was found in the acceleration, and on what was not."""
    problem = _force(search)
    before = problem.mean_square_before
    scale = Scale(
        before * problem.samples, lambda share: f": {np.sqrt(max(share, 0.0) * before):.3f} m/s² RMS"
    )
    named, absent = judge(
        search, found, here, scale, lambda name: seen_as(problem, name, here), doubt, entire
    )
    named = with_ridges(named, ridges(entire, here, found.names))
    unfelt = any(
        c.pair == LIFT and c.verdict == "weak"
        for m in entire.flights.measurements
        for c in m.flight.consistency
    )
    return [_unfelt(v) if unfelt and v.verdict == MISSING else v for v in named], absent


def _unfelt(verdict: EffectVerdict) -> EffectVerdict:
    """A verdict where the thrust that the model rests on is hardly felt: whatever fits may stand in for that."""
    return replace(
        verdict,
        verdict=POSSIBLE,
        rests_on="what is measured hardly follows the thrust command",
        advice="check that command and accelerometer are of one flight and on one clock, then fly again; "
        + verdict.advice,
        confidence=None if verdict.confidence is None else 0.5 * verdict.confidence,
    )


def seen_elsewhere(
    problem: ForceProblem,
    named: Sequence[EffectVerdict],
    absent: Sequence[EffectVerdict],
    turned: Sequence[EffectVerdict],
    flight: Flight,
    late: float,
) -> tuple[list[EffectVerdict], list[EffectVerdict], list[Term]]:
    """Verdicts on what the flights have no measurements for, and on the rotation and the rate loop, ranked after those
    that are `named`; and the terms of the rate loop.

    `turned` are the verdicts on the rotation, `flight` is the one whose rate loop is judged, `late` s are granted to
    it: rotors found to follow their command later than believed.
    """
    base = problem.base
    candidates = {c.effect for c in problem.choices}
    others = [
        unmeasured(e, e.lacks(problem.flight))
        for n, e in problem.effects.items()
        if n not in candidates and n not in base.names() and not e.rotational
    ]
    rates, terms = judge_rates(flight, base.names(), base.effects_directory, late)
    unseen = tuple(
        v.name for v in absent if v.verdict == NOT_EXCITED and problem.effects[v.name].stage is Stage.COMMAND
    )
    if unseen:
        rates = [also_possible(v, unseen) if v.verdict == MISSING else v for v in rates]
    rank, turning = len(named), []
    for verdict in (*turned, *rates):
        rank += verdict.rank is not None
        turning.append(replace(verdict, rank=None if verdict.rank is None else rank))
    return others, turning, terms


def _lacks_thrust(problem: ForceProblem, found: Sequence[str], here: Fit) -> bool:
    """Whether less thrust was found than is believed."""
    scales = [n for n in found if problem.effects[n].scales_rotors]
    return any(here.interval(i)[1] < here.free[i].neutral for n in scales for i in here.sizes(n))


def or_a_rotor(
    verdicts: Sequence[EffectVerdict], nearly: Mapping[str, tuple[str, ...]]
) -> tuple[EffectVerdict, ...]:
    """Verdicts on the rotation where thrust is lacking, too: one weaker rotor makes both what it is found to lack and
    `nearly` what a centre of mass does."""
    open_now = {
        v.name: nearly.get(v.name, ()) for v in verdicts if v.verdict == MISSING and nearly.get(v.name)
    }
    out = []
    for v in verdicts:
        others = open_now.get(v.name) or tuple(n for n, rotors in open_now.items() if v.name in rotors)
        if others:
            v = replace(
                v,
                verdict=POSSIBLE,
                parameters=v.parameters if v.name in open_now else (),
                indistinguishable_from=tuple(dict.fromkeys((*v.indistinguishable_from, *others))),
                rests_on="thrust is lacking, too, and one weaker rotor would make both",
                advice="compare with a flight when the vehicle was healthy (--healthy FLIGHT)",
                confidence=None if v.confidence is None else 0.5 * v.confidence,
            )
        out.append(v)
    return tuple(out)


def _perhaps_late(
    search: Search, found: State, entire: ForceProblem, here: Fit, verdict: EffectVerdict
) -> EffectVerdict:
    """A verdict on what delays the thrust, which a late estimate of the velocity may be instead."""
    choice = next(c for c in found.choices if c.effect == verdict.name)
    if entire.effects[verdict.name].stage is not Stage.COMMAND:
        return verdict
    rest = search.without(found, choice).choices
    late = late_instead(entire, here, entire.fit(rest, None))
    if late is None:
        return verdict
    # how it is smoothed is not known: the shape of the answer tells no more
    others = tuple(
        c.effect
        for c in entire.choices
        if entire.effects[c.effect].stage is Stage.COMMAND
        and c.effect not in (*found.names, *verdict.indistinguishable_from)
    )
    told = "a late estimate" if math.isnan(late) else f"a velocity estimate {1e3 * late:.0f} ms late"
    return replace(
        verdict,
        verdict=POSSIBLE,
        indistinguishable_from=(*verdict.indistinguishable_from, *others, told),
        advice="log an accelerometer, or fly quick steps to the sides as well: they tell it from a late estimate",
    )


def later(problem: ForceProblem, found: Sequence[str], here: Fit) -> float:
    """s by which rotors were found to follow their command later than believed: the rate loop is built on them."""
    terms = {t.effect: t for t in here.terms if t.effect in found} | {t.effect: t for t in problem.on_the_way}
    return sum(
        max(0.0, float(term.values[p.name]) - p.neutral_for(problem.flights.vehicle))
        for name, term in terms.items()
        for p in problem.effects[name].parameters
        if problem.effects[name].stage is Stage.COMMAND
    )


def seen_as(problem: ForceProblem, name: str, fitted: Fit) -> tuple[str, ...]:
    """Rotational effects that may be what `name` shows by less than neutral, where the flight lacks the columns to
    tell."""
    return tuple(
        e.name
        for e in problem.effects.values()
        if name in e.seen_as
        and e.lacks(problem.flight)
        and all(fitted.estimate[i] < fitted.free[i].neutral for i in fitted.of(name))
    )
