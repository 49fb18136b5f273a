"""The records of flights on board: whether there is room for one, and the one that is being written."""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from trueflight.companion.mission import Mission
from trueflight.models.design import Design
from trueflight.models.errors import InputError
from trueflight.models.record import FlightRecorder
from trueflight.models.record_pb2 import Event
from trueflight.models.vehicle import Vehicle

_BYTES_A_TICK = 500
"""More than a tick takes on the disk: 291 bytes in a corrected lemniscate over the stand-in."""
_SPARE = 4 << 20
"""Bytes beside the record itself that must be free."""
_AROUND = 60.0
"""s of a flight that are no mission: climbing, proving, going home."""


class Records:
    """The folder of the flight records of a vehicle and its design; one is written at a time.

    `emit(level, kind, text)` must not block. `rate` is the ticks a second. `required`: whether a flight may only begin
    with a record. A flight under way is never ended by its record: what is lost is told at once. `flush` hands over the
    ticks that wait to be written.
    """

    def __init__(
        self,
        folder: Path,
        vehicle: Vehicle,
        design: Design,
        rate: float,
        required: bool,
        emit: Callable[[str, str, str], None],
        flush: Callable[[], None] = lambda: None,
    ) -> None:
        self._vehicle, self._design = vehicle, design
        self.folder, self.recorder = folder, None
        self._rate, self._required, self._emit = rate, required, emit
        self._flush = flush
        self._told = ""
        self._rescued = False

    recorder: FlightRecorder | None

    @property
    def path(self) -> str:
        """The record that is being written now; empty where none is, and where it could not be written on."""
        recorder = self.recorder
        return str(recorder.path) if recorder is not None and not recorder.error else ""

    def why_not(self, seconds: float = 0.0) -> str:
        """'' where a flight with a mission of so many s may begin, otherwise what is wrong with its record."""
        return self._no_room(seconds) if self._required else ""

    def begin(self, mission: Mission, model: str) -> tuple[str, str]:
        """Begin the record of a mission: its name, and why the flight may not begin without one.

        `model` is the hash of the one that corrects.
        """
        stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
        name = f"{stamp}-{mission.identity}-{mission.trajectory.name}-{mission.controller}.mcap"
        metadata = {
            "mission": mission.identity,
            "trajectory": mission.trajectory.name,
            "controller": mission.controller,
            "model": model,
            "repeat": str(mission.repeat),
            **{f"parameter.{key}": str(value) for key, value in mission.trajectory.parameters.items()},
        }
        self._told, self._rescued = "", False
        self._flush()  # what was before this flight is not of it
        try:
            self.recorder = FlightRecorder(self.folder / name, self._vehicle, self._design, metadata)
            return name, ""
        except InputError as error:
            self._emit("error", "record_failed", f"{error}: this flight has no record")
            return "", f"{error}; make room, or set require_record = false" if self._required else ""

    def look(self) -> None:
        """Tell at once what happened to the record of the flight under way."""
        recorder = self.recorder
        if recorder is None:
            return
        if recorder.error and recorder.error != self._told:
            self._told = recorder.error
            self._emit("error", "record_failed", f"{recorder.error}: the record of this flight ends here")
        if recorder.rescued and not self._rescued:
            self._rescued = True
            self._emit("warning", "record_rescued", f"{recorder.path} was taken away in flight; written anew")

    def end(self) -> str:
        """Close the record; its name, empty where there is no file by it."""
        recorder = self.recorder
        if recorder is None:
            return ""
        self._flush()
        recorder.close()
        self.look()
        self.recorder = None
        if recorder.dropped:
            text = f"{recorder.dropped} messages missing in {recorder.path.name}"
            self._emit("warning", "record_incomplete", text)
        return recorder.path.name if recorder.path.is_file() else ""

    def tick(self, data: bytes, vehicle_time_us: int, host_time_ns: int) -> None:
        """Hand over a serialised tick; never blocks."""
        recorder = self.recorder
        if recorder is not None:
            recorder.tick(data, vehicle_time_us, host_time_ns)

    def event(self, event: Event) -> None:
        """Hand over an event; never blocks."""
        recorder = self.recorder
        if recorder is not None:
            recorder.event(event)

    def _no_room(self, seconds: float) -> str:
        advice = "make room, or set require_record = false"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            disk = os.statvfs(self.folder)
        except OSError as error:
            return f"no flight record can be written to {self.folder} ({error.strerror}); {advice}"
        if not os.access(self.folder, os.W_OK):
            return f"no flight record can be written to {self.folder} (not writable); {advice}"
        free = disk.f_bavail * disk.f_frsize
        needed = _SPARE + _BYTES_A_TICK * self._rate * (seconds + _AROUND)
        if free < needed:
            return (
                f"the disk has {free / 1e6:.1f} MB left in {self.folder}, the record of this flight may take "
                f"{needed / 1e6:.1f} MB; {advice}"
            )
        return ""
