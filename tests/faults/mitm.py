"""A man in the middle of the MAVLink between the vehicle and the companion: it sees every message and may change it.

Real UDP on both sides. What it does to the link is a *fault*: a function from a message and the time to what is passed
on instead, with a delay for each. What the vehicle truly did is seen before the fault changes it.
"""

from __future__ import annotations

import heapq
import math
import random
import select
import socket
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import count
from typing import Any

from pymavlink.dialects.v20 import common as mav
from rig import free_port

from trueflight.companion.latest import mode_name

HEARTBEAT, TIMESYNC, SET_ATTITUDE_TARGET, HIGHRES_IMU, ODOMETRY = 0, 111, 82, 105, 331


@dataclass(frozen=True)
class Passing:
    """One message on its way. `fields` decodes it; `changed` packs it again with other fields."""

    data: bytes
    number: int
    from_vehicle: bool

    def fields(self) -> Any:
        """The message as pymavlink has it; changes to it stay here."""
        return mav.MAVLink(None).decode(bytearray(self.data))

    def changed(self, **fields: Any) -> bytes:
        """The same message from the same sender, with these fields."""
        message = self.fields()
        link = mav.MAVLink(None, srcSystem=self.data[5], srcComponent=self.data[6])
        link.seq = self.data[4]
        for name, value in fields.items():
            setattr(message, name, value)
        return bytes(message.pack(link))


Fault = Callable[[Passing, float], Iterable[tuple[float, bytes]]]
"""From a message and the time (monotonic s) to (delay in s, bytes) of what passes instead."""


def nothing(passing: Passing, now: float) -> Iterable[tuple[float, bytes]]:
    """No fault."""
    return [(0.0, passing.data)]


class ManInTheMiddle:
    """Forwards between the vehicle, which sends to `port`, and the companion, which listens on `companion_port`.

    `fault` may be set at any time. `setpoints` are the times (monotonic s) at which one left the companion, `seen` the
    true odometry as (time, north, east, down) and `mode`, `armed` what the vehicle's last heartbeat said.
    """

    def __init__(self) -> None:
        self.port, self.companion_port = free_port(), free_port()
        self.fault: Fault = nothing
        self.setpoints: list[float] = []
        self.seen: list[tuple[float, float, float, float]] = []
        self.modes: list[tuple[float, str]] = []
        self.mode, self.armed = "UNKNOWN", False
        self._vehicle_side = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._vehicle_side.bind(("127.0.0.1", self.port))
        self._companion_side = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._companion_side.bind(("127.0.0.1", 0))
        self._vehicle: tuple[str, int] | None = None
        self._late: list[tuple[float, int, bool, bytes]] = []
        self._count = count()
        self._running = True
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def empty(self) -> bool:
        """Whether nothing that was delayed is still on its way."""
        return not self._late

    def close(self) -> None:
        """Forward nothing any more."""
        self._running = False
        self._thread.join()
        self._vehicle_side.close()
        self._companion_side.close()

    def setpoints_since(self, begin: float) -> list[float]:
        """Seconds from `begin` to each setpoint after it."""
        return [t - begin for t in list(self.setpoints) if t > begin]

    def silence(self, begin: float) -> float:
        """Seconds from `begin` to the last setpoint after it; 0 where none left."""
        return max(self.setpoints_since(begin), default=0.0)

    def strayed(self, begin: float) -> float:
        """Greatest true distance in m from where the vehicle was at `begin`."""
        seen = list(self.seen)
        here = next((row for row in seen if row[0] >= begin), seen[-1])
        return max((math.dist(row[1:], here[1:]) for row in seen if row[0] >= begin), default=0.0)

    def left(self, mode: str, begin: float) -> float:
        """Seconds from `begin` until the vehicle told of another mode than `mode`; infinite where it never did."""
        return next((t - begin for t, told in list(self.modes) if t > begin and told != mode), math.inf)

    def _run(self) -> None:
        while self._running:
            wait = 0.1
            if self._late:
                wait = min(max(self._late[0][0] - time.monotonic(), 0.0), 0.1)
            ready, _, _ = select.select([self._vehicle_side, self._companion_side], [], [], wait)
            for side in ready:
                try:
                    datagram, address = side.recvfrom(65535)
                except ConnectionError:
                    continue
                if side is self._vehicle_side:
                    self._vehicle = address
                for part in messages(datagram):
                    self._pass(part, side is self._vehicle_side)
            now = time.monotonic()
            while self._late and self._late[0][0] <= now:
                _, _, to_companion, data = heapq.heappop(self._late)
                self._send(to_companion, data)

    def _pass(self, data: bytes, from_vehicle: bool) -> None:
        now = time.monotonic()
        number = int.from_bytes(data[7:10], "little")
        passing = Passing(data, number, from_vehicle)
        self._note(passing, now)
        for delay, out in self.fault(passing, now):
            if delay <= 0.0:
                self._send(from_vehicle, out)
            else:
                heapq.heappush(self._late, (now + delay, next(self._count), from_vehicle, out))

    def _note(self, passing: Passing, now: float) -> None:
        if passing.number == SET_ATTITUDE_TARGET and not passing.from_vehicle:
            self.setpoints.append(now)
        elif passing.number == ODOMETRY and passing.from_vehicle:
            odometry = passing.fields()
            self.seen.append((now, odometry.x, odometry.y, odometry.z))
        elif passing.number == HEARTBEAT and passing.from_vehicle:
            heartbeat = passing.fields()
            self.mode = mode_name(heartbeat.custom_mode)
            self.armed = bool(heartbeat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
            self.modes.append((now, self.mode))

    def _send(self, to_companion: bool, data: bytes) -> None:
        try:
            if to_companion:
                self._companion_side.sendto(data, ("127.0.0.1", self.companion_port))
            elif self._vehicle is not None:
                self._vehicle_side.sendto(data, self._vehicle)
        except ConnectionError:
            return


def messages(datagram: bytes) -> list[bytes]:
    """The MAVLink 2 messages of a datagram; a real autopilot puts several into one."""
    found, begin = [], 0
    while begin + 12 <= len(datagram):
        if datagram[begin] != 0xFD:
            begin += 1
            continue
        signature = 13 if datagram[begin + 2] & mav.MAVLINK_IFLAG_SIGNED else 0
        end = begin + 12 + datagram[begin + 1] + signature
        found.append(datagram[begin:end])
        begin = end
    return found


def delayed(seconds: float, *numbers: int, from_vehicle: bool = True) -> Fault:
    """Messages of one direction come `seconds` later: those `numbers`, all without any."""

    def fault(passing: Passing, now: float) -> Iterable[tuple[float, bytes]]:
        concerned = passing.from_vehicle == from_vehicle and (not numbers or passing.number in numbers)
        return [(seconds if concerned else 0.0, passing.data)]

    return fault


def without(number: int, fault: Fault = nothing) -> Fault:
    """`fault` on a link on which messages of this number never pass."""

    def both(passing: Passing, now: float) -> Iterable[tuple[float, bytes]]:
        return [] if passing.number == number else fault(passing, now)

    return both


def lost(*directions: bool) -> Fault:
    """Nothing passes in these directions: True from the vehicle, False to it."""

    def fault(passing: Passing, now: float) -> Iterable[tuple[float, bytes]]:
        return [] if passing.from_vehicle in directions else [(0.0, passing.data)]

    return fault


def frozen(stamp: bool = False, noise: float = 0.0, only: tuple[str, ...] = (), seed: int = 1) -> Fault:
    """The odometry of the first moment again and again; its time goes on unless `stamp` is frozen as well.

    `noise` in m, m/s and rad is added to it, so that no two are the same. `only` names the fields that stand still.
    """
    first: dict[str, Any] = {}
    generator = random.Random(seed)

    def fault(passing: Passing, now: float) -> Iterable[tuple[float, bytes]]:
        if passing.number != ODOMETRY or not passing.from_vehicle:
            return [(0.0, passing.data)]
        message = passing.fields()
        names = only or ("x", "y", "z", "q", "vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed")
        if stamp:
            names = (*names, "time_usec")
        if not first:
            first.update({name: getattr(message, name) for name in names})
        out = dict(first)
        if noise:
            for name in names:
                if name == "q":
                    w, x, y, z = (value + generator.gauss(0.0, 0.5 * noise) for value in out[name])
                    size = math.sqrt(w * w + x * x + y * y + z * z)
                    out[name] = [w / size, x / size, y / size, z / size]
                elif name != "time_usec":
                    out[name] += generator.gauss(0.0, noise)
        return [(0.0, passing.changed(**out))]

    return fault


def reset(
    north: float = 0.0, east: float = 0.0, down: float = 0.0, turn: float = 0.0, told: bool = True
) -> Fault:
    """From now on the estimate is elsewhere by so many m, and its heading by `turn` rad (NED, clockwise)."""

    def fault(passing: Passing, now: float) -> Iterable[tuple[float, bytes]]:
        if passing.number != ODOMETRY or not passing.from_vehicle:
            return [(0.0, passing.data)]
        message = passing.fields()
        c, s = math.cos(0.5 * turn), math.sin(0.5 * turn)
        w, x, y, z = message.q
        out: dict[str, Any] = {
            "x": message.x + north,
            "y": message.y + east,
            "z": message.z + down,
            "q": [c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w],
            "reset_counter": (message.reset_counter + told) % 256,
        }
        return [(0.0, passing.changed(**out))]

    return fault
