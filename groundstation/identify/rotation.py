"""Which effect on the vehicle's rotation is missing: measured in the angular acceleration, from each rotor's thrust.

What is measured stands in `identify.torque`; effects are chosen by `identify.search` as those in the acceleration are:
given all others, on held-out blocks, with inference that holds under autocorrelated residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trueflight.groundstation.identify.actuation import fit_rate_loop
from trueflight.groundstation.identify.adequacy import ABOVE
from trueflight.groundstation.identify.doubt import Weighing
from trueflight.groundstation.identify.search import Search
from trueflight.groundstation.identify.torque import TorqueProblem, turning_of
from trueflight.groundstation.identify.verdicts import Scale, by_weight, judge, unmeasured
from trueflight.groundstation.results import EffectVerdict, RotationalRms
from trueflight.models.effect import Effect, Stage
from trueflight.models.effects import catalogue
from trueflight.models.flight import Flight
from trueflight.models.model import Term


@dataclass(frozen=True)
class RotationalFindings:
    """What the rotation of a flight says: verdicts, the terms found, and the residual where rotors were recorded."""

    verdicts: tuple[EffectVerdict, ...]
    terms: tuple[Term, ...]
    rms: RotationalRms | None


def judge_rotation(
    flight: Flight, included: Sequence[str] = (), effects_directory: str | None = None
) -> RotationalFindings:
    """Verdicts on all effects on the torque; `included` are in the model already."""
    effects = {
        n: e for n, e in catalogue(effects_directory).items() if e.rotational and e.stage is not Stage.RATE
    }
    missing = {n: e.lacks(flight) for n, e in effects.items() if n not in included}
    measurable = tuple(n for n, columns in missing.items() if not columns)
    turning = turning_of(flight) if measurable else None
    if turning is None:
        return RotationalFindings(tuple(unmeasured(effects[n], c) for n, c in missing.items()), (), None)
    problem = TorqueProblem(turning, effects, measurable, tuple(n for n in effects if n in included))
    search = Search(problem)
    before, found = search.state(()), search.select()
    scale = Scale(before.fit.sse, lambda share: "", "rotation")
    r = problem.turning.rotation
    left = found.fit.residual / problem.weight
    noise_alone = bool(np.all(np.sqrt(np.mean(left**2, axis=0)) < ABOVE * r.noise))
    doubt = Weighing(problem, found.fit, r.noise * problem.weight, quiet=noise_alone)
    named, absent = judge(search, found, found.fit, scale, doubt=doubt)
    others = [unmeasured(effects[n], c) for n, c in missing.items() if n not in measurable]
    rms = problem.rms(before.fit, found.fit)
    return RotationalFindings((*named, *by_weight(absent), *others), found.fit.terms, rms)


def fit_rotation(flight: Flight, effect: Effect) -> Term | None:
    """`effect` alone, fitted to the rotation of `flight`; None where the flight cannot tell."""
    if effect.stage is Stage.RATE:
        loop = fit_rate_loop([flight])
        return None if loop is None else Term(effect.name, {"lag": loop.lag, "delay": loop.delay})
    turning = turning_of(flight)
    if turning is None:
        return None
    problem = TorqueProblem(turning, {effect.name: effect}, (effect.name,))
    best = min((problem.fit((choice,)) for choice in problem.choices), key=lambda f: f.sse)
    return best.terms[0]
