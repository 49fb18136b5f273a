"""The last seconds of one vehicle's flight, as its ticks come in: in any order, with holes that may be filled later."""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trueflight.groundstation.reading.flight_record import COMMANDED, flight_of_record
from trueflight.models.flight import Flight
from trueflight.models.model import Model
from trueflight.models.record import FlightRecord
from trueflight.models.record_columns import TickColumns
from trueflight.models.record_pb2 import Tick
from trueflight.models.vehicle import Vehicle

HOLE = 0.5
"""s without a tick from which it is a hole: companions tick at 30 Hz or more."""


@dataclass(frozen=True)
class Hole:
    """Times of the vehicle's clock, us, between which ticks are missing."""

    start: int
    stop: int


@dataclass(frozen=True)
class Snapshot:
    """What one look needs: serialised `ticks` of the flight number `flight` of `vehicle`, which began at `zero` us of
    its clock, and the model that they are held against."""

    name: str
    flight: int
    zero: int
    ticks: tuple[bytes, ...]
    vehicle: Vehicle
    base: Model


class Window:
    """The ticks of the last `seconds` of a flight; another flight, or a clock that begins anew, empties it."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.flight, self.zero = seconds, 0, -1
        self._times: list[int] = []
        self._ticks: dict[int, bytes] = {}
        self._commanded = False

    def take(self, ticks: Iterable[Tick]) -> None:
        """Add ticks of now, in the order in which they came."""
        for tick in ticks:
            time, commanded = tick.vehicle_time_us, tick.phase in COMMANDED
            if commanded and (not self._commanded or time < self.zero):
                self.flight, self.zero = self.flight + 1, time
                self._times.clear()
                self._ticks.clear()
            self._commanded = commanded
            if commanded:
                self._add(time, tick)
        self._forget()

    def fill(self, ticks: Iterable[Tick]) -> int:
        """Add ticks of the past that had not come; how many there were of them."""
        before = len(self._ticks)
        for tick in ticks:
            if tick.phase in COMMANDED and tick.vehicle_time_us >= self.zero:
                self._add(tick.vehicle_time_us, tick)
        self._forget()
        return len(self._ticks) - before

    def _add(self, time: int, tick: Tick) -> None:
        if time in self._ticks:
            return
        if not self._times or time > self._times[-1]:
            self._times.append(time)
        else:
            bisect.insort(self._times, time)
        self._ticks[time] = tick.SerializeToString()

    def _forget(self) -> None:
        if not self._times:
            return
        keep = bisect.bisect_left(self._times, self._times[-1] - round(1e6 * self.seconds))
        for time in self._times[:keep]:
            del self._ticks[time]
        del self._times[:keep]

    @property
    def covered(self) -> float:
        """Time from the first to the last tick, s."""
        return 1e-6 * (self._times[-1] - self._times[0]) if self._times else 0.0

    @property
    def now(self) -> float:
        """Time of the last tick on the flight's clock, s."""
        return 1e-6 * (self._times[-1] - self.zero) if self._times else 0.0

    def holes(self) -> list[Hole]:
        """Where ticks are missing."""
        times = np.array(self._times, dtype=np.int64)
        at = np.flatnonzero(np.diff(times) > 1e6 * HOLE)
        return [Hole(int(times[i]), int(times[i + 1])) for i in at]

    def snapshot(self, name: str, vehicle: Vehicle, base: Model) -> Snapshot:
        """All that it holds."""
        ticks = tuple(self._ticks[time] for time in self._times)
        return Snapshot(name, self.flight, self.zero, ticks, vehicle, base)


def flight_of(snapshot: Snapshot) -> Flight:
    """The ticks of a snapshot as a flight, checked as a record's are; `t` is 0 where the flight began.

    Raises `InputError` as `read_flight_record`; where a hole is too long for one flight only what came after it is
    taken.
    """
    columns = TickColumns(sum(map(len, snapshot.ticks)))
    ends = [0, *itertools.accumulate(map(len, snapshot.ticks))]
    columns.add(b"".join(snapshot.ticks), list(itertools.pairwise(ends)))
    columns.settle()
    ticks = columns.columns()
    ticks["t"] = ticks["vehicle_time"] - 1e-6 * snapshot.zero
    record = FlightRecord(f"{snapshot.name}, live", ticks, (), vehicle=snapshot.vehicle)
    return flight_of_record(Path(record.path), record, snapshot.vehicle, on_disk=False)
