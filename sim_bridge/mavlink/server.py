"""The loop that paces the simulation against the wall clock and serves MAVLink and the pilot over UDP."""

from __future__ import annotations

import errno
import gc
import json
import select
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as mav

from trueflight.models.errors import InputError
from trueflight.sim_bridge.autopilot import Autopilot, Verdict
from trueflight.sim_bridge.mavlink.commands import Commands
from trueflight.sim_bridge.mavlink.event import Event
from trueflight.sim_bridge.mavlink.peer import Address, Peer
from trueflight.sim_bridge.mavlink.telemetry import STREAMS
from trueflight.sim_bridge.modes import Mode
from trueflight.sim_bridge.world import PHYSICS_STEP

_BEHIND = 0.25  # s of wall time behind schedule after which the schedule is moved instead of caught up
_FORGET_US = 10_000_000  # a partner that connected by itself is forgotten after so much silence
_STATUS_TEXT = 50  # bytes a STATUSTEXT carries; longer texts come in pieces
_SOCKET_BUFFER = 1 << 20
_DATAGRAMS_PER_STEP = 64  # taken before a step that is due; a flood must not stop the physics

PILOT_MODES = (
    "POSCTL",
    "ALTCTL",
    "STABILIZED",
    "MANUAL",
    "HOLD",
    "LAND",
    "RTL",
    "OFFBOARD",
    "KILL",
    "RELEASE_KILL",
)
"""What the simulated pilot can switch to."""


@dataclass(frozen=True)
class Link:
    """Where the vehicle is on UDP: its own address, its partner's, and the pilot's port (0: no pilot)."""

    local: Address = ("127.0.0.1", 14580)
    remote: Address = ("127.0.0.1", 14540)
    pilot_port: int = 14590


def pilot_order(autopilot: Autopilot, order: str) -> dict[str, object]:
    """Carry out what the pilot switches to, one of `PILOT_MODES`; the answer tells whether it was taken."""
    autopilot.pilot_present = True
    if order == "KILL":
        verdict = autopilot.kill()
    elif order == "RELEASE_KILL":
        autopilot.release_kill()
        verdict = Verdict.ACCEPTED
    elif order in PILOT_MODES:
        verdict = autopilot.set_mode(Mode[order])
    else:
        return {"accepted": False, "reason": f"unknown mode '{order}'; known: {', '.join(PILOT_MODES)}"}
    autopilot.notices.append((4, f"Pilot took over using sticks: {order}"))
    accepted = verdict is Verdict.ACCEPTED
    reason = "" if accepted else autopilot.notices[-2][1]
    return {"accepted": accepted, "reason": reason, "mode": autopilot.mode.name, "armed": autopilot.armed}


def _bind(address: Address, what: str, option: str) -> socket.socket:
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind(address)
    except OSError as error:
        bound.close()
        host, port = address
        if error.errno == errno.EADDRINUSE:
            raise InputError(
                f"UDP port {port} on {host} is in use ({what}): another sim-bridge or PX4 may be running; "
                f"stop it or choose another port with {option}"
            ) from None
        raise InputError(
            f"cannot use {host}:{port} for {what}: {error.strerror}; choose another with {option}"
        ) from None
    bound.setblocking(False)
    return bound


class Server:
    """Serves one autopilot. `speed` is simulated time over wall time."""

    def __init__(self, autopilot: Autopilot, link: Link, speed: float = 1.0) -> None:
        self.autopilot = autopilot
        self.link = link
        self.speed = speed
        parameters = autopilot.parameters
        self.system, self.component = int(parameters["MAV_SYS_ID"]), int(parameters["MAV_COMP_ID"])
        self.commands = Commands(autopilot, self.system, self.component)
        self.socket = _bind(link.local, "MAVLink", "--port")
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BUFFER)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SOCKET_BUFFER)
        self.pilot: socket.socket | None = None
        if link.pilot_port:
            try:
                self.pilot = _bind(("127.0.0.1", link.pilot_port), "the simulated pilot", "--pilot-port")
            except InputError:
                self.socket.close()
                raise
        self.peers: dict[Address, Peer] = {}
        self._add(link.remote, permanent=True)
        self._notice_id = self._event_number = 0

    def close(self) -> None:
        """Release the sockets."""
        self.socket.close()
        if self.pilot is not None:
            self.pilot.close()

    def run(self, running: Callable[[], bool], each_step: Callable[[int], None] | None = None) -> None:
        """Simulate and serve while `running()`; `each_step(time_us)` is called after every physics step."""
        # What lives now lives to the end: the garbage collector need not walk it again in the middle of a flight.
        gc.collect()
        gc.freeze()
        autopilot = self.autopilot
        step = PHYSICS_STEP / self.speed
        sockets = [self.socket] if self.pilot is None else [self.socket, self.pilot]
        due = time.perf_counter()
        taken = 0
        while running():
            wait = due - time.perf_counter()
            # select sleeps to within some 0.1 ms and wakes at once for a datagram, so that a setpoint acts in the
            # physics step that follows its arrival. That step simulates the time since the odometry before it: a
            # companion that answers within 2 ms of wall time is not late at all in simulated time.
            ready, _, _ = select.select(sockets, (), (), max(wait, 0.0))
            if ready and (wait > 0.0 or taken < _DATAGRAMS_PER_STEP):
                taken += 1
                self._receive(ready)
                continue
            taken = 0
            if wait < -_BEHIND:
                due = time.perf_counter()
            autopilot.step()
            due += step
            if each_step is not None:
                each_step(autopilot.time_us)
            self._publish()

    def _add(self, address: Address, permanent: bool) -> Peer:
        peer = Peer(address, self.system, self.component, permanent, self.autopilot.time_us)
        self.peers[address] = peer
        return peer

    def _receive(self, ready: list[socket.socket]) -> None:
        if self.socket in ready:
            try:
                datagram, address = self.socket.recvfrom(65535)
            except (BlockingIOError, ConnectionError):
                return
            peer = self.peers.get(address) or self._add(address, permanent=False)
            peer.heard = self.autopilot.time_us
            for message in peer.parse(datagram):
                for reply in self.commands.handle(message, peer):
                    self._send(peer, reply)
        elif self.pilot is not None:
            self._serve_pilot(self.pilot)

    def _serve_pilot(self, pilot: socket.socket) -> None:
        try:
            datagram, address = pilot.recvfrom(4096)
        except (BlockingIOError, ConnectionError):
            return
        try:
            order = str(json.loads(datagram)["mode"])
        except (ValueError, KeyError, TypeError):
            answer: dict[str, object] = {"accepted": False, "reason": 'send {"mode": "POSCTL"}'}
        else:
            answer = pilot_order(self.autopilot, order)
        pilot.sendto(json.dumps(answer).encode(), address)

    def _send(self, peer: Peer, message: Any) -> None:
        # Nobody need listen: a full buffer or a refused datagram is loss, as on any link.
        try:
            self.socket.sendto(peer.pack(message), peer.address)
        except (BlockingIOError, ConnectionError):
            return

    def _publish(self) -> None:
        autopilot = self.autopilot
        now = autopilot.time_us
        fastest = int(autopilot.parameters["EKF2_PREDICT_US"])
        forgotten: list[Address] = []
        for address, peer in self.peers.items():
            for number in peer.due(now, fastest):
                self._send(peer, STREAMS[number][0](autopilot))
            if not peer.permanent and now - peer.heard > _FORGET_US * max(self.speed, 1.0):
                forgotten.append(address)
        for address in forgotten:
            del self.peers[address]
        if autopilot.notices:
            self._tell()
        while autopilot.events:
            event = Event(*autopilot.events.popleft(), autopilot.time_us // 1000, self._event_number)
            self._event_number += 1
            for peer in self.peers.values():
                self._send(peer, event)

    def _tell(self) -> None:
        notices = list(self.autopilot.notices)
        self.autopilot.notices.clear()
        for severity, text in notices:
            encoded = text.encode()
            self._notice_id = self._notice_id % 65535 + 1
            pieces = [encoded[i : i + _STATUS_TEXT] for i in range(0, len(encoded), _STATUS_TEXT)]
            for sequence, piece in enumerate(pieces):
                number = self._notice_id if len(pieces) > 1 else 0
                message = mav.MAVLink_statustext_message(severity, piece, number, sequence)
                # PX4 tells ground stations only: a companion learns of a refusal from the acknowledgement
                # alone.
                for peer in self.peers.values():
                    if peer.ground_station:
                        self._send(peer, message)
