"""Pure delay from command to thrust."""

from collections.abc import Mapping

import numpy as np

from trueflight.models.effect import Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, delay: float) -> Motion:
    """`T(t) = T_command(t - delay)`; `delay` is the whole delay between the two columns of the record."""
    return motion.with_(delay=float(np.asarray(delay)))


def truth(hidden: Mapping[str, float], neutral: Mapping[str, float]) -> dict[str, float]:
    """The simulator's delay comes on top of the one that is believed."""
    return {"delay": neutral["delay"] + hidden["extra_delay"]}


EFFECT = Effect(
    name="transport_delay",
    title="thrust comes a fixed time after its command",
    stage=Stage.COMMAND,
    formula=formula,
    parameters=(
        Parameter(
            "delay",
            "s",
            "from logged command to motor",
            "command_delay",
            0.04,
            0.0,
            0.3,
            clock_samples=1.0,
            actuation="thrust_delay",
        ),
    ),
    needs=("thrust_command",),
    manoeuvre="quick vertical steps: thrust changes within a few hundredths of a second",
    citation="radio, serial line, driver protocol and clock offset between columns add up to one shift in time",
    confounded_with=("motor_lag",),
    exports=False,
    shifts_clock=True,
    before_rotors=True,
    truth_for=truth,
    on_airframe=lambda airframe, values: airframe.with_(delay=values["delay"]),
)
