"""A companion that is slow, hangs or is stopped in flight, and comes back: nothing old leaves it."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from mitm import ManInTheMiddle
from rig import Bridge, Companion, wait_for

from trueflight.models.record import read_record

pytestmark = pytest.mark.realtime

LOSS_TIME = 0.5  # s: COM_OF_LOSS_T

SLEEPS = """
import signal, time
from trueflight.companion.law.control import ControlLaw
waiting = []
signal.signal(signal.SIGUSR1, lambda *_: waiting.append(2.5))
step = ControlLaw.step
def hanging(self, *arguments, **named):
    end = time.monotonic() + (waiting.pop() if waiting else 0.0)
    while time.monotonic() < end:
        if {asleep}:
            time.sleep(0.1)
    return step(self, *arguments, **named)
ControlLaw.step = hanging
"""
SLOW = """
import time
from trueflight.companion.law.control import ControlLaw
step = ControlLaw.step
def slow(self, *arguments, **named):
    time.sleep(0.012)
    return step(self, *arguments, **named)
ControlLaw.step = slow
"""


@pytest.fixture
def flown() -> Iterator[ManInTheMiddle]:
    """A simulated vehicle behind a man in the middle."""
    middle = ManInTheMiddle()
    bridge = Bridge(middle.port, "--param", f"COM_OF_LOSS_T={LOSS_TIME}", "--param", "COM_OBL_RC_ACT=4")
    yield middle
    bridge.end()
    middle.close()


@pytest.mark.parametrize("how", ["asleep", "spinning", "stopped"])
def test_after_a_hang_not_one_setpoint_leaves(how: str, flown: ManInTheMiddle, tmp_path: Path) -> None:
    companion = Companion(
        tmp_path, flown.companion_port, before=SLEEPS.format(asleep=how == "asleep"), settings=""
    )
    try:
        companion.fly(trajectory="hover", parameters={"duration": 600.0})
        companion.phase("mission")
        begin = time.monotonic()
        companion.send(signal.SIGSTOP if how == "stopped" else signal.SIGUSR1)
        wait_for(lambda: flown.left("OFFBOARD", begin) < 60.0, "the offboard-loss failsafe")
        if how == "stopped":
            time.sleep(1.5)
            companion.send(signal.SIGCONT)
        wait_for(lambda: companion.ticks[-1].phase in ("silent", "idle"), "awake again, and silent")
        wait_for(lambda: not flown.armed, "landed")
        assert flown.silence(begin + 0.1) == 0.0
        assert companion.told("stale")
    finally:
        companion.end(signal.SIGKILL)


def test_a_pilot_who_took_over_during_a_hang_is_never_disturbed(tmp_path: Path) -> None:
    """The mode changes and the vehicle is disarmed while the companion is stopped; its inbox is full of the past."""
    middle = ManInTheMiddle()
    bridge = Bridge(middle.port, "--param", "COM_OF_LOSS_T=5.0")
    companion = Companion(tmp_path, middle.companion_port, settings="")
    try:
        companion.fly(trajectory="hover", parameters={"duration": 600.0})
        companion.phase("mission")
        companion.send(signal.SIGSTOP)
        begin = time.monotonic()
        time.sleep(0.2)
        bridge.pilot("LAND")
        wait_for(lambda: not middle.armed, "landed and disarmed")
        companion.send(signal.SIGCONT)
        wait_for(lambda: companion.ticks[-1].phase == "idle", "awake again, and idle")
        time.sleep(0.5)
        assert middle.silence(begin + 0.1) == 0.0
    finally:
        companion.end(signal.SIGKILL)
        bridge.end()
        middle.close()


def test_a_control_law_slower_than_its_odometry_answers_to_the_newest(
    flown: ManInTheMiddle, tmp_path: Path
) -> None:
    """12 ms for each tick of 10 ms: what cannot be answered is overtaken, and the age does not grow."""
    companion = Companion(tmp_path, flown.companion_port, before=SLOW, settings="")
    try:
        status = companion.done(companion.fly(trajectory="hover", parameters={"duration": 5.0}))
        assert status["state"] == "finished", status["reason"]
        ticks = read_record(companion.records / status["record"]).ticks
        flying = ticks["phase"] == "mission"
        assert ticks["overtaken"][flying].sum() > 10
        ages = sorted(ticks["age"][flying])
        assert ages[int(0.9 * len(ages))] < 0.06
    finally:
        companion.end()
