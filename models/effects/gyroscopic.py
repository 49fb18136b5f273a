"""The rotors' angular momentum couples roll and pitch."""

from array_api_compat import array_namespace

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, inertia: Array) -> Motion:
    """`torque' = torque - w x (0, 0, J sum s_i W_i)`, W_i the speed of rotor i in rad/s and s_i = 1 counter-clockwise.

    `inertia` J in kg m² is that of what turns with one rotor. It acts where the two pairs turn at different speeds:
    while the vehicle yaws.
    """
    xp = array_namespace(motion.torque)
    spin = 0.0 * motion.torque[:, 0]
    for i, direction in enumerate(motion.vehicle.rotor_directions):
        spin = spin + float(direction) * motion.rotor_speed[:, i]
    momentum = inertia * spin
    p, q = motion.body_rate[:, 0], motion.body_rate[:, 1]
    return motion.with_(torque=motion.torque + xp.stack([-q * momentum, p * momentum, 0.0 * p], axis=-1))


EFFECT = Effect(
    name="gyroscopic",
    title="rotor momentum couples roll and pitch",
    stage=Stage.TORQUE,
    formula=formula,
    parameters=(
        Parameter(
            "inertia",
            "kg m^2",
            "moment of inertia of one rotor with its bell",
            0.0,
            2e-5,
            0.0,
            2e-2,
            truth="inertia",
        ),
    ),
    needs=("angular_velocity", "rotor_speed"),
    manoeuvre="quick yaw both ways while rolling and pitching",
    citation="Bouabdallah 2007 (thesis, EPFL 3727), ch. 2: propeller gyroscopic effect; "
    "Newton-Euler equations of a body with rotors (Goldstein, Classical Mechanics, ch. 5)",
    confounded_with=("rate_loop_lag",),
    exports=False,
    rotational=True,
    on_airframe=lambda airframe, values: airframe.with_(spin_inertia=values["inertia"]),
)
