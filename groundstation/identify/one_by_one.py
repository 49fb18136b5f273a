"""Numbers of an effect that another effect could stand in for, one by one.

An accelerometer's bias has three numbers. Near a hover each is nearly one with something else: what is felt along the
thrust is a thrust gain as well, what is felt across it a thrust that leans. Exchanged as a whole, the bias always looks
better as long as one of its numbers is really there; so each number is held at "no effect" by itself, beside the other
effect, by linearisation where the fit is. Where that explains the flight nearly as well, only both together are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from trueflight.groundstation.identify.fitting import Fit, variance_per_independent_sample
from trueflight.groundstation.identify.force import ForceProblem
from trueflight.groundstation.identify.search import STRONG_EVIDENCE, sizes, whole
from trueflight.groundstation.identify.verdicts import MISSING, POSSIBLE
from trueflight.groundstation.results import EffectVerdict, ParameterEstimate


@dataclass(frozen=True)
class Share:
    """A number that `rival` could stand in for."""

    effect: str
    parameter: str
    rival: str


def shares(problem: ForceProblem, here: Fit, found: Sequence[str]) -> tuple[Share, ...]:
    """What each number of the effects `found` that have several could be instead."""
    told = []
    candidates = {c.effect for c in problem.choices} - {*found}
    for name in found:
        own, effect = here.sizes(name), problem.effects[name]
        if len(own) < 2 or effect.acts_through:
            continue
        rivals = {
            n for n in candidates if name in problem.effects[n].confounded_with or n in effect.confounded_with
        }
        for rival in sorted(n for n in rivals if not problem.effects[n].acts_through):
            columns = -problem.contribution(here, whole(problem.effects[rival]))
            for i in own:
                low, high = here.interval(i)
                if not low <= here.free[i].neutral <= high and _stands_in(problem, here, i, rival, columns):
                    told.append(Share(name, here.free[i].parameter.name, rival))
    return tuple(told)


def with_shares(verdicts: Sequence[EffectVerdict], told: Sequence[Share]) -> list[EffectVerdict]:
    """Verdicts in which what may be shared is told as not determined, with what both are together; the rivals are
    possible."""
    out = []
    for v in verdicts:
        mine = [s for s in told if s.effect == v.name]
        stands_for = tuple(dict.fromkeys(s.effect for s in told if s.rival == v.name))
        if stands_for and v.rank is None:
            v = replace(v, verdict=POSSIBLE, indistinguishable_from=stands_for, confidence=None)
        out.append(_shared(v, mine) if mine else v)
    return out


def _shared(v: EffectVerdict, mine: Sequence[Share]) -> EffectVerdict:
    loose = {s.parameter: s.rival for s in mine}
    parameters = tuple(
        replace(p, low=min(p.low, 0.0), high=max(p.high, 0.0)) if p.name in loose else p for p in v.parameters
    )
    together = tuple(
        ParameterEstimate(f"{v.name}.{p.name} and {loose[p.name]} together", p.value, p.low, p.high, p.unit)
        for p in v.parameters
        if p.name in loose
    )
    known = any(not p.low <= 0.0 <= p.high for p in parameters if p.name not in loose)
    same = [r for r in dict.fromkeys(loose.values()) if r not in v.indistinguishable_from]
    return replace(
        v,
        verdict=v.verdict if known or v.verdict != MISSING else POSSIBLE,
        parameters=parameters,
        undetermined=(*v.undetermined, *loose),
        products=(*v.products, *together),
        indistinguishable_from=(*same, *v.indistinguishable_from),
    )


def _stands_in(problem: ForceProblem, here: Fit, i: int, rival: str, columns: np.ndarray) -> bool:
    """Whether number `i` at "no effect", with `columns` (K A, p) of the rival at its typical size beside all else,
    explains the flight nearly as well."""
    unit = variance_per_independent_sample(problem, here.residual)
    count, effect = len(here.free), problem.effects[rival]
    neutral, spread = (np.array([getattr(f, n) for f in here.free]) for n in ("neutral", "spread"))
    flat = np.column_stack([here.jacobian.reshape(-1, count), columns])
    offset = np.concatenate([here.estimate - neutral, np.zeros(columns.shape[1])])
    weight = np.concatenate([spread**-2.0, np.full(columns.shape[1], 0.25)])
    held, loose = i, [j for j in range(len(offset)) if j != i]
    start = here.residual.ravel() - flat[:, held] * offset[held]
    matrix = flat[:, loose]
    normal = matrix.T @ matrix / unit + np.diag(weight[loose])
    slope = matrix.T @ start / unit + weight[loose] * offset[loose]
    step = -np.linalg.lstsq(normal, slope, rcond=1e-12)[0]
    left = start + matrix @ step
    after = float(left @ left) / unit + float(np.sum(weight[loose] * (offset[loose] + step) ** 2))
    before = here.sse / unit + float(np.sum(weight * offset**2))
    if after - before + 2.0 * (columns.shape[1] - 1) > STRONG_EVIDENCE:
        return False
    own = sizes(effect)
    rest = problem.at_rest(effect)
    values = [
        rest[p.name] + q * (p.typical - rest[p.name])
        for p, q in zip(own, step[-columns.shape[1] :], strict=True)
    ]
    return all(p.low <= x <= p.high for p, x in zip(own, values, strict=True))
