"""From a file to a checked `Flight`, whatever wrote it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from trueflight.groundstation.reading.assemble import assemble
from trueflight.groundstation.reading.betaflight_table import BLACKBOX, CONVERT, blackbox_mapping
from trueflight.groundstation.reading.crazyflie_log import TIME as CRAZYFLIE_TIME
from trueflight.groundstation.reading.crazyflie_log import is_usd_log, read_usd_log, usd_mapping
from trueflight.groundstation.reading.mapping import (
    Given,
    Mapping,
    apply_mapping,
    load_mapping,
    merged,
    read_mappings,
)
from trueflight.groundstation.reading.sources import Sources, refuse_topics
from trueflight.groundstation.reading.table import Table, own_columns, read_table, unknown_columns
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.outside import unreadable
from trueflight.models.vehicle import Vehicle, load_vehicle

TABLES = (".csv", ".txt", ".tsv", ".parquet", ".pq")
RECORDS = (".mcap", ".db3")
ULOGS = (".ulg", ".ulog")
DATAFLASH = (".bin",)
TELEMETRY = (".tlog",)
ENDINGS = (*RECORDS, *TABLES, *ULOGS, *DATAFLASH, *TELEMETRY)
"""Best first: of files of a folder that differ in their ending only, the first of these is read."""


class NoVehicle(InputError):
    """A flight without the file of its vehicle."""


def read_flight(
    path: str | Path, vehicle: str | Path | Vehicle | None = None, mapping: Given = None
) -> Flight:
    """Read a flight: the project's CSV or Parquet, any table through a column `mapping`, MCAP record, MCAP of
    ROS 2, or PX4 ULog.

    `vehicle` is a vehicle or its file; without it the one beside the flight is taken (a record of the
    companion carries its own): `NAME.vehicle.toml` with the longest NAME that the flight's name starts with,
    or `vehicle.toml`. A mapping is found in the same way (`NAME.mapping.toml`, `mapping.toml`);
    lines such as "velocity.turned = 20" correct what it, or a log, says. Raises `InputError`, in one line, for
    whatever makes the file unfit for analysis.
    """
    path = Path(path)
    with unreadable(path, "the flight", "record or export it again"):
        return _read_flight(path, vehicle, mapping)


def _read_flight(path: Path, vehicle: str | Path | Vehicle | None, mapping: Given) -> Flight:
    suffix = path.suffix.lower()
    if path.is_dir():
        raise InputError(
            f"{path}: is a folder; pass one of its flights (`groundstation flights {path}` lists them)"
        )
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the path (`groundstation flights DIR` lists flights)")
    mappings = read_mappings(mapping)
    beside = None if suffix in TABLES else _beside(path, "mapping.toml")
    if beside is not None and not mappings:
        mappings = (load_mapping(beside),)
    every = merged(mappings)
    sources = Sources() if every is None else every.sources
    corrections = merged([one for one in mappings if one.corrects and not one.names_columns])
    if suffix in RECORDS:
        from trueflight.groundstation.reading.flight_record import read_flight_record
        from trueflight.groundstation.reading.px4_flight import flight_of
        from trueflight.groundstation.reading.ros_bag import is_ros_bag, load_ros_bag

        if is_ros_bag(path):
            return flight_of(path, load_ros_bag(path, sources), _vehicle(path, vehicle), corrections)

        refuse_topics(sources, path)
        return read_flight_record(path, vehicle, corrections)
    if suffix in ULOGS:
        from trueflight.groundstation.reading.ulog import read_ulog

        return read_ulog(path, _vehicle(path, vehicle), corrections, sources)
    if suffix in DATAFLASH:
        from trueflight.groundstation.reading.ardupilot_log import load_dataflash
        from trueflight.groundstation.reading.px4_flight import flight_of

        refuse_topics(sources, path)
        return flight_of(path, load_dataflash(path), _vehicle(path, vehicle), corrections)
    if suffix in TELEMETRY:
        from trueflight.groundstation.reading.mavlink_log import load_tlog
        from trueflight.groundstation.reading.px4_flight import flight_of

        refuse_topics(Sources(topics=sources.topics), path)
        return flight_of(path, load_tlog(path, sources), _vehicle(path, vehicle), corrections)
    if suffix in BLACKBOX:
        raise InputError(f"{path}: {CONVERT}")
    on_card = is_usd_log(path)
    if suffix not in TABLES and not on_card:
        raise InputError(
            f"{path}: '{suffix}' is no kind of flight file; known are {', '.join(ENDINGS)} and the logs of a "
            "Crazyflie's card"
        )
    refuse_topics(sources, path)
    return _of_table(
        path, read_usd_log(path) if on_card else read_table(path), vehicle, mappings, corrections
    )


def is_flight_file(path: Path) -> bool:
    """Whether a file of a folder is taken for a flight: by its ending, or, where it has none, by how it begins."""
    return path.suffix.lower() in ENDINGS or (not path.suffix and is_usd_log(path))


def _of_table(
    path: Path,
    table: Table,
    vehicle: str | Path | Vehicle | None,
    mappings: tuple[Mapping, ...],
    corrections: Mapping | None,
) -> Flight:
    """The flight of a table: its columns named by a mapping, by whoever wrote it, or as the project's own."""
    believed = _vehicle(path, vehicle)
    table, known = _known(table)
    beside = None if known is not None else _mapping_beside(path, table)
    if beside is not None and not any(one.names_columns for one in mappings):
        mappings = (load_mapping(beside), *mappings)
    if known is not None and not any(one.names_columns for one in mappings):
        mappings = (known, *mappings)
    whole = merged(mappings)
    if whole is not None and (whole.names_columns or "t" not in table.columns):
        mapped = apply_mapping(table, whole, believed)
        flight = assemble(
            path, believed, mapped.t, mapped.columns, table.place,
            extra=mapped.extra, flying=None, notes=(*table.notes, *mapped.notes),
            accelerometer=not mapped.estimated_force, named_by=whole,
        )  # fmt: skip
        return replace(flight, unlogged=mapped.unlogged)
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
        mapping=corrections,
    )


def _known(table: Table) -> tuple[Table, Mapping | None]:
    """The table, and what its columns are where it is told by the names that another program gives them."""
    if CRAZYFLIE_TIME in table.columns and table.first_line is None:
        return table, usd_mapping(table)
    return blackbox_mapping(table) or (table, None)


def _vehicle(path: Path, vehicle: str | Path | Vehicle | None) -> Vehicle:
    if isinstance(vehicle, Vehicle):
        return vehicle
    if vehicle is not None:
        return load_vehicle(vehicle)
    if (beside := _beside(path, "vehicle.toml")) is not None:
        return load_vehicle(beside)
    draft = (
        f"; `groundstation import {path} --draft-vehicle {path.with_name('vehicle.toml')}` drafts one"
        if path.suffix.lower() in (*ULOGS, *DATAFLASH, *TELEMETRY)
        else ""
    )
    raise NoVehicle(
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
