"""Thrust over mass differs from the believed one by a factor."""

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, gain: Array) -> Motion:
    """`T' = gain T`: a wrong thrust constant multiplies, a wrong mass divides; acceleration sees only the ratio."""
    return motion.with_(thrust=motion.thrust * gain)


EFFECT = Effect(
    name="thrust_gain",
    title="thrust-to-mass ratio differs from the believed one",
    stage=Stage.THRUST,
    formula=formula,
    parameters=(
        Parameter(
            "gain",
            "1",
            "true over believed thrust-to-mass ratio",
            1.0,
            1.05,
            0.4,
            2.5,
            truth="gain",
            grows="thrust over mass has risen by {:.1%} of what is believed",
            shrinks="thrust over mass has fallen by {:.1%} of what is believed",
            drifts=1.0,
        ),
    ),
    needs=("thrust_command",),
    manoeuvre="hover, then climbs and descents at two or more accelerations",
    citation="F = m a: specific thrust is c u / m, so a payload, the mass and the thrust constant are one number",
    confounded_with=("thrust_curve", "battery_sag", "accelerometer_bias", "rotor_damage"),
    scales_rotors=True,
    learnt_unasked=True,
    aliases=("mass", "payload", "thrust constant"),
    on_airframe=lambda airframe, values: airframe.scaled(values["gain"]),
)
