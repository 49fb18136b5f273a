"""From a file to a checked `Flight`, whatever wrote it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from trueflight.groundstation.reading import plausible
from trueflight.groundstation.reading.airborne import flying_mask
from trueflight.groundstation.reading.table import Table, own_columns, read_table, unknown_columns
from trueflight.groundstation.reading.uniform import MOST_LOST, even_clock
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.outside import unreadable
from trueflight.models.vehicle import Vehicle, load_vehicle

TABLES = (".csv", ".txt", ".tsv", ".parquet", ".pq")
RECORDS = (".mcap",)
ULOGS = (".ulg", ".ulog")
ENDINGS = (*TABLES, *RECORDS, *ULOGS)


def read_flight(
    path: str | Path, vehicle: str | Path | Vehicle | None = None, mapping: str | Path | None = None
) -> Flight:
    """Read a flight: the project's CSV or Parquet, any table through a column `mapping`, MCAP record, MCAP of
    ROS 2, or PX4 ULog.

    `vehicle` is a vehicle or its file; without it the one beside the flight is taken (a record of the
    companion carries its own): `NAME.vehicle.toml` with the longest NAME that the flight's name starts with,
    or `vehicle.toml`. A mapping is found in the same way (`NAME.mapping.toml`, `mapping.toml`). Raises
    `InputError`, in one line, for whatever makes the file unfit for analysis.
    """
    path = Path(path)
    with unreadable(path, "the flight", "record or export it again"):
        return _read_flight(path, vehicle, mapping)


def _read_flight(path: Path, vehicle: str | Path | Vehicle | None, mapping: str | Path | None) -> Flight:
    suffix = path.suffix.lower()
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the path (`groundstation flights DIR` lists flights)")
    if suffix in RECORDS:
        from trueflight.groundstation.reading.flight_record import read_flight_record
        from trueflight.groundstation.reading.px4_flight import flight_of
        from trueflight.groundstation.reading.ros_bag import is_ros_bag, load_ros_bag

        if is_ros_bag(path):
            return flight_of(path, load_ros_bag(path), _vehicle(path, vehicle))

        return read_flight_record(path, vehicle)
    if suffix in ULOGS:
        from trueflight.groundstation.reading.ulog import read_ulog

        return read_ulog(path, _vehicle(path, vehicle))
    if suffix not in TABLES:
        raise InputError(f"{path}: '{suffix}' is no kind of flight file; known are {', '.join(ENDINGS)}")
    table = read_table(path)
    believed = _vehicle(path, vehicle)
    mapping = mapping or _mapping_beside(path, table)
    if mapping is not None:
        from trueflight.groundstation.reading.mapping import apply_mapping, load_mapping

        mapped = apply_mapping(table, load_mapping(Path(mapping)), believed)
        return assemble(
            path, believed, mapped.t, mapped.columns, table.place,
            extra=mapped.extra, flying=None, notes=(*table.notes, *mapped.notes),
        )  # fmt: skip
    columns = own_columns(table)
    extra = unknown_columns(table)
    flying = table.columns["flying"] > 0.5 if "flying" in table.columns else None
    return assemble(
        path,
        believed,
        table.columns["t"],
        columns,
        table.place,
        extra=extra,
        flying=flying,
        notes=table.notes,
    )


def assemble(
    path: Path,
    vehicle: Vehicle,
    t: np.ndarray,
    columns: dict[str, np.ndarray],
    place: Callable[[int], str],
    *,
    extra: dict[str, np.ndarray] | None = None,
    flying: np.ndarray | None = None,
    commanded: np.ndarray | None = None,
    notes: tuple[str, ...] = (),
    most_lost: float = MOST_LOST,
) -> Flight:
    """Check columns (N, ...) by attribute of `Flight` on the clock `t` (N,), put them on an even clock and
    find what was flown. `place(row)` names a row in messages; `most_lost` is the share of samples that gaps may
    take. Raises `InputError` for anything that cannot be analysed."""
    origin = str(path)
    _check_groups(origin, columns)
    columns, dead = plausible.without_dead_battery(columns)
    said = [*notes, *dead]
    names = list(columns)
    every = {
        **plausible.without_empty_attitude(columns),
        **{f"extra {k}": v for k, v in (extra or {}).items()},
    }
    if flying is not None:
        every["flying"] = np.asarray(flying, dtype=bool)
    if commanded is not None:
        every["commanded"] = np.asarray(commanded, dtype=bool)
    t, every, order, more = plausible.in_order(t, every)
    said += more

    def sorted_place(row: int) -> str:
        return place(int(order[min(row, len(order) - 1)]) if len(order) else 0)

    plausible.check_clock(t, sorted_place)
    t, every, more = plausible.without_duplicates(t, every)
    said += more
    given = {name: every[name] for name in names}
    others = {name: column for name, column in every.items() if name not in given}
    index = np.arange(len(t))
    _, given_and_index, more = plausible.complete(t, {**given, "row": index}, sorted_place)
    kept = given_and_index.pop("row")
    t, given = t[kept], given_and_index
    others = {name: column[kept] for name, column in others.items()}
    said += more
    plausible.check_units(given, vehicle, origin)
    given = plausible.continuous(given)
    t, every, more = even_clock(t, {**given, **others}, origin, most_lost)
    said += more
    given = {name: every[name] for name in given}
    if "thrust_command" not in given:
        given["thrust_command"] = given["motor_command"].mean(axis=1)
        said.append("no collective command in the log: thrust_command is the mean of the motor commands")
    in_air = every["flying"] if flying is not None else flying_mask(t, given, vehicle)
    if commanded is not None:
        in_air = in_air & every["commanded"]
    dt = float(np.median(np.diff(t)))
    seconds = float(in_air.sum()) * dt
    if seconds < plausible.SHORTEST:
        cut = " (the log may be cut short)" if any("cut" in note for note in said) else ""
        raise InputError(
            f"{origin}: only {seconds:.1f} s of {t[-1] - t[0]:.1f} s are in the air{cut}; at least "
            f"{plausible.SHORTEST:g} s are needed: fly longer, or check hover_thrust of the vehicle file"
        )
    if not np.all(in_air):
        first, last = t[in_air][0], t[in_air][-1]
        said.append(
            f"{seconds:.1f} s of {t[-1] - t[0]:.1f} s are in the air, between t = {first:.1f} and "
            f"{last:.1f} s; the rest (ground, takeoff, landing, fragments) is left out"
        )
    plausible.check_specific_force(given, in_air, origin)
    plausible.check_attitude(t, given, in_air, origin)
    plausible.check_motion(t, given, in_air, origin)
    return Flight(
        name=path.stem,
        vehicle=vehicle,
        t=t,
        **given,  # type: ignore[arg-type]
        flying=in_air,
        accelerometer="specific_force" in given,
        origin=origin,
        data_hash=hashlib.sha256(path.read_bytes()).hexdigest(),
        notes=tuple(said),
        extra={name.removeprefix("extra "): every[name] for name in others if name.startswith("extra ")},
    )


def _check_groups(origin: str, columns: dict[str, np.ndarray]) -> None:
    """What no analysis can do without: a command, and something that was measured in answer to it."""
    if "thrust_command" not in columns and "motor_command" not in columns:
        raise InputError(
            f"{origin}: no thrust_command (nor motor_command_1..4): without the command nothing can be "
            "predicted; add "
            "the column, or name yours in a mapping (--mapping)"
        )
    moves = "quaternion" in columns and ("velocity" in columns or "position" in columns)
    if "specific_force" not in columns and not moves:
        raise InputError(
            f"{origin}: neither an accelerometer (specific_force_x, y, z) nor attitude with velocity or "
            "position "
            "(quaternion_*, velocity_*); add one of them, or name yours in a mapping (--mapping)"
        )


def _vehicle(path: Path, vehicle: str | Path | Vehicle | None) -> Vehicle:
    if isinstance(vehicle, Vehicle):
        return vehicle
    if vehicle is not None:
        return load_vehicle(vehicle)
    if (beside := _beside(path, "vehicle.toml")) is not None:
        return load_vehicle(beside)
    draft = (
        f"; `groundstation import {path} --draft-vehicle {path.with_name('vehicle.toml')}` drafts one"
        if path.suffix.lower() in ULOGS
        else ""
    )
    raise InputError(
        f"{path}: no vehicle.toml beside it; pass --vehicle FILE (mass, hover_thrust and rotors as you "
        f"believe them){draft}"
    )


def _beside(path: Path, kind: str) -> Path | None:
    """The file that goes with a flight: of the files `NAME.kind` in its directory the one with the longest
    NAME that the flight's name starts with, otherwise `kind` alone."""
    fitting = [
        f for f in path.parent.glob(f"*.{kind}") if path.stem.startswith(f.name.removesuffix(f".{kind}"))
    ]
    alone = path.parent / kind
    return max(fitting, key=lambda f: len(f.name)) if fitting else (alone if alone.is_file() else None)


def _mapping_beside(path: Path, table: Table) -> Path | None:
    """The mapping beside a table that is not in the project's own format."""
    if "t" in table.columns and ("thrust_command" in table.columns or "motor_command_1" in table.columns):
        return None
    return _beside(path, "mapping.toml")
