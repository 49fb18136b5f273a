"""Quadratic drag of the frame."""

from array_api_compat import array_namespace

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, x: Array, y: Array, z: Array) -> Motion:
    """`a = -diag(x, y, z) v_air |v_air|`, body axes; `x`, `y`, `z` in 1/m are `rho C_d A / 2 m` of each face."""
    xp = array_namespace(motion.air_velocity)
    ahead, left, up = motion.body_velocity
    speed = xp.sqrt(ahead * ahead + left * left + up * up + 1e-12)
    force = xp.stack([-x * ahead * speed, -y * left * speed, -z * up * speed], axis=-1)
    return motion.with_(force=motion.force + force)


EFFECT = Effect(
    name="parasitic_drag",
    title="quadratic drag of the frame",
    stage=Stage.FORCE,
    formula=formula,
    parameters=(
        Parameter(
            "x",
            "1/m",
            "drag over mass and squared speed along body x",
            0.0,
            0.05,
            0.0,
            1.0,
            truth="x",
            drifts=0.1,
        ),
        Parameter(
            "y",
            "1/m",
            "drag over mass and squared speed along body y",
            0.0,
            0.05,
            0.0,
            1.0,
            truth="y",
            drifts=0.1,
        ),
        Parameter(
            "z", "1/m", "drag over mass and squared speed along body z", 0.0, 0.05, 0.0, 1.0, truth="z"
        ),
    ),
    needs=("quaternion", "velocity", "thrust_command"),
    manoeuvre="translations at two or more speeds, the fastest at 4 m/s or more",
    citation="drag equation; Leishman, Principles of Helicopter Aerodynamics, ch. 6 (parasitic drag of the airframe)",
    confounded_with=("rotor_drag", "wind"),
    on_airframe=lambda airframe, values: airframe.with_(frame_drag=(values["x"], values["y"], values["z"])),
)
