"""Flight records of our own companion (MCAP), whole or cut short by a power cut."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from trueflight.groundstation.reading.assemble import assemble
from trueflight.groundstation.reading.clocks import of_one_clock
from trueflight.groundstation.reading.mapping import Mapping
from trueflight.groundstation.reading.rows import held, whole
from trueflight.models.errors import InputError
from trueflight.models.flight import COLUMNS, Flight
from trueflight.models.record import FlightRecord, read_record
from trueflight.models.vehicle import Vehicle, load_vehicle

COMMANDED = ("takeoff", "mission", "landing")
"""Phases in which the companion's own command flies the vehicle."""

REFERENCES = ("position_reference", "velocity_reference", "acceleration_reference", "yaw_reference")

MOST_OWN = 0.6
"""Share of the ticks that must count the vehicle's clock."""
KEPT = (
    "feedback_thrust",
    "feedback_body_rate",
    "correction",
    "correction_raw",
    "latency",
    "inference",
    "interval",
)


def read_flight_record(
    path: Path, vehicle: str | Path | Vehicle | None = None, mapping: Mapping | None = None
) -> Flight:
    """The flight of a record. The vehicle is that of the record unless one is given; `mapping` corrects columns.

    Only what the companion itself commanded, in the air, counts as flying. Words of each tick stand as
    numbers in `extra`: `mission` (1 while the trajectory was flown), `corrected` (1 while the guard let a
    correction act) and, where a model was evaluated without being applied, `shadow` (1 meanwhile) with
    `shadow_raw` (m/s², heading frame; 0 elsewhere). Raises `InputError` for a record without a vehicle, a
    flight, or any plausible column.
    """
    record = read_record(path)
    return flight_of_record(path, record, _vehicle(path, record, vehicle), mapping)


def flight_of_record(
    path: Path,
    record: FlightRecord,
    believed: Vehicle,
    mapping: Mapping | None = None,
    on_disk: bool = True,
) -> Flight:
    """The flight of a `record` of the vehicle `believed`, as `read_flight_record`; `path` is its name in messages, and
    a file where it is `on_disk`; the record has no ticks any more then."""
    ticks, foreign = _of_the_vehicle(path, record.ticks)
    columns = {name: ticks[name] for name in COLUMNS if name in ticks and not _unknown(ticks[name])}
    if "battery_voltage" in columns and not np.any(columns["battery_voltage"] > 0):
        del columns["battery_voltage"]
    for name in ("thrust_command", "body_rate_command"):
        if name in columns:  # no setpoint was sent there: nothing was commanded, nothing is missing
            columns[name] = _zero_where_unknown(columns[name])
    for name in REFERENCES:
        if name in columns:
            columns[name] = held(columns[name])
    commanded = _is(ticks["phase"], COMMANDED.__contains__) & ticks["armed"] & ticks["setpoint_sent"]
    extra = {name: ticks[name] for name in KEPT if name in ticks and not _unknown(ticks[name])}
    extra["mission"] = _is(ticks["phase"], "mission".__eq__).astype(float)
    extra["corrected"] = 1.0 - _is(ticks["guard"], lambda word: word.startswith(("off", "tripped")))
    if "shadow_raw" in ticks:
        extra["shadow"] = _is(ticks["shadow"], bool).astype(float)
        extra["shadow_raw"] = _zero_where_unknown(ticks["shadow_raw"])
    extra["commanded"] = commanded.astype(float)
    t = ticks["t"]
    if not np.any(commanded):
        raise InputError(
            f"{path}: the companion never flew in this record (phases: "
            f"{', '.join(sorted(set(ticks['phase'])))}); "
            "take another one (`groundstation flights DIR`)"
        )
    notes = (*record.notes, *foreign, *_trip(ticks["guard"], t))
    if on_disk:  # an hour of them is large: what is not looked at must not stay
        record.ticks.clear()
    del ticks
    return assemble(
        path,
        believed,
        t,
        columns,
        lambda row: f"{path}, tick {row + 1}",
        extra=extra,
        commanded=commanded,
        notes=notes,
        mapping=mapping,
        on_disk=on_disk,
    )


def _of_the_vehicle(path: Path, ticks: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], list[str]]:
    """The ticks that count the vehicle's clock, and what to say of the others: odometry of another component of the
    network was flown then. Raises `InputError` where most ticks count other clocks."""
    own = of_one_clock(ticks["vehicle_time"], ticks["host_time"])
    if np.all(own):
        return ticks, []
    if np.mean(own) < MOST_OWN:
        raise InputError(
            f"{path}: the ticks count several clocks, and none of them most ({100 * np.mean(own):.0f} %): odometry of "
            "other components was flown; take another record, and see that one component alone sends odometry"
        )
    kept = {name: column[own] for name, column in ticks.items()}
    kept["t"] = kept["vehicle_time"] - kept["vehicle_time"][0]
    return kept, [
        f"{np.sum(~own)} of {len(own)} ticks count another clock (odometry of another component, or a vehicle that "
        "began again) and are left out"
    ]


def _trip(guard: np.ndarray, t: np.ndarray) -> list[str]:
    """That the correction was switched off in flight, when and why: whoever reads a figure must know."""
    tripped = np.flatnonzero(_is(guard, lambda word: word.startswith("tripped")))
    return (
        [f"correction switched off at {t[tripped[0]]:.1f} s: guard {guard[tripped[0]]}"]
        if len(tripped)
        else []
    )


def _vehicle(path: Path, record: FlightRecord, vehicle: str | Path | Vehicle | None) -> Vehicle:
    if isinstance(vehicle, Vehicle):
        return vehicle
    if vehicle is not None:
        return load_vehicle(vehicle)
    if record.vehicle is None:
        damage = next((f" ({note})" for note in record.notes if "vehicle file" in note), "")
        raise InputError(f"{path}: the record holds no vehicle{damage}; pass --vehicle FILE")
    return record.vehicle


def _is(words: np.ndarray, wanted: Callable[[str], bool]) -> np.ndarray:
    """Which of many `words` (N,), few of them different, are `wanted`."""
    answers = {word: bool(wanted(word)) for word in set(words)}
    return np.fromiter(map(answers.__getitem__, words), bool, len(words))


def _zero_where_unknown(column: np.ndarray) -> np.ndarray:
    return np.nan_to_num(column) if not np.all(whole(column)) else column


def _unknown(column: np.ndarray) -> bool:
    """Whether a column holds nothing, or nothing in most ticks."""
    return bool(whole(column).mean() < 0.5)
