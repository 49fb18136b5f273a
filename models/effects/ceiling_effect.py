"""Thrust rises near a ceiling."""

from collections.abc import Mapping

import numpy as np
from array_api_compat import array_namespace

from trueflight.models.effect import BELOW_CEILING, FLIGHT, Array, Effect, Motion, Parameter, Stage

STRONGEST = 0.6
"""Largest value of the squared ratio: nearer to the ceiling the formula leaves its range."""


def formula(motion: Motion, *, rho: Array, ceiling: Array) -> Motion:
    """`T' = T mean over rotors of 1 / (1 - (rho R / 4 d_i)²)`, d_i the distance of each rotor from the ceiling.

    `ceiling` is its height above ground. `rho` = 1.52 is the measured 1 / 6.924 of Sanchez-Cuevas et al. at the
    square of R / d. Above the ceiling, where a wrong height may put a flight, nothing happens.
    """
    xp = array_namespace(motion.thrust)
    arms = motion.vehicle.rotor_positions or ((0.0, 0.0, 0.0),)
    up = motion.rotation[:, 2, :]  # world z in body axes
    above = motion.height + motion.vehicle.rotor_height
    total = 0.0 * motion.thrust
    for x, y, z in arms:
        distance = ceiling - (above + up[:, 0] * x + up[:, 1] * y + up[:, 2] * z)
        ratio = rho * motion.vehicle.rotor_radius / (4.0 * xp.clip(distance, 1e-3, None))
        below = xp.clip(distance * 1e6, 0.0, 1.0)
        total = total + 1.0 / (1.0 - below * xp.clip(ratio * ratio, 0.0, STRONGEST))
    return motion.with_(thrust=motion.thrust * (total / float(len(arms))))


def _at(motion: Motion, radii: float) -> Mapping[str, float]:
    """A ceiling so many rotor radii above the highest point that the rotors reached for a moment."""
    reached = float(np.quantile(np.asarray(motion.height), 0.998))
    hubs = max((z for _, _, z in motion.vehicle.rotor_positions), default=0.0)
    above = reached + hubs + motion.vehicle.rotor_height
    return {"ceiling": float(np.clip(above + radii * motion.vehicle.rotor_radius, LOWEST, HIGHEST))}


def just_above(motion: Motion) -> Mapping[str, float]:
    """A ceiling one rotor radius above the highest point."""
    return _at(motion, 1.0)


def heights(motion: Motion) -> list[Mapping[str, float]]:
    """Ceilings from the highest point, as a wrong height may tell it, to four radii above."""
    return [{"rho": 2.0, **_at(motion, radii)} for radii in (0.0, 0.5, 2.0, 4.0)]


LOWEST, HIGHEST = 0.3, 30.0
"""m above ground: from a test stand's cover to the deck of a bridge."""

EFFECT = Effect(
    name="ceiling_effect",
    title="thrust rises near a ceiling",
    stage=Stage.THRUST,
    formula=formula,
    parameters=(
        Parameter("rho", "1", "multiplier of the rotor radius", 0.0, 1.5, 0.0, 6.0, even=True),
        Parameter(
            "ceiling",
            "m",
            "height of the ceiling above ground",
            3.0,
            3.0,
            LOWEST,
            HIGHEST,
            structural=True,
            belongs_to=FLIGHT,
        ),
    ),
    needs=("quaternion", "position", "thrust_command"),
    manoeuvre="slow passes and hovers below the ceiling, from five rotor radii to one",
    citation="Sanchez-Cuevas, Heredia, Ollero 2017 (ICUAS, bridge inspection by contact), thrust ratio in ceiling "
    "effect; Powers et al. 2013",
    confounded_with=("thrust_gain", "ground_effect", "axial_inflow"),
    generalises=("thrust_gain",),
    typical_for=just_above,
    starts_for=heights,
    shown_in=BELOW_CEILING,
)
