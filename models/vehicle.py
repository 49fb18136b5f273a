"""What its owner believes about a vehicle: `vehicle.toml`."""

from __future__ import annotations

import difflib
import math
import re
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from trueflight.models.errors import InputError
from trueflight.models.outside import is_number, numbers, read_toml, shown
from trueflight.models.shipped import QUAD5 as QUAD5  # where users look for it

GRAVITY = 9.81
"""Standard gravity of the project, m/s²."""

THRUST_MODELS = ("linear", "quadratic")

LONGEST_NAME = 64
"""Bytes of a vehicle's name."""
MOST_ROTORS = 32
"""Rotors of a vehicle file; more is damage."""

_REQUIRED = ("name", "mass", "hover_thrust")
# Physical sense of each number, wide: from a nano quadrotor (10 g) to a heavy lifter (100 kg).
_RANGES = {
    "mass": (0.005, 150.0, "kg"),
    "rotor_radius": (0.005, 2.0, "m"),
    "rotor_height": (0.0, 2.0, "m"),
    "hover_thrust": (0.02, 0.98, "of full collective"),
    "nominal_voltage": (1.0, 1000.0, "V"),
    "command_delay": (0.0, 0.5, "s"),
    "motor_time_constant": (0.0, 1.0, "s"),
    "rate_time_constant": (0.0, 1.0, "s"),
}


@dataclass(frozen=True)
class Vehicle:
    """A quadrotor as its owner believes it to be.

    World ENU, body FLU, SI units. `rotor_positions` (4, 3) in m from the centre of mass; `rotor_directions` (4,)
    is +1 for a rotor that turns counter-clockwise seen from above; `hover_thrust` is the normalised collective
    command that holds a hover at `nominal_voltage`; `command_delay` and `motor_time_constant` in s are what is
    known about the path from command to thrust, `rate_time_constant` in s about the closed loop of the body rates
    (0: nothing). `rotor_height` in m is that of the rotors above the ground where the recorded z is 0: a companion's z
    is 0 where the vehicle stands. `thrust_model` is the assumed map from normalised command u to thrust in N:
    "linear" `m g u / hover_thrust`, "quadratic" `m g (u / hover_thrust)²`.
    """

    name: str
    mass: float
    hover_thrust: float
    inertia: tuple[float, ...] = (0.0, 0.0, 0.0)
    rotor_radius: float = 0.1
    rotor_positions: tuple[tuple[float, ...], ...] = ()
    rotor_directions: tuple[int, ...] = ()
    thrust_model: str = "linear"
    nominal_voltage: float = 16.0
    command_delay: float = 0.0
    motor_time_constant: float = 0.0
    rate_time_constant: float = 0.0
    rotor_height: float = 0.0
    source: str = field(default="", compare=False)

    @property
    def weight(self) -> float:
        """Weight in N."""
        return self.mass * GRAVITY

    def thrust(self, command: np.ndarray) -> np.ndarray:
        """Believed collective thrust in N of a normalised command (any shape)."""
        ratio = np.asarray(command, dtype=float) / self.hover_thrust
        return self.weight * (ratio if self.thrust_model == "linear" else np.sign(ratio) * ratio**2)

    def command(self, thrust: float) -> float:
        """Normalised collective command believed to give `thrust` (N); the inverse of `thrust()`, not limited."""
        ratio = thrust / self.weight
        if self.thrust_model == "linear":
            return self.hover_thrust * ratio
        return self.hover_thrust * math.copysign(math.sqrt(abs(ratio)), ratio)


def load_vehicle(path: str | Path) -> Vehicle:
    """Read and check a `vehicle.toml`.

    Raises `InputError` with file and field for a missing file, a syntax error, a misspelt or missing key, a wrong
    type, or a value without physical sense (a mass of 500).
    """
    return vehicle_from_table(read_toml(Path(path), "the vehicle file", "pass --vehicle FILE"), str(path))


def check_name(name: object, where: str) -> str:
    """A name that may be part of a Zenoh key and of a file's name; raises `InputError` for any other."""
    if isinstance(name, str) and re.fullmatch(r"\w[\w.+-]*", name) and len(name.encode()) <= LONGEST_NAME:
        return name
    raise InputError(
        f"{where} is {shown(name)}; it must begin with a letter or digit and hold only letters, digits, '-', '_', '.' "
        f"and '+', {LONGEST_NAME} bytes at most (it is part of Zenoh keys and file names)"
    )


def vehicle_from_table(table: dict[str, object], where: str) -> Vehicle:
    """Check the table of a vehicle file; `where` names it in error messages."""
    known = {f.name for f in fields(Vehicle)} - {"source"}
    for key in table:
        if key not in known:
            close = difflib.get_close_matches(key, sorted(known), 1)
            hint = f"did you mean '{close[0]}'?" if close else f"known keys: {', '.join(sorted(known))}"
            raise InputError(f"{where}: unknown key '{key}'; {hint}")
    for key in _REQUIRED:
        if key not in table:
            raise InputError(f"{where}: '{key}' is missing; add it")
    values: dict[str, object] = {}
    for key, value in table.items():
        if key in ("name", "thrust_model"):
            if not isinstance(value, str) or not value.strip():
                raise InputError(f"{where}: '{key}' must be a text, not {shown(value)}")
            values[key] = check_name(value, f"{where}: name") if key == "name" else value
        elif key in ("inertia", "rotor_positions", "rotor_directions"):
            values[key] = _array(where, key, value)
        else:
            values[key] = _number(where, key, value)
    vehicle = Vehicle(**values, source=where)  # type: ignore[arg-type]
    if vehicle.thrust_model not in THRUST_MODELS:
        raise InputError(
            f"{where}: thrust_model is '{vehicle.thrust_model}'; it must be one of {', '.join(THRUST_MODELS)}"
        )
    if len(vehicle.rotor_positions) != len(vehicle.rotor_directions):
        raise InputError(
            f"{where}: {len(vehicle.rotor_positions)} rotor_positions but {len(vehicle.rotor_directions)} "
            "rotor_directions; give one of each a rotor"
        )
    return vehicle


def _number(where: str, key: str, value: object) -> float:
    if not is_number(value):
        raise InputError(f"{where}: '{key}' must be a number, not {shown(value)}")
    number = float(value)  # type: ignore[arg-type]
    low, high, unit = _RANGES[key]
    if not low <= number <= high:
        raise InputError(
            f"{where}: {key} = {number:g} is outside {low:g} to {high:g} {unit}; check value and unit"
        )
    return number


def _array(where: str, key: str, value: object) -> object:
    if key == "inertia":
        array = numbers(value, (3,))
        if array is None or not (np.all(array >= 0) and np.all(array < 100)):
            raise InputError(f"{where}: 'inertia' must be three diagonal moments in kg m^2, each 0 to 100")
        return tuple(float(x) for x in array)
    if key == "rotor_positions":
        array = numbers(value, (None, 3))
        if array is None or len(array) > MOST_ROTORS or not np.all(np.abs(array) < 10):
            raise InputError(f"{where}: 'rotor_positions' must be a list of [x, y, z] in m, each below 10")
        return tuple(tuple(float(x) for x in row) for row in array)
    array = numbers(value, (None,))
    if array is None or len(array) > MOST_ROTORS or not np.all(np.isin(array, (-1, 1))):
        raise InputError(f"{where}: 'rotor_directions' must be a list of 1 and -1")
    return tuple(int(x) for x in array)
