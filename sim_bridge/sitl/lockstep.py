"""The loop between a real PX4 and the simulated world: sensors out, motor commands in, one clock for both.

PX4's simulation connects as TCP client, asks for the ground truth (MAV_CMD_SET_MESSAGE_INTERVAL) and waits: the
HIL_SENSOR messages are its clock. Until it drives its outputs it says nothing more, and time runs freely; from then
on it answers each HIL_SENSOR with one HIL_ACTUATOR_CONTROLS of the same time, and the world waits for it.
"""

from __future__ import annotations

import errno
import select
import socket
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from pymavlink.dialects.v20 import common as mav

from trueflight.models.errors import InputError
from trueflight.sim_bridge.mavlink.stream import MessageStream
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.sitl.messages import SENSOR_PERIOD, SENSOR_STEPS, Offer, SensorMessages
from trueflight.sim_bridge.sitl.sensors import RawSensors

_PERIOD_US = round(SENSOR_PERIOD * 1e6)

_HOUSEKEEPING_EVERY = 25

_ARMED, _LOCKSTEP = 128, 1  # bits of HIL_ACTUATOR_CONTROLS.mode and .flags
_FREE_RUN = 4.0  # times real time while PX4 boots: its start script takes wall time
_PATIENCE = 0.25  # s of wall time for an answer; then the world goes on for one step with the commands it has
_SILENCE = 10.0  # s of wall time without any answer that end the flight
_HANDSHAKE = 10.0  # s of wall time for the first message of what has connected
_GARBAGE = 600  # bytes without any message that tell a stranger
_BEHIND = 0.25  # s of wall time behind schedule after which the schedule is moved instead of caught up
_PARKED = 4  # further connections that are kept waiting

Tell = Callable[[str], None]


class Ending(Enum):
    """Why a flight with PX4 ended."""

    STOPPED = "stopped"
    CLOSED = "PX4 closed the connection"
    SILENT = "PX4 fell silent"


@dataclass
class Progress:
    """Where a flight is. `simulated` and `wall` in s since the connection; `late` counts steps without an answer in
    time; `airborne` tells whether the vehicle is off the ground; `answer_times` in s of wall time, of the last steps.
    """

    simulated: float = 0.0
    wall: float = 0.0
    answers: int = 0
    late: int = 0
    armed: bool = False
    airborne: bool = False
    refused: int = 0
    answer_times: deque[float] = field(default_factory=lambda: deque(maxlen=10_000))

    @property
    def times_real_time(self) -> float:
        """Simulated over wall time."""
        return self.simulated / self.wall if self.wall > 0 else 0.0


def listen(host: str, port: int) -> socket.socket:
    """A socket that waits for PX4. Raises `InputError` where the address cannot be used."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(_PARKED)
    except (OSError, OverflowError) as error:
        listener.close()
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            raise InputError(
                f"TCP port {port} on {host} is in use: another simulator (sim-bridge sitl, Gazebo, jMAVSim) may be "
                "running; stop it, or choose --port 4561 and start PX4 with `-i 1`"
            ) from None
        raise InputError(f"cannot listen on {host}:{port} ({error}); choose --host and --port") from None
    listener.setblocking(False)
    return listener


class Lockstep:
    """Serves one PX4 with the sensors of one simulated vehicle. `speed` is simulated over wall time, 0 without a limit.

    `tell` gets one line for everything that a user should know.
    """

    def __init__(
        self,
        simulator: Simulator,
        sensors: RawSensors,
        listener: socket.socket,
        tell: Tell,
        speed: float = 1.0,
        offer: Offer | None = None,
    ) -> None:
        self.simulator = simulator
        self.speed = speed
        self.progress = Progress()
        self.peer = ""
        self._listener = listener
        self._tell = tell
        self._client: socket.socket | None = None
        self._parked: list[socket.socket] = []
        self._stream = MessageStream()
        self._motors = (0.0, 0.0, 0.0, 0.0)
        self._in_step = False  # from PX4's first motor commands on
        self._answered_us = self._sent_us = 0
        self._answered_at = 0.0
        self._ticks = 0
        self._start_us = simulator.time_us
        self._now = self._before = simulator.moment()
        self._messages = SensorMessages(sensors, Offer() if offer is None else offer, self._now)
        self._foreign_told = False

    def close(self) -> None:
        """Release the connections."""
        for one in (*self._parked, *([self._client] if self._client else [])):
            one.close()
        self._listener.close()

    # Before the flight

    def accept(self, running: Callable[[], bool]) -> bool:
        """Wait for a PX4 to connect and to speak; False when `running` ends first. Others are told and sent away."""
        while running():
            ready, _, _ = select.select([self._listener], (), (), 0.2)
            if not ready:
                continue
            client, address = self._listener.accept()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.peer = f"{address[0]}:{address[1]}"
            self._stream = MessageStream()
            complaint = self._greet(client, running)
            if not complaint:
                self._client = client
                return running()
            if running():
                self._tell(f"{self.peer} was sent away: {complaint}; still waiting for PX4")
            client.close()
        return False

    def _greet(self, client: socket.socket, running: Callable[[], bool]) -> str:
        """Hear what a connection says first; the complaint, or nothing where it is a PX4."""
        deadline = time.monotonic() + _HANDSHAKE
        while time.monotonic() < deadline and running():
            ready, _, _ = select.select([client], (), (), 0.1)
            if not ready:
                continue
            try:
                data = client.recv(65536)
            except (BlockingIOError, ConnectionError):
                data = b""
            if not data:
                return "it closed the connection before it said anything"
            for message in self._stream.feed(data):
                kind = message.get_type()
                if kind == "HEARTBEAT" and message.autopilot != mav.MAV_AUTOPILOT_PX4:
                    return f"it is no PX4 (its HEARTBEAT names autopilot {message.autopilot}, PX4 is 12)"
                if kind in ("HEARTBEAT", "COMMAND_LONG", "HIL_ACTUATOR_CONTROLS"):
                    return ""
            if self._stream.foreign > _GARBAGE:
                return "it does not speak MAVLink"
        return f"it said nothing for {_HANDSHAKE:.0f} s"

    # The flight

    def run(self, running: Callable[[], bool], each_step: Callable[[int], None] | None = None) -> Ending:
        """Fly until `running` ends or PX4 goes; `each_step` gets PX4's clock in us after every step.

        Raises `InputError` for a PX4 that cannot be simulated this way.
        """
        begin = due = time.perf_counter()
        progress, simulator = self.progress, self.simulator
        world = simulator.world
        try:
            while running():
                self._send_sensors()
                if not self._take_controls():
                    return Ending.SILENT
                self._advance()
                progress.simulated = (simulator.time_us - self._start_us) * 1e-6
                progress.wall = time.perf_counter() - begin
                progress.airborne = not world.touching and world.position[2] > world.standing_height + 0.05
                if each_step is not None:
                    each_step(self._sent_us)
                if self._ticks % _HOUSEKEEPING_EVERY == 0:
                    self._look_around()
                due = self._keep_pace(due, running)
        except ConnectionError:
            return Ending.CLOSED
        return Ending.STOPPED

    def _keep_pace(self, due: float, running: Callable[[], bool]) -> float:
        speed = self.speed if self._in_step else min(self.speed or _FREE_RUN, _FREE_RUN)
        now = time.perf_counter()
        if not speed or now - due > _BEHIND:
            return now
        due += SENSOR_PERIOD / speed
        while (wait := due - time.perf_counter()) > 0 and running():
            time.sleep(min(wait, 0.2))
        return due

    def _advance(self) -> None:
        """Two physics steps; disarmed, the motors stand still."""
        simulator, motors = self.simulator, self._motors
        for _ in range(SENSOR_STEPS):
            if self.progress.armed:
                simulator.drive(motors)
            else:
                simulator.rest()
            self._before, self._now = self._now, simulator.moment()
        self._ticks += 1

    def _send_sensors(self) -> None:
        """What the sensors say now, as one write."""
        time_us = self.simulator.time_us + _PERIOD_US  # PX4's clock must not begin at 0
        self._sent_us = time_us
        self._write(self._messages.of(self._ticks, time_us, self._before, self._now))

    def _write(self, data: bytes) -> None:
        assert self._client is not None
        deadline = time.monotonic() + _SILENCE
        while data:
            try:
                data = data[self._client.send(data) :]
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise ConnectionError("PX4 reads no more") from None
                select.select((), [self._client], (), 0.1)

    def _take_controls(self) -> bool:
        """Take PX4's motor commands for this step; False when it has been silent for too long."""
        sent = time.perf_counter()
        while True:
            waiting = self._in_step and self._answered_us < self._sent_us
            elapsed = time.perf_counter() - sent
            if waiting and elapsed > _PATIENCE:
                # Not every step of PX4's has an answer when it is stopped in a debugger or starts a module.
                self.progress.late += 1
                return time.perf_counter() - self._answered_at < _SILENCE
            assert self._client is not None
            ready, _, _ = select.select([self._client], (), (), _PATIENCE if waiting else 0.0)
            if not ready:
                if waiting:
                    continue
                return True
            try:
                data = self._client.recv(65536)
            except BlockingIOError:
                continue
            if not data:
                raise ConnectionError("closed")
            for message in self._stream.feed(data):
                if message.get_type() == "HIL_ACTUATOR_CONTROLS":
                    self._obey(message)
            if self._in_step and self._answered_us >= self._sent_us:
                self.progress.answer_times.append(time.perf_counter() - sent)

    def _obey(self, controls: Any) -> None:
        if not controls.flags & _LOCKSTEP:
            raise InputError(
                "this PX4 was built without lockstep (flag in HIL_ACTUATOR_CONTROLS): its clock would not follow the "
                "simulation; build px4_sitl_default, not px4_sitl_nolockstep"
            )
        self._in_step = True
        self._answered_us = controls.time_usec
        self._answered_at = time.perf_counter()
        progress = self.progress
        progress.answers += 1
        armed = bool(controls.mode & _ARMED)
        if armed is not progress.armed:
            progress.armed = armed
            self._tell(f"{'armed' if armed else 'disarmed'} at {progress.simulated:.1f} s")
        outputs = controls.controls
        if armed and any(abs(value) > 1e-6 for value in outputs[4:]):
            extra = [i + 1 for i in range(4, len(outputs)) if abs(outputs[i]) > 1e-6]
            raise InputError(
                f"PX4 drives output {extra[0]}, the vehicle file has 4 rotors: the airframe is another one; start PX4 "
                "with PX4_SIM_MODEL=none_iris"
            )
        a, b, c, d = (min(max(value, 0.0), 1.0) if value == value else 0.0 for value in outputs[:4])
        self._motors = (a, b, c, d)

    def _look_around(self) -> None:
        """Others at the door, and foreign bytes in the stream."""
        while select.select([self._listener], (), (), 0.0)[0]:
            other, address = self._listener.accept()
            self.progress.refused += 1
            # Closed, a second PX4 would spin on the dead connection; kept open, it waits.
            if len(self._parked) < _PARKED:
                self._parked.append(other)
            else:
                other.close()
            if self.progress.refused <= _PARKED:
                self._tell(
                    f"{address[0]}:{address[1]} connected, too, and is kept waiting: this vehicle has its PX4; give "
                    "each its own sim-bridge sitl (--port 4561 for `px4 -i 1`)"
                )
        if self._stream.foreign > _GARBAGE and not self._foreign_told:
            self._foreign_told = True
            self._tell(f"{self._stream.foreign} bytes from PX4's connection were no MAVLink and are skipped")
