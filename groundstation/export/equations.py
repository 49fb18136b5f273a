"""The model as equations of motion in symbols: from state, command and parameters to the derivative of the state.

World ENU, body FLU, SI units. The state is position and velocity in the world, quaternion w x y z body to world; with a
lag of the rotors their speed over hover speed (1 where the believed thrust is the weight); with a lag of the body rates
these, rad/s. The inputs are the normalised collective command and the body rates asked for, rad/s. The parameters are
those of the model's effects, and the battery's voltage where an effect reads it.

The effects' own formulas are traced: what is fitted is what is written down.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import sympy

from trueflight.groundstation.export.symbols import NoSymbol, Symbolic
from trueflight.groundstation.export.target import NOT, WHOLE, Line, airframe_of
from trueflight.models.array import Array
from trueflight.models.effect import Effect, Motion, Stage
from trueflight.models.effects import EXACT_ROTATION
from trueflight.models.errors import InputError
from trueflight.models.model import Model
from trueflight.models.prediction import acceleration, apply_effects
from trueflight.models.vehicle import GRAVITY

_TRACED = (Stage.THRUST, Stage.ROTATION, Stage.AIR, Stage.FORCE)
VOLTAGE = "voltage"


@dataclass(frozen=True)
class Equations:
    """`derivative` of the `state`, in symbols of `state`, `inputs` and `parameters`; these with their values. `lines`
    has what became of each effect."""

    state: tuple[sympy.Symbol, ...]
    inputs: tuple[sympy.Symbol, ...]
    parameters: Mapping[sympy.Symbol, float]
    derivative: tuple[sympy.Expr, ...]
    lines: tuple[Line, ...]


def equations(model: Model) -> Equations:
    """The equations of a model. Raises `InputError` for an effect of the user's own that cannot be traced."""
    airframe = airframe_of(model)
    state = list(_symbols("px py pz vx vy vz qw qx qy qz"))
    height, velocity, quaternion = state[2], tuple(state[3:6]), tuple(state[6:10])
    command, *asked = inputs = _symbols("thrust_command p_command q_command r_command")
    ratio = command / model.vehicle.hover_thrust
    target = sympy.Max(ratio, 0)
    target = sympy.sqrt(target) if model.vehicle.thrust_model == "linear" else target
    speed, rates = target, list(asked)
    rotor_dot: list[sympy.Expr] = []
    rates_dot: list[sympy.Expr] = []
    if airframe.lag > 0.0:
        (speed,) = _symbols("rotor_speed")
        state.append(speed)
        rotor_dot = [(target - speed) / airframe.lag]
    if airframe.rate_lag > 0.0:
        rates = list(_symbols("p q r"))
        state += rates
        rates_dot = [(want - rate) / airframe.rate_lag for want, rate in zip(asked, rates, strict=True)]
    (voltage,) = _symbols(VOLTAGE)
    motion = _motion(model, velocity, quaternion, height, GRAVITY * speed**2, voltage)
    chain, values, lines = _chain(model)
    whole = cast(Symbolic, traced(lambda: acceleration(apply_effects(motion, chain)), motion, chain))
    moved = tuple(sympy.sympify(one) for one in whole.values[0])
    parameters = dict(values)
    if any(voltage in e.free_symbols for e in moved):
        parameters[voltage] = model.vehicle.nominal_voltage
    return Equations(
        tuple(state),
        tuple(inputs),
        parameters,
        (*velocity, *moved, *_turning(quaternion, rates), *rotor_dot, *rates_dot),
        lines,
    )


def _symbols(names: str) -> tuple[sympy.Symbol, ...]:
    return tuple(sympy.Symbol(name, real=True) for name in names.split())


def _turning(q: tuple[sympy.Symbol, ...], rates: list[sympy.Expr]) -> tuple[sympy.Expr, ...]:
    """Derivative of a quaternion (w x y z, body to world) under body rates."""
    w, x, y, z = q
    a, b, c = rates
    return (
        (-x * a - y * b - z * c) / 2,
        (w * a + y * c - z * b) / 2,
        (w * b - x * c + z * a) / 2,
        (w * c + x * b - y * a) / 2,
    )


def _motion(
    model: Model, v: tuple[Any, ...], q: tuple[Any, ...], height: Any, thrust: Any, voltage: Any
) -> Motion:
    """One sample as effects see it. The heading frame is the world's, with a yaw of 0: the formulas are the same in
    every frame that is upright."""
    w, x, y, z = q
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    zero, one = _array([sympy.Integer(0)]), _array([sympy.Integer(1)])
    nothing = _array([[sympy.Integer(0)] * 3])
    acting = _array([thrust])
    return Motion(
        vehicle=model.vehicle,
        dt=0.0,
        command=acting,
        thrust=acting,
        force=nothing,
        reading=nothing,
        rotation=_array([rotation]),
        euler=(zero, zero),
        air_velocity=_array([list(v)]),
        cos_yaw=one,
        sin_yaw=zero,
        height=_array([height]),
        voltage=_array([voltage]),
    )


def _array(values: Any) -> Array:
    return cast(Array, Symbolic(np.array(values, dtype=object)))


def _chain(
    model: Model,
) -> tuple[list[tuple[Effect, dict[str, Any]]], dict[sympy.Symbol, float], tuple[Line, ...]]:
    """Effects that are traced, with symbols for their numbers; the numbers; a line for every effect."""
    chain: list[tuple[Effect, dict[str, Any]]] = []
    numbers: dict[sympy.Symbol, float] = {}
    lines = []
    for effect, values in model.effect_chain():
        if effect.stage not in _TRACED:
            lines.append(_otherwise(effect))
            continue
        symbols = {
            name: sympy.Symbol(re.sub(r"\W", "_", f"{effect.name}_{name}"), real=True) for name in values
        }
        numbers |= {symbols[name]: float(value) for name, value in values.items()}
        chain.append((effect, {name: Symbolic(symbol) for name, symbol in symbols.items()}))
        lines.append(Line(effect.name, WHOLE, "its own formula, its numbers are parameters"))
    if not model.rotates_exactly:
        chain.append((EXACT_ROTATION, {}))
    if model.network is not None:
        lines.append(Line("network", NOT, "no formula a person could read; export to ONNX, which holds it"))
    return chain, numbers, tuple(lines)


def _otherwise(effect: Effect) -> Line:
    if effect.stage is Stage.SENSOR:
        return Line(effect.name, NOT, "an error of the sensor, not of the motion")
    if effect.stage is Stage.TORQUE:
        return Line(effect.name, NOT, "acts on the torque, and the body rates are inputs here")
    if effect.shifts_clock:
        return Line(effect.name, NOT, "a delay is no differential equation; shift the inputs by it")
    return Line(
        effect.name, WHOLE, "a state of its own behind the inputs, without its delay where it has one"
    )


def traced(
    whole: Callable[[], Array], motion: Motion, chain: Sequence[tuple[Effect, Mapping[str, Any]]]
) -> Array:
    """What `whole` makes of a `motion` in symbols, with every effect of the `chain` tried by itself first, so that a
    message names the one that cannot be traced. Raises `InputError` with it."""
    for effect, values in chain:
        try:
            effect.apply(motion.with_(thrust_acceleration=motion.force), values)
        except NoSymbol as error:
            raise InputError(f"{effect.name}: {error} has no symbolic form; export to onnx instead") from None
        except Exception as error:  # noqa: BLE001 - a user's formula may fail in any way
            raise InputError(
                f"{effect.name}: its formula takes no symbols ({type(error).__name__}: {error}); write it with "
                "array_namespace alone, or export to onnx instead"
            ) from None
    return whole()
