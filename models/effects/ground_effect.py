"""Thrust rises near the ground."""

from array_api_compat import array_namespace

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage

STRONGEST = 0.6
"""Largest value of the squared ratio: below about a third of a radius the formula leaves its range."""


def formula(motion: Motion, *, rho: Array) -> Motion:
    """`T' = T mean over rotors of 1 / (1 - (rho R / 4 h_i)²)`, h_i the height of each rotor over the ground.

    `rho` = 1 is a single rotor by the method of images; a quadrotor's fountain flow makes it larger.
    """
    xp = array_namespace(motion.thrust)
    arms = motion.vehicle.rotor_positions or ((0.0, 0.0, 0.0),)
    up = motion.rotation[:, 2, :]  # world z in body axes
    above = motion.height + motion.vehicle.rotor_height
    total = 0.0 * motion.thrust
    for x, y, z in arms:
        height = xp.clip(above + up[:, 0] * x + up[:, 1] * y + up[:, 2] * z, 1e-3, None)
        ratio = rho * motion.vehicle.rotor_radius / (4.0 * height)
        total = total + 1.0 / (1.0 - xp.clip(ratio * ratio, 0.0, STRONGEST))
    return motion.with_(thrust=motion.thrust * (total / float(len(arms))))


EFFECT = Effect(
    name="ground_effect",
    title="thrust rises near the ground",
    stage=Stage.THRUST,
    formula=formula,
    parameters=(Parameter("rho", "1", "multiplier of the rotor radius", 0.0, 1.2, 0.0, 6.0, even=True),),
    needs=("quaternion", "position", "thrust_command"),
    manoeuvre="slow passes and hovers at heights from half a rotor radius above the ground to five radii",
    citation="Cheeseman & Bennett 1955; Danjun et al. 2015; Sanchez-Cuevas et al. 2017 (quadrotors)",
    confounded_with=("thrust_gain",),
    generalises=("thrust_gain",),
)
