"""Columns of many protobuf messages of one kind, without an object for each.

Messages of a recording hardly differ in form: the same fields, in the same places. The first is walked field by field;
all that have its form are then read at once, a field at a time. Wire format: https://protobuf.dev/programming-guides/encoding.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import Message

VARINT, FIXED64, DELIMITED = 0, 1, 2
_WIRE = {
    FieldDescriptor.TYPE_DOUBLE: FIXED64,
    FieldDescriptor.TYPE_INT64: VARINT,
    FieldDescriptor.TYPE_UINT32: VARINT,
    FieldDescriptor.TYPE_BOOL: VARINT,
    FieldDescriptor.TYPE_STRING: DELIMITED,
    FieldDescriptor.TYPE_MESSAGE: DELIMITED,
}
Into = Mapping[str, tuple[np.ndarray, float]]
"""Where the fields of a path go, and what stands there for a message that has none."""
MOST_FORMS = 64
"""Forms of messages of one length that are looked for in one batch before messages are put into the usual form."""
MOST_REMEMBERED = 1000
"""Forms that are remembered from batch to batch."""


@dataclass(frozen=True)
class _Slot:
    """A field that messages of one form have: its path, the place of its content, and how it is written."""

    path: str
    start: int
    stop: int
    kind: int


@dataclass(frozen=True)
class _Form:
    """`slots` of the fields present, `mask` (L,) of the bits that all messages of the form have in common, what these
    are (`fixed`), and the submessages that are there, by path."""

    slots: tuple[_Slot, ...]
    mask: np.ndarray
    fixed: np.ndarray
    present: tuple[str, ...]


class Unusual(Exception):
    """A message that is whole, perhaps, but not as our own writer makes them."""


class Columns:
    """Reads messages of a `kind`, many at a time; what a message has not is `unknown` by its path.

    `words` (text by its number) and the forms of messages that were seen are kept from one batch to the next.
    """

    def __init__(self, kind: type[Message], unknown: Mapping[str, float]) -> None:
        self._kind, self._unknown = kind, unknown
        self.words = {"": 0}
        self._forms: dict[int, list[_Form]] = {}

    def read(
        self, data: bytes, starts: np.ndarray, lengths: np.ndarray, columns: Mapping[str, np.ndarray]
    ) -> None:
        """Write the fields of the messages in `data` that begin at `starts` (N,) and have `lengths` (N,) bytes into
        `columns`, each (N,), by the field's path: position.x.

        Text is written as its number in `words`; of a submessage that is there what it lacks is zero. Repeated doubles
        go by index ("rotor_speed.0"). Raises what protobuf does for a message that is damaged.
        """
        into = {path: (column, self._unknown[path]) for path, column in columns.items()}
        for length in np.unique(lengths).tolist():
            rows = np.flatnonzero(lengths == length)
            block = _gathered(data, starts[rows], length)
            for _ in range(MOST_FORMS):
                if not len(rows):
                    break
                try:
                    form = self._form(block[0])
                except Unusual:
                    same = np.all(block == block[0], axis=1)
                    self._rewritten(block[0].tobytes(), rows[same], into)
                else:
                    same = np.all((block & form.mask) == form.fixed, axis=1)
                    _fill(form, block if same.all() else block[same], rows[same], into, self.words)
                rows, block = rows[~same], block[~same]
            for row, one in zip(rows, block, strict=True):
                self._rewritten(one.tobytes(), np.array([row]), into)

    def _form(self, message: np.ndarray) -> _Form:
        known = self._forms.setdefault(len(message), [])
        for form in known:
            if np.array_equal(message & form.mask, form.fixed):
                return form
        if sum(map(len, self._forms.values())) > MOST_REMEMBERED:  # a damaged file may have no two alike
            self._forms, known = {}, []
        form = _form_of(self._kind.DESCRIPTOR, message.tobytes())
        self._forms[len(message)] = [*known, form]
        return form

    def _rewritten(self, data: bytes, rows: np.ndarray, into: Into) -> None:
        """Read one message, by protobuf itself, that stands in all of `rows`."""
        message = self._kind.FromString(data)
        message.DiscardUnknownFields()
        usual = message.SerializeToString(deterministic=True)
        block = np.tile(np.frombuffer(usual, np.uint8), (len(rows), 1))
        _fill(_form_of(self._kind.DESCRIPTOR, usual), block, rows, into, self.words)


def _gathered(data: bytes, starts: np.ndarray, length: int) -> np.ndarray:
    """The bytes (n, `length`) of messages of one length."""
    if not length:
        return np.empty((len(starts), 0), np.uint8)
    whole = np.dtype((np.void, length))
    every = np.ndarray((len(data) - length + 1,), whole, data, 0, (1,))  # one from each byte on
    return every[starts].view(np.uint8).reshape(len(starts), length)


def _form_of(kind: Descriptor, data: bytes) -> _Form:
    slots: list[_Slot] = []
    present: list[str] = []
    mask = np.full(len(data), 0xFF, np.uint8)
    _walk(kind, data, 0, len(data), "", slots, present)
    for slot in slots:
        mask[slot.start : slot.stop] = 0x80 if slot.kind == VARINT else 0
    return _Form(tuple(slots), mask, mask & np.frombuffer(data, np.uint8), tuple(present))


def _walk(
    kind: Descriptor, data: bytes, at: int, end: int, prefix: str, slots: list[_Slot], present: list[str]
) -> None:
    """Note all fields of a message between two places of `data`."""
    seen = set()
    while at < end:
        tag, at = _varint(data, at, end)
        known = kind.fields_by_number.get(tag >> 3)
        if known is None or tag >> 3 in seen:
            raise Unusual
        seen.add(tag >> 3)
        path, wire = f"{prefix}{known.name}", tag & 7
        if known.is_repeated:
            if wire != DELIMITED or known.type != FieldDescriptor.TYPE_DOUBLE:
                raise Unusual
        elif _WIRE.get(known.type) != wire:
            raise Unusual
        if wire == VARINT:
            start = at
            _, at = _varint(data, at, end)
            slots.append(_Slot(path, start, at, VARINT))
            continue
        size = 8
        if wire == DELIMITED:
            size, at = _varint(data, at, end)
        if at + size > end:
            raise Unusual
        if known.is_repeated:
            if size % 8:
                raise Unusual
            slots += [_Slot(f"{path}.{i}", at + 8 * i, at + 8 * i + 8, FIXED64) for i in range(size // 8)]
        elif known.type == FieldDescriptor.TYPE_MESSAGE:
            present.append(f"{path}.")
            _walk(known.message_type, data, at, at + size, f"{path}.", slots, present)
        else:
            slots.append(_Slot(path, at, at + size, wire))
        at += size


def _varint(data: bytes, at: int, end: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= end:
            raise Unusual
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise Unusual


def _fill(form: _Form, block: np.ndarray, rows: np.ndarray, into: Into, words: dict[str, int]) -> None:
    """Write the fields of messages `block` (n, L), contiguous and of one form, into `rows` (n,)."""
    own: Any = slice(int(rows[0]), int(rows[-1]) + 1) if rows[-1] - rows[0] + 1 == len(rows) else rows
    there = {slot.path for slot in form.slots}
    for path, (column, unknown) in into.items():
        if path not in there:
            column[own] = 0.0 if f"{path.rpartition('.')[0]}." in form.present else unknown
    for slot in form.slots:
        if slot.path not in into:
            continue
        column, _ = into[slot.path]
        if slot.kind == FIXED64:
            column[own] = np.ndarray(len(block), "<f8", block.data, slot.start, block.strides[:1])
        elif slot.kind == VARINT:
            column[own] = _integers(block[:, slot.start : slot.stop])
        else:
            column[own] = _numbered(block[:, slot.start : slot.stop], words)


def _integers(content: np.ndarray) -> np.ndarray:
    """Numbers (n,) of varints (n, b)."""
    value = np.zeros(len(content), np.uint64)
    for i, byte in enumerate(content.T):
        value |= (byte & np.uint8(0x7F)).astype(np.uint64) << np.uint64(7 * i)
    return value.view(np.int64)


def _numbered(content: np.ndarray, words: dict[str, int]) -> np.ndarray:
    """Numbers (n,) of the text that bytes (n, b) are."""
    if np.all(content == content[0]):
        return np.full(len(content), words.setdefault(content[0].tobytes().decode("utf-8"), len(words)))
    whole = np.ascontiguousarray(content).view(np.dtype((np.void, content.shape[1])))[:, 0]
    found, which = np.unique(whole, return_inverse=True)
    return np.array([words.setdefault(w.tobytes().decode("utf-8"), len(words)) for w in found])[which]


def leaves(kind: Descriptor, prefix: str = "") -> Iterator[tuple[str, FieldDescriptor]]:
    """Path and description of every field of a message that is not a message itself."""
    for known in kind.fields:
        if known.type == FieldDescriptor.TYPE_MESSAGE:
            yield from leaves(known.message_type, f"{prefix}{known.name}.")
        else:
            yield f"{prefix}{known.name}", known
