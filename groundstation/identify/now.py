"""An effect as it is now: what holds at the end of a flight in which it changes."""

from __future__ import annotations

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
    model: Model, name: str, flight: Flight, bandwidth: float | None = None
) -> tuple[Model, OverTime] | None:
    """`model`, fitted to `flight`, with its effect `name` as it is at the end, everything fitted beside it, and its
    course; None where it is of one size throughout."""
    with threadpool_limits(1, user_api="blas"):
        return _as_it_is_now(model, name, flight, bandwidth)


def _as_it_is_now(
    model: Model, name: str, flight: Flight, bandwidth: float | None
) -> tuple[Model, OverTime] | None:
    effect = effect_named(name, model.effects_directory)
    if effect.stage is Stage.RATE:
        return None
    if effect.rotational:
        told = _turning(effect, flight)
        if told is None:
            return None
        terms = tuple(told[0] if t.effect == name else t for t in model.terms)
        return model.with_terms(terms), told[1]
    known = {t.effect: effect_named(t.effect, model.effects_directory) for t in model.terms}
    fitted = {n for n, e in known.items() if e.parameters and not e.rotational}
    flights = MeasuredFlights((measure(flight, bandwidth),), model.effects_directory, model.network_chain())
    rest = model.with_terms(tuple(t for t in model.terms if t.effect not in fitted))
    problem = ForceProblem(flights, rest, only=lambda e: e.name in fitted)
    search = Search(problem)
    found = search.state([whole(known[t.effect]) for t in model.terms if t.effect in fitted])
    timed = in_time(search, found, of=name)
    state = timed.state
    if timed.drift is not None:
        _, state, course = beside_drift(problem, state, timed.drift)
        made = model_of(state.fit, rest)
        made = made.with_terms(at_the_end(made.terms, name, course))
    else:
        choice = next((c for c in state.choices if c.effect == name), None)
        changed = None if choice is None else over_time(problem, state.fit, choice)
        if changed is None:
            return None
        made, course = model_of(state.fit, rest), changed
    if {t.effect for t in made.terms} != {t.effect for t in model.terms}:
        return None  # something else took the place of another effect of the model
    by_name = {t.effect: t for t in made.terms}
    rms = float((state.fit.sse / state.fit.residual.size) ** 0.5)
    return replace(model, terms=tuple(by_name[t.effect] for t in model.terms), fit={"rms": rms}), course


def _turning(effect: Effect, flight: Flight) -> tuple[Term, OverTime] | None:
    turning = turning_of(flight)
    if turning is None:
        return None
    problem = TorqueProblem(turning, {effect.name: effect}, (effect.name,))
    search = Search(problem)
    found = min((search.state((choice,)) for choice in problem.choices), key=lambda s: s.fit.sse)
    state = in_time(search, found, drifts=False, of=effect.name).state
    if not state.choices:
        return None
    course = over_time(problem, state.fit, state.choices[0])
    return None if course is None else (state.fit.terms[0], course)
