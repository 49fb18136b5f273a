"""A flight as a poorer logger keeps it: an estimate that comes late, and fewer rows a second."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.writing import write_flight
from trueflight.models.flight import Flight

RATE = 100.0
"""Hz of the records of `sim-bridge fly`."""


def read_logged(record: Path, late: float, rate: float) -> Flight:
    """Read a record as a logger of `rate` Hz keeps it whose position and velocity pass a first-order lag of `late` s.

    What is poorer than the record is written beside it as NAME.logged.csv and read as any flight.
    """
    flight = read_flight(record)
    every = round(RATE / rate)
    if late == 0.0 and every == 1:
        return flight
    written = record.with_suffix(".logged.csv")
    write_flight(thinned(lagged(flight, late), every), written)
    return read_flight(written, flight.vehicle)


def lagged(flight: Flight, late: float) -> Flight:
    """Position and velocity through `late` dx/dt + x = measured, from the first sample on; `late` in s."""
    if late == 0.0:
        return flight
    keep = float(np.exp(-np.median(np.diff(flight.t)) / late))

    def behind(measured: np.ndarray | None) -> np.ndarray | None:
        if measured is None:
            return None
        followed: np.ndarray = lfilter([1.0 - keep], [1.0, -keep], measured, axis=0, zi=keep * measured[:1])[
            0
        ]
        return followed

    return replace(flight, position=behind(flight.position), velocity=behind(flight.velocity))


def thinned(flight: Flight, every: int) -> Flight:
    """One row of so many, as a logger keeps them: nothing is filtered before."""
    rows = len(flight)
    columns = {f.name: getattr(flight, f.name) for f in fields(flight)}
    kept: dict[str, Any] = {
        name: values[::every]
        for name, values in columns.items()
        if isinstance(values, np.ndarray) and len(values) == rows
    }
    return replace(flight, **kept, extra={name: values[::every] for name, values in flight.extra.items()})
