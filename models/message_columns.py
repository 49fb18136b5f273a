"""Columns of many protobuf messages of one kind, without an object for each.

Messages of a recording hardly differ in form: the same fields, in the same places. The first is walked field by field;
all that have its form are then read at once, a field at a time. Wire format: https://protobuf.dev/programming-guides/encoding.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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
MOST_FORMS = 64
"""Forms of messages of one length that are looked for in one batch before messages are put into the usual form."""


@dataclass(frozen=True)
class _Slot:
    """A field that messages of one form have: its path, the place of its content, and how it is written."""

    path: str
    start: int
    stop: int
    kind: int


@dataclass(frozen=True)
class _Form:
    """`slots` of the fields present, `mask` (L,) of the bits that all messages of the form have in common, and the
    submessages that are there, by path."""

    slots: tuple[_Slot, ...]
    mask: np.ndarray
    present: tuple[str, ...]


class Unusual(Exception):
    """A message that is whole, perhaps, but not as our own writer makes them."""


def read_columns(
    kind: type[Message],
    messages: Sequence[memoryview],
    into: Mapping[str, np.ndarray],
    words: dict[str, int],
) -> None:
    """Write the fields of N `messages` of a `kind` into the arrays `into`, each (N,), by the field's path: position.x.

    Text is written as its number in `words`, which grows.

    What a message has not stays as it was in the array; of a submessage that is there what it lacks is zero. Repeated
    doubles go by index ("rotor_speed.0"). Raises what protobuf does for a message that is damaged.
    """
    lengths = np.array([len(m) for m in messages])
    for length in np.unique(lengths):
        rows = np.flatnonzero(lengths == length)
        block = np.frombuffer(b"".join(messages[int(i)] for i in rows), np.uint8).reshape(
            len(rows), int(length)
        )
        for _ in range(MOST_FORMS):
            if not len(rows):
                break
            try:
                form = _form_of(kind.DESCRIPTOR, block[0].tobytes())
            except Unusual:
                same = np.all(block == block[0], axis=1)
                _rewritten(kind, block[0].tobytes(), rows[same], into, words)
            else:
                same = np.all((block & form.mask) == (block[0] & form.mask), axis=1)
                _fill(form, block if same.all() else block[same], rows[same], into, words)
            rows, block = rows[~same], block[~same]
        for row, data in zip(rows, block, strict=True):
            _rewritten(kind, data.tobytes(), np.array([row]), into, words)


def _rewritten(
    kind: type[Message],
    data: bytes,
    rows: np.ndarray,
    into: Mapping[str, np.ndarray],
    words: dict[str, int],
) -> None:
    """Read one message, by protobuf itself, that stands in all of `rows`."""
    message = kind.FromString(data)
    message.DiscardUnknownFields()
    usual = message.SerializeToString(deterministic=True)
    block = np.tile(np.frombuffer(usual, np.uint8), (len(rows), 1))
    _fill(_form_of(kind.DESCRIPTOR, usual), block, rows, into, words)


def _form_of(kind: Descriptor, data: bytes) -> _Form:
    slots: list[_Slot] = []
    present: list[str] = []
    mask = np.full(len(data), 0xFF, np.uint8)
    _walk(kind, data, 0, len(data), "", slots, present)
    for slot in slots:
        mask[slot.start : slot.stop] = 0x80 if slot.kind == VARINT else 0
    return _Form(tuple(slots), mask, tuple(present))


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


def _fill(
    form: _Form, block: np.ndarray, rows: np.ndarray, into: Mapping[str, np.ndarray], words: dict[str, int]
) -> None:
    """Write the fields of messages `block` (n, L) of one form into `rows` (n,)."""
    own: Any = slice(int(rows[0]), int(rows[-1]) + 1) if rows[-1] - rows[0] + 1 == len(rows) else rows
    there = {slot.path for slot in form.slots}
    for path in form.present:
        for name, column in into.items():
            if name.startswith(path) and name not in there and "." not in name[len(path) :]:
                column[own] = 0.0
    for slot in form.slots:
        if slot.path not in into:
            continue
        column = into[slot.path]
        content = block[:, slot.start : slot.stop]
        if slot.kind == FIXED64:
            column[own] = np.ascontiguousarray(content).view("<f8")[:, 0]
        elif slot.kind == VARINT:
            column[own] = _integers(content)
        else:
            column[own] = _numbered(content, words)


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
