"""Stock MAVSDK programs, as separate processes, against a real `sim-bridge run`."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from bridge_process import Bridge

pytestmark = pytest.mark.realtime

PROGRAMS = Path(__file__).with_name("mavsdk_programs.py")


def run_program(name: str, running: Bridge) -> dict[str, object]:
    done = subprocess.run(
        [sys.executable, str(PROGRAMS), name, f"udpin://127.0.0.1:{running.companion}"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    answer: dict[str, object] = json.loads(done.stdout.strip().splitlines()[-1])
    return answer


def test_takeoff_and_land(bridge: Callable[..., Bridge]) -> None:
    seen = run_program("takeoff_and_land", bridge("--speed", "2"))
    assert seen["altitudes"] == [2.5, 5.0]
    assert seen["end"] == pytest.approx(0.0, abs=0.1)


def test_offboard_by_position_velocity_attitude_and_rates(bridge: Callable[..., Bridge]) -> None:
    seen = run_program("offboard", bridge("--speed", "2"))
    assert "NO_SETPOINT_SET" in str(seen["refused"])
    assert seen["end"] == pytest.approx(0.0, abs=0.1)
