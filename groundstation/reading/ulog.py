"""PX4 ULog files, as they come from the vehicle's card."""

from __future__ import annotations

from pathlib import Path

from trueflight.groundstation.reading.mapping import Mapping
from trueflight.groundstation.reading.px4_flight import flight_of
from trueflight.groundstation.reading.px4_log import load_ulog
from trueflight.groundstation.reading.sources import Sources
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.vehicle import Vehicle


def read_ulog(
    path: Path, vehicle: Vehicle, mapping: Mapping | None = None, sources: Sources | None = None
) -> Flight:
    """The flight of a PX4 ULog (1.11 to today), on an even clock of 100 Hz: see `px4_flight.flight_of`. Raises
    `InputError` for a file that is no ULog, is cut short before the flight, or lacks a needed topic, or one that
    `sources` choose."""
    if sources is not None and sources.namespace is not None:
        raise InputError(
            f"{path}: a ULog holds one vehicle and no namespaces; leave out --vehicle-namespace, or choose a topic "
            "(--topic battery_voltage=battery_status:1)"
        )
    return flight_of(path, load_ulog(path, sources), vehicle, mapping)
