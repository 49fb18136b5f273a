"""One rotor gives less thrust than the others at the same speed."""

from collections.abc import Mapping

from array_api_compat import array_namespace

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, loss_1: Array, loss_2: Array, loss_3: Array, loss_4: Array) -> Motion:
    """`f_i' = (1 - loss_i) f_i` of rotor i: its torque about the centre of mass and its thrust are lost together.

    `loss_1`, `loss_2`, `loss_3` and `loss_4` are shares, 0 to 1, in the order of the vehicle's rotor_positions.

    Where nothing tells the rotors apart, the rotor is believed to be driven so much harder that roll, pitch and yaw
    stay balanced, and the thrust of all is `4 (1 - loss) / (4 - 3 loss)` of the commanded.
    """
    losses = (loss_1, loss_2, loss_3, loss_4)
    if motion.rotor_thrust is None:
        factor = 1.0
        for loss in losses:
            factor = factor * 4.0 * (1.0 - loss) / (4.0 - 3.0 * loss)
        return motion.with_(thrust=motion.thrust * factor)
    xp = array_namespace(motion.rotor_thrust)
    each = [(1.0 - loss) * motion.rotor_thrust[:, i] for i, loss in enumerate(losses)]
    each += [motion.rotor_thrust[:, i] for i in range(len(losses), motion.rotor_thrust.shape[1])]
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
        )
        for i in (1, 2, 3, 4)
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
    truth_for=truth,
)
