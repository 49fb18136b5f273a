"""A flight in memory: columns of numpy arrays, whatever file they came from."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle

COLUMNS: dict[str, tuple[tuple[str, ...], str, str]] = {
    # attribute: (names in the project's own CSV, unit, what it is)
    "position": (("position_x", "position_y", "position_z"), "m", "position, world ENU"),
    "velocity": (("velocity_x", "velocity_y", "velocity_z"), "m/s", "velocity, world ENU"),
    "quaternion": (
        ("quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"),
        "1",
        "attitude, body FLU to world ENU",
    ),
    "angular_velocity": (
        ("angular_velocity_x", "angular_velocity_y", "angular_velocity_z"),
        "rad/s",
        "angular velocity, body FLU",
    ),
    "specific_force": (
        ("specific_force_x", "specific_force_y", "specific_force_z"),
        "m/s^2",
        "accelerometer's specific force, body FLU",
    ),
    "thrust_command": (("thrust_command",), "1", "normalised collective command"),
    "body_rate_command": (
        ("body_rate_command_x", "body_rate_command_y", "body_rate_command_z"),
        "rad/s",
        "commanded body rates, FLU",
    ),
    "battery_voltage": (("battery_voltage",), "V", "battery voltage"),
    "position_reference": (
        ("position_reference_x", "position_reference_y", "position_reference_z"),
        "m",
        "reference position, world ENU",
    ),
    "velocity_reference": (
        ("velocity_reference_x", "velocity_reference_y", "velocity_reference_z"),
        "m/s",
        "reference velocity, world ENU",
    ),
    "acceleration_reference": (
        ("acceleration_reference_x", "acceleration_reference_y", "acceleration_reference_z"),
        "m/s^2",
        "reference acceleration, world ENU",
    ),
    "yaw_reference": (("yaw_reference",), "rad", "reference yaw"),
    "rotor_speed": (
        ("rotor_speed_1", "rotor_speed_2", "rotor_speed_3", "rotor_speed_4"),
        "rad/s",
        "rotor speeds, in the order of rotor_positions",
    ),
    "motor_command": (
        ("motor_command_1", "motor_command_2", "motor_command_3", "motor_command_4"),
        "1",
        "normalised motor commands, in the order of rotor_positions",
    ),
}
"""Every column a flight may have, besides `t` (s). Scalars have shape (N,), the others (N, k)."""
EACH_ROTOR = ("rotor_speed", "motor_command")
"""Columns of one value a rotor; `COLUMNS` names those of four."""
MOST_ROTORS = 12
"""Rotors of a flight: PX4 allocates no more."""


def column_names(attribute: str, width: int) -> tuple[str, ...]:
    """Names in the project's own CSV of the columns (N, `width`) of an attribute."""
    if attribute in EACH_ROTOR:
        return tuple(f"{attribute}_{i + 1}" for i in range(width))
    return COLUMNS[attribute][0]


@dataclass(frozen=True)
class Check:
    """One pair of columns that physics ties together, compared.

    `verdict` is "agrees", "undone" (`text` says what), "weak" (a warning), "contradicts" (a refusal), "cannot tell"
    (the flight moves too little). `left` is the share of the motion's energy by which the two differ, NaN where nothing
    moves. `text` is one sentence, `mapping` the lines of a mapping that mend it. `angle` in rad and `late` in s, NaN
    where neither is meant.
    """

    pair: str
    verdict: str
    left: float
    text: str = ""
    mapping: str = ""
    angle: float = float("nan")
    late: float = float("nan")


@dataclass(frozen=True)
class Flight:
    """One flight, in columns.

    `t` (N,) in s, strictly increasing; every other column has N rows or is None. World ENU, body FLU, quaternion
    w, x, y, z body to world, SI units. `flying` (N,) bool marks the samples to analyse (in the air, under the
    recorded commands). `accelerometer` is False where `specific_force` was differentiated from the trajectory or is an
    estimator's; `bandwidth` is then its bandwidth in Hz, otherwise None. `sensor_rate` is the rate in Hz at which the
    accelerometer (or velocity) has new values, where the log repeats them; otherwise None.
    `unlogged` names the angles of the attitude ("pitch") that were not logged but made of other columns: what is
    differentiated from them tells nothing.
    `origin` is the file, `data_hash` its SHA-256.
    `notes` tells what the reader had to do (resampling, gaps, cut takeoff), `consistency` which of its columns agree.
    """

    name: str
    vehicle: Vehicle
    t: np.ndarray
    position: np.ndarray | None = None
    velocity: np.ndarray | None = None
    quaternion: np.ndarray | None = None
    angular_velocity: np.ndarray | None = None
    specific_force: np.ndarray | None = None
    thrust_command: np.ndarray | None = None
    body_rate_command: np.ndarray | None = None
    battery_voltage: np.ndarray | None = None
    position_reference: np.ndarray | None = None
    velocity_reference: np.ndarray | None = None
    acceleration_reference: np.ndarray | None = None
    yaw_reference: np.ndarray | None = None
    rotor_speed: np.ndarray | None = None
    motor_command: np.ndarray | None = None
    flying: np.ndarray | None = None
    accelerometer: bool = True
    bandwidth: float | None = None
    sensor_rate: float | None = None
    unlogged: tuple[str, ...] = ()
    origin: str = ""
    data_hash: str = ""
    notes: tuple[str, ...] = ()
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    consistency: tuple[Check, ...] = ()

    def __len__(self) -> int:
        return len(self.t)

    def __post_init__(self) -> None:
        for name in COLUMNS:
            column = getattr(self, name)
            if column is not None and len(column) != len(self.t):
                raise ValueError(f"column '{name}' has {len(column)} rows, t has {len(self.t)}")

    @property
    def dt(self) -> float:
        """Median sample period, s."""
        return float(np.median(np.diff(self.t)))

    @property
    def duration(self) -> float:
        """Time from the first to the last sample, s."""
        return float(self.t[-1] - self.t[0])

    def has(self, *names: str) -> bool:
        """Whether the flight has all of these columns."""
        return all(getattr(self, name) is not None for name in names)

    def column(self, name: str) -> np.ndarray:
        """A column that must be there; raises `InputError` with what to do where it is not."""
        value = getattr(self, name)
        if value is None:
            names, unit, what = COLUMNS[name]
            raise InputError(
                f"{self.origin or self.name}: {what} is missing; add the columns {', '.join(names)} ({unit}) "
                "or map yours to them with --mapping"
            )
        return value

    def part(self, where: slice | np.ndarray) -> Flight:
        """The flight restricted to some of its samples (a slice or a boolean mask (N,))."""
        changes: dict[str, object] = {
            name: getattr(self, name)[where]
            for name in (*COLUMNS, "t", "flying")
            if getattr(self, name) is not None
        }
        changes["extra"] = {name: column[where] for name, column in self.extra.items()}
        return replace(self, **changes)  # type: ignore[arg-type]
