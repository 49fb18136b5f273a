"""Where ticks come from: a companion over its link, or a record that is played again. Both look the same to a watch."""

from __future__ import annotations

import contextlib
import queue
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import zenoh

from trueflight.groundstation.live.window import Hole
from trueflight.groundstation.operate.link import Link
from trueflight.models.errors import InputError
from trueflight.models.record import read_messages, read_record
from trueflight.models.record_pb2 import Event, Tick
from trueflight.models.vehicle import Vehicle

ASK = 1.0
"""s between two questions to a companion."""
HISTORY = 1000
"""Ticks of the past that are asked for: all that a companion keeps."""
AGAIN = 3.0
"""s between two copies of a record that does not hold yet what is missing."""
STEP = 1_000_000
"""us of flight that a record gives at once where it is played as fast as it can be looked at."""


class Source(Protocol):
    """One vehicle's ticks and events, and what is known of it."""

    @property
    def name(self) -> str:
        """The vehicle's name."""

    @property
    def vehicle(self) -> Vehicle | None:
        """What its owner believes of it; None as long as nobody has said."""

    @property
    def status(self) -> dict[str, Any]:
        """The companion's status; empty where there is none."""

    @property
    def ended(self) -> bool:
        """Whether nothing more will come."""

    def ticks(self) -> list[Tick]:
        """The ticks that have come since they were asked for last."""

    def events(self) -> list[Event]:
        """The events that have come since."""

    def filled(self) -> list[Tick]:
        """Ticks of the past that had been missing."""

    def missing(self, holes: Sequence[Hole]) -> None:
        """Tell it which ticks are missing now."""

    def close(self) -> None:
        """Ask no more."""


class FromLink:
    """A companion: what takes long (status, its record) is asked on a thread of its own."""

    def __init__(self, link: Link, vehicle: Vehicle | None = None) -> None:
        self.link, self.name, self.vehicle = link, link.vehicle, vehicle
        self.status: dict[str, Any] = {}
        self.ended = False
        self._ticks: queue.SimpleQueue[Tick] = queue.SimpleQueue()
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._filled: queue.SimpleQueue[Tick] = queue.SimpleQueue()
        self._holes: tuple[Hole, ...] = ()
        self._searched: set[Hole] = set()
        self._again = 0.0
        self._closing = threading.Event()
        link.follow(self._ticks.put, self._events.put, history=HISTORY)
        self._thread = threading.Thread(target=self._attend, name=f"attends {self.name}", daemon=True)
        self._thread.start()

    def ticks(self) -> list[Tick]:
        """As in `Source`."""
        return [self._ticks.get() for _ in range(self._ticks.qsize())]

    def events(self) -> list[Event]:
        """As in `Source`."""
        return [self._events.get() for _ in range(self._events.qsize())]

    def filled(self) -> list[Tick]:
        """As in `Source`."""
        return [self._filled.get() for _ in range(self._filled.qsize())]

    def missing(self, holes: Sequence[Hole]) -> None:
        """As in `Source`."""
        self._holes = tuple(holes)

    def close(self) -> None:
        """As in `Source`."""
        self._closing.set()
        self._thread.join(2.0 * self.link.settings.timeout)

    def _attend(self) -> None:
        while not self._closing.wait(ASK):
            with contextlib.suppress(InputError, zenoh.ZError):  # the link may be down: ticks say the rest
                self.status = {**self.link.status(), "insecure": self.link.warning}
                if self.vehicle is None:
                    self._ask_for_vehicle()
                self._fill()

    def _newest(self) -> str:
        records = self.link.records()
        return str(max(records, key=lambda r: float(r["time"]))["name"]) if records else ""

    def _ask_for_vehicle(self) -> None:
        """The vehicle file stands at the head of every record, also of one that is being written."""
        if not (name := self._newest()):
            return
        with tempfile.TemporaryDirectory() as folder:
            head = Path(folder) / name
            head.write_bytes(self.link.head_of_record(name))
            self.vehicle = read_record(head, ticks=False).vehicle

    def _fill(self) -> None:
        """Look for what is missing in the newest record, once it is written as far as that."""
        wanted = [hole for hole in self._holes if hole not in self._searched]
        if not wanted or time.monotonic() < self._again:
            return
        self._again = time.monotonic() + AGAIN
        if not (name := self._newest()):
            return
        with tempfile.TemporaryDirectory() as folder:
            ticks, _ = read_messages(self.link.fetch_record(name, Path(folder)))
        for hole in wanted:
            if ticks[-1].vehicle_time_us >= hole.stop:
                self._searched.add(hole)
                for tick in ticks:
                    if hole.start < tick.vehicle_time_us < hole.stop:
                        self._filled.put(tick)


class FromRecord:
    """A record played again at `speed` times its own, or, where that is 0, a second of it each time it is asked."""

    def __init__(self, path: Path, speed: float, vehicle: Vehicle | None = None) -> None:
        self._ticks, self._events = read_messages(path)
        self._ticks.sort(key=lambda tick: tick.vehicle_time_us)
        self.vehicle = vehicle or read_record(path, ticks=False).vehicle
        if self.vehicle is None:
            raise InputError(f"{path}: the record holds no vehicle; pass --vehicle FILE")
        self.name = self.vehicle.name
        self.status: dict[str, Any] = {}
        self._speed, self._begun = speed, time.monotonic()
        self._now = self._ticks[0].vehicle_time_us
        self._start, self._given, self._told = self._now, 0, 0

    @property
    def ended(self) -> bool:
        """As in `Source`."""
        return self._given == len(self._ticks)

    def ticks(self) -> list[Tick]:
        """As in `Source`."""
        played = round(1e6 * self._speed * (time.monotonic() - self._begun))
        self._now = self._start + played if self._speed else self._now + STEP
        begin = self._given
        while self._given < len(self._ticks) and self._ticks[self._given].vehicle_time_us <= self._now:
            self._given += 1
        return self._ticks[begin : self._given]

    def events(self) -> list[Event]:
        """As in `Source`."""
        begin = self._told
        while self._told < len(self._events) and self._events[self._told].vehicle_time_us <= self._now:
            self._told += 1
        return self._events[begin : self._told]

    def filled(self) -> list[Tick]:
        """As in `Source`."""
        return []

    def missing(self, holes: Sequence[Hole]) -> None:
        """As in `Source`: a record has no more than it has."""

    def close(self) -> None:
        """As in `Source`."""
