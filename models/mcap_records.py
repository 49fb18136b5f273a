"""The records of an MCAP file, whole chunks only, with every size checked before memory is taken for it."""

from __future__ import annotations

import os
import struct
import threading
import zlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, BinaryIO, Literal

import lz4.frame
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import StreamReader, breakup_chunk

Chunks = Literal["apart", "whole", "not"]
_HEAD = struct.Struct("<BQH")
"""Opcode and length of a record, and the channel that a message begins with."""
_OF_MESSAGE = 22
"""Bytes of a message before its data: channel, sequence and two times."""
MOST_IN_CHUNK = 256 << 20
"""Bytes of one chunk when unpacked; writers make chunks of some hundred kilobytes to a few megabytes."""


def mcap_records(stream: BinaryIO, damaged: list[str], chunks: Chunks = "apart") -> Iterator[McapRecord]:
    """Every record that is whole; a chunk that is not is skipped and noted in `damaged`. `chunks` come
    taken "apart", "whole" and uncompressed (`parts` tells what is in one), or "not" at all.

    Raises what `mcap` does where the file itself cannot be followed further: see `models.outside.unreadable`.
    """
    bounded: Any = _Bounded(stream)
    for record in _Reader(bounded, chunks, bounded.size).records:
        if not isinstance(record, Chunk):
            yield record
            continue
        try:
            unpacked = _unpacked(record)
            whole = breakup_chunk(unpacked, validate_crc=True) if chunks == "apart" else [_checked(unpacked)]
        except Exception as error:  # noqa: BLE001 - each decompressor raises its own kind
            damaged.append(" ".join(str(error).split()) or type(error).__name__)
            continue
        yield from whole


def _checked(chunk: Chunk) -> Chunk:
    if chunk.uncompressed_crc and zlib.crc32(chunk.data) != chunk.uncompressed_crc:
        raise ValueError("a chunk's checksum is wrong")
    return chunk


def parts(chunk: Chunk) -> list[tuple[int, int, int, int]]:
    """Opcode, channel (of messages), and where the content begins and ends, of each record of an uncompressed chunk:
    of a message its data alone. Raises `ValueError` where a record reaches beyond the chunk."""
    data, at, found, message = chunk.data, 0, [], int(Opcode.MESSAGE)
    size, head = len(data), _HEAD.unpack_from
    while at < size:
        if at + _HEAD.size > size:
            raise ValueError("a chunk ends inside a record")
        opcode, length, channel = head(data, at)
        start, at = at + 9, at + 9 + length
        if at > size or (opcode == message and length < _OF_MESSAGE):
            raise ValueError("a record reaches beyond its chunk")
        found.append((opcode, channel, start + _OF_MESSAGE if opcode == message else start, at))
    return found


class _Reader(StreamReader):
    """Passes over where messages stand in a chunk: nobody asks here, and it takes longer than to read them."""

    def __init__(self, stream: Any, chunks: Chunks, size: int) -> None:
        super().__init__(stream, emit_chunks=True, record_size_limit=size)
        self._passed = {Opcode.MESSAGE_INDEX, *([Opcode.CHUNK] if chunks == "not" else [])}

    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        return None if opcode in self._passed else super()._read_record(opcode, length)


class _Bounded:
    """A file that is asked for no more than it has: lengths in a damaged file may be anything."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.size = os.fstat(stream.fileno()).st_size
        self._left = self.size

    def read(self, length: int = -1) -> bytes:
        """Bytes from here on, fewer at the end."""
        data = self._stream.read(min(max(length, 0), self._left))
        self._left -= len(data)
        return data


class _Of(threading.local):
    """One decompressor for each thread: no two may use one, and it takes as long to make as a chunk to unpack."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdDecompressor()


_OF_THREAD = _Of()


def _unpacked(chunk: Chunk) -> Chunk:
    """The chunk with its data uncompressed. Raises `ValueError` for one that unpacks to more than it says."""
    size = chunk.uncompressed_size
    if size > MOST_IN_CHUNK:
        raise ValueError(f"a chunk claims {size} bytes")
    if chunk.compression == "zstd":
        claimed = zstandard.get_frame_parameters(chunk.data).content_size
        if claimed not in (zstandard.CONTENTSIZE_UNKNOWN, size):
            raise ValueError(f"a chunk claims {size} bytes and {claimed}")
        data = _OF_THREAD.zstd.decompress(chunk.data, size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, size + 1)
    else:
        return chunk
    if len(data) != size:
        raise ValueError(f"a chunk claims {size} bytes and has {len(data)}")
    return replace(chunk, compression="", data=data)
