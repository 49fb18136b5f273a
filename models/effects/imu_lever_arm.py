"""The accelerometer is away from the centre of mass."""

from array_api_compat import array_namespace

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, x: Array, y: Array, z: Array) -> Motion:
    """`f_measured = f + dw/dt x r + w x (w x r)`, with r = (x, y, z) in m from the centre of mass, body axes."""
    xp = array_namespace(motion.body_rate)
    p, q, r = (motion.body_rate[:, i] for i in range(3))
    dp, dq, dr = (motion.body_acceleration[:, i] for i in range(3))
    along = p * x + q * y + r * z
    square = p * p + q * q + r * r
    reading = xp.stack(
        [
            dq * z - dr * y + p * along - square * x,
            dr * x - dp * z + q * along - square * y,
            dp * y - dq * x + r * along - square * z,
        ],
        axis=-1,
    )
    return motion.with_(reading=motion.reading + reading)


EFFECT = Effect(
    name="imu_lever_arm",
    title="accelerometer away from the centre of mass",
    stage=Stage.SENSOR,
    formula=formula,
    parameters=tuple(
        Parameter(
            axis, "m", f"position of the accelerometer along body {axis}", 0.0, 0.03, -0.5, 0.5, truth=axis
        )
        for axis in ("x", "y", "z")
    ),
    needs=("specific_force", "angular_velocity", "thrust_command"),
    needs_accelerometer=True,
    noisy=("angular_velocity",),
    manoeuvre="quick rolls, pitches and yaws both ways, at constant thrust",
    citation="acceleration of a point of a rigid body, Goldstein, Classical Mechanics, ch. 4; "
    "Titterton & Weston, Strapdown Inertial Navigation Technology (size effect)",
    confounded_with=("accelerometer_bias", "rotor_drag"),
    exports=False,
)
