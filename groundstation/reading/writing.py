"""Flights in the project's own format: CSV or Parquet, with the vehicle file beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trueflight.models.errors import InputError
from trueflight.models.flight import COLUMNS, Flight, column_names
from trueflight.models.record import vehicle_to_toml
from trueflight.models.whole_file import whole_file, write_whole

DIGITS = 9


def write_flight(flight: Flight, path: Path) -> Path:
    """Write `flight` to `path` (.csv or .parquet) and its vehicle to `NAME.vehicle.toml` beside it.

    Both appear whole or not at all. Returns the vehicle's path. Raises `InputError` for another suffix or a
    place that cannot be written.
    """
    import pyarrow as pa
    from pyarrow import csv as arrow_csv
    from pyarrow import parquet as arrow_parquet

    suffix = path.suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise InputError(f"{path}: flights are written as .csv or .parquet; change the ending of -o")
    columns = own_table(flight)
    vehicle_path = path.with_suffix(".vehicle.toml")
    table = pa.table({name: pa.array(values) for name, values in columns.items()})
    with whole_file(path, "the flight", "choose another -o") as partial:
        if suffix == ".csv":
            arrow_csv.write_csv(table, partial, arrow_csv.WriteOptions(quoting_style="none"))
        else:
            arrow_parquet.write_table(table, partial, compression="zstd")
        # Before the flight has its name: a flight beside another's vehicle would be read with it.
        write_whole(vehicle_path, vehicle_to_toml(flight.vehicle), "the vehicle file", "choose another -o")
    return vehicle_path


def own_table(flight: Flight) -> dict[str, np.ndarray]:
    """The flight's columns by the names of the project's own format, rounded to nine digits."""
    out: dict[str, np.ndarray] = {"t": _rounded(flight.t)}
    for attribute in COLUMNS:
        values = getattr(flight, attribute)
        if values is None:
            continue
        columns = values.reshape(len(flight), -1).T
        for name, column in zip(column_names(attribute, len(columns)), columns, strict=True):
            out[name] = _rounded(column)
    if flight.flying is not None:
        out["flying"] = flight.flying.astype(np.int8)
    for name, values in flight.extra.items():
        columns = values.reshape(len(flight), -1).T
        for index, column in enumerate(columns):
            out[
                name if len(columns) == 1 else f"{name}_{'xyz'[index] if len(columns) == 3 else index + 1}"
            ] = _rounded(column)
    return out


def _rounded(column: np.ndarray) -> np.ndarray:
    """To nine significant digits of the column's largest value: below every sensor's resolution, half the
    file."""
    largest = float(np.max(np.abs(column[np.isfinite(column)]), initial=0.0))
    if largest == 0.0:
        return column.astype(float)
    return np.round(column, DIGITS - 1 - int(np.floor(np.log10(largest))))
