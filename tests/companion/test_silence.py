"""A companion that hangs, is stopped or is killed in flight falls silent, and the autopilot takes over.

The time is measured on the wire. COM_OF_LOSS_T is how long PX4 waits for a setpoint: silence must come sooner
than that for the failsafe to mean anything, and must last.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from rig import Bridge, Companion, Wiretap, wait_for

from trueflight.models.record import read_record

pytestmark = pytest.mark.realtime

LOSS_TIME = 1.0  # s: COM_OF_LOSS_T, as the bridge and PX4 have it by default

HANGS = """
import signal, time
from trueflight.companion.law.control import ControlLaw
hung = []
signal.signal(signal.SIGUSR1, lambda *_: hung.append({kind!r}))
step = ControlLaw.step
def hanging(self, *arguments, **named):
    while hung:
        if hung[0] == "asleep":
            time.sleep(1.0)
    return step(self, *arguments, **named)
ControlLaw.step = hanging
"""


@pytest.fixture
def link() -> Iterator[tuple[Bridge, Wiretap]]:
    tap = Wiretap()
    bridge = Bridge(tap.port, "--param", f"COM_OF_LOSS_T={LOSS_TIME}")
    yield bridge, tap
    bridge.end()
    tap.close()


@pytest.mark.parametrize(
    ("how", "number"),
    [
        ("asleep", signal.SIGUSR1),
        ("killed", signal.SIGKILL),
        pytest.param(
            "busy", signal.SIGUSR1, marks=pytest.mark.long
        ),  # both hang in tests/faults/test_hangs.py
        pytest.param("stopped", signal.SIGSTOP, marks=pytest.mark.long),
    ],
)
def test_trouble_in_flight_means_silence_and_the_failsafe(
    how: str, number: int, link: tuple[Bridge, Wiretap], tmp_path: Path
) -> None:
    _, tap = link
    companion = Companion(tmp_path, tap.companion_port, before=HANGS.format(kind=how))
    try:
        companion.fly(trajectory="hover", parameters={"duration": 600.0})
        companion.phase("mission")
        count = len(companion.ticks)
        wait_for(
            lambda: len(companion.ticks) > count + 120, "more than the second that a killed recorder may lose"
        )
        assert tap.mode == "OFFBOARD"
        begin = time.monotonic()
        companion.send(number)
        wait_for(lambda: tap.mode != "OFFBOARD", "the offboard-loss failsafe")
        assert tap.silence(begin) < LOSS_TIME
        wait_for(lambda: not tap.armed, "the failsafe to land and disarm")
        assert tap.silence(begin) < LOSS_TIME, "silence lasts"
    finally:
        companion.end(signal.SIGKILL)
    (path,) = companion.records.glob("*.mcap")
    record = read_record(path)
    assert record.truncated
    assert (record.ticks["phase"] == "mission").any(), "what was flown until a second ago is in it"


def test_a_hang_is_told_to_the_ground(link: tuple[Bridge, Wiretap], tmp_path: Path) -> None:
    _, tap = link
    companion = Companion(tmp_path, tap.companion_port, before=HANGS.format(kind="asleep"))
    try:
        companion.fly(trajectory="hover", parameters={"duration": 600.0})
        companion.phase("takeoff")
        wait_for(lambda: companion.told("takeoff"), "takeoff")
        companion.send(signal.SIGUSR1)
        wait_for(lambda: companion.told("no_odometry"), "the event")
    finally:
        companion.end(signal.SIGKILL)
