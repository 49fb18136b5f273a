"""A late or smoothed estimate looks like a late thrust, where no accelerometer tells the difference.

Acceleration from differentiated velocity is as late as the velocity; so is, in a hover, a thrust that acts late.
Sideways they differ: tilt is known from the attitude, which is not late with the velocity, and thrust that acts late
does not delay it. So the flight is asked: would what the model predicts as it stands, seen late on all axes, explain as
much?
Acceleration that an estimator made itself is late with its attitude, and nothing tells.
"""

from __future__ import annotations

import math

import numpy as np

from trueflight.groundstation.identify.fitting import Fit, variance_per_independent_sample
from trueflight.groundstation.identify.force import ForceProblem
from trueflight.groundstation.identify.search import STRONG_EVIDENCE
from trueflight.models.frames import rotate, rotate_inverse
from trueflight.models.lag import delayed

LATEST = 0.3
"""s by which an estimate is late at most."""


def late_instead(problem: ForceProblem, here: Fit, without: Fit) -> float | None:
    """s by which the estimate of the acceleration would have to be late to explain as much as the fit `here` has
    beyond `without`; None where an accelerometer was logged or the flight tells that it is not so, not a number where
    nothing tells."""
    if problem.flight.accelerometer or problem.flight.quaternion is None:
        return None
    if problem.flight.specific_force is not None:
        return math.nan
    unit = variance_per_independent_sample(problem, here.residual)
    from scipy import optimize  # dear to load

    found = optimize.minimize_scalar(
        lambda late: _left(problem, without, float(late)), bounds=(0.0, LATEST), method="bounded",
        options={"xatol": 0.002},
    )  # fmt: skip
    worse = (float(found.fun) - here.sse) / unit + without.prior_penalty - here.prior_penalty
    # the lateness is a number, too
    worse += 2.0 * (1 + len(without.free) - len(here.free))
    return float(found.x) if worse < STRONG_EVIDENCE else None


def _left(problem: ForceProblem, fitted: Fit, late: float) -> float:
    """Squared error of what is fitted, seen so many s late; its numbers follow by one Gauss-Newton step."""
    chain = [(problem.effects[t.effect], t.values) for t in fitted.terms]
    seen = []
    for k, m in enumerate(problem.measurements):
        flight = m.flight
        assert flight.quaternion is not None
        force = rotate(flight.quaternion, problem.flights.acting(k, chain))
        force = np.stack([delayed(column, late, flight.dt) for column in force.T], axis=1)
        seen.append(problem.flights.behind_filter(m, rotate_inverse(flight.quaternion, force)))
    residual = (problem.flights.measured() - np.concatenate(seen)).ravel()
    flat = fitted.jacobian.reshape(len(residual), -1)
    if flat.shape[1]:
        size = np.maximum(np.linalg.norm(flat, axis=0), 1e-30)
        residual = residual - flat @ (np.linalg.lstsq(flat / size, residual, rcond=1e-9)[0] / size)
    return float(residual @ residual)
