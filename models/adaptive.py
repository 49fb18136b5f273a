"""Which numbers of a model are learnt anew in flight, and from where to where."""

from __future__ import annotations

import math

from trueflight.models.effect import Effect, Parameter, Stage
from trueflight.models.effects import catalogue
from trueflight.models.errors import InputError
from trueflight.models.learnable import MOST, Learnable
from trueflight.models.model import Model, Term

REACH = 6.0
"""Typical sizes by which a number may leave its deployed value: a third of the thrust, 12 m/s of wind, beyond which a
vehicle should land and not learn."""
_INTERVAL = 2.0 * 1.96
"""Standard deviations in a 95 % interval."""
_WITHIN = 10.0
"""s in which a number may drift by its `drifts`."""


def adaptive(model: Model) -> tuple[Model, tuple[Learnable, ...]]:
    """The model with those effects that are learnt even where it lacks them, from where they do nothing; and all
    numbers that are learnt in flight, at most `MOST`: what changes fastest first.

    Raises `InputError` where nothing of it can be learnt.
    """
    wider = _with_neutral(model)
    found: list[tuple[float, Learnable]] = []
    for term, (effect, values) in zip(wider.terms, wider.effect_chain(), strict=True):
        if effect.exports and effect.stage is not Stage.SENSOR:
            for p in _free(effect, values):
                found.append((p.drifts, _learnable(wider, effect, p, term)))
    if not found:
        raise InputError(f"{model.label}: no number of it changes in flight; export it without --adaptive")
    found.sort(key=lambda one: -one[0])
    return wider, tuple(one for _, one in found[:MOST])


def _with_neutral(model: Model) -> Model:
    names = model.names()
    added = tuple(
        Term(name, effect.neutral(model.vehicle))
        for name, effect in catalogue(model.effects_directory).items()
        if effect.learnt_unasked
        and name not in names
        and (not effect.acts_through or any(carrier in names for carrier in effect.acts_through))
    )
    return model.with_terms((*model.terms, *added))


def _free(effect: Effect, values: object) -> list[Parameter]:
    """Its parameters that drift; of an effect of which one parameter alone acts, the one that does."""
    assert isinstance(values, dict)
    free = [p for p in effect.parameters if p.drifts > 0.0 and p.name in values]
    if effect.exclusive and free:
        return [max(free, key=lambda p: abs(values[p.name]))]
    return free


def _learnable(model: Model, effect: Effect, p: Parameter, term: Term) -> Learnable:
    value = float(term.values[p.name])
    low, high = term.intervals.get(p.name, (value, value))
    width = (high - low) / _INTERVAL
    typical = abs(p.typical - p.neutral_for(model.vehicle))
    size = p.drifts * typical
    return Learnable(
        effect.name,
        p.name,
        p.unit,
        value,
        min(value, max(p.low, value - REACH * typical)),
        max(value, min(p.high, value + REACH * typical)),
        max(size, width if math.isfinite(width) else 0.0),
        size / math.sqrt(_WITHIN),
    )
