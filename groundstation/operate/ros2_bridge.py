"""From a companion's ticks and events to ROS 2 or to viewers, until told to end."""

from __future__ import annotations

import json
import queue
import time
from collections.abc import Iterator

import zenoh

from trueflight.groundstation.operate.link import Link
from trueflight.groundstation.operate.processes import told_to_end
from trueflight.groundstation.operate.ros2 import Messages, Place, Publisher, Trail, reference_turn, turn
from trueflight.models.errors import InputError
from trueflight.models.record_pb2 import Event, Tick

ROUTER = "tcp/localhost:7447"
"""Where `ros2 run rmw_zenoh_cpp rmw_zenohd` listens."""
PERIOD = 0.01  # s between two looks at what has arrived
STATE = 0.5  # s of the vehicle between two diagnostics of the flight, and two of the battery and of each path


def open_ros(router: str) -> zenoh.Session:
    """A Zenoh session of its own for ROS: what may be said there is no matter of the vehicle's keys.

    Raises `InputError` where no router answers."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([router]))
    config.insert_json5("connect/timeout_ms", "3000")
    config.insert_json5("scouting/multicast/enabled", "false")
    try:
        return zenoh.open(config)
    except zenoh.ZError:
        raise InputError(
            f"--router {router}: no router of rmw_zenoh answers there; start `ros2 run rmw_zenoh_cpp rmw_zenohd`"
        ) from None


class Bridge:
    """Turns ticks and events into messages and publishes them, as they come."""

    def __init__(self, node: Publisher, messages: Messages) -> None:
        self.ticks: queue.SimpleQueue[Tick] = queue.SimpleQueue()
        self.events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self.seen = 0
        self._node, self._messages = node, messages
        self._flown, self._asked = Trail(), Trail()
        self._behind: float | None = None
        self._state = -STATE

    def run(self, link: Link, seconds: float | None = None) -> int:
        """Follow `link` until told to end or for `seconds`; returns how many ticks were seen."""
        link.follow(self.ticks.put, self.events.put)
        end = time.monotonic() + (seconds if seconds is not None else float("inf"))
        with told_to_end() as told:
            while time.monotonic() < end and not told.wait(PERIOD):
                self.forward()
        self.forward()
        return self.seen

    def forward(self) -> None:
        """Publish what has arrived since the last time."""
        for _ in range(self.ticks.qsize()):
            tick = self.ticks.get()
            self.seen += 1
            now, flown = time.time(), 1e-6 * tick.vehicle_time_us
            stamp = self._stamp(flown, now)
            for topic, data in self._messages.of_tick(tick, stamp):
                self._node.publish(topic, data, now)
            self._flown.add(Place(stamp, tick.position, turn(tick)))
            if tick.HasField("position_reference"):
                self._asked.add(Place(stamp, tick.position_reference, reference_turn(tick)))
            if abs(flown - self._state) >= STATE:
                self._state = flown
                for topic, data in self._now_and_then(tick, stamp):
                    self._node.publish(topic, data, now)
        for _ in range(self.events.qsize()):
            now = time.time()
            topic, data = self._messages.of_event(self.events.get(), now)
            self._node.publish(topic, data, now)

    def _now_and_then(self, tick: Tick, stamp: float) -> Iterator[tuple[str, bytes]]:
        yield self._messages.state(tick, stamp)
        yield self._messages.battery(tick, stamp)
        for topic, trail in (("path", self._flown), ("reference_path", self._asked)):
            trail.forget(stamp)
            yield self._messages.path(topic, trail, stamp)

    def _stamp(self, flown: float, now: float) -> float:
        """The time of a tick, s since 1970: the vehicle's clock, by the message that came with the least delay. A clock
        that begins again (another companion) begins anew."""
        behind = now - flown
        if self._behind is None or behind < self._behind or behind > self._behind + 5.0:
            self._behind = behind
        return flown + self._behind
