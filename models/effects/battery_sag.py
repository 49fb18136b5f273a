"""Thrust follows the battery's voltage."""

from array_api_compat import array_namespace

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, exponent: Array) -> Motion:
    """`T' = T (V / V_nominal)^exponent`; 2 where rotor speed follows the voltage, 0 where the driver compensates."""
    xp = array_namespace(motion.voltage)
    ratio = xp.log(motion.voltage / motion.vehicle.nominal_voltage)
    return motion.with_(thrust=motion.thrust * xp.exp(exponent * ratio))


EFFECT = Effect(
    name="battery_sag",
    title="thrust follows the battery voltage",
    stage=Stage.THRUST,
    formula=formula,
    parameters=(
        Parameter(
            "exponent",
            "1",
            "of voltage over nominal voltage",
            0.0,
            1.0,
            0.0,
            3.5,
            truth="exponent",
            drifts=0.1,
        ),
    ),
    needs=("thrust_command", "battery_voltage"),
    manoeuvre="one flight from a full to a nearly empty battery, or flights on both",
    citation="duty cycle times voltage drives the motor, thrust goes with rotor speed squared (Bangura & Mahony 2014)",
    confounded_with=("thrust_gain",),
    generalises=("thrust_gain",),
    before_rotors=True,
)
