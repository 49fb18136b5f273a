"""Running `sim-bridge run` as a process of its own, on ports that nobody uses."""

from __future__ import annotations

import socket
import subprocess
from dataclasses import dataclass
from pathlib import Path

QUAD5 = Path(__file__).parents[2] / "models/vehicles/quad5"


def free_ports(count: int) -> list[int]:
    """UDP ports of 127.0.0.1 that nobody uses now."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


@dataclass(frozen=True)
class Bridge:
    """A running `sim-bridge run`: its own port, the companion's, the pilot's."""

    process: subprocess.Popen[str]
    ready: str
    port: int
    companion: int
    pilot: int
