"""What a target of an export is, and what it says of each effect of a model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from trueflight.models.airframe import MEANINGS, Airframe, believed_airframe
from trueflight.models.effect import Effect, Stage
from trueflight.models.errors import InputError
from trueflight.models.model import Model
from trueflight.models.vehicle import Vehicle

WHOLE, ROUGHLY, NOT = "whole", "roughly", "not"
"""How much of an effect a target holds."""

NO_LAG = 0.001
"""s, for targets that divide by the time constant of the rotors: far below the period of any control loop."""

AIR_DENSITY = 1.225
"""kg/m³ at sea level."""
_THRUST_COEFFICIENT, _TORQUE_PER_DIAMETER = 0.1, 0.07
"""Usual for small fixed-pitch propellers: thrust = C_T rho n² D⁴; drag torque over thrust and diameter, C_P / 2 pi C_T.
"""


@dataclass(frozen=True)
class Line:
    """What became of one effect: `held` is WHOLE, ROUGHLY or NOT; `how` says where it went, or why it did not."""

    effect: str
    held: str
    how: str


@dataclass(frozen=True)
class Written:
    """The text of a file, a line for each effect of the model, and notes: what was assumed, what to set elsewhere."""

    text: str
    lines: tuple[Line, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Known:
    """What no vehicle file tells and some targets need: `hover_speed` of the rotors in rad/s, and `torque_length` in m,
    the drag torque of a rotor over its thrust. None is not known: a usual propeller's is taken, and a note says so."""

    hover_speed: float | None = None
    torque_length: float | None = None


@dataclass(frozen=True)
class Target:
    """A simulator, autopilot or solver: its `name` on the command line, a `title`, how its files end, and what writes
    one. `write` raises `InputError` where the model's vehicle lacks what the target needs."""

    name: str
    title: str
    ending: str
    write: Callable[[Model, Known], Written]


@dataclass(frozen=True)
class Holding:
    """How a target holds one number of an airframe: whole or roughly, and where."""

    how: str
    held: str = WHOLE


Holdings = Mapping[str, Holding]
"""By the fields of `Airframe`; what is left out the target does not hold."""


@dataclass(frozen=True)
class Rotors:
    """An airframe's rotors with the numbers that turn thrust into speed and torque.

    `hover_speed` in rad/s is where they carry the weight; `thrust_constant` in N s² is thrust over speed squared of
    one whole rotor, `torque_length` in m its drag torque over its thrust; `full_command` is that of most
    thrust, at `full_speed` in rad/s; `positions` in m, body FLU, from the centre of mass as found.
    """

    hover_speed: float
    thrust_constant: float
    torque_length: float
    full_command: float
    full_speed: float
    positions: tuple[tuple[float, float, float], ...]


def airframe_of(model: Model) -> Airframe:
    """The airframe of a model: the vehicle file's, with every effect that has numbers there."""
    airframe = believed_airframe(model.vehicle)
    for effect, values in model.effect_chain():
        if effect.on_airframe is not None:
            airframe = effect.on_airframe(airframe, values)
    return airframe


def rotors_of(airframe: Airframe, known: Known) -> tuple[Rotors, tuple[str, ...]]:
    """The rotors of an airframe, and a note for each number that had to be assumed. Raises `InputError` where the
    vehicle file has no rotors, or where no command lifts the vehicle."""
    vehicle = airframe.vehicle
    count = len(vehicle.rotor_positions)
    if not count:
        raise InputError(f"{told(vehicle)}: no rotor_positions; add them, and 'model add' anew")
    top = airframe.top()
    full = airframe.thrust(top)
    if not full > vehicle.weight:
        raise InputError(
            f"{told(vehicle)}: by this model the rotors give {full:.3g} N at most and the vehicle weighs "
            f"{vehicle.weight:.3g} N; check mass, hover_thrust and the fit of its effects"
        )
    notes = []
    if top < 1.0:
        notes.append(
            f"thrust: the curve falls beyond a command of {top:.2g}, where the flights that it is from were not; that "
            "command stands for full"
        )
    speed, length = known.hover_speed, known.torque_length
    diameter = 2.0 * vehicle.rotor_radius
    if speed is None:
        turns = math.sqrt(vehicle.weight / count / (_THRUST_COEFFICIENT * AIR_DENSITY * diameter**4))
        speed = 2.0 * math.pi * turns
        notes.append(
            f"rotors: {speed:.0f} rad/s in a hover is a usual propeller's of this size, not measured; --hover-speed "
            "sets it (forces do not depend on it)"
        )
    if length is None:
        length = _TORQUE_PER_DIAMETER * diameter
        notes.append(
            f"rotors: a drag torque of {length:.3g} m times thrust is a usual propeller's, not measured; "
            "--torque-length sets it (yaw depends on it)"
        )
    constant = vehicle.weight / count / speed**2
    x, y = airframe.centre_of_mass
    positions = tuple((a - x, b - y, c) for a, b, c in vehicle.rotor_positions)
    fastest = speed * math.sqrt(full / vehicle.weight)
    return Rotors(speed, constant, length, top, fastest, positions), tuple(notes)


def moments(vehicle: Vehicle) -> tuple[float, float, float]:
    """The vehicle's moments of inertia, kg m². Raises `InputError` where its file has none, or no rigid body's."""
    a, b, c = vehicle.inertia
    if not min(a, b, c) > 0.0 or a + b < c or b + c < a or c + a < b:
        raise InputError(
            f"{told(vehicle)}: inertia {list(vehicle.inertia)} is no rigid body's; put three moments in kg m^2 "
            "into the vehicle file, and 'model add' anew"
        )
    return a, b, c


def told(vehicle: Vehicle) -> str:
    """What names a vehicle in a message."""
    return vehicle.source or f"vehicle '{vehicle.name}'"


def hover_command(airframe: Airframe) -> float:
    """The normalised command at which thrust is weight; that of most thrust where there is none."""
    low, high = 0.0, airframe.top()
    for _ in range(60):  # up to there the curve rises: halving finds it to the last digit
        middle = 0.5 * (low + high)
        low, high = (middle, high) if airframe.thrust(middle) < airframe.vehicle.weight else (low, middle)
    return high


def lines_of(model: Model, holdings: Holdings, title: str) -> tuple[Line, ...]:
    """What became of each effect of the model, and of its network, in a target that holds these numbers."""
    believed = believed_airframe(model.vehicle)
    lines = [_line(effect, values, believed, holdings, title) for effect, values in model.effect_chain()]
    if model.network is not None:
        lines.append(Line("network", NOT, f"{title} holds no network; export to ONNX, which does"))
    return tuple(lines)


def _line(
    effect: Effect, values: Mapping[str, float], believed: Airframe, holdings: Holdings, title: str
) -> Line:
    if effect.stage is Stage.SENSOR:
        return Line(
            effect.name, NOT, "an error of the sensor, not of the vehicle; put it into the sensor there"
        )
    if effect.on_airframe is None:
        return Line(effect.name, NOT, f"{title} has no number for it ({effect.title})")
    changed = effect.on_airframe(believed, values).changed_from(believed)
    if not changed:
        said = "exact in every simulator" if not effect.parameters else "its numbers change nothing"
        return Line(effect.name, WHOLE, said)
    held = [holdings.get(name) for name in changed]
    known = [one for one in held if one is not None]
    missing = [MEANINGS[name] for name, one in zip(changed, held, strict=True) if one is None]
    if not known:
        return Line(effect.name, NOT, f"{title} has no number for the {', '.join(missing)}")
    rough = missing or any(one.held == ROUGHLY for one in known)
    said = "; ".join(one.how for one in known) + "".join(f"; not the {what}" for what in missing)
    return Line(effect.name, ROUGHLY if rough else WHOLE, said)


def header(model: Model, lines: tuple[Line, ...], notes: tuple[str, ...]) -> tuple[str, ...]:
    """What stands at the top of a file as comments: where it is from, what it holds and what not, what was assumed."""
    what = f"{model.vehicle.name}, {model.label}, written by trueflight"
    marks = {WHOLE: "holds", ROUGHLY: "holds roughly", NOT: "does NOT hold"}
    return (what, *(f"{marks[line.held]} {line.effect}: {line.how}" for line in lines), *notes)
