"""Real processes for the companion's tests: bridge, companion, a wiretap between them, a ground on Zenoh."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import zenoh
from processes import with_parent

from trueflight.companion.latest import mode_name
from trueflight.models import contract
from trueflight.models.record_pb2 import Event, Tick

VEHICLE = Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml"
HEARTBEAT, SET_ATTITUDE_TARGET, VISION_POSITION_ESTIMATE, ODOMETRY = 0, 82, 102, 331
PATIENCE = 90.0
"""Seconds after which a test gives up waiting; nothing measured depends on it."""


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    """A port on the loopback interface that nobody uses now."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for(condition: Callable[[], Any], what: str, patience: float = PATIENCE) -> Any:
    """What `condition` returns once it is true; fails the test when it never is."""
    end = time.monotonic() + patience
    while True:
        value = condition()
        if value:
            return value
        assert time.monotonic() < end, f"waited {patience:g} s for {what}"
        time.sleep(0.02)


class Process:
    """A child process whose output is kept, and that is ended by its own id."""

    def __init__(self, arguments: Sequence[str], extra: dict[str, str] | None = None) -> None:
        self.lines: list[str] = []
        environment = {**os.environ, "PYTHONUNBUFFERED": "1", **(extra or {})}
        self.child = subprocess.Popen(
            [sys.executable, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
            preexec_fn=with_parent,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def output(self) -> str:
        return "\n".join(self.lines)

    def ready(self) -> str:
        """The line `ready: ...`, once it is there."""

        def found() -> str | None:
            assert self.child.poll() is None or any(x.startswith("ready") for x in self.lines), self.output
            return next((line for line in self.lines if line.startswith("ready")), None)

        return str(wait_for(found, "ready"))

    def send(self, number: int) -> None:
        os.kill(self.child.pid, number)

    def end(self, number: int = signal.SIGTERM) -> int:
        """Send a signal and wait; the exit code."""
        if self.child.poll() is None:
            self.send(signal.SIGCONT)
            self.send(number)
        try:
            return self.child.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.send(signal.SIGKILL)
            raise AssertionError(f"did not end after signal {number}:\n{self.output}") from None

    def _read(self) -> None:
        assert self.child.stdout is not None
        for line in self.child.stdout:
            self.lines.append(line.rstrip())


BRISK = ("COM_OF_LOSS_T=5", "COM_DISARM_LAND=0.2", "MPC_LAND_SPEED=2")
"""The stand-in's parameters for tests of other things: it waits long for a setpoint that a busy machine delays, and
comes down fast."""


class Bridge(Process):
    """`sim-bridge run`, sending to `port`; `flags` come after `BRISK`, and the last word counts."""

    def __init__(self, port: int, *flags: str) -> None:
        self.port, self.pilot_port = free_port(), free_port()
        program = "from trueflight.sim_bridge.cli import main; main()"
        super().__init__(
            ["-c", program, "run", "--vehicle", str(VEHICLE), "--mavlink", f"udpout:127.0.0.1:{port}"]
            + ["--port", str(self.port), "--pilot-port", str(self.pilot_port)]
            + [*(text for parameter in BRISK for text in ("--param", parameter)), *flags]
        )
        self.ready()

    def pilot(self, mode: str) -> dict[str, Any]:
        """The simulated pilot switches."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sticks:
            sticks.settimeout(10.0)
            sticks.sendto(json.dumps({"mode": mode}).encode(), ("127.0.0.1", self.pilot_port))
            return dict(json.loads(sticks.recv(4096)))


class Wiretap:
    """Stands on the UDP link between vehicle and companion and notes when which message passes.

    `times[message id]` are monotonic seconds; `mode` and `armed` are those of the vehicle's last heartbeat.
    The vehicle sends to `port`, the companion listens on `companion_port`. `poses` are the datagrams that carried
    VISION_POSITION_ESTIMATE.
    """

    def __init__(self) -> None:
        self.port, self.companion_port = free_port(), free_port()
        self.times: dict[int, list[float]] = {SET_ATTITUDE_TARGET: [], ODOMETRY: []}
        self.mode, self.armed = "UNKNOWN", False
        self.poses: list[bytes] = []
        self._vehicle_side = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._vehicle_side.bind(("127.0.0.1", self.port))
        self._companion_side = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._companion_side.bind(("127.0.0.1", 0))
        self._running = True
        self._thread = threading.Thread(target=self._forward, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._running = False
        self._thread.join()
        self._vehicle_side.close()
        self._companion_side.close()

    def silence(self, since: float) -> float:
        """Seconds from `since` (monotonic) to the last setpoint that passed."""
        return max([t for t in self.times[SET_ATTITUDE_TARGET] if t > since], default=since) - since

    def _forward(self) -> None:
        vehicle: tuple[str, int] | None = None
        while self._running:
            ready, _, _ = select.select([self._vehicle_side, self._companion_side], [], [], 0.1)
            for side in ready:
                try:
                    datagram, address = side.recvfrom(65535)
                except ConnectionError:
                    continue
                now = time.monotonic()
                if len(datagram) > 10 and datagram[0] == 0xFD:
                    number = int.from_bytes(datagram[7:10], "little")
                    if number in self.times:
                        self.times[number].append(now)
                    elif number == VISION_POSITION_ESTIMATE:
                        self.poses.append(datagram)
                    elif number == HEARTBEAT and side is self._vehicle_side:
                        payload = datagram[10 : 10 + datagram[1]].ljust(9, b"\0")
                        self.mode = mode_name(int.from_bytes(payload[:4], "little"))
                        self.armed = bool(payload[6] & 128)
                try:
                    if side is self._vehicle_side:
                        vehicle = address
                        self._companion_side.sendto(datagram, ("127.0.0.1", self.companion_port))
                    elif vehicle is not None:
                        self._vehicle_side.sendto(datagram, vehicle)
                except ConnectionError:
                    continue


PATIENT = "[safety]\nlate = 0.5\nstale = 3.0\n"
"""Settings for tests of other things than lateness: a busy machine is late, and would end their flights."""


class Companion(Process):
    """`companion run` with a folder of its own, and a ground that talks to it over Zenoh.

    `settings` is the text of its companion.toml, unless a flag names one.
    """

    def __init__(
        self,
        folder: Path,
        mavlink_port: int,
        *flags: str,
        before: str = "",
        environment: dict[str, str] | None = None,
        settings: str = PATIENT,
    ) -> None:
        self.records = folder / "records"
        if "--config" not in flags:
            config = folder / "patient.toml"
            config.write_text(settings)
            flags = (*flags, "--config", str(config))
        self.zenoh_port = free_port(socket.SOCK_STREAM)
        program = "from trueflight.companion.cli import main; main()"
        if before:  # what is to be different must not end where the flying process begins
            here = "from trueflight.companion import flying; flying.fly_instead = flying.fly"
            program = f"{before}\n{here}\n{program}"
        super().__init__(
            [
                "-c",
                program,
                "run",
                "--vehicle",
                str(VEHICLE),
                "--connect",
                f"udpin://127.0.0.1:{mavlink_port}",
            ]
            + ["--records", str(self.records), "--models", str(folder / "models")]
            + ["-l", f"tcp/127.0.0.1:{self.zenoh_port}", *flags],
            environment,
        )
        self.ready()
        zenoh_config = zenoh.Config()
        zenoh_config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{self.zenoh_port}"]))
        zenoh_config.insert_json5("listen/endpoints", "[]")
        zenoh_config.insert_json5("scouting/multicast/enabled", "false")
        self.session = zenoh.open(zenoh_config)
        self.ticks: list[Tick] = []
        self.events: list[Event] = []
        self._subscribers = [
            self.session.declare_subscriber(
                contract.key("quad5", "tick"),
                lambda s: self.ticks.append(Tick.FromString(s.payload.to_bytes())),
            ),
            self.session.declare_subscriber(
                contract.key("quad5", "event"),
                lambda s: self.events.append(Event.FromString(s.payload.to_bytes())),
            ),
        ]
        wait_for(lambda: self.ticks, "the first tick over Zenoh")

    def query(self, leaf: str, payload: bytes | dict[str, Any] = b"") -> zenoh.Sample:
        """The sample that answers a query."""
        data = json.dumps(payload) if isinstance(payload, dict) else payload
        replies = list(self.session.get(contract.key("quad5", leaf), payload=data, timeout=PATIENCE))
        assert len(replies) == 1
        assert replies[0].ok is not None
        return replies[0].ok

    def ask(self, leaf: str, payload: bytes | dict[str, Any] = b"") -> dict[str, Any]:
        """The JSON that answers a query."""
        return dict(json.loads(self.query(leaf, payload).payload.to_string()))

    def fly(self, **mission: Any) -> str:
        """Ask for a mission that must be accepted; its identity."""
        wait_for(lambda: self.ask("status")["ready"], "ready to fly")
        answer = self.ask("mission", mission)
        assert answer["accepted"], answer
        return str(answer["mission"])

    def phase(self, phase: str) -> Tick:
        """The first of the newest ticks in this phase."""
        return wait_for(lambda: self.ticks[-1] if self.ticks[-1].phase == phase else None, f"phase {phase}")  # type: ignore[no-any-return]

    def done(self, mission: str) -> dict[str, Any]:
        """The status of a mission once it is over."""

        def ended() -> dict[str, Any] | None:
            assert self.child.poll() is None, self.output
            found = next(m for m in self.ask("status")["missions"] if m["mission"] == mission)
            return found if found["state"] not in ("queued", "flying") else None

        return dict(wait_for(ended, "the end of the mission"))

    def told(self, kind: str) -> list[str]:
        """The texts of all events of a kind."""
        return [event.text for event in list(self.events) if event.kind == kind]

    def end(self, number: int = signal.SIGTERM) -> int:
        self.session.close()
        return super().end(number)
