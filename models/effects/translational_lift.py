"""Thrust rises with horizontal airspeed."""

from array_api_compat import array_namespace

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, lift: Array) -> Motion:
    """`a = lift (u² + v²)` along body z, with u, v the airspeed in the rotor plane.

    At the same rotor speed a rotor in edgewise flow gives more thrust, by the square of the airspeed and, to that
    order, whatever the rotor speed: `lift` in 1/m is that gain over mass.
    """
    xp = array_namespace(motion.air_velocity)
    ahead, left, _ = motion.body_velocity
    force = xp.stack([0.0 * ahead, 0.0 * ahead, lift * (ahead * ahead + left * left)], axis=-1)
    return motion.with_(force=motion.force + force)


EFFECT = Effect(
    name="translational_lift",
    title="thrust rises with horizontal airspeed",
    stage=Stage.FORCE,
    formula=formula,
    parameters=(
        Parameter(
            "lift", "1/m", "thrust over mass gained per squared airspeed", 0.0, 0.02, 0.0, 0.3, truth="lift"
        ),
    ),
    needs=("quaternion", "velocity", "thrust_command"),
    manoeuvre="level translations at two or more speeds, the fastest at 4 m/s or more, both ways",
    citation="Svacha, Mohta, Kumar 2017 (ICUAS), thrust model with k_h |v_h|²; Leishman, Principles of Helicopter "
    "Aerodynamics, sec. 3.5 (blade element theory in forward flight, term in the square of the advance ratio)",
    confounded_with=("parasitic_drag", "axial_inflow", "thrust_curve"),
    on_airframe=lambda airframe, values: airframe.with_(lift=values["lift"]),
)
