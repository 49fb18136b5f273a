"""Foreign tables through a column mapping: which column is what, in which unit and frame.

A mapping is a TOML file with one table for each quantity:

    frame = "ned_frd"            # of the whole file; "enu_flu" unless told otherwise
    [time]
    column = "timestamp"
    unit = "us"
    [quaternion]
    columns = ["qx", "qy", "qz", "qw"]
    order = "xyzw"               # w, x, y, z unless told otherwise
    [thrust_command]
    column = "thrust_N"
    unit = "N"                   # through mass, hover_thrust and thrust_model of the vehicle file

Quantities are the attributes of `Flight` (`models.flight.COLUMNS`), and
* `[attitude]`: `roll`, `pitch`, `yaw` name columns of Z-Y-X angles, instead of a quaternion. A log without
  pitch says `pitch = "from_acceleration"`: the pitch that explains the forward world acceleration by thrust
  alone. The x axis then agrees with any model by construction; height and roll stay measured.
* `[world_acceleration]`: kinematic acceleration in the world, gravity not in it; it becomes the specific
  force through the attitude.

Each takes `unit`, `sign` (a number, or one for each column), `frame`; a quaternion also `order`, `inverse = true` where
it turns world into body, and `body = "frd"` where only its body is of that frame. What the reader found wrong is
mended by
* `turned = 20` (vectors): the log's frame is turned by so many degrees about z, anticlockwise from above; it is
  turned back;
* `axes = ["y", "-x", "z"]` (vectors): our x, y, z are these axes of the log's; `axes = "body"` for a velocity along the
  body's axes;
* `late = 0.1`: the values come so many seconds after what they tell, and are shifted back;
* `leave_out = true`: as if the quantity had not been logged;
* `from = 12.5` and `until = 60` of `[time]`: what is before and after, in s, is cut off.

A mapping without the column of `[time]` names none: it corrects what is read already, from a table in the project's
own names or from a log. Which topics of a log are read, `reading.sources` tells. One key of it is a line that a command
takes as it is: `--mapping 'velocity.turned = 20'`.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeGuard

import numpy as np

from trueflight.groundstation.reading.faults import about_z
from trueflight.groundstation.reading.sources import Sources, sources_in
from trueflight.groundstation.reading.table import Table
from trueflight.models.errors import InputError
from trueflight.models.flight import COLUMNS, EACH_ROTOR, MOST_ROTORS
from trueflight.models.frames import (
    enu_flu_from_ned_frd,
    enu_from_ned,
    flu_from_frd,
    heading_from_world,
    quaternion_from_euler,
    rotate,
    rotate_inverse,
)
from trueflight.models.outside import numbers, read_toml, shown, toml_table
from trueflight.models.vehicle import GRAVITY, Vehicle

FRAMES = ("enu_flu", "ned_frd")

Given = str | Path | Sequence[str | Path] | None
"""A mapping as it is given: a file, a line of TOML, or some of both, of which the later ones hold."""

UNITS: dict[str, dict[str, tuple[float, float]]] = {
    # unit of the project: {unit in the file: (factor, offset)}, value = factor * (read - offset)
    "s": {"s": (1.0, 0.0), "ms": (1e-3, 0.0), "us": (1e-6, 0.0), "ns": (1e-9, 0.0)},
    "m": {"m": (1.0, 0.0), "cm": (1e-2, 0.0), "mm": (1e-3, 0.0)},
    "m/s": {"m/s": (1.0, 0.0), "cm/s": (1e-2, 0.0), "mm/s": (1e-3, 0.0), "km/h": (1 / 3.6, 0.0)},
    "m/s^2": {"m/s^2": (1.0, 0.0), "g": (GRAVITY, 0.0), "mg": (1e-3 * GRAVITY, 0.0)},
    "rad": {"rad": (1.0, 0.0), "deg": (np.pi / 180, 0.0), "cdeg": (np.pi / 18000, 0.0)},
    "rad/s": {
        "rad/s": (1.0, 0.0),
        "deg/s": (np.pi / 180, 0.0),
        "mdeg/s": (np.pi / 180000, 0.0),
        "mrad/s": (1e-3, 0.0),
        "rpm": (np.pi / 30, 0.0),
        "rev/s": (2 * np.pi, 0.0),
    },
    "V": {"V": (1.0, 0.0), "mV": (1e-3, 0.0)},
    "1": {
        "1": (1.0, 0.0),
        "percent": (1e-2, 0.0),
        "u16": (1 / 65535, 0.0),
        "pwm": (1e-3, 1000.0),
        "dshot": (1 / 1999, 48.0),
    },
}

WORLD = ("position", "velocity", "position_reference", "velocity_reference", "acceleration_reference")
BODY = ("angular_velocity", "specific_force", "body_rate_command")
_KEYS = {"column", "columns", "unit", "sign", "frame", "late", "leave_out"}
_SPECIAL = {"time": "s", "attitude": "rad", "world_acceleration": "m/s^2"}


@dataclass(frozen=True)
class Mapping:
    """A mapping as read: `quantities` by name, each with the keys of its table; `frame` of the file, '' where it names
    none; `sources` are the topics that it chooses."""

    source: str
    frame: str
    quantities: dict[str, dict[str, object]]
    sources: Sources = field(default_factory=Sources)

    @property
    def corrects(self) -> bool:
        """Whether it says anything of a quantity."""
        return bool(self.frame or self.quantities)

    @property
    def names_columns(self) -> bool:
        """Whether it tells which column of a table is what; otherwise it corrects what was read."""
        return "column" in self.quantities.get("time", {})

    def over(self, other: Mapping | None) -> Mapping:
        """This one over `other`, key by key."""
        if other is None:
            return self
        names = [*other.quantities, *(name for name in self.quantities if name not in other.quantities)]
        merged = {n: {**other.quantities.get(n, {}), **self.quantities.get(n, {})} for n in names}
        sources = self.sources.over(other.sources)
        return Mapping(f"{other.source}, {self.source}", self.frame or other.frame, merged, sources)


@dataclass(frozen=True)
class MappedTable:
    """A foreign table in the project's names, units and frames; `extra` are the columns that nothing
    claimed, `estimated_force` whether its specific force is an estimator's and no accelerometer's, `unlogged` the
    angles of its attitude that were made of other columns."""

    t: np.ndarray
    columns: dict[str, np.ndarray]
    extra: dict[str, np.ndarray]
    notes: tuple[str, ...]
    estimated_force: bool = False
    unlogged: tuple[str, ...] = ()


def read_mappings(given: Given) -> tuple[Mapping, ...]:
    """Read and check what is given, in its order. Raises `InputError` with source and field for anything it does not
    know."""
    every = [given] if isinstance(given, str | Path) else given or []
    return tuple(load_mapping(one) for one in every)


def absolute(given: Given) -> list[str]:
    """What is given, files by their whole paths: for another process."""
    every = [given] if isinstance(given, str | Path) else given or []
    return [one if _is_line(one) else str(Path(one).resolve()) for one in every]


def _is_line(given: str | Path) -> TypeGuard[str]:
    return isinstance(given, str) and "=" in given


def merged(mappings: Sequence[Mapping]) -> Mapping | None:
    """One mapping out of several, of which the later ones hold; None out of none."""
    out = None
    for one in mappings:
        out = one.over(out)
    return out


def load_mapping(given: str | Path) -> Mapping:
    """Read and check a mapping file, or a line of one. Raises `InputError` with source and field for anything it does
    not know."""
    if _is_line(given):
        source = f"--mapping '{given}'"
        table = toml_table(given, source, "a line is like velocity.turned = 20")
    else:
        source, table = str(given), read_toml(Path(given), "the mapping")
    sources, frame = sources_in(table, source), table.pop("frame", "")
    if frame != "":
        _one_of(source, "frame", frame, FRAMES)
    known = [*COLUMNS, *_SPECIAL]
    quantities: dict[str, dict[str, object]] = {}
    for name, entry in table.items():
        if name not in known:
            raise InputError(f"{source}: unknown quantity '{name}'; {_suggestion(name, known)}")
        if not isinstance(entry, dict):
            raise InputError(f"{source}: '{name}' must be a table, [{name}] with column = \"...\"")
        allowed = (
            {"roll", "pitch", "yaw", "unit", "sign", "frame", "late", "leave_out"}
            if name == "attitude"
            else set(_KEYS)
        )
        if name == "time":
            allowed = {*_KEYS, "from", "until"} - {"leave_out"}
        if not isinstance(entry.get("leave_out", False), bool):
            given_value = shown(entry["leave_out"])
            raise InputError(f"{source}: [{name}] leave_out must be true or false, not {given_value}")
        if name == "quaternion":
            allowed |= {"order", "inverse", "body"}
        if name in (*WORLD, *BODY):
            allowed |= {"turned", "axes"}
        for key in entry:
            if key not in allowed:
                hint = _suggestion(key, sorted(allowed))
                raise InputError(f"{source}: [{name}] has an unknown key '{key}'; {hint}")
        _one_of(source, f"[{name}] frame", entry.get("frame", FRAMES[0]), FRAMES)
        quantities[name] = entry
    return Mapping(source, str(frame), quantities, sources)


def apply_mapping(table: Table, mapping: Mapping, vehicle: Vehicle) -> MappedTable:
    """Translate a table. Raises `InputError` for a column that is not there or a unit that does not fit."""
    if not mapping.names_columns:
        raise InputError(f'{mapping.source}: [time] is missing; add it with column = "..." and unit = "s"')
    used: set[str] = set()
    columns: dict[str, np.ndarray] = {}
    notes: list[str] = []
    t = _quantity(table, mapping, "time", vehicle, used, 1, "s")
    for name, entry in mapping.quantities.items():
        if name not in COLUMNS or entry.get("leave_out"):
            continue
        names, unit, _ = COLUMNS[name]
        values = _quantity(table, mapping, name, vehicle, used, len(names), unit)
        columns[name] = _in_frame(mapping, name, values)
    world = None
    if "world_acceleration" in mapping.quantities:
        values = _quantity(table, mapping, "world_acceleration", vehicle, used, 3, "m/s^2")
        world = enu_from_ned(values) if _frame(mapping, "world_acceleration") == "ned_frd" else values
    if "attitude" in mapping.quantities and not mapping.quantities["attitude"].get("leave_out"):
        columns["quaternion"], said = _attitude(table, mapping, world, used)
        notes += said
    if world is not None:
        if "quaternion" not in columns:
            raise InputError(
                f"{mapping.source}: [world_acceleration] needs an attitude to become a specific force; "
                "map [quaternion] or [attitude] as well"
            )
        columns["specific_force"] = rotate_inverse(
            columns["quaternion"], world + np.array([0.0, 0.0, GRAVITY])
        )
        notes.append("the specific force is the logged world acceleration plus gravity, in body axes")
    columns = _mended(mapping, t, columns)
    extra = {name: column for name, column in table.columns.items() if name not in used}
    made = mapping.quantities.get("attitude", {}).get("pitch") == "from_acceleration"
    unlogged = ("pitch",) if made and "quaternion" in columns else ()
    return MappedTable(t - t[0], columns, extra, tuple(notes), world is not None, unlogged)


def left_out(mapping: Mapping | None) -> set[str]:
    """The quantities, by attribute of `Flight`, that a mapping reads as if they had not been logged."""
    quantities = {} if mapping is None else mapping.quantities
    names = {name for name, entry in quantities.items() if entry.get("leave_out")}
    return names | ({"quaternion"} if "attitude" in names else set())


def units_of(mapping: Mapping | None) -> dict[str, str]:
    """The units that a mapping names, by attribute of `Flight`."""
    quantities = {} if mapping is None else mapping.quantities
    return {name: str(entry["unit"]) for name, entry in quantities.items() if "unit" in entry}


def span_of(mapping: Mapping | None) -> tuple[float, float]:
    """From when until when, s, a mapping reads a flight."""
    entry = {} if mapping is None else mapping.quantities.get("time", {})
    source = "" if mapping is None else mapping.source
    low, high = (
        _number(source, "time", key, entry[key], "s") if key in entry else end
        for key, end in (("from", -np.inf), ("until", np.inf))
    )
    if low >= high:
        raise InputError(f"{source}: [time] from = {low:g} is not before until = {high:g}")
    return low, high


def corrected_time(mapping: Mapping, t: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    """The clock (N,) in s, in the unit that a mapping tells."""
    return _in_unit(mapping, "time", t, vehicle, 1, "s") if "time" in mapping.quantities else t


def corrected(
    mapping: Mapping, t: np.ndarray, columns: dict[str, np.ndarray], vehicle: Vehicle
) -> dict[str, np.ndarray]:
    """Columns (N, ...) that were read already, by attribute of `Flight`, in the units, frames, order and time that a
    mapping tells. Raises `InputError` for a quantity that is not there, or a key that names columns."""
    out = dict(columns)
    for name, entry in mapping.quantities.items():
        if name == "time" or entry.get("leave_out"):
            continue
        column = "quaternion" if name == "attitude" else name
        if column not in columns:
            raise InputError(
                f"{mapping.source}: there is no {name} to correct; {_suggestion(name, sorted(columns))}"
            )
        if naming := {"column", "columns", "roll", "pitch", "yaw"} & set(entry):
            raise InputError(
                f"{mapping.source}: [{name}] {sorted(naming)[0]} names columns, and a mapping of columns needs [time]"
            )
    entries = {n: mapping.quantities.get(n, {}) for n in columns if n in COLUMNS}
    whole = Mapping(mapping.source, mapping.frame, entries)
    for name in entries:
        names, unit, _ = COLUMNS[name]
        count = columns[name].shape[1] if name in EACH_ROTOR else len(names)
        values = _in_unit(whole, name, columns[name], vehicle, count, unit)
        out[name] = _in_frame(whole, name, values)
    return _mended(mapping, t, out)


def _mended(mapping: Mapping, t: np.ndarray, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns turned, exchanged and shifted as the mapping says. Delays first, for a body's velocity is turned by the
    attitude of its own time."""
    out = dict(columns)
    for name, entry in mapping.quantities.items():
        if "late" in entry and (name in out or (name == "attitude" and "quaternion" in out)):
            column = "quaternion" if name == "attitude" else name
            out[column] = _shifted(t, out[column], _number(mapping.source, name, "late", entry["late"], "s"))
    for name, entry in mapping.quantities.items():
        if "turned" in entry and name in out:
            angle = np.radians(_number(mapping.source, name, "turned", entry["turned"], "degrees"))
            out[name] = out[name] @ about_z(-angle).T
        if "axes" in entry and name in out:
            out[name] = _by_axes(mapping.source, name, entry["axes"], out)
    return out


def _shifted(t: np.ndarray, column: np.ndarray, late: float) -> np.ndarray:
    """A column (N,) or (N, k) as it was `late` s later."""
    flat = column.reshape(len(t), -1)
    known = np.isfinite(t) & np.isfinite(flat.sum(axis=1))
    if known.sum() < 2:
        return column
    out = np.stack([np.interp(t + late, t[known], one[known]) for one in flat.T], -1)
    out[~known] = np.nan
    return out.reshape(column.shape)


def _by_axes(source: str, name: str, axes: object, columns: dict[str, np.ndarray]) -> np.ndarray:
    """A vector (N, 3) whose x, y, z are the given axes of the log's."""
    if axes == "body" and name in ("velocity", "velocity_reference"):
        if "quaternion" not in columns:
            raise InputError(
                f'{source}: [{name}] axes = "body" needs an attitude; map [quaternion] or [attitude]'
            )
        return rotate(columns["quaternion"], columns[name])
    words = axes if isinstance(axes, list) else []
    letters = [str(word).lstrip("-") for word in words]
    if sorted(letters) != ["x", "y", "z"]:
        body = ' or "body"' if name == "velocity" else ""
        raise InputError(
            f'{source}: [{name}] axes must be a list like ["y", "-x", "z"]{body}, not {shown(axes)}'
        )
    out = np.empty_like(columns[name])
    for k, word in enumerate(words):
        out[:, k] = (-1.0 if str(word).startswith("-") else 1.0) * columns[name][:, "xyz".index(letters[k])]
    return out


def _number(source: str, name: str, key: str, given: object, unit: str) -> float:
    value = numbers(given, ())
    if value is None:
        raise InputError(f"{source}: [{name}] {key} must be a number ({unit}), not {shown(given)}")
    return float(value)


def _quantity(
    table: Table, mapping: Mapping, name: str, vehicle: Vehicle, used: set[str], count: int, unit: str
) -> np.ndarray:
    """Values (N,) or (N, count) of one quantity in the project's unit, not yet turned into its frame."""
    entry = mapping.quantities[name]
    names = entry.get("columns", entry.get("column"))
    names = [names] if isinstance(names, str) else names
    if name in EACH_ROTOR and isinstance(names, list) and count < len(names) <= MOST_ROTORS:
        count = len(names)
    if not isinstance(names, list) or len(names) != count or not all(isinstance(n, str) for n in names):
        what = 'column = "..."' if count == 1 else f"columns = [...] with {count} names"
        raise InputError(f"{mapping.source}: [{name}] needs {what}, it has {shown(names)}")
    used.update(names)
    read = [table.column(n, f" for [{name}] of {mapping.source}") for n in names]
    values = read[0].copy() if count == 1 else np.stack(read, -1)
    return _in_unit(mapping, name, values, vehicle, count, unit)


def _in_unit(
    mapping: Mapping, name: str, values: np.ndarray, vehicle: Vehicle, count: int, unit: str
) -> np.ndarray:
    """Values (N,) or (N, count) of one quantity with the mapping's signs, in the project's `unit`."""
    entry = mapping.quantities[name]
    values = values * _signs(mapping.source, name, entry.get("sign", 1), count)
    given = entry.get("unit", unit)
    if name == "thrust_command" and given == "N":
        ratio = values / vehicle.weight
        if vehicle.thrust_model == "quadratic":
            ratio = np.sign(ratio) * np.sqrt(np.abs(ratio))
        return vehicle.hover_thrust * ratio
    factor, offset = _unit(mapping.source, name, given, unit)
    return factor * (values - offset)


def _attitude(
    table: Table, mapping: Mapping, world: np.ndarray | None, used: set[str]
) -> tuple[np.ndarray, list[str]]:
    entry, source = mapping.quantities["attitude"], mapping.source
    notes: list[str] = []
    factor, _ = _unit(source, "attitude", entry.get("unit", "rad"), "rad")
    signs = np.broadcast_to(_signs(source, "attitude", entry.get("sign", 1), 3), (3,))
    angles: dict[str, np.ndarray] = {}
    for axis, sign in zip(("roll", "pitch", "yaw"), signs, strict=True):
        name = entry.get(axis)
        if axis == "pitch" and name == "from_acceleration":
            continue
        if not isinstance(name, str):
            raise InputError(f'{source}: [attitude] needs {axis} = "column", it has {shown(name)}')
        used.add(name)
        angles[axis] = sign * factor * table.column(name, f" for [attitude] of {source}")
        high = float(np.nanquantile(np.abs(angles[axis]), 0.99)) if axis != "yaw" else 0.0
        if high > 2 * np.pi:
            raise InputError(
                f"{table.origin}: {axis} in '{name}' reaches {high:.0f} rad; is it in degrees? "
                f'Set unit = "deg" in [attitude] of {source}'
            )
    if "pitch" not in angles:
        if world is None:
            raise InputError(
                f'{source}: pitch = "from_acceleration" needs [world_acceleration]; map it, or name a '
                "pitch column"
            )
        forward = heading_from_world(world, angles["yaw"])
        angles["pitch"] = np.arctan2(forward[:, 0], np.maximum(forward[:, 2] + GRAVITY, 1e-3))
        notes.append("pitch is not logged: taken from the forward acceleration, so the x axis shows no error")
    quaternion = quaternion_from_euler(np.stack([angles[a] for a in ("roll", "pitch", "yaw")], -1))
    if _frame(mapping, "attitude") == "ned_frd":
        quaternion = enu_flu_from_ned_frd(quaternion)
    return quaternion, notes


def _in_frame(mapping: Mapping, name: str, values: np.ndarray) -> np.ndarray:
    """Values of one quantity in world ENU or body FLU, quaternions as w, x, y, z body to world."""
    ned = _frame(mapping, name) == "ned_frd"
    if name == "quaternion":
        entry = mapping.quantities[name]
        order = entry.get("order", "wxyz")
        _one_of(mapping.source, "[quaternion] order", order, ("wxyz", "xyzw"))
        values = values[:, [3, 0, 1, 2]] if order == "xyzw" else values
        values = values * [1.0, -1.0, -1.0, -1.0] if entry.get("inverse", False) else values
        body = entry.get("body", "flu")
        _one_of(mapping.source, "[quaternion] body", body, ("flu", "frd"))
        values = values * [1.0, 1.0, -1.0, -1.0] if body == "frd" else values
        return enu_flu_from_ned_frd(values) if ned else values
    if ned and (name in BODY or mapping.quantities[name].get("axes") == "body"):
        return flu_from_frd(values)
    if ned and name in WORLD:
        return enu_from_ned(values)
    if ned and name == "yaw_reference":
        return np.pi / 2 - values
    return values


def _frame(mapping: Mapping, name: str) -> str:
    return str(mapping.quantities[name].get("frame", mapping.frame or FRAMES[0]))


def _unit(source: str, name: str, given: object, wanted: str) -> tuple[float, float]:
    units = UNITS[wanted]
    if not isinstance(given, str) or given not in units:
        choices = [*units, "N"] if name == "thrust_command" else [*units]
        raise InputError(f"{source}: [{name}] unit is {shown(given)}; it must be one of {', '.join(choices)}")
    return units[given]


def _signs(source: str, name: str, given: object, count: int) -> np.ndarray:
    one, each = numbers(given, ()), numbers(given, (count,))
    signs = one if one is not None else each
    if signs is None or not np.all(np.abs(signs) == 1):
        raise InputError(
            f"{source}: [{name}] sign must be 1 or -1, or a list of {count} of them, not {shown(given)}"
        )
    return signs


def _one_of(source: str, key: str, given: object, choices: tuple[str, ...]) -> None:
    if given not in choices:
        raise InputError(f"{source}: {key} is {shown(given)}; it must be one of {', '.join(choices)}")


def _suggestion(word: str, known: list[str]) -> str:
    close = difflib.get_close_matches(word, known, 1)
    return f"did you mean '{close[0]}'?" if close else f"known: {', '.join(known)}"
