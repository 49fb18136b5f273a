"""Whether what the rotation shows is one rotor, or the centre of mass, and not how any vehicle is built.

A weaker rotor lacks the same part of its thrust about every axis: each axis is asked by itself (a specification test,
Hausman, Econometrica 46, 1978). A centre of mass and unequal rotors are told apart by all three axes, or not at all. A
fit that leaves half of the rotation unexplained has not seen the rotors. And where only commands are logged, the motors
of a healthy set differ by some percent in what they make of one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import special

from trueflight.groundstation.identify.doubt import ALPHA, MASTERED, SAME
from trueflight.groundstation.identify.fitting import Fit, robust_covariance
from trueflight.groundstation.identify.shares import CHANGED, DIFFER
from trueflight.groundstation.identify.torque import TorqueProblem
from trueflight.groundstation.identify.verdicts import MINOR, MISSING, POSSIBLE
from trueflight.groundstation.results import EffectVerdict
from trueflight.models.effect import ROTOR_SHARE


def doubted(verdict: EffectVerdict, problem: TorqueProblem, here: Fit, quiet: bool) -> EffectVerdict:
    """The verdict on what was found in the rotation, after these questions; with no more than noise left (`quiet`) the
    axes agree."""
    shown = problem.effects[verdict.name].in_shares
    if not shown or verdict.verdict not in (MISSING, POSSIBLE):
        return verdict
    if problem.turning.rotation.flight.rotor_speed is None and _as_built(verdict, problem):
        return replace(
            verdict,
            verdict=MINOR,
            rank=None,
            indistinguishable_from=(),
            confidence=None,
            rests_on="",
            advice=f"motors of one set differ by {100 * DIFFER:.0f} % in what they make of a command: a healthy "
            "vehicle shows as much; compare with an earlier flight of it",
        )
    if verdict.verdict != MISSING:
        return verdict
    told, others = "", [n for n, e in problem.effects.items() if e.in_shares not in ("", shown)]
    if len(problem.turning.rotation.axes) < 3:
        told = "one axis of the attitude was not logged: a weaker rotor and a weight near it look the same"
    elif not quiet and (left := _left(problem, here)) > MASTERED:
        told = (
            f"{100 * left:.0f} % of the angular acceleration (RMS) is not what the rotors' torques make of it"
        )
    elif not quiet and shown == ROTOR_SHARE and (apart := _apart(problem, here, verdict.name)) > SAME:
        told = f"roll, pitch and yaw, each by itself, differ on its size by {100 * min(apart, 9.99):.0f} %"
    if not told:
        return verdict
    return replace(
        verdict,
        verdict=POSSIBLE,
        indistinguishable_from=tuple(dict.fromkeys((*verdict.indistinguishable_from, *others))),
        rests_on=told,
        advice="it may stand in for what the rotors' torques do not explain; compare with a flight when the vehicle "
        "was healthy (--healthy FLIGHT)",
        confidence=None if verdict.confidence is None else 0.5 * verdict.confidence,
    )


def _as_built(verdict: EffectVerdict, problem: TorqueProblem) -> bool:
    """Whether motors that differ as those of a healthy set do make as much, from commands alone."""
    places = np.array(problem.turning.motion.vehicle.rotor_positions, dtype=float)[:, :2]
    if problem.effects[verdict.name].in_shares == ROTOR_SHARE:
        return all(abs(p.value) < CHANGED * DIFFER for p in verdict.parameters)
    granted = CHANGED * DIFFER * np.sqrt(np.sum(places**2, axis=0)) / len(places)
    return all(abs(p.value) < granted["xy".index(p.name)] for p in verdict.parameters)


def _left(problem: TorqueProblem, here: Fit) -> float:
    """RMS of what is left over that of what was measured, of the axis that is explained best."""
    left = np.sqrt(np.mean((here.residual / problem.weight) ** 2, axis=0))
    measured = np.sqrt(np.mean(problem.turning.measured**2, axis=0))
    return float(np.min(left / np.maximum(measured, 1e-12)))


def _apart(problem: TorqueProblem, here: Fit, name: str) -> float:
    """How much the axes differ on the loss of the rotor, over what it does, both RMS; 0 where chance makes as much."""
    (own,) = here.of(name)
    k, axes, count = here.jacobian.shape
    rest = [i for i in range(count) if i != own]
    alone = here.jacobian[:, :, own][:, :, None] * np.eye(axes)
    wide = np.concatenate([here.jacobian[:, :, rest], alone], axis=2)
    size = np.maximum(np.sqrt(np.sum(wide**2, axis=(0, 1))), 1e-30)
    wide = wide / size
    flat = wide.reshape(k * axes, -1)
    step = -np.linalg.lstsq(flat.T @ flat, flat.T @ here.residual.ravel(), rcond=1e-12)[0]
    residual = here.residual + (flat @ step).reshape(k, axes)
    covariance, critical = robust_covariance(problem, wide, residual, np.zeros(wide.shape[2]))
    losses = (step / size)[-axes:]
    spread = (covariance / np.outer(size, size))[-axes:, -axes:]
    contrast = np.eye(axes)[1:] - np.eye(axes)[:1]
    differ = contrast @ losses
    statistic = float(differ @ np.linalg.pinv(contrast @ spread @ contrast.T, hermitian=True) @ differ)
    if special.chdtrc(axes - 1, statistic * (1.96 / critical) ** 2) > ALPHA:
        return 0.0
    done = float(here.estimate[own]) * here.jacobian[:, :, own]
    moved = alone @ (losses - losses.mean())
    return float(np.linalg.norm(moved)) / max(float(np.linalg.norm(done)), 1e-30)
