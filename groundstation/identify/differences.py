"""Is a number that is believed to be the vehicle's the same in all of several flights?

Beside everything else that is fitted, one value for each flight is held against one for all: a likelihood ratio with
squared errors counted in independent samples, and with the slow error that every flight is granted. Where the flights
differ, those that agree are found by leaving out, one after the other, the flight that is farthest from the rest.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from trueflight.groundstation.identify.fitting import (
    SCALE,
    Fit,
    Measured,
    critical_value,
    variance_per_independent_sample,
)
from trueflight.groundstation.identify.search import FAMILY
from trueflight.groundstation.identify.spans import EVERYWHERE
from trueflight.groundstation.results import ParameterEstimate, SharedNumber


def asked(
    problem: Measured,
    here: Fit,
    effects: Iterable[str],
    names: Sequence[str],
    material: float,
    tried: int = 1,
) -> tuple[SharedNumber, ...]:
    """Each number of `effects` that all flights share in the fit `here`, asked whether it is the same in all of them.

    `names` are those of the flights. A difference below `material`, RMS over the flight that shows it, is none; `tried`
    numbers share the risk of a chance find.
    """
    rows = rows_of_flights(problem)
    found = []
    for effect in effects:
        for i in here.sizes(effect):
            if here.free[i].span == EVERYWHERE and np.any(here.jacobian[:, :, i]):
                found.append(_asked(problem, here, i, rows, names, material, tried))
    return tuple(found)


def rows_of_flights(problem: Measured) -> list[slice]:
    """The used samples of each flight."""
    edges = np.cumsum([0, *(int(m.used.sum()) for m in problem.measurements)])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]


def _asked(
    problem: Measured,
    here: Fit,
    i: int,
    rows: Sequence[slice],
    names: Sequence[str],
    material: float,
    tried: int,
) -> SharedNumber:
    free, value, count = here.free[i], float(here.estimate[i]), len(rows)
    own = np.zeros((*here.residual.shape, count))
    for k, part in enumerate(rows):
        own[part, :, k] = here.jacobian[part, :, i]
    others = [j for j in range(len(here.free)) if j != i]
    jacobian = np.concatenate([here.jacobian[:, :, others], own], axis=2)
    flat, residual = jacobian.reshape(-1, jacobian.shape[2]), here.residual.ravel()
    prior = [0.0 if here.free[j].flat else problem.unit() / here.free[j].spread ** 2 for j in others]
    prior += [0.0 if free.flat else problem.unit() / free.spread**2 / count] * count
    normal = flat.T @ flat + np.diag(prior)
    inverse = np.linalg.pinv(normal, hermitian=True)
    # the shared fit is a step away from its optimum where it was stopped: its own step is no difference
    step = -inverse @ (flat.T @ residual)
    together = here.jacobian.reshape(len(residual), -1)
    at = np.array([0.0 if f.flat else problem.unit() / f.spread**2 for f in here.free])
    settled = -np.linalg.pinv(together.T @ together + np.diag(at), hermitian=True) @ (together.T @ residual)
    left = residual + flat @ step
    shared = residual + together @ settled
    unit = max(variance_per_independent_sample(problem, left.reshape(here.residual.shape)), problem.unit())
    ratio = max(float(shared @ shared - left @ left) / unit, 0.0)
    p_value = float(special.chdtrc(count - 1, ratio))
    size = value + step[len(others) :]
    covariance = unit * inverse[len(others) :, len(others) :]
    # what sensors and clocks of each flight are granted is no difference of the vehicle
    granted = (SCALE * size / 1.96) ** 2 + (free.tolerance / 1.96) ** 2
    covariance = covariance + np.diag(granted)
    seconds = [float(m.used.sum()) * float(np.median(np.diff(m.t))) for m in problem.measurements]
    half = [
        critical_value(s) * float(np.sqrt(max(c, 0.0)))
        for s, c in zip(seconds, np.diag(covariance), strict=True)
    ]
    values = tuple(
        ParameterEstimate(free.parameter.name, float(x), float(x - h), float(x + h), free.parameter.unit, n)
        for x, h, n in zip(size, half, names, strict=True)
    )
    alpha = FAMILY / max(tried, 1)
    agree = agreeing(size, covariance, alpha) if p_value < alpha else tuple(range(count))
    level, spread = common_value(size, covariance, agree)
    apart = [k for k in range(count) if k not in agree]
    does = [
        float(np.sqrt(np.mean(np.sum((own[part, :, k] * (size[k] - level)) ** 2, axis=1))))
        for k, part in enumerate(rows)
    ]
    differ = [k for k in apart if does[k] > material]
    alone = len(agree) == 1 and bool(differ)
    return SharedNumber(
        free.effect,
        free.parameter.name,
        ratio,
        p_value,
        values,
        None
        if alone
        else ParameterEstimate(
            free.parameter.name, level, level - 1.96 * spread, level + 1.96 * spread, free.parameter.unit
        ),
        tuple(names) if alone else tuple(names[k] for k in differ),
    )


def fitted_anew(number: SharedNumber, here: Fit, names: Sequence[str]) -> SharedNumber:
    """A number that differs, with the values of the fit `here` in which each flight has its own."""
    own = [i for i in here.of(number.effect) if here.free[i].parameter.name == number.parameter]
    at = {here.free[i].span.flight: i for i in own}
    if set(at) != set(range(len(names))):
        return number
    order = [at[k] for k in range(len(names))]
    unit = number.values[0].unit
    values = tuple(
        ParameterEstimate(number.parameter, float(here.estimate[i]), *here.interval(i), unit, name)
        for i, name in zip(order, names, strict=True)
    )
    agree = [k for k, name in enumerate(names) if name not in number.apart]
    common = None
    if agree:
        covariance = here.covariance[np.ix_(order, order)]
        level, spread = common_value(here.estimate[order], covariance, agree)
        half = float(np.hypot(here.critical * spread, SCALE * level))
        common = ParameterEstimate(number.parameter, level, level - half, level + half, unit)
    return replace(number, values=values, common=common)


def common_value(size: np.ndarray, covariance: np.ndarray, among: Sequence[int]) -> tuple[float, float]:
    """The one value of several estimates (generalised least squares), and its standard deviation."""
    inverse = np.linalg.pinv(covariance[np.ix_(among, among)], hermitian=True)
    weight = float(inverse.sum())
    return float(inverse.sum(axis=0) @ size[list(among)]) / max(weight, 1e-30), float(
        1.0 / np.sqrt(max(weight, 1e-30))
    )


def agreeing(size: np.ndarray, covariance: np.ndarray, alpha: float) -> tuple[int, ...]:
    """The flights that agree on one value: the one whose absence makes the others agree best is left out, until they
    do; one alone where no two do."""
    among = list(range(len(size)))
    while len(among) > 1:
        if special.chdtrc(len(among) - 1, _disagreement(size, covariance, among)) >= alpha:
            break
        without = {k: [j for j in among if j != k] for k in among}
        among = min(without.values(), key=lambda rest: _disagreement(size, covariance, rest))
    return tuple(among)


def _disagreement(size: np.ndarray, covariance: np.ndarray, among: Sequence[int]) -> float:
    """Weighted squared distance of the estimates from their common value."""
    inverse = np.linalg.pinv(covariance[np.ix_(among, among)], hermitian=True)
    away = size[list(among)] - common_value(size, covariance, among)[0]
    return float(away @ inverse @ away)
