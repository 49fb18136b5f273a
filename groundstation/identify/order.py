"""Does an effect come when it should? What the motion answers to comes before it, and what answers the motion after.

A controller takes back what a gust or an error does: the thrust it commands is then an answer to the acceleration that
it seems to explain, and least squares finds a thrust that does nothing (a bent curve, a delay) where the gust was. In a
flight that is led by its plan this is small; in a hover it is all there is to see (closed loops without excitation:
Gustavsson, Ljung & Soderstrom, Automatica 13, 1977). What tells is the order in time: moved earlier, an answer
explains more than where it stands, and a cause less.
"""

from __future__ import annotations

import numpy as np

from trueflight.groundstation.identify.fitting import Fit, variance_per_independent_sample
from trueflight.groundstation.identify.search import STRONG_EVIDENCE, Problem

LEADS = (0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8)
"""s by which what an effect does is moved: no clock is as wrong as the first, and a loop answers before the last."""
MORE = 1.02
"""Times what it explains in its place that an answer explains where it is moved to."""
ASKEW = 1.05
"""Times what it explains when moved as far the other way: what is slow explains as much either way."""


def answers(problem: Problem, here: Fit, effect: str) -> float | None:
    """s by which the effect comes after what it explains; None where it comes with it, or before."""
    own = here.sizes(effect)
    if not own:
        return None
    plain = here.estimate[own] - [here.free[i].neutral for i in own]
    beside = [i for i in range(len(here.free)) if i not in here.of(effect)]
    done = -here.jacobian[:, :, own] @ plain
    without = here.residual + done
    shifts = [0.0, *(sign * lead for lead in LEADS for sign in (1.0, -1.0))]
    moved = np.stack([_moved(problem, done, shift) for shift in shifts])
    rows = np.isfinite(moved).all(axis=(0, 2))
    if rows.sum() < 0.5 * len(rows):
        return None
    flat = here.jacobian[rows][:, :, beside].reshape(int(rows.sum()) * done.shape[1], len(beside))
    basis = np.linalg.qr(flat / np.maximum(np.linalg.norm(flat, axis=0), 1e-30))[0]
    target = without[rows].ravel()
    target = target - basis @ (basis.T @ target)
    explained = {s: _explained(target, m[rows].ravel(), basis) for s, m in zip(shifts, moved, strict=True)}
    lead = max(LEADS, key=lambda x: explained[x])
    gained = explained[lead] - max(explained[0.0], 0.0)
    # of the axes on which the effect acts
    acts = np.sum(done**2, axis=0) / max(float(np.sum(done**2)), 1e-30)
    unit = sum(
        float(share) * variance_per_independent_sample(problem, here.residual[:, [axis]])
        for axis, share in enumerate(acts)
    )
    more = explained[lead] > MORE * explained[0.0] and explained[lead] > ASKEW * explained[-lead]
    return lead if more and gained > STRONG_EVIDENCE * unit else None


def _explained(target: np.ndarray, moved: np.ndarray, basis: np.ndarray) -> float:
    """Squared error that a multiple of `moved` takes away beside `basis`; less than none where the multiple is
    negative."""
    rest = moved - basis @ (basis.T @ moved)
    along = float(rest @ target)
    return float(np.sign(along) * along**2 / max(float(rest @ rest), 1e-30))


def _moved(problem: Problem, done: np.ndarray, shift: float) -> np.ndarray:
    """`done` (K, A) as it is `shift` s later, NaN where that was not used."""
    out, at = np.full_like(done, np.nan), 0
    for m in problem.measurements:
        rows = slice(at, at + int(m.used.sum()))
        at = rows.stop
        placed = np.full((len(m.t), done.shape[1]), np.nan)
        placed[m.used] = done[rows]
        by = round(shift / float(np.median(np.diff(m.t))))
        there = np.full_like(placed, np.nan)
        if by >= 0:
            there[: len(placed) - by] = placed[by:]
        else:
            there[-by:] = placed[:by]
        out[rows] = there[m.used]
    return out
