"""Effects whose regressor is a noisy measurement itself: least squares finds them too small, unless its noise is taken
off.

An accelerometer's lever arm goes with the derivative of the gyroscope, whose noise adds to the regressor's own energy
and explains nothing. What it adds is seen by adding as much once more: the columns of the effect with a second,
made-up noise of the size that the log shows, less those without. That energy is taken off the normal equations
(corrected least squares: Fuller, Measurement Error Models, 1987, ch. 1.2 and 2.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from trueflight.groundstation.identify.fitting import Fit, MeasuredFlights, half_width
from trueflight.groundstation.identify.force import ForceProblem
from trueflight.groundstation.identify.search import whole
from trueflight.groundstation.measured.measurement import Measurement
from trueflight.models.model import Term

MOST = 0.5
"""Part of a regressor's energy that may be noise: beyond, the correction is as uncertain as the effect."""


def without_attenuation(problem: ForceProblem, here: Fit, names: Sequence[str]) -> Fit:
    """The fit `here` with those effects of `names` that read noisy columns as large as they are without that noise."""
    noisy = [n for n in names if problem.effects[n].noisy and here.sizes(n)]
    if not noisy:
        return here
    count = len(here.free)
    added = np.zeros((count, count))
    for name in noisy:
        own, columns = here.sizes(name), problem.effects[name].noisy
        louder = replace(
            problem,
            flights=MeasuredFlights(
                tuple(_louder(m, columns) for m in problem.flights.measurements),
                problem.flights.effects_directory,
                problem.flights.always,
            ),
        )
        choice = whole(problem.effects[name])
        more = louder.contribution(here, choice) - problem.contribution(here, choice)
        free = [here.free[i] for i in own]
        more = more / np.array([f.parameter.typical - f.neutral for f in free])
        added[np.ix_(own, own)] = more.T @ more
    flat = here.jacobian.reshape(-1, count)
    normal = flat.T @ flat
    if np.any(np.diag(added) > MOST * np.diag(normal)):
        return here
    prior = np.diag([0.0 if f.flat else problem.unit() / f.spread**2 for f in here.free])
    size = here.estimate - np.array([f.neutral for f in here.free])
    undone = np.linalg.pinv(normal - added + prior, hermitian=True)
    step = undone @ added @ size
    turn = undone @ (normal + prior)
    covariance = turn @ here.covariance @ turn.T
    moved = replace(
        here,
        estimate=here.estimate + step,
        covariance=covariance,
        residual=here.residual + here.jacobian @ step,
    )
    return replace(moved, terms=tuple(_term(moved, t) for t in here.terms))


def _louder(m: Measurement, columns: Sequence[str]) -> Measurement:
    """The measurement of a flight with as much white noise once more on these columns as they have, the same every
    time."""
    rng = np.random.default_rng(0)
    changes = {}
    for name in columns:
        column = m.flight.column(name)
        # third differences leave motion alone, and the median is deaf to shocks
        sigma = np.median(np.abs(np.diff(column, n=3, axis=0)), axis=0) / 0.6745 / np.sqrt(20.0)
        changes[name] = column + sigma * rng.normal(size=column.shape)
    return replace(m, flight=replace(m.flight, **changes))


def _term(fitted: Fit, term: Term) -> Term:
    """The term with the values and intervals of the fit."""
    values, intervals = dict(term.values), dict(term.intervals)
    for i in fitted.of(term.effect):
        name, value = fitted.free[i].parameter.name, float(fitted.estimate[i])
        half = half_width(fitted.free[i], value, fitted.covariance[i, i], fitted.critical)
        values[name], intervals[name] = value, (value - half, value + half)
    return replace(term, values=values, intervals=intervals)
