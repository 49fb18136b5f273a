"""The centre of mass is off the rotors' centre."""

from array_api_compat import array_namespace

from trueflight.models.effect import CENTRE_SHARE, Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, x: Array, y: Array) -> Motion:
    """`torque' = torque - c x (0, 0, F)`, with c = (x, y, 0) in m the centre of mass, F the thrust of all rotors in N.

    The rotors' positions are the vehicle file's, from where its owner believes the centre of mass.
    """
    xp = array_namespace(motion.torque)
    thrust = xp.sum(motion.rotor_thrust, axis=1)
    return motion.with_(torque=motion.torque + xp.stack([-y * thrust, x * thrust, 0.0 * thrust], axis=-1))


EFFECT = Effect(
    name="com_offset",
    title="centre of mass off the rotors' centre: a torque that scales with thrust",
    stage=Stage.TORQUE,
    formula=formula,
    parameters=(
        Parameter(
            "x", "m", "centre of mass along body x, from the believed one", 0.0, 0.005, -0.2, 0.2, truth="x"
        ),
        Parameter(
            "y", "m", "centre of mass along body y, from the believed one", 0.0, 0.005, -0.2, 0.2, truth="y"
        ),
    ),
    needs=("angular_velocity",),
    manoeuvre="any flight of half a minute, with rolls and pitches both ways and some change of thrust",
    citation="torque r x F of rotors about the centre of mass: "
    "Mahony, Kumar, Corke 2012 (IEEE RAM 19(3)), section on dynamics",
    confounded_with=("rotor_damage",),
    needs_any=("rotor_speed", "motor_command"),
    exports=False,
    rotational=True,
    in_shares=CENTRE_SHARE,
    on_airframe=lambda airframe, values: airframe.with_(centre_of_mass=(values["x"], values["y"])),
)
