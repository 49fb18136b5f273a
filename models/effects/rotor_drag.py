"""Linear drag in the rotor plane."""

from array_api_compat import array_namespace

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage
from trueflight.models.vehicle import GRAVITY


def formula(motion: Motion, *, x: Array, y: Array) -> Motion:
    """`a = -diag(x, y, 0) v_air sqrt(T / m g)`, body axes: H-force goes with rotor speed times airspeed.

    `x`, `y` in 1/s are the values at hover thrust.
    """
    xp = array_namespace(motion.thrust)
    ahead, left, _ = motion.body_velocity
    rotor_speed = xp.sqrt(xp.clip(motion.thrust, 0.0, None) / GRAVITY)
    force = xp.stack([-x * ahead * rotor_speed, -y * left * rotor_speed, 0.0 * ahead], axis=-1)
    return motion.with_(force=motion.force + force)


EFFECT = Effect(
    name="rotor_drag",
    title="linear drag in the rotor plane",
    stage=Stage.FORCE,
    formula=formula,
    parameters=(
        Parameter(
            "x",
            "1/s",
            "drag over mass and speed along body x, at hover thrust",
            0.0,
            0.15,
            0.0,
            2.0,
            truth="x",
            drifts=0.1,
        ),
        Parameter(
            "y",
            "1/s",
            "drag over mass and speed along body y, at hover thrust",
            0.0,
            0.15,
            0.0,
            2.0,
            truth="y",
            drifts=0.1,
        ),
    ),
    needs=("quaternion", "velocity", "thrust_command"),
    manoeuvre="translations along body x and along body y at 1 to 4 m/s, there and back",
    citation="Mahony, Kumar, Corke 2012; Faessler, Franchi, Scaramuzza 2018; Kai et al. 2017",
    confounded_with=("parasitic_drag", "wind", "accelerometer_bias"),
    on_airframe=lambda airframe, values: airframe.with_(hub_drag=(values["x"], values["y"])),
)
