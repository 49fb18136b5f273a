"""Flights from files: the project's own CSV and Parquet, foreign tables through a mapping, flight records,
ULogs."""

from trueflight.groundstation.reading.flight_file import read_flight
from trueflight.groundstation.reading.uniform import segments

__all__ = ["read_flight", "segments"]
