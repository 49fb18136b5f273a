"""One partner on the link: its address, its message streams and its parser."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as mav

from trueflight.sim_bridge.mavlink.telemetry import ESTIMATOR_STREAMS, STREAMS

Address = tuple[str, int]

_MAVLINK_1, _MAVLINK_2 = 0xFE, 0xFD  # first byte of a message


@dataclass
class Stream:
    """A message that is sent every `interval` us of the vehicle's clock; 0 switches it off."""

    interval: int
    due: int


class Peer:
    """A partner with message rates of its own. Times in us of the vehicle's clock."""

    def __init__(self, address: Address, system: int, component: int, permanent: bool, now: int) -> None:
        self.address = address
        self.permanent = permanent
        self.ground_station = False
        self.heard = now
        self.link = mav.MAVLink(None, srcSystem=system, srcComponent=component)
        self.link.robust_parsing = True
        self.streams = {number: Stream(_interval_of(rate), now) for number, (_, rate) in STREAMS.items()}
        self.next_due = now

    def parse(self, datagram: bytes) -> list[Any]:
        """The messages of a datagram, which holds whole ones; what is not MAVLink is skipped.

        pymavlink's own parser reads a stream: a broken datagram would make it wait for the rest in the next ones.
        """
        messages = []
        begin = 0
        while begin + 8 <= len(datagram):
            if datagram[begin] == _MAVLINK_2:
                length = datagram[begin + 1] + (25 if datagram[begin + 2] & mav.MAVLINK_IFLAG_SIGNED else 12)
            elif datagram[begin] == _MAVLINK_1:
                length = datagram[begin + 1] + 8
            else:
                begin += 1
                continue
            try:
                messages.append(self.link.decode(bytearray(datagram[begin : begin + length])))
                begin += length
            except (mav.MAVError, struct.error, ValueError):
                begin += 1
        return messages

    def pack(self, message: Any) -> bytes:
        """The bytes of a message on this link."""
        packed: bytes = message.pack(self.link)
        # Sequence numbers are counted per link, so that the partner sees its own losses only.
        self.link.seq = (self.link.seq + 1) % 256
        return packed

    def set_interval(self, number: int, interval: float, now: int) -> bool:
        """As MAV_CMD_SET_MESSAGE_INTERVAL: us between messages, 0 the default rate, -1 off. False where
        unknown.
        """
        if number not in self.streams or not math.isfinite(interval):
            return False
        stream = self.streams[number]
        stream.interval = _interval_of(STREAMS[number][1]) if interval == 0 else max(round(interval), 0)
        if stream.interval:
            stream.due = _next_due(now, stream.interval)
            self.next_due = min(self.next_due, stream.due)
        return True

    def interval(self, number: int) -> int:
        """As MESSAGE_INTERVAL.interval_us: us between messages, -1 off, 0 not available."""
        if number not in self.streams:
            return 0
        return self.streams[number].interval or -1

    def due(self, now: int, estimator_interval: int) -> list[int]:
        """The messages to send now, by number."""
        if now < self.next_due:
            return []
        numbers = []
        soonest = now + 1_000_000
        for number, stream in self.streams.items():
            interval = stream.interval
            if not interval:
                continue
            if number in ESTIMATOR_STREAMS and interval < estimator_interval:
                interval = estimator_interval
            if now >= stream.due:
                numbers.append(number)
                stream.due = _next_due(now, interval)
            soonest = min(soonest, stream.due)
        self.next_due = soonest
        return numbers


def _next_due(now: int, interval: int) -> int:
    """The next multiple of the interval: messages with the same rate are of the same moment."""
    return (now // interval + 1) * interval


def _interval_of(rate: float) -> int:
    return round(1e6 / rate) if rate else 0
