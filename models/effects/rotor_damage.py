"""One rotor gives less thrust than the others at the same speed."""

from collections.abc import Mapping

from array_api_compat import array_namespace

from trueflight.models.allocation import leverage
from trueflight.models.effect import ROTOR_SHARE, Array, Effect, Motion, Parameter, Stage
from trueflight.models.flight import MOST_ROTORS


def formula(motion: Motion, **losses: Array) -> Motion:
    """`f_i' = (1 - loss_i) f_i` of rotor i: its torque about the centre of mass and its thrust are lost together.

    `losses`, `loss_1`, `loss_2` and so on, are shares, 0 to 1, in the order of the vehicle's rotor_positions; those of
    rotors that it does not have do nothing.

    Where nothing tells the rotors apart, the vehicle is believed to be driven so that roll, pitch and yaw stay
    balanced: of four rotors the weaker is driven so much harder, and the thrust of all is
    `4 (1 - loss) / (4 - 3 loss)` of the commanded.
    """
    if motion.rotor_thrust is None:
        factor = 1.0
        lever = leverage(motion.vehicle)
        for i, h in enumerate(lever):
            loss = losses.get(f"loss_{i + 1}", 0.0)
            factor = factor * (1.0 - h * loss) / (1.0 - h * loss + loss / len(lever))
        return motion.with_(thrust=motion.thrust * factor)
    xp = array_namespace(motion.rotor_thrust)
    count = motion.rotor_thrust.shape[1]
    each = [(1.0 - losses.get(f"loss_{i + 1}", 0.0)) * motion.rotor_thrust[:, i] for i in range(count)]
    weaker = xp.stack(each, axis=-1)
    share = xp.sum(weaker, axis=1) / xp.clip(xp.sum(motion.rotor_thrust, axis=1), 1e-9, None)
    return motion.with_(thrust=motion.thrust * share, rotor_thrust=weaker)


def truth(hidden: Mapping[str, float], neutral: Mapping[str, float]) -> dict[str, float]:
    """The simulator hides the `loss` of the `rotor` of that number."""
    return {**neutral, f"loss_{round(hidden['rotor'])}": hidden["loss"]}


EFFECT = Effect(
    name="rotor_damage",
    title="one rotor weaker: torque and thrust loss",
    stage=Stage.THRUST,
    formula=formula,
    parameters=tuple(
        Parameter(
            f"loss_{i}",
            "1",
            f"share of the thrust that rotor {i} lacks",
            0.0,
            0.1,
            0.0,
            0.7,
            grows=f"rotor {i} has lost {{:.0%}} of its thrust",
            shrinks=f"rotor {i} has regained {{:.0%}} of its thrust",
            rotor=i,
            drifts=1.0,
        )
        for i in range(1, MOST_ROTORS + 1)
    ),
    needs=("angular_velocity", "thrust_command"),
    manoeuvre="rolls, pitches and yaws both ways with some change of thrust: the rotors must take different loads",
    citation="thrust c_i w_i² of each rotor with c_i its own (Mahony, Kumar, Corke 2012, section on dynamics); "
    "multiplicative loss of effectiveness as in Freddi, Lanzon, Longhi 2011 (IFAC World Congress)",
    confounded_with=("com_offset", "thrust_gain"),
    needs_any=("rotor_speed", "motor_command"),
    rotational=True,
    seen_as=("thrust_gain",),
    exclusive=True,
    in_shares=ROTOR_SHARE,
    truth_for=truth,
    on_airframe=lambda airframe, values: airframe.with_(
        strength=tuple(1.0 - values[f"loss_{i}"] for i in (1, 2, 3, 4))
    ),
)
