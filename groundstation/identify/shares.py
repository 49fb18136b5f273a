"""What each rotor carries of the thrust, on the mean of a flight: a measurement of its own.

Over some seconds of flight the torques of all rotors cancel, whatever they did from moment to moment. So what the
commands (or speeds) of the rotors say that each of them carries tells what is uneven about the vehicle: a rotor that
has to be driven harder than the others is weaker, or the weight stands nearer to it. One flight alone cannot tell these
from how the vehicle was built: motors of one set differ, batteries are not seated in the middle. Against flights of the
same vehicle when it was healthy, the change is seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from trueflight.groundstation.identify.verdicts import MISSING, POSSIBLE
from trueflight.groundstation.results import EffectVerdict, MotorShares, ParameterEstimate
from trueflight.models.allocation import leverage
from trueflight.models.effect import CENTRE_SHARE, ROTOR_SHARE, Effect
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.prediction import rotor_thrust

SLOW = 1.0
"""m/s of speed through the air, as far as it is known, up to which no aerodynamic moment is worth a rotor's share."""
LEAST = 5.0
"""s of such flight."""
UNEVEN = 0.30
"""Of the mean, between the rotors that carry most and least: what ArduPilot's log analysis (TestMotorBalance) fails a
copter for, 150 us of a command that has 500 us in a hover. It warns from half of that; many fly so."""
REPEATED = 0.03
"""Standard deviation by which the share of one rotor of a healthy vehicle changes from flight to flight: a battery that
is seated by a millimetre elsewhere on arms of 32 mm changes it by as much."""
CHANGED = 3.0
"""Such standard deviations from which a change since a healthy flight is told."""
DIFFER = 0.05
"""Standard deviation by which the rotors of one set differ in the thrust they give to one command, as built: brushed
motors and moulded propellers."""
BLOCK = 2.0
"""s over which shares are averaged before their scatter is taken, as residuals are correlated."""


def motor_shares(flight: Flight, healthy: Sequence[Flight] = ()) -> MotorShares | None:
    """What each rotor carries of the thrust of `flight`, and how that differs from the flights of the same vehicle in
    `healthy`; None where no rotor was logged, or the flight has no `LEAST` s of slow flight.

    Raises `InputError` for a healthy flight that cannot be compared.
    """
    found = _mean_shares(flight)
    if found is None:
        return None
    share, error, total = found
    references = []
    for other in healthy:
        reference = _mean_shares(other)
        if reference is None or len(reference[0]) != len(share):
            raise InputError(
                f"{other.origin or other.name}: no {LEAST:g} s of slow flight with the commands of {len(share)} "
                "rotors to compare with; give a healthy flight of the same vehicle"
            )
        references.append(reference)
    if references:
        usual = np.mean([r[0] for r in references], axis=0)
        usual_error = np.sqrt(np.mean([r[1] ** 2 for r in references], axis=0) / len(references))
        spread = REPEATED * np.sqrt(1.0 + 1.0 / len(references))
        collective = total / float(np.mean([r[2] for r in references]))
    else:
        usual, usual_error, spread, collective = _even(flight), np.zeros(len(share)), DIFFER, float("nan")
    ratio = share / usual
    rotor, excess = _standing_out(ratio)
    relative = np.sqrt((error / share) ** 2 + (usual_error / usual) ** 2 + spread**2)
    half, limit = 1.96 * float(relative[rotor]), CHANGED * float(relative[rotor])
    places = np.array(flight.vehicle.rotor_positions, dtype=float)[:, :2]
    lever = leverage(flight.vehicle)[rotor]
    uneven = float((share.max() - share.min()) / share.mean())
    stands_out = excess > limit if references else uneven > UNEVEN and excess > limit
    return MotorShares(
        shares=tuple(float(x) for x in share),
        errors=tuple(float(1.96 * x) for x in error),
        compared_with=tuple(f.name for f in healthy),
        changes=tuple(float(x) for x in ratio / np.median(ratio) - 1.0) if references else (),
        collective=collective,
        uneven=uneven,
        rotor=rotor + 1 if stands_out else 0,
        excess=excess,
        excess_low=excess - half,
        excess_high=excess + half,
        losses=tuple(_loss(e, lever, len(share)) for e in (excess, excess - half, excess + half)),
        centre=tuple(float(x) for x in (share - usual) @ places),
        centre_errors=tuple(1.96 * float(x) for x in np.sqrt((share * relative) ** 2 @ places**2)),
        yaw=float(-np.array(flight.vehicle.rotor_directions, float) @ (share - usual)),
    )


def _loss(excess: float, lever: float, count: int) -> float:
    """The part of its thrust that a rotor of `count` lacks that is driven by `excess` harder than the mean of the
    others, where the allocation makes good `lever` of it by the rotor itself."""
    # commands are 1 + k times a column of the allocation: `lever` of its own, the rest on the others
    k = excess / max(lever - (1.0 + excess) * (1.0 - lever) / (count - 1), 1e-3)
    return float(k / (1.0 + k * lever))


def _mean_shares(flight: Flight) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Share of each rotor (R,), its standard error (R,), and the mean thrust that the commands stand for, of a hover's;
    None where too little was flown slowly."""
    thrust = rotor_thrust(flight)
    if thrust is None:
        return None
    calm = np.ones(len(flight), bool) if flight.flying is None else flight.flying.copy()
    if flight.velocity is not None:
        calm &= np.linalg.norm(flight.velocity, axis=1) < SLOW
    calm &= np.all(np.isfinite(thrust), axis=1)
    total = thrust.sum(axis=1)
    calm &= total > 0.5 * np.median(total[calm]) if calm.any() else False
    if calm.sum() * flight.dt < LEAST:
        return None
    block = ((flight.t[calm] - flight.t[0]) / BLOCK).astype(int)
    means = np.array([thrust[calm][block == b].sum(axis=0) for b in np.unique(block)])
    each = means / means.sum(axis=1, keepdims=True)
    share = means.sum(axis=0) / means.sum()
    error = each.std(axis=0, ddof=1) / np.sqrt(len(each)) if len(each) > 1 else np.full(len(share), 0.01)
    command = flight.motor_command
    driven = (
        1.0
        if command is None
        else float(np.mean(flight.vehicle.thrust(command[calm]))) / flight.vehicle.weight
    )
    return share, np.maximum(error, 1e-4), driven


def _even(flight: Flight) -> np.ndarray:
    """Shares (R,) of the thrust with which equal rotors balance a vehicle whose weight is in their middle."""
    x, y, _ = np.array(flight.vehicle.rotor_positions, dtype=float).T
    count = len(x)
    allocation = np.stack([np.ones(count), y, -x, -np.array(flight.vehicle.rotor_directions, float)])
    return np.asarray(np.linalg.pinv(allocation) @ np.array([1.0, 0.0, 0.0, 0.0]))


def _standing_out(ratio: np.ndarray) -> tuple[int, float]:
    """The rotor (from 0) whose ratio stands out above the mean of the others, and by how much."""
    others = np.array([np.delete(ratio, i).mean() for i in range(len(ratio))])
    excess = ratio / others - 1.0
    rotor = int(np.argmax(excess))
    return rotor, float(excess[rotor])


def judge_shares(
    shares: MotorShares | None, verdicts: Sequence[EffectVerdict], effects: Mapping[str, Effect]
) -> tuple[EffectVerdict, ...]:
    """`verdicts` on the rotation, with what the shares say where the rotation itself could not: a weaker rotor, or a
    weight near it, possible and told apart by neither. `effects` are those by name."""
    told = {v.name: effects[v.name].in_shares for v in verdicts if effects[v.name].in_shares}
    if shares is None or not shares.rotor or any(v.verdict == MISSING for v in verdicts if v.name in told):
        return tuple(verdicts)
    return tuple(
        _from_shares(v, shares, told[v.name], tuple(n for n in told if told[n] != told[v.name]))
        if v.name in told
        else v
        for v in verdicts
    )


def _from_shares(
    verdict: EffectVerdict, shares: MotorShares, shown: str, others: tuple[str, ...]
) -> EffectVerdict:
    """The verdict on an effect by the shares; `others` would do the same to them."""
    found: tuple[ParameterEstimate, ...]
    if shown == ROTOR_SHARE:
        value, low, high = shares.losses
        found = (ParameterEstimate(f"loss_{shares.rotor}", value, low, high, "1"),)
    else:
        assert shown == CENTRE_SHARE
        found = tuple(
            ParameterEstimate(n, c, c - h, c + h, "m")
            for n, c, h in zip("xy", shares.centre, shares.centre_errors, strict=True)
        )
    return replace(
        verdict,
        verdict=POSSIBLE,
        rank=None,
        variance_share=0.0,
        p_value=1.0,
        parameters=found,
        indistinguishable_from=others,
        advice=shares.advice,
        rests_on=shares.told,
        confidence=None,
    )
