"""The ticks of a flight record as columns: read a few thousand at a time, and never kept as objects."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError

from trueflight.models.message_columns import leaves, read_columns
from trueflight.models.record_pb2 import Tick

BATCH = 4 << 20
"""Bytes of messages that are read at once."""
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
        self._waiting: list[memoryview] = []
        self._bytes = self._read = 0
        self._words = {"": 0}
        self._room = max(ROOM, size // LEAST)
        self._columns, self._into = _empty(self._room)

    def add(self, ticks: list[memoryview]) -> None:
        """Take ticks. Raises what protobuf does for one that is damaged, of these or of those not long before; all
        before that one are kept."""
        self._waiting += ticks
        self._bytes += sum(map(len, ticks))
        self.count += len(ticks)
        if self._bytes >= BATCH:
            self.settle()

    def settle(self) -> None:
        """Read what is waiting; raises as `add` does."""
        waiting, self._waiting, self._bytes = self._waiting, [], 0
        try:
            self._take(waiting)
        except Exception:  # noqa: BLE001 - a word that is none, or what protobuf raises
            whole, error = _until_damaged(waiting)
            self.count -= len(waiting) - len(whole)
            self._take(whole)
            raise error from None

    def _take(self, ticks: list[memoryview]) -> None:
        if not ticks:
            return
        while self._read + len(ticks) > self._room:
            self._grow()
        rows = slice(self._read, self._read + len(ticks))
        _blank(self._columns, rows)
        read_columns(Tick, ticks, {path: column[rows] for path, column in self._into.items()}, self._words)
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
        words = np.array(list(self._words), object)
        for path, field in leaves(Tick.DESCRIPTOR):
            if field.type == FieldDescriptor.TYPE_STRING:
                columns[path] = words[columns[path]]
        return _known(columns)


def _until_damaged(ticks: list[memoryview]) -> tuple[list[memoryview], Exception]:
    """The ticks before the first that protobuf cannot read, and what it says of that."""
    for i, tick in enumerate(ticks):
        try:
            Tick.FromString(bytes(tick))
        except DecodeError as error:
            return ticks[:i], error
    raise AssertionError("ticks that protobuf reads are not read")


def _empty(count: int) -> tuple[dict[str, np.ndarray], Mapping[str, np.ndarray]]:
    """Columns for so many ticks, and the place in them of every field by its path."""
    columns: dict[str, np.ndarray] = {name: np.empty((count, 3)) for name in VECTORS}
    columns |= {"quaternion": np.empty((count, 4)), "rotor_speed": np.empty((count, ROTORS))}
    columns |= {"feedback_thrust": np.empty(count), "feedback_body_rate": np.empty((count, 3))}
    into: dict[str, np.ndarray] = {"feedback.thrust": columns["feedback_thrust"]}
    into |= {f"feedback.body_rate.{c}": columns["feedback_body_rate"][:, i] for i, c in enumerate("xyz")}
    into |= {f"quaternion.{c}": columns["quaternion"][:, i] for i, c in enumerate("wxyz")}
    into |= {f"rotor_speed.{i}": columns["rotor_speed"][:, i] for i in range(ROTORS)}
    for name in VECTORS:
        into |= {f"{name}.{c}": columns[name][:, i] for i, c in enumerate("xyz")}
    for path, field in leaves(Tick.DESCRIPTOR):
        if "." not in path and path not in columns:
            columns[path] = into[path] = np.empty(count, _KINDS[field.type])
    return columns, into


def _blank(columns: dict[str, np.ndarray], rows: slice) -> None:
    """What a tick says that has no field at all."""
    for name, column in columns.items():
        unknown = np.nan if name in VECTORS or name == "rotor_speed" else 0
        column[rows] = unknown


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
    ):
        if not np.any(np.isfinite(columns[name])):
            del columns[name]
    vehicle_time = columns.pop("vehicle_time_us")
    columns["vehicle_time"] = vehicle_time * 1e-6
    columns["host_time"] = columns.pop("host_time_ns") * 1e-9
    columns["t"] = (vehicle_time - vehicle_time[:1]) * 1e-6
    return columns
