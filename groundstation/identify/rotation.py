"""Which effect on the vehicle's rotation is missing: measured in the angular acceleration, from each rotor's thrust.

What is measured stands in `identify.torque`; effects are chosen by `identify.search` as those in the acceleration are:
given all others, on held-out blocks, with inference that holds under autocorrelated residuals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from trueflight.groundstation.identify.actuation import fit_rate_loop
from trueflight.groundstation.identify.adequacy import ABOVE
from trueflight.groundstation.identify.changes import in_time, in_words, over_time
from trueflight.groundstation.identify.doubt import Weighing
from trueflight.groundstation.identify.rotors_apart import doubted
from trueflight.groundstation.identify.search import LAW, Search, State, plausible
from trueflight.groundstation.identify.shares import judge_shares, motor_shares
from trueflight.groundstation.identify.spans import Values
from trueflight.groundstation.identify.torque import TorqueProblem, turning_of
from trueflight.groundstation.identify.verdicts import Scale, by_weight, judge, unmeasured
from trueflight.groundstation.measured.measurement import measure_rotation
from trueflight.groundstation.results import EffectVerdict, MotorShares, RotationalRms
from trueflight.models.effect import CENTRE_SHARE, ROTOR_SHARE, Effect, Stage
from trueflight.models.effects import catalogue
from trueflight.models.flight import Flight
from trueflight.models.model import Term


@dataclass(frozen=True)
class RotationalFindings:
    """What the rotation of a flight says: verdicts, the terms found, and the residual and what each rotor carries where
    rotors were recorded; `spanned` are the values of those terms that change in flight. `nearly` names, by a centre of
    mass that was found, weaker rotors that turn the vehicle but for a tenth as it does."""

    verdicts: tuple[EffectVerdict, ...]
    terms: tuple[Term, ...]
    rms: RotationalRms | None
    shares: MotorShares | None = None
    spanned: Mapping[str, Values] = field(default_factory=dict)
    nearly: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


def judge_rotation(
    flight: Flight,
    included: Sequence[str] = (),
    effects_directory: str | None = None,
    healthy: Sequence[Flight] = (),
) -> RotationalFindings:
    """Verdicts on all effects on the torque; `included` are in the model already, `healthy` flights of the same vehicle
    to compare what each rotor carries with."""
    shares = motor_shares(flight, healthy)
    effects = {
        n: e for n, e in catalogue(effects_directory).items() if e.rotational and e.stage is not Stage.RATE
    }
    turns = that_turns(flight)
    missing = {n: e.lacks(turns) for n, e in effects.items() if n not in included}
    measurable = tuple(n for n, columns in missing.items() if not columns)
    turning = turning_of(flight) if measurable else None
    if turning is None:
        unseen = judge_shares(shares, [unmeasured(effects[n], c) for n, c in missing.items()], effects)
        return RotationalFindings(unseen, (), None, shares)
    problem = TorqueProblem(turning, effects, measurable, tuple(n for n in effects if n in included))
    search = Search(problem)
    found = in_time(search, search.select(), drifts=False).state
    if any(c.spans for c in found.choices):
        # what is left of each axis is known only now
        problem = replace(problem, weighed_with=found.choices)
        search = Search(problem)
        found = search.grown(search.state(found.choices))
    before = search.state(())
    scale = Scale(before.fit.sse, lambda share: "", "rotation")
    r = problem.turning.rotation
    left, noise = found.fit.residual / problem.weight, r.noise[list(r.axes)]
    noise_alone = bool(np.all(np.sqrt(np.mean(left**2, axis=0)) < ABOVE * noise))
    doubt = Weighing(problem, found.fit, noise * problem.weight, quiet=noise_alone)
    named, absent = judge(search, found, found.fit, scale, doubt=doubt)
    named, absent = ([doubted(v, problem, found.fit, noise_alone) for v in x] for x in (named, absent))
    others = [unmeasured(effects[n], c) for n, c in missing.items() if n not in measurable]
    rms = problem.rms(before.fit, found.fit)
    named = in_words(named, {c.effect: t for c in found.choices if (t := over_time(problem, found.fit, c))})
    verdicts = judge_shares(shares, [*named, *by_weight(absent), *others], effects)
    kept = {v.name for v in verdicts if v.rank is not None}
    spanned = {name: values for name, values in found.fit.spanned.items() if name in kept}
    terms = tuple(t for t in found.fit.terms if t.effect in kept)
    return RotationalFindings(verdicts, terms, rms, shares, spanned, _nearly(search, found))


def _nearly(search: Search, found: State) -> dict[str, tuple[str, ...]]:
    """By a centre of mass that was found, the weaker rotors that explain the rotation but for `LAW` of what it does."""
    effects, like = search.problem.effects, {}
    for choice in found.choices:
        if effects[choice.effect].in_shares != CENTRE_SHARE or choice.spans:
            continue
        without = search.without(found, choice)
        enough = (1.0 - LAW**2) * (without.fit.sse - found.fit.sse)
        rotors = [c for c in search.problem.choices if effects[c.effect].in_shares == ROTOR_SHARE]
        fitted = ((c, search.state((*without.choices, c)).fit) for c in rotors)
        like[choice.effect] = tuple(
            dict.fromkeys(
                c.effect for c, f in fitted if without.fit.sse - f.sse > enough and plausible(f, c.effect)
            )
        )
    return like


def that_turns(flight: Flight) -> Flight:
    """The flight with the body rates of its attitude where it has no others."""
    rotation = measure_rotation(flight) if flight.angular_velocity is None else None
    return flight if rotation is None else rotation.flight


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
