"""First-order lag from command to rotor speed."""

import numpy as np

from trueflight.models.effect import Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, tau: float) -> Motion:
    """`tau dw/dt + w = w_command` of rotor speed w, with thrust as w squared; `tau` is the whole time constant."""
    return motion.with_(tau=float(np.asarray(tau)))


HELD = 0.5
"""A command that is held for a sample looks, between samples, like one that is half a sample late and smoothed."""

EFFECT = Effect(
    name="motor_lag",
    title="thrust lags its command (rotor speed dynamics)",
    stage=Stage.COMMAND,
    formula=formula,
    parameters=(
        Parameter(
            "tau",
            "s",
            "time constant of rotor speed",
            "motor_time_constant",
            0.05,
            0.0,
            0.4,
            clock_samples=HELD,
            actuation="thrust_lag",
            truth="time_constant",
        ),
    ),
    needs=("thrust_command",),
    manoeuvre="quick vertical steps: thrust changes within a few hundredths of a second",
    citation="brushless motor and rotor as a first-order system in rotor speed (Bangura & Mahony 2014; Faessler 2017)",
    confounded_with=("transport_delay",),
    exports=False,
    before_rotors=True,
    on_airframe=lambda airframe, values: airframe.with_(lag=values["tau"]),
)
