"""The columns of an ArduPilot dataflash log (`.bin`): pymavlink knows the formats, numpy takes the fields."""

from __future__ import annotations

import contextlib
import mmap
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trueflight.groundstation.reading.rows import possible
from trueflight.models.errors import InputError

START, FORMAT, FORMAT_LENGTH = b"\xa3\x95", 0x80, 89
"""How every message begins; the type that defines the others, and its length."""
HEADER = START + bytes([FORMAT])
"""How a log begins."""
SEARCHED = 4096
"""Bytes at the beginning of a file in which that must be."""
TIMES = (("TimeUS", 1), ("TimeMS", 1000))


@dataclass(frozen=True)
class Messages:
    """The messages of one name: `t` (M,) in us since boot, and their fields (M,) by name, texts as bytes. `whole` are
    the fields that the log stores as whole numbers without a factor."""

    name: str
    t: np.ndarray
    fields: dict[str, np.ndarray]
    whole: frozenset[str]

    def __len__(self) -> int:
        return len(self.t)

    def has(self, *names: str) -> bool:
        """Whether the messages have all of these fields."""
        return all(name in self.fields for name in names)

    def field(self, *names: str) -> np.ndarray | None:
        """The first of these fields (M,) that the messages have, as floats."""
        return next((np.asarray(self.fields[n], dtype=float) for n in names if n in self.fields), None)

    def stack(self, *names: str) -> np.ndarray:
        """Fields as columns (M, k)."""
        return np.stack([np.asarray(self.fields[name], dtype=float) for name in names], -1)

    def at(self, rows: np.ndarray) -> Messages:
        """Some of the messages."""
        return Messages(self.name, self.t[rows], {n: v[rows] for n, v in self.fields.items()}, self.whole)

    def by_instance(self, *names: str) -> dict[int, Messages]:
        """The messages of each instance (core, sensor, battery), told by the first of these fields that is there;
        messages without one are of instance 0."""
        which = self.field(*names)
        if which is None:
            return {0: self}
        return {int(one): self.at(which == one) for one in np.unique(which)}


class Dataflash:
    """A log whose messages are taken by name. Raises `InputError` for a file that is none.

    pymavlink knows what a format means. Its own reader (`DFReader`) gives up at the first message of an unknown type,
    as damage makes them, prints every byte that it skips, and makes an object of each message, a hundred times slower
    than a column is made.
    """

    def __init__(self, path: Path) -> None:
        with path.open("rb") as stream:
            if HEADER not in stream.read(SEARCHED):
                raise InputError(
                    f"{path}: no ArduPilot dataflash log (nor a log of a Crazyflie's card): its messages are not "
                    "defined at its beginning; download the log as a .bin file"
                )
            self._map = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        self._places, self._formats, self.skipped = _indexed(self._map)
        self._bytes = np.frombuffer(self._map, dtype=np.uint8)
        self._taken: dict[str, Messages | None] = {}

    def __enter__(self) -> Dataflash:
        return self

    def __exit__(self, *_: object) -> None:
        del self._bytes  # the map cannot be closed while an array looks at it
        with contextlib.suppress(BufferError):
            self._map.close()

    def messages(self, name: str) -> Messages | None:
        """The messages of a name; None where the log has none."""
        if name not in self._taken:
            self._taken[name] = self._read(name)
        return self._taken[name]

    def first_of(self, *names: str) -> Messages | None:
        """The messages of the first of these names that the log has."""
        return next((found for name in names if (found := self.messages(name)) is not None), None)

    def _read(self, name: str) -> Messages | None:
        form = self._formats.get(name)
        if form is None or not self._places.get(form.type):
            return None
        row = np.dtype([(f"f{i}", _dtype(form.msg_struct, i)) for i in range(len(form.msg_mults))])
        starts = np.array(self._places[form.type], dtype=np.int64) + len(HEADER)
        starts = starts[starts + row.itemsize <= len(self._bytes)]
        if not len(starts) or row.itemsize + len(HEADER) > form.len:
            return None
        raw = self._bytes[starts[:, None] + np.arange(row.itemsize)].view(row)[:, 0]
        fields, whole = {}, set()
        for i, column in enumerate(form.columns[: len(form.msg_mults)]):
            factor = form.msg_mults[i]
            values = possible(raw[f"f{i}"])
            fields[column] = values if factor is None else values * factor
            if factor is None and fields[column].dtype.kind in "iu":
                whole.add(column)
        for column, unit in TIMES:
            if column in fields:
                return Messages(name, fields.pop(column).astype(np.int64) * unit, fields, frozenset(whole))
        return Messages(name, self._when(starts), fields, frozenset(whole))

    def _when(self, starts: np.ndarray) -> np.ndarray:
        """Times (M,) of messages without one (before Copter 3.3): those of the attitude or sensor written before."""
        for name in ("IMU", "ATT"):
            clock = self.messages(name)
            if clock is not None:
                places = np.array(self._places[self._formats[name].type], dtype=np.int64)[: len(clock)]
                return clock.t[np.clip(np.searchsorted(places, starts) - 1, 0, len(clock) - 1)]
        return np.zeros(len(starts), dtype=np.int64)


def _indexed(data: mmap.mmap) -> tuple[dict[int, list[int]], dict[str, Any], int]:
    """Where the messages of each type begin, the formats by name, and how many bytes were no message.

    A message counts where the next one begins right behind it, or the file ends: what damage makes of one does not.
    """
    from pymavlink.DFReader import FORMAT_TO_STRUCT, DFFormat

    lengths, formats = {FORMAT: FORMAT_LENGTH}, {}
    places: dict[int, list[int]] = {}
    size, at, skipped = len(data), 0, 0
    while at + len(HEADER) <= size:
        length = lengths.get(data[at + 2]) if data[at : at + 2] == START else None
        after = at + (length or 0)
        if length is None or after > size or (after + 2 <= size and data[after : after + 2] != START):
            found = data.find(START, at + 1)
            found = size if found < 0 else found
            skipped += found - at
            at = found
            continue
        kind = data[at + 2]
        places.setdefault(kind, []).append(at)
        if kind == FORMAT:
            number, long, *texts = struct.unpack("<BB4s16s64s", data[at + len(HEADER) : after])
            name, code, columns = (t.split(b"\0")[0].decode("ascii", "replace") for t in texts)
            if long > len(HEADER) and all(c in FORMAT_TO_STRUCT for c in code) and name not in formats:
                lengths[number] = long
                formats[name] = DFFormat(number, name, long, code, columns)
        at = after
    return places, formats, skipped


def _dtype(codes: str, index: int) -> str:
    """numpy's type of one field of `struct` codes such as "<Qf16s"."""
    fields, length = [], ""
    for code in codes[1:]:
        if code.isdigit():
            length += code
            continue
        fields.append(
            f"S{length}" if code == "s" else f"<{code}" if code not in "bB" else {"b": "i1", "B": "u1"}[code]
        )
        length = ""
    return fields[index]
