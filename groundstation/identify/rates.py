"""How body rates follow their command, against what is believed of it: the closed rate loop needs no rotor data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from trueflight.groundstation.identify.actuation import RateLoop, fit_rate_loop, rate_loop_sensitivity
from trueflight.groundstation.identify.search import FAMILY
from trueflight.groundstation.identify.verdicts import MISSING, NOT_EXCITED, NOT_SUPPORTED, unmeasured
from trueflight.groundstation.results import EffectVerdict, ParameterEstimate
from trueflight.models.effect import Effect, Stage
from trueflight.models.effects import catalogue
from trueflight.models.flight import Flight
from trueflight.models.model import Term

UNBELIEVED_LAG = 0.15
"""s of lag and delay of a rate loop that are granted to a vehicle whose file says nothing of it: what look-ahead can
still make good (`models.contract.ACTUATION_LIMITS`). Beyond, no attitude loop is fast enough to fly on."""
RATE_TOLERANCE = 1.5
"""Factor on the vehicle file's rate_time_constant, which is known from a step or a design, not from a fit."""
LOOP_PER_ROTOR = 2.0
"""s by which a rate loop with 60 degrees of phase margin slows down for every s that its rotors are later."""


def judge_rates(
    flight: Flight, included: Sequence[str] = (), effects_directory: str | None = None, later: float = 0.0
) -> tuple[list[EffectVerdict], list[Term]]:
    """Verdicts on how body rates follow their command, and the terms found; `later` s is by how much more than
    believed the rotors were found to lag theirs."""
    verdicts, terms = [], []
    for name, effect in catalogue(effects_directory).items():
        if effect.stage is Stage.RATE and name not in included:
            verdict, term = _judge_rates(effect, flight, later)
            verdicts.append(verdict)
            terms += [] if term is None else [term]
    return verdicts, terms


def _judge_rates(effect: Effect, flight: Flight, later: float) -> tuple[EffectVerdict, Term | None]:
    """The closed rate loop against what is believed of it."""
    if effect.lacks(flight):
        return unmeasured(effect, effect.lacks(flight)), None
    loop = fit_rate_loop([flight])
    if loop is None:
        advice = f"body rates follow no loop of that kind, or hardly move; fly {effect.manoeuvre}"
        return EffectVerdict(effect.name, NOT_EXCITED, None, 0.0, 1.0, (), (), advice, "rotation"), None
    covariance, critical = rate_loop_sensitivity(flight, loop)
    half = [critical * float(np.sqrt(max(v, 0.0))) for v in np.diag(covariance)[:2]]
    half[1] += flight.dt  # no log's clock is better
    values = {"lag": loop.lag, "delay": loop.delay}
    unit = {p.name: p.unit for p in effect.parameters}
    intervals = {n: (max(0.0, v - h), v + h) for (n, v), h in zip(values.items(), half, strict=True)}
    estimates = tuple(ParameterEstimate(n, v, *intervals[n], unit[n]) for n, v in values.items())
    granted = _granted(flight, later)
    spread = critical * float(np.sqrt(max(covariance[:2, :2].sum(), 0.0)))
    p = float(special.ndtr(-(loop.lag + loop.delay - granted) / max(spread / 1.96, 1e-6)))
    late = p < FAMILY
    verdict = EffectVerdict(
        effect.name,
        MISSING if late else NOT_SUPPORTED,
        1 if late else None,
        float(np.clip(1.0 - loop.unexplained, 0.0, 1.0)) if late else 0.0,
        p,
        estimates,
        (),
        _told(loop, granted, late, flight.vehicle.rate_time_constant),
        "rotation",
    )
    return verdict, Term(effect.name, values, intervals) if late else None


def _granted(flight: Flight, later: float) -> float:
    """s of lag and delay that the rate loop may have and still be as believed."""
    believed = flight.vehicle.rate_time_constant
    granted = RATE_TOLERANCE * (believed + flight.vehicle.command_delay) + flight.dt
    if believed == 0.0:
        granted = max(UNBELIEVED_LAG, granted)
    return granted + LOOP_PER_ROTOR * later


def _told(loop: RateLoop, granted: float, late: bool, believed: float) -> str:
    limit = f"the {1e3 * granted:.0f} ms that are granted"
    if believed == 0.0:
        limit += "; set rate_time_constant in the vehicle file to hold it to less"
    seen = f"{1e3 * loop.lag:.0f} ms lag and {1e3 * loop.delay:.0f} ms delay"
    return f"rates follow with {seen}, {'beyond' if late else 'within'} {limit}"
