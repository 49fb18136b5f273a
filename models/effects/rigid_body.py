"""Exact rotation of thrust, instead of the small angles of the hover linearisation."""

from trueflight.models.effect import Effect, Motion, Stage


def formula(motion: Motion) -> Motion:
    """Thrust along the body's z axis: `R e3 T / m`, heading frame."""
    return motion.with_(thrust_acceleration=motion.rotation[:, :, 2] * motion.thrust[:, None])


EFFECT = Effect(
    name="rigid_body",
    title="exact rotation of the thrust vector",
    stage=Stage.ROTATION,
    formula=formula,
    parameters=(),
    exact_rotation=True,
    needs=("quaternion", "thrust_command"),
    manoeuvre="any flight with tilt above about ten degrees",
    citation="Newton-Euler equations; Carvalho et al. 2022, eq. (1)-(3)",
    unconfounded="it has no parameter: nothing is fitted",
    on_airframe=lambda airframe, values: airframe,
)
