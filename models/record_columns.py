"""The ticks of a flight record as columns: read a few thousand at a time, and never kept as objects."""

from __future__ import annotations

import math
import mmap
from collections.abc import Mapping

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError

from trueflight.models.learnable import MOST
from trueflight.models.message_columns import Columns, leaves
from trueflight.models.record_pb2 import Tick

BATCH = 1 << 19
"""Bytes of messages that are read at once: so many stay in the processor's cache."""
VECTORS = (
    "position",
    "velocity",
    "angular_velocity",
    "specific_force",
    "position_reference",
    "velocity_reference",
    "acceleration_reference",
    "correction",
    "correction_raw",
    "body_rate_command",
    "shadow_raw",
    "trim",
)
"""Those of three numbers that may be unknown in a tick."""
ROTORS = 4
LEARNT = ("learnt", "learnt_deviation", "learnt_acting")
"""Those of as many numbers as are learnt in flight, at most `MOST`."""
ROOM = 1 << 14
"""Ticks that there is room for at least; columns grow by doubling."""
LEAST = 64
"""Bytes that a tick takes in a file at the least, compressed: room that is never written to takes no memory."""
_KINDS = {
    FieldDescriptor.TYPE_DOUBLE: float,
    FieldDescriptor.TYPE_INT64: np.int64,
    FieldDescriptor.TYPE_UINT32: np.int64,
    FieldDescriptor.TYPE_BOOL: bool,
    FieldDescriptor.TYPE_STRING: np.int32,  # the number of a word
}


class TickColumns:
    """Collects serialised ticks, of a file of `size` bytes; `columns` are those of all of them."""

    def __init__(self, size: int = 0) -> None:
        self.count = 0
        self._waiting: list[bytes] = []
        self._starts: list[int] = []
        self._stops: list[int] = []
        self._bytes = self._read = 0
        self._room = max(ROOM, size // LEAST)
        self._columns, self._into = _empty(self._room)
        never_told = (*VECTORS, *LEARNT, "rotor_speed")
        unknown = {path: np.nan if path.split(".")[0] in never_told else 0 for path in self._into}
        self._messages = Columns(Tick, unknown)

    def add(self, data: bytes, spans: list[tuple[int, int]]) -> None:
        """Take ticks, from a first to before a last byte of `data` each. Raises what protobuf does for one that is
        damaged, of these or of those not long before; all before that one are kept."""
        if not spans:
            return
        self._waiting.append(data)
        self._starts += [self._bytes + start for start, _ in spans]
        self._stops += [self._bytes + stop for _, stop in spans]
        self._bytes += len(data)
        self.count += len(spans)
        if self._bytes >= BATCH:
            self.settle()

    def settle(self) -> None:
        """Read what is waiting; raises as `add` does."""
        data, starts, stops = b"".join(self._waiting), np.array(self._starts, int), np.array(self._stops, int)
        self._waiting, self._starts, self._stops, self._bytes = [], [], [], 0
        try:
            self._take(data, starts, stops)
        except Exception:  # noqa: BLE001 - a word that is none, or what protobuf raises
            whole, error = _until_damaged(data, starts, stops)
            self.count -= len(starts) - whole
            self._take(data, starts[:whole], stops[:whole])
            raise error from None

    def _take(self, data: bytes, starts: np.ndarray, stops: np.ndarray) -> None:
        if not len(starts):
            return
        while self._read + len(starts) > self._room:
            self._grow()
        rows = slice(self._read, self._read + len(starts))
        into = {path: column[rows] for path, column in self._into.items()}
        self._messages.read(data, starts, stops - starts, into)
        self._read = rows.stop

    def _grow(self) -> None:
        self._room *= 2
        larger, self._into = _empty(self._room)
        for name, column in larger.items():  # one after the other: never all of them twice
            column[: self._read] = self._columns.pop(name)[: self._read]
        self._columns = larger

    def columns(self) -> dict[str, np.ndarray]:
        """Columns (N,) or (N, k) of all ticks, by the names of `models.record.FlightRecord`; what no tick has is left
        out."""
        columns = {name: column[: self._read] for name, column in self._columns.items()}
        words = np.array(list(self._messages.words), object)
        for path, field in leaves(Tick.DESCRIPTOR):
            if field.type == FieldDescriptor.TYPE_STRING:
                columns[path] = words[columns[path]]
        return _known(columns)


def _until_damaged(data: bytes, starts: np.ndarray, stops: np.ndarray) -> tuple[int, Exception]:
    """How many ticks are before the first that protobuf cannot read, and what it says of that."""
    for i, (start, stop) in enumerate(zip(starts, stops, strict=True)):
        try:
            Tick.FromString(data[start:stop])
        except DecodeError as error:
            return i, error
    raise AssertionError("ticks that protobuf reads are not read")


def _untouched(*shape: int, kind: type = float) -> np.ndarray:
    """An array in memory that is taken page by page as it is written to; numpy asks for pages of 2 MB."""
    size = math.prod(shape) * np.dtype(kind).itemsize
    room = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    return np.frombuffer(room, kind).reshape(shape)


def _empty(count: int) -> tuple[dict[str, np.ndarray], Mapping[str, np.ndarray]]:
    """Columns for so many ticks, and the place in them of every field by its path."""
    columns = {name: _untouched(count, 3) for name in VECTORS}
    columns |= {"quaternion": _untouched(count, 4), "rotor_speed": _untouched(count, ROTORS)}
    columns |= {name: _untouched(count, MOST) for name in LEARNT}
    columns |= {"feedback_thrust": _untouched(count), "feedback_body_rate": _untouched(count, 3)}
    into: dict[str, np.ndarray] = {"feedback.thrust": columns["feedback_thrust"]}
    into |= {f"feedback.body_rate.{c}": columns["feedback_body_rate"][:, i] for i, c in enumerate("xyz")}
    into |= {f"quaternion.{c}": columns["quaternion"][:, i] for i, c in enumerate("wxyz")}
    into |= {f"rotor_speed.{i}": columns["rotor_speed"][:, i] for i in range(ROTORS)}
    for name in LEARNT:
        into |= {f"{name}.{i}": columns[name][:, i] for i in range(MOST)}
    for name in VECTORS:
        into |= {f"{name}.{c}": columns[name][:, i] for i, c in enumerate("xyz")}
    for path, field in leaves(Tick.DESCRIPTOR):
        if "." not in path and path not in columns:
            columns[path] = into[path] = _untouched(count, kind=_KINDS[field.type])
    return columns, into


def _known(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns without those of which nothing is known, and with the time in s."""
    fewer = np.any(np.isnan(columns["rotor_speed"]), axis=1)  # a vehicle of three rotors
    columns["rotor_speed"][fewer] = np.nan
    columns["battery_voltage"][columns["battery_voltage"] == 0.0] = np.nan
    for name in (
        "specific_force",
        "rotor_speed",
        "battery_voltage",
        "position_reference",
        "shadow_raw",
        "trim",
        *LEARNT,
    ):
        if not np.any(np.isfinite(columns[name])):
            del columns[name]
    vehicle_time = columns.pop("vehicle_time_us")
    columns["vehicle_time"] = vehicle_time * 1e-6
    columns["host_time"] = columns.pop("host_time_ns") * 1e-9
    columns["t"] = (vehicle_time - vehicle_time[:1]) * 1e-6
    return columns
