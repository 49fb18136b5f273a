"""Whoever may end a flight ends it at once: pilot, kill switch, the autopilot's own failsafes, a restart.

The autopilot is the simulated one, on the wire; what it tells is as PX4 tells it. The record says why.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from rig import SET_ATTITUDE_TARGET, Bridge, Companion, Wiretap, wait_for

from trueflight.models.record import FlightRecord, read_record

pytestmark = pytest.mark.realtime

FOREVER = {"trajectory": "hover", "parameters": {"duration": 600.0}}


@pytest.fixture
def tap() -> Iterator[Wiretap]:
    tap = Wiretap()
    yield tap
    tap.close()


def record_of(companion: Companion, status: dict[str, str]) -> FlightRecord:
    return read_record(companion.records / status["record"])


def reasons(record: FlightRecord) -> dict[str, str]:
    """The last text of each kind of event."""
    return {event.kind: event.text for event in record.events}


@pytest.mark.parametrize(
    ("parameters", "flags", "mode", "cause"),
    [
        (["GF_MAX_VER_DIST=0.8", "GF_ACTION=2"], [], "HOLD", "geofence"),
        (["BAT_CRIT_THR=0.5", "COM_LOW_BAT_ACT=2"], ["--charge", "0.49"], "LAND", "battery critical"),
    ],
)
def test_a_failsafe_of_the_autopilot_ends_the_flight_and_the_record_says_which(
    parameters: list[str], flags: list[str], mode: str, cause: str, tap: Wiretap, tmp_path: Path
) -> None:
    for parameter in parameters:
        flags = [*flags, "--param", parameter]
    bridge = Bridge(tap.port, *flags)
    companion = Companion(tmp_path, tap.companion_port)
    try:
        mission = companion.fly(**FOREVER)
        companion.phase("silent")
        sent = len(tap.times[SET_ATTITUDE_TARGET])
        told = len(companion.ticks)
        wait_for(lambda: len(companion.ticks) > told + 100, "another second")
        assert len(tap.times[SET_ATTITUDE_TARGET]) == sent
        bridge.pilot("LAND")
        status = companion.done(mission)
    finally:
        companion.end()
        bridge.end()
    assert status["state"] == "aborted"
    told_by = reasons(record_of(companion, status))
    assert f"{mode} was chosen by the autopilot's failsafe" in told_by["failsafe"]
    assert cause in told_by["failsafe"]
    assert "failsafe" in told_by["autopilot"]


def test_the_kill_switch_ends_the_flight_and_what_was_queued(tap: Wiretap, tmp_path: Path) -> None:
    bridge = Bridge(tap.port)
    companion = Companion(tmp_path, tap.companion_port)
    try:
        first = companion.fly(**FOREVER)
        companion.phase("mission")
        second = companion.ask("mission", FOREVER)["mission"]
        bridge.pilot("KILL")
        status = companion.done(first)
        assert "motors were cut" in status["reason"]
        assert "kill_switch" in reasons(record_of(companion, status))
        queued = companion.done(second)
        assert queued["state"] == "aborted"
        assert "ended early" in queued["reason"]
        assert not queued["record"], "it never began"
        sent = len(tap.times[SET_ATTITUDE_TARGET])
        # Arming is refused now, and the pilot is told why in words.
        refused = companion.done(companion.fly(**FOREVER))
        assert refused["state"] == "failed"
        assert "the kill switch is on; flip it back" in refused["reason"]
        assert not tap.armed
        assert len(tap.times[SET_ATTITUDE_TARGET]) > sent, (
            "it streamed, which PX4 wants to hear before it arms"
        )
    finally:
        companion.end()
        bridge.end()


def test_a_companion_that_comes_back_in_flight_sends_nothing(tap: Wiretap, tmp_path: Path) -> None:
    bridge = Bridge(tap.port, "--param", "COM_OF_LOSS_T=30", "--param", "COM_OBL_RC_ACT=4")
    first = Companion(tmp_path, tap.companion_port)
    second: Companion | None = None
    try:
        first.fly(**FOREVER)
        first.phase("mission")
        assert tap.mode == "OFFBOARD"
        first.end(signal.SIGKILL)
        sent = len(tap.times[SET_ATTITUDE_TARGET])
        second = Companion(tmp_path, tap.companion_port)
        assert tap.mode == "OFFBOARD", "the autopilot still waits for setpoints"
        assert tap.armed
        answer = second.ask("mission", FOREVER)
        assert not answer["accepted"]
        assert "armed by somebody else" in answer["reason"]
        ticks = len(second.ticks)
        wait_for(lambda: len(second.ticks) > ticks + 200, "two more seconds")
        assert {tick.phase for tick in second.ticks} == {"idle"}
        assert len(tap.times[SET_ATTITUDE_TARGET]) == sent
        bridge.pilot("LAND")
        wait_for(lambda: not tap.armed, "the pilot's landing")
        wait_for(lambda: second.ask("status")["ready"], "ready again, once it stands")
    finally:
        if second is not None:
            second.end()
        bridge.end()
