from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from bridge_process import QUAD5, Bridge, free_ports
from processes import with_parent

from trueflight.models.design import Design, load_design
from trueflight.models.vehicle import Vehicle, load_vehicle


@pytest.fixture(scope="session")
def vehicle() -> Vehicle:
    return load_vehicle(QUAD5 / "vehicle.toml")


@pytest.fixture(scope="session")
def design(vehicle: Vehicle) -> Design:
    return load_design(QUAD5 / "design.json", vehicle)


@pytest.fixture
def bridge(tmp_path: Path) -> Iterator[Callable[..., Bridge]]:
    """Starts `sim-bridge run` with more arguments; every process is ended by SIGINT after the test."""
    running: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> Bridge:
        port, companion, pilot = free_ports(3)
        process = subprocess.Popen(
            [
                *(sys.executable, "-c", "from trueflight.sim_bridge.cli import main; main()", "run"),
                *("--vehicle", str(QUAD5 / "vehicle.toml"), "--port", str(port), "--pilot-port", str(pilot)),
                *("--mavlink", f"udpout:127.0.0.1:{companion}", *arguments),
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
            preexec_fn=with_parent,
        )
        running.append(process)
        assert process.stdout is not None
        ready = process.stdout.readline()
        return Bridge(process, ready, port, companion, pilot)

    yield start
    for process in running:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
        assert "Traceback" not in errors
