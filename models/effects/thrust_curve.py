"""The map from command to thrust is not the assumed curve."""

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage
from trueflight.models.vehicle import GRAVITY


def formula(motion: Motion, *, curvature: Array) -> Motion:
    """`r' = r (1 + curvature (r - 1))`, with r the thrust over the hover thrust: the hover stays where it is.

    Curvature 0 keeps the assumed curve; on a linear one, 1 makes it a pure square.
    """
    excess = motion.command / GRAVITY - 1.0
    return motion.with_(thrust=motion.thrust * (1.0 + curvature * excess))


EFFECT = Effect(
    name="thrust_curve",
    title="command to thrust is not the assumed curve",
    stage=Stage.THRUST,
    formula=formula,
    parameters=(Parameter("curvature", "1", "bend of the thrust curve about hover", 0.0, 0.2, -0.9, 1.5),),
    needs=("thrust_command",),
    manoeuvre="vertical accelerations up and down, from half to one and a half times the hover thrust",
    citation="second-order expansion about hover of the blend of linear and square, as PX4's THR_MDL_FAC",
    confounded_with=("thrust_gain", "accelerometer_bias"),
    generalises=("thrust_gain",),
    before_rotors=True,
    on_airframe=lambda airframe, values: airframe.bent(values["curvature"]),
)
