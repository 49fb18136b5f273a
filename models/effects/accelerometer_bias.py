"""Constant offset of the accelerometer."""

from array_api_compat import array_namespace

from trueflight.models.effect import FLIGHT, Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, x: Array, y: Array, z: Array) -> Motion:
    """`f_measured = f + (x, y, z)`, body axes, m/s²: an error of the reading, not of the flight."""
    xp = array_namespace(motion.reading)
    one = 0.0 * motion.reading[:, 0] + 1.0
    return motion.with_(reading=motion.reading + xp.stack([x * one, y * one, z * one], axis=-1))


EFFECT = Effect(
    name="accelerometer_bias",
    title="constant offset of the accelerometer",
    stage=Stage.SENSOR,
    formula=formula,
    parameters=tuple(
        Parameter(
            axis, "m/s^2", f"offset along body {axis}", 0.0, 0.1, -0.8, 0.8, truth=axis, belongs_to=FLIGHT
        )
        for axis in ("x", "y", "z")
    ),
    needs=("specific_force",),
    needs_accelerometer=True,
    manoeuvre="hover at several headings, and tilts both ways",
    citation="IEEE Std 1293, bias term of the accelerometer model; range: 80 mg zero-g offset of MEMS data sheets",
    confounded_with=("thrust_gain", "thrust_curve", "wind", "thrust_misalignment"),
)
