"""One partner on the link: its address, its message streams and its parser."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as mav

from sim_bridge.mavlink.telemetry import ESTIMATOR_STREAMS, STREAMS

Address = tuple[str, int]


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
        """The messages of a datagram; what is not MAVLink is skipped."""
        messages = self.link.parse_buffer(bytearray(datagram)) or []
        return [message for message in messages if message.get_type() != "BAD_DATA"]

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
        stream.due = now
        self.next_due = now
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
                stream.due += interval
                if stream.due <= now:
                    stream.due = now + interval
            soonest = min(soonest, stream.due)
        self.next_due = soonest
        return numbers


def _interval_of(rate: float) -> int:
    return round(1e6 / rate) if rate else 0
