"""The records of an MCAP file, whole chunks only, with every size checked before memory is taken for it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import StreamReader, breakup_chunk

MOST_IN_CHUNK = 256 << 20
"""Bytes of one chunk when unpacked; writers make chunks of some hundred kilobytes to a few megabytes."""


def mcap_records(stream: BinaryIO, damaged: list[str]) -> Iterator[McapRecord]:
    """Every record that is whole; a chunk that is not is skipped and noted in `damaged`.

    Raises what `mcap` does where the file itself cannot be followed further: see `models.outside.unreadable`.
    """
    bounded: Any = _Bounded(stream)
    for record in StreamReader(bounded, emit_chunks=True, record_size_limit=bounded.size).records:
        if not isinstance(record, Chunk):
            yield record
            continue
        try:
            parts = breakup_chunk(_unpacked(record), validate_crc=True)
        except Exception as error:  # noqa: BLE001 - each decompressor raises its own kind
            damaged.append(" ".join(str(error).split()) or type(error).__name__)
            continue
        yield from parts


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


def _unpacked(chunk: Chunk) -> Chunk:
    """The chunk with its data uncompressed. Raises `ValueError` for one that unpacks to more than it says."""
    size = chunk.uncompressed_size
    if size > MOST_IN_CHUNK:
        raise ValueError(f"a chunk claims {size} bytes")
    if chunk.compression == "zstd":
        claimed = zstandard.get_frame_parameters(chunk.data).content_size
        if claimed not in (zstandard.CONTENTSIZE_UNKNOWN, size):
            raise ValueError(f"a chunk claims {size} bytes and {claimed}")
        data = zstandard.decompress(chunk.data, size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, size + 1)
    else:
        return chunk
    if len(data) != size:
        raise ValueError(f"a chunk claims {size} bytes and has {len(data)}")
    return replace(chunk, compression="", data=data)
