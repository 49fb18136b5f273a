"""An effect as it is now: what holds at the end of a flight in which it changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from threadpoolctl import threadpool_limits

from trueflight.groundstation.identify.changes import in_time, over_time
from trueflight.groundstation.identify.drift import at_the_end, beside_drift
from trueflight.groundstation.identify.fitting import MeasuredFlights, model_of
from trueflight.groundstation.identify.force import ForceProblem
from trueflight.groundstation.identify.search import Search, whole
from trueflight.groundstation.identify.torque import TorqueProblem, turning_of
from trueflight.groundstation.measured.measurement import measure
from trueflight.groundstation.results import OverTime
from trueflight.models.effect import Effect, Stage
from trueflight.models.effects import effect_named
from trueflight.models.flight import Flight
from trueflight.models.model import Model, Term


def as_it_is_now(
    model: Model, names: Sequence[str], flight: Flight, bandwidth: float | None = None
) -> tuple[Model, dict[str, OverTime]]:
    """`model`, fitted to `flight`, with its effects `names` as they are at the end, everything fitted beside them; and
    the courses of those that change."""
    with threadpool_limits(1, user_api="blas"):
        effects = {t.effect: effect_named(t.effect, model.effects_directory) for t in model.terms}
        courses: dict[str, OverTime] = {}
        for name in names:
            if effects[name].rotational and effects[name].stage is not Stage.RATE:
                told = _turning(effects[name], flight)
                if told is not None:
                    term, courses[name] = told
                    model = model.with_terms(tuple(term if t.effect == name else t for t in model.terms))
        acting = [n for n in names if not effects[n].rotational]
        made, seen = _acting(model, effects, acting, flight, bandwidth)
        return made, courses | seen


def _acting(
    model: Model, effects: Mapping[str, Effect], names: Sequence[str], flight: Flight, bandwidth: float | None
) -> tuple[Model, dict[str, OverTime]]:
    fitted = {n for n, e in effects.items() if e.parameters and not e.rotational}
    rest = model.with_terms(tuple(t for t in model.terms if t.effect not in fitted))
    flights = MeasuredFlights((measure(flight, bandwidth),), model.effects_directory, model.network_chain())
    problem = ForceProblem(flights, rest, only=lambda e: e.name in fitted)
    search = Search(problem)
    if not names:
        return model, {}
    found = search.state([whole(effects[t.effect]) for t in model.terms if t.effect in fitted])
    timed = in_time(search, found, of=names)
    state = timed.state
    told = {c.effect: over_time(problem, state.fit, c) for c in state.choices}
    courses = {name: course for name, course in told.items() if course is not None}
    made = model_of(state.fit, rest)
    if timed.drift is not None:
        name = timed.drift.choice.effect
        _, state, courses[name] = beside_drift(problem, state, timed.drift)
        made = model_of(state.fit, rest)
        made = made.with_terms(at_the_end(made.terms, name, courses[name]))
    by_name = {t.effect: t for t in made.terms}
    if not courses or set(by_name) != set(effects):
        return model, {}
    rms = float((state.fit.sse / state.fit.residual.size) ** 0.5)
    return replace(model, terms=tuple(by_name[t.effect] for t in model.terms), fit={"rms": rms}), courses


def _turning(effect: Effect, flight: Flight) -> tuple[Term, OverTime] | None:
    turning = turning_of(flight)
    if turning is None:
        return None
    problem = TorqueProblem(turning, {effect.name: effect}, (effect.name,))
    search = Search(problem)
    found = min((search.state((choice,)) for choice in problem.choices), key=lambda s: s.fit.sse)
    state = in_time(search, found, drifts=False, of=(effect.name,)).state
    if not state.choices:
        return None
    course = over_time(problem, state.fit, state.choices[0])
    return None if course is None else (state.fit.terms[0], course)
