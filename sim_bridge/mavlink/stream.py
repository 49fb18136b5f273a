"""MAVLink on a stream of bytes, as TCP brings it: messages in pieces, several at once, or none at all."""

from __future__ import annotations

import struct
from typing import Any

from pymavlink.dialects.v20 import common as mav

_MAVLINK_1, _MAVLINK_2 = 0xFE, 0xFD  # first byte of a message


class MessageStream:
    """Takes bytes as they come and gives whole messages; `foreign` counts the bytes that belonged to none."""

    def __init__(self) -> None:
        self._link = mav.MAVLink(None)
        self._rest = bytearray()
        self.messages = 0
        self.foreign = 0

    def feed(self, data: bytes) -> list[Any]:
        """The messages that are complete now. A message with a wrong checksum is skipped as foreign bytes."""
        rest = self._rest
        rest += data
        found = []
        begin, size = 0, len(rest)
        while size - begin >= 3:
            if rest[begin] == _MAVLINK_2:
                signed = rest[begin + 2] & mav.MAVLINK_IFLAG_SIGNED
                end = begin + rest[begin + 1] + (25 if signed else 12)
            elif rest[begin] == _MAVLINK_1:
                end = begin + rest[begin + 1] + 8
            else:
                begin += 1
                self.foreign += 1
                continue
            if end > size:
                break
            try:
                found.append(self._link.decode(rest[begin:end]))
                begin = end
                self.messages += 1
            except (mav.MAVError, struct.error, ValueError):
                begin += 1
                self.foreign += 1
        del rest[:begin]
        return found
