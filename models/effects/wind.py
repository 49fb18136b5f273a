"""Steady wind."""

from array_api_compat import array_namespace

from trueflight.models.effect import FLIGHT, Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, x: Array, y: Array) -> Motion:
    """`v_air = v - w`, with w = (x, y, 0) in m/s, world ENU: where the air moves to."""
    xp = array_namespace(motion.air_velocity)
    ahead = motion.cos_yaw * x + motion.sin_yaw * y
    left = -motion.sin_yaw * x + motion.cos_yaw * y
    wind = xp.stack([ahead, left, 0.0 * ahead], axis=-1)
    return motion.with_(air_velocity=motion.air_velocity - wind)


EFFECT = Effect(
    name="wind",
    title="steady wind, acting through drag",
    stage=Stage.AIR,
    formula=formula,
    parameters=(
        Parameter(
            "x",
            "m/s",
            "wind towards east",
            0.0,
            2.0,
            -20.0,
            20.0,
            truth="east",
            belongs_to=FLIGHT,
            drifts=1.0,
        ),
        Parameter(
            "y",
            "m/s",
            "wind towards north",
            0.0,
            2.0,
            -20.0,
            20.0,
            truth="north",
            belongs_to=FLIGHT,
            drifts=1.0,
        ),
    ),
    needs=("quaternion", "velocity", "thrust_command"),
    manoeuvre="translations in all directions and a slow full turn in yaw",
    citation="drag follows the velocity relative to the air",
    confounded_with=("accelerometer_bias", "rotor_drag", "parasitic_drag"),
    acts_through=("rotor_drag", "parasitic_drag"),
    carrier_truth="drag",
    learnt_unasked=True,
    on_airframe=lambda airframe, values: airframe.with_(moving_air=(values["x"], values["y"])),
)
