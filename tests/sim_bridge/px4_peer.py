"""A scripted PX4 at the far end of the simulator's TCP port: the exchange that a real one was seen to have.

It connects, asks for the ground truth, sends a heartbeat and waits. HIL_SENSOR with id 0 is its clock. After its start
it answers each of them with one HIL_ACTUATOR_CONTROLS. Everything here is in PX4's frames (NED, FRD) and numpy's
plain vector algebra, and shares no conversion with the bridge.
"""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mav

ARMED, CUSTOM, LOCKSTEP = 128, 1, 1
EARTH = 6371000.0
GRAVITY = 9.81


def skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def turned(angle: np.ndarray) -> np.ndarray:
    """The rotation matrix of a rotation vector (Rodrigues)."""
    size = float(np.linalg.norm(angle))
    if size < 1e-12:
        return np.eye(3)
    k = skew(angle / size)
    return np.eye(3) + math.sin(size) * k + (1 - math.cos(size)) * k @ k


@dataclass
class Sensed:
    """One step as PX4 sees it: the messages that came with one HIL_SENSOR."""

    sensor: Any
    others: list[Any] = field(default_factory=list)

    def of(self, kind: str) -> Any:
        return next((message for message in self.others if message.get_type() == kind), None)


class Px4Peer:
    """The connection. `next()` gives the next step's sensors, `answer()` sends motor commands for it."""

    def __init__(self, port: int, timeout: float = 60.0) -> None:
        end = time.monotonic() + timeout
        while True:
            try:
                self.socket = socket.create_connection(("127.0.0.1", port), timeout=timeout)
                break
            except ConnectionRefusedError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.05)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.link = mav.MAVLink(None, srcSystem=1, srcComponent=1)
        self.waiting: list[Any] = []
        self.sent_interval = 5000.0

    def greet(self, autopilot: int = mav.MAV_AUTOPILOT_PX4) -> None:
        number = mav.MAVLINK_MSG_ID_HIL_STATE_QUATERNION
        self.send(mav.MAVLink_command_long_message(0, 0, 511, 0, number, self.sent_interval, 0, 0, 0, 0, 0))
        self.send(mav.MAVLink_heartbeat_message(0, autopilot, 0, 0, 0, 3))

    def send(self, message: Any) -> None:
        self.socket.sendall(message.pack(self.link))

    def _receive(self) -> None:
        while not self.waiting:
            data = self.socket.recv(65536)
            if not data:
                raise ConnectionError("the simulator closed the connection")
            self.waiting += self.link.parse_buffer(data) or []

    def next(self) -> Sensed:
        """The next HIL_SENSOR and what comes with it, up to the one after or to the end of what has arrived; what of
        the step before arrives later than that is among it."""
        self._receive()
        late = []
        while self.waiting[0].get_type() != "HIL_SENSOR":
            late.append(self.waiting.pop(0))
            self._receive()
        step = Sensed(self.waiting.pop(0), late)
        while self.waiting and self.waiting[0].get_type() != "HIL_SENSOR":
            step.others.append(self.waiting.pop(0))
        return step

    def answer(
        self, step: Sensed, motors: Any = (0.0,) * 4, armed: bool = False, flags: int = LOCKSTEP
    ) -> None:
        controls = [*(float(value) for value in motors), *(0.0,) * 16][:16]
        mode = CUSTOM | (ARMED if armed else 0)
        self.send(mav.MAVLink_hil_actuator_controls_message(step.sensor.time_usec, controls, mode, flags))

    def fly(
        self, seconds: float, control: Callable[[Sensed], Any] | None, armed: bool = True
    ) -> list[Sensed]:
        """Answer every step for so much of PX4's time; the steps."""
        steps = [self.next()]
        begin = steps[0].sensor.time_usec
        while True:
            step = steps[-1]
            self.answer(step, (0.0,) * 4 if control is None else control(step), armed)
            if step.sensor.time_usec - begin >= seconds * 1e6:
                return steps
            steps.append(self.next())

    def close(self) -> None:
        self.socket.close()


class Hover:
    """Flies by the sensors it gets and by nothing else: gyroscope integrated, level and north found at rest.

    `target` in m, NED from where it stood; `arms` are the rotors' places (forward, right) in m and `turns` their
    directions (+1 counter-clockwise from above), as PX4's control allocation has them; `hover` the command that hovers.
    """

    def __init__(self, arms: Any, turns: Any, hover: float, mass: float, inertia: Any) -> None:
        self.target = np.zeros(3)
        self.inertia = np.array(inertia)
        self.mass, self.hover = mass, hover
        rows = []
        for (forward, right), turn in zip(arms, turns, strict=True):
            # Thrust is up, -z: its moment about the centre is r x F. A rotor that turns counter-clockwise from above
            # turns the body the other way, which is positive yaw in FRD.
            moment = np.cross([forward, right, 0.0], [0.0, 0.0, -1.0])
            rows.append([1.0, moment[0], moment[1], 0.009 * turn])
        self.mix = np.linalg.inv(np.array(rows).T)
        self.rotation: np.ndarray | None = None
        self.position, self.velocity = np.zeros(3), np.zeros(3)
        self._still: list[tuple[np.ndarray, np.ndarray]] = []
        self._field = np.zeros(3)
        self._home: tuple[float, float, float] | None = None
        self._integral = np.zeros(3)

    def local(self, gps: Any) -> np.ndarray:
        latitude, longitude, altitude = gps.lat * 1e-7, gps.lon * 1e-7, gps.alt * 1e-3
        if self._home is None:
            self._home = (latitude, longitude, altitude)
        a, b, c = self._home
        east = math.radians(longitude - b) * EARTH * math.cos(math.radians(a))
        return np.array([math.radians(latitude - a) * EARTH, east, c - altitude])

    def stand(self, step: Sensed) -> tuple[float, ...]:
        """On the ground: collect what the sensors say at rest."""
        s = step.sensor
        if s.fields_updated & 0x1C0:
            self._field = np.array([s.xmag, s.ymag, s.zmag])
        self._still.append((np.array([s.xacc, s.yacc, s.zacc]), self._field))
        if step.of("HIL_GPS") is not None:
            self.local(step.of("HIL_GPS"))
        return (0.0,) * 4

    def align(self) -> None:
        """Level and heading from what was seen at rest: an accelerometer at rest reads up, a compass north and down."""
        force = np.mean([one for one, _ in self._still], axis=0)
        field = np.mean([two for _, two in self._still[10:]], axis=0)
        down = -force / np.linalg.norm(force)
        east = np.cross(down, field)
        east /= np.linalg.norm(east)
        north = np.cross(east, down)
        self.rotation = np.array([north, east, down])  # body to NED, up to the declination

    def control(self, step: Sensed) -> np.ndarray:
        if self.rotation is None:
            self.align()
        s, dt = step.sensor, 0.004
        rate = np.array([s.xgyro, s.ygyro, s.zgyro])
        self.rotation = self.rotation @ turned(rate * dt)
        acceleration = self.rotation @ np.array([s.xacc, s.yacc, s.zacc]) + [0, 0, GRAVITY]
        self.position = self.position + self.velocity * dt
        self.velocity = self.velocity + acceleration * dt
        gps = step.of("HIL_GPS")
        if gps is not None:
            self.position += 0.3 * (self.local(gps) - self.position)
            self.velocity += 0.3 * (np.array([gps.vn, gps.ve, gps.vd]) * 0.01 - self.velocity)
        error = self.position - self.target
        self._integral = np.clip(self._integral + 0.3 * error * dt, -1.0, 1.0)
        wanted = np.clip(-1.2 * error - 1.8 * self.velocity - self._integral, -3.0, 3.0)
        thrust = self.mass * (
            np.array([0.0, 0.0, GRAVITY]) - wanted
        )  # opposite to the force: along body down
        down = thrust / np.linalg.norm(thrust)
        # Tilt error as a rotation in the body; heading is held at where it began, by the rate alone.
        tilt = np.cross([0.0, 0.0, 1.0], self.rotation.T @ down)
        rates = 8.0 * tilt
        torque = self.inertia * (20.0 * (rates - rate) * [1.0, 1.0, 0.3])
        forces = self.mix @ [float(thrust @ self.rotation[:, 2]), *torque]
        return np.clip(self.hover * forces / (self.mass * GRAVITY / 4), 0.0, 1.0)


class ParameterServer:
    """PX4's second stream: answers parameter requests on UDP from a port of its own to the bridge's."""

    def __init__(self, port: int, values: dict[str, int | float], obey: bool = True) -> None:
        self.values, self.obey = dict(values), obey
        self.batteries: list[Any] = []
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.connect(("127.0.0.1", port))
        self.socket.setblocking(False)
        self.link = mav.MAVLink(None, srcSystem=1, srcComponent=1)

    def send(self, message: Any) -> None:
        try:
            self.socket.send(message.pack(self.link))
        except ConnectionError:
            return

    def serve(self) -> None:
        """Send a heartbeat and answer what has come."""
        self.send(mav.MAVLink_heartbeat_message(2, mav.MAV_AUTOPILOT_PX4, 0, 0, 0, 3))
        while True:
            try:
                data = self.socket.recv(65536)
            except (BlockingIOError, ConnectionError):
                return
            for message in self.link.parse_buffer(data) or []:
                kind = message.get_type()
                if kind == "BATTERY_STATUS":
                    self.batteries.append(message)
                    continue
                name = message.param_id
                if name not in self.values:
                    continue
                integer = isinstance(self.values[name], int)
                if kind == "PARAM_SET" and self.obey:
                    value = message.param_value
                    self.values[name] = struct.unpack("<i", struct.pack("<f", value))[0] if integer else value
                held = self.values[name]
                raw = struct.unpack("<f", struct.pack("<i", held))[0] if integer else float(held)
                kind_number = mav.MAV_PARAM_TYPE_INT32 if integer else mav.MAV_PARAM_TYPE_REAL32
                self.send(mav.MAVLink_param_value_message(name.encode(), raw, kind_number, 1000, 0))

    def close(self) -> None:
        self.socket.close()
