"""The thrust axis is tilted against the body."""

from array_api_compat import array_namespace

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, x: Array, y: Array) -> Motion:
    """`f = T (x, y, sqrt(1 - x² - y²))`, body axes: thrust leans by the angles x and y (rad) to body x and y."""
    xp = array_namespace(motion.thrust)
    upright = (1.0 - x * x - y * y) ** 0.5
    force = xp.stack([x * motion.thrust, y * motion.thrust, (upright - 1.0) * motion.thrust], axis=-1)
    return motion.with_(force=motion.force + force)


EFFECT = Effect(
    name="thrust_misalignment",
    title="thrust axis tilted against the body's",
    stage=Stage.FORCE,
    formula=formula,
    parameters=(
        Parameter("x", "rad", "lean of the thrust towards body x", 0.0, 0.02, -0.2, 0.2, truth="x"),
        Parameter("y", "rad", "lean of the thrust towards body y", 0.0, 0.02, -0.2, 0.2, truth="y"),
    ),
    needs=("quaternion", "thrust_command"),
    manoeuvre="vertical accelerations up and down, from half to one and a half times the hover thrust",
    citation="T R e3' with e3' the rotors' axis in the body: Newton-Euler equations "
    "(Carvalho et al. 2022, eq. (1)-(3)) with a mounting error of motors or of the autopilot",
    confounded_with=("accelerometer_bias", "wind", "rotor_drag"),
    aliases=("mounting of the autopilot",),
    generalises=("accelerometer_bias",),
    on_airframe=lambda airframe, values: airframe.with_(lean=(values["x"], values["y"])),
)
