"""What a list of flights tells of each file."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from trueflight.groundstation.reading.flight_file import read_flight
from trueflight.groundstation.reading.ros_bag import is_ros_bag
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.record import read_record

SENSORS = {
    "specific_force": "accelerometer",
    "position": "position",
    "quaternion": "attitude",
    "angular_velocity": "gyroscope",
    "battery_voltage": "battery",
    "rotor_speed": "rotor speeds",
    "motor_command": "motor commands",
    "position_reference": "reference",
}


def flight_row(file: Path, directory: Path) -> dict[str, Any]:
    """What the table tells of one file; a file that cannot be read tells why."""
    stamp = datetime.fromtimestamp(file.stat().st_mtime, UTC)
    row: dict[str, Any] = {
        "flight": str(file.relative_to(directory)),
        "date": stamp.strftime("%Y-%m-%d"),
        "trajectory": "",
        "controller": "",
        "model": "",
        "error": "",
    }
    try:
        flight = read_flight(file)
        if file.suffix.lower() == ".mcap" and not is_ros_bag(file):
            row |= _record_facts(file)
    except InputError as error:
        return {**row, "error": str(error)}
    flying = 1.0 if flight.flying is None else float(flight.flying.mean())
    return {
        **row,
        "vehicle": flight.vehicle.name,
        "duration": round(flight.duration, 2),
        "flying": round(flying * len(flight) * flight.dt, 2),
        "rate": round(1.0 / flight.dt, 1),
        "measured": [word for name, word in SENSORS.items() if flight.has(name)],
        "notes": list(flight.notes),
    }


def controller_of(flight: Flight) -> str:
    """Which controller flew, where a record of the companion tells; '' otherwise."""
    record = Path(flight.origin)
    if record.suffix.lower() != ".mcap" or not record.is_file() or is_ros_bag(record):
        return ""
    return str(read_record(record, ticks=False).metadata.get("controller", ""))


def _record_facts(file: Path) -> dict[str, Any]:
    record = read_record(file, ticks=False)
    facts = {name: record.metadata.get(name, "") for name in ("trajectory", "controller", "model")}
    created = record.metadata.get("created_ns", "")
    if created.isdecimal() and len(created) < 20:
        facts["date"] = datetime.fromtimestamp(int(created) * 1e-9, UTC).strftime("%Y-%m-%d")
    return facts
