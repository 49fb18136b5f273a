"""Thrust falls as the rotors climb into the air, and rises as they sink."""

from array_api_compat import array_namespace

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage
from trueflight.models.vehicle import GRAVITY


def formula(motion: Motion, *, slope: Array) -> Motion:
    """`a = -slope w_air sqrt(T / m g)` along body z, with w_air the axial airspeed: inflow takes angle of attack away.

    `slope` in 1/s is the value at hover thrust; blade element theory gives a loss in rotor speed times airspeed.
    """
    xp = array_namespace(motion.thrust)
    _, _, up = motion.body_velocity
    rotor_speed = xp.sqrt(xp.clip(motion.thrust, 0.0, None) / GRAVITY)
    force = xp.stack([0.0 * up, 0.0 * up, -slope * up * rotor_speed], axis=-1)
    return motion.with_(force=motion.force + force)


EFFECT = Effect(
    name="axial_inflow",
    title="thrust falls with climb speed",
    stage=Stage.FORCE,
    formula=formula,
    parameters=(
        Parameter(
            "slope", "1/s", "thrust over mass lost per axial airspeed, at hover thrust", 0.0, 0.2, 0.0, 3.0
        ),
    ),
    needs=("quaternion", "velocity", "thrust_command"),
    manoeuvre="climbs and descents at 1 to 3 m/s, there and back",
    citation="Leishman, Principles of Helicopter Aerodynamics, ch. 3 (blade element theory); Svacha et al. 2017",
    confounded_with=("parasitic_drag", "motor_lag", "vortex_ring"),
    on_airframe=lambda airframe, values: airframe.with_(inflow=values["slope"]),
)
