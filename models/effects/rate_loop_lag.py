"""Body rates lag their command."""

import numpy as np

from trueflight.models.effect import Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, lag: float, delay: float) -> Motion:
    """`lag w' = c(t - delay) - w`, w the body rates and c their command: the closed rate loop as a first-order system.

    A rate controller's integral, where the vehicle has one, is fitted beside it.
    """
    return motion.with_(rate_lag=float(np.asarray(lag)), rate_delay=float(np.asarray(delay)))


EFFECT = Effect(
    name="rate_loop_lag",
    title="body rates lag their command",
    stage=Stage.RATE,
    formula=formula,
    parameters=(
        Parameter(
            "lag",
            "s",
            "time constant of the closed rate loop",
            "rate_time_constant",
            0.15,
            0.0,
            1.5,
            actuation="rate_lag",
        ),
        Parameter(
            "delay",
            "s",
            "from the logged command to the motors",
            "command_delay",
            0.04,
            0.0,
            0.3,
            actuation="rate_delay",
        ),
    ),
    needs=("angular_velocity", "body_rate_command"),
    manoeuvre="quick rolls and pitches both ways: steps of position in all directions",
    citation="first-order closed rate loop, as in Faessler, Falanga, Scaramuzza 2017 (RA-L), sec. III; "
    "output-error fit of Ljung, System Identification, 2nd ed., sec. 10.2",
    confounded_with=("transport_delay", "motor_lag"),
    exports=False,
    rotational=True,
    on_airframe=lambda airframe, values: airframe.with_(rate_lag=values["lag"], rate_delay=values["delay"]),
)
