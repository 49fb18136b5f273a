"""An effect added to a vehicle's model from several flights: what is the vehicle's is fitted to all of them together,
and what is each flight's own is fitted beside it and left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from threadpoolctl import threadpool_limits

from trueflight.groundstation.identify.differences import asked, fitted_anew
from trueflight.groundstation.identify.fitting import Fit, MeasuredFlights, model_of
from trueflight.groundstation.identify.force import MATERIAL_ACCELERATION
from trueflight.groundstation.identify.joint_force import JointForce, plain
from trueflight.groundstation.identify.now import as_it_is_now
from trueflight.groundstation.identify.ownership import BY_FILE, Ownership, needs_several, ownership
from trueflight.groundstation.identify.search import Search, State, whole
from trueflight.groundstation.identify.together import FITTED, LEAST, check_together, thinned
from trueflight.groundstation.measured.measurement import measure
from trueflight.groundstation.reading.several import told_apart
from trueflight.groundstation.results import OverTime, ParameterEstimate, SharedNumber
from trueflight.groundstation.versions.store import add_effect, extended, turned
from trueflight.models.effect import FLIGHT, Effect
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.model import Model, Term


@dataclass(frozen=True)
class Made:
    """A model fitted to several flights, not yet saved.

    `left_out` are numbers that are each flight's own, by effect; `differing` those of the vehicle that are not the same
    in all flights: the model has them as they were in the last. `courses` are those of added effects that change
    in the one flight they were fitted to: the model has what holds at the end.
    """

    model: Model
    left_out: dict[str, tuple[ParameterEstimate, ...]]
    differing: tuple[SharedNumber, ...]
    courses: Mapping[str, OverTime] = field(default_factory=dict)


def add_effect_together(
    base: Model,
    effect: str | Sequence[str],
    flights: Sequence[Flight],
    bandwidth: float | None = None,
    whose: Ownership = BY_FILE,
) -> Made:
    """`base` with one more effect, or several at once, every parameter refitted to all of `flights`.

    The flights are in the order of time. Wind and the like, which belong to a flight, are fitted beside where they
    show. Raises `InputError` as `versions.store.add_effect`, for flights that do not belong together, and for an effect
    that is each flight's own.
    """
    check_together(flights)
    model = extended(base, effect, flights)
    with threadpool_limits(1, user_api="blas"):
        added = [n for n in model.names() if n not in base.names()]
        return _fitted(model, added, told_apart(flights), bandwidth, whose)


def _fitted(
    model: Model, added: Sequence[str], flights: Sequence[Flight], bandwidth: float | None, whose: Ownership
) -> Made:
    shown = [thinned(f, max(LEAST, FITTED / len(flights))) for f in flights]
    names = [f.name for f in flights]
    terms = [turned(t, model, shown) for t in model.terms]
    problem = JointForce(
        MeasuredFlights(
            tuple(measure(f, bandwidth) for f in shown), model.effects_directory, model.network_chain()
        ),
        model.with_terms(()),
        whose=whose,
    )
    effects = problem.effects
    for effect in added:
        if _is_of_flights(effects[effect], whose):
            raise InputError(
                f"{effect} is each flight's own, and no part of a vehicle's model; add it from one flight, or say "
                f"--shared {effect}"
            )
    fitted = [t for t in terms if effects[t.effect].parameters and not effects[t.effect].rotational]
    problem = replace(problem, base=model.with_terms(tuple(t for t in terms if t not in fitted)))
    differing: list[SharedNumber] = []
    while True:
        search = Search(problem)
        state = _with_what_is_of_flights(search, [t.effect for t in fitted])
        answers = asked(
            problem,
            state.fit,
            [t.effect for t in fitted],
            names,
            MATERIAL_ACCELERATION,
            sum(len(effects[t.effect].parameters) for t in fitted),
        )
        if not any(a.differs for a in answers):
            break
        differing.append(max((a for a in answers if a.differs), key=lambda a: a.ratio))
        number = differing[-1].effect, differing[-1].parameter
        problem = replace(problem, whose=problem.whose.with_own([number]))
    return _made(model, problem, state.fit, names, flights, whose, differing)


def _is_of_flights(effect: Effect, whose: Ownership) -> bool:
    sizes = [p.name for p in effect.parameters if not p.structural]
    return bool(sizes) and all(whose.of(effect, n) == FLIGHT for n in sizes)


def _with_what_is_of_flights(search: Search, names: Sequence[str]) -> State:
    """The effects `names`, with those beside them that are each flight's own and show."""
    problem = search.problem
    assert isinstance(problem, JointForce)
    chosen = [whole(problem.effects[n]) for n in names]
    state = search.state(chosen)
    for choice in problem.choices:
        effect = problem.effects[choice.effect]
        acts = not effect.acts_through or set(effect.acts_through) & set(names)
        if choice.effect in names or not acts or not _is_of_flights(effect, problem.whose):
            continue
        richer = search.state([*state.choices, choice])
        if richer.fit.wald(choice.effect) < search.significance and search.evident(richer, state):
            state = richer
    return state


def _made(
    model: Model,
    problem: JointForce,
    here: Fit,
    names: Sequence[str],
    flights: Sequence[Flight],
    whose: Ownership,
    differing: Sequence[SharedNumber],
) -> Made:
    """The vehicle's model, with what was left out of it."""
    own: dict[str, tuple[ParameterEstimate, ...]] = {}
    for i, f in enumerate(here.free):
        if f.nuisance or whose.of(problem.effects[f.effect], f.parameter.name) != FLIGHT:
            continue
        flight = names[f.span.flight or 0]
        estimate = ParameterEstimate(
            f.parameter.name, float(here.estimate[i]), *here.interval(i), f.parameter.unit, flight
        )
        own[f.effect] = (*own.get(f.effect, ()), estimate)
    found = {t.effect: t for t in model_of(here, problem.base).terms}
    terms: tuple[Term, ...] = tuple(plain(found.get(t.effect, t)) for t in model.terms)
    rms = float((here.sse / here.residual.size) ** 0.5)
    hashes = "+".join(f.data_hash for f in flights)
    return Made(
        replace(model.with_terms(terms), data_hash=hashes, fit={"rms": rms}, fitted_to=tuple(names)),
        own,
        tuple(fitted_anew(n, here, names) for n in differing),
    )


def add_effect_to(
    base: Model,
    effect: str | Sequence[str],
    flights: Sequence[Flight],
    bandwidth: float | None = None,
    per_flight: Sequence[str] = (),
    shared: Sequence[str] = (),
) -> Made:
    """`base` with one more effect, or several at once, from one flight or from several.

    `per_flight` and `shared` as in `ownership`.
    Raises `InputError` as `versions.store.add_effect` and `add_effect_together`.
    """
    whose = ownership(per_flight, shared, base.effects_directory)
    if len(flights) > 1:
        return add_effect_together(base, effect, flights, bandwidth, whose)
    needs_several(per_flight, shared)
    made = add_effect(base, effect, flights, bandwidth)
    added = [n for n in made.names() if n not in base.names()]
    model, courses = as_it_is_now(made, added, flights[0], bandwidth)
    for name, course in courses.items():
        if course.ended:
            raise InputError(
                f"{flights[0].origin or flights[0].name}: {name} ended at {course.changes[-1].time:.1f} s "
                f"({'; '.join(course.lines)}): there is nothing to add for the vehicle as it is now"
            )
    return Made(model, {}, (), courses)
