"""In flight: messages without measure, a record that can grow no more, a records folder that goes away."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from rig import SET_ATTITUDE_TARGET, Bridge, Companion, Wiretap, wait_for

from trueflight.models import contract
from trueflight.models.record import read_record

pytestmark = pytest.mark.realtime

SPEED = "2"
OFFBOARD_LOSS = 1.0
"""s without a setpoint after which the stand-in's failsafe takes over (COM_OF_LOSS_T)."""
SMALL_DISK = (
    "import resource, signal\n"
    "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
    "resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000))"
)
"""No file can grow beyond that: what a disk does that fills up, without the right to mount one."""


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Companion, Wiretap]]:
    tap = Wiretap()
    bridge = Bridge(tap.port, "--speed", SPEED, "--param", f"COM_OF_LOSS_T={OFFBOARD_LOSS}")
    folder = tmp_path_factory.mktemp("companion")
    companion = Companion(folder, tap.companion_port, before=SMALL_DISK)
    yield companion, tap
    companion.end()
    bridge.end()
    tap.close()


def resident(companion: Companion) -> int:
    """MB that the companion's process holds."""
    for line in Path(f"/proc/{companion.child.pid}/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) // 1024
    raise AssertionError("no VmHWM")


def test_nothing_that_is_sent_in_flight_holds_the_vehicle_up(flight: tuple[Companion, Wiretap]) -> None:
    companion, tap = flight
    mission = companion.fly(trajectory="hover", parameters={"duration": 600.0})
    companion.phase("mission")
    before, since = resident(companion), time.monotonic()
    key = contract.key("quad5", "mission")
    nested = b'{"trajectory":[' + b"0," * 10_000_000 + b"0]}"
    list(companion.session.get(key, payload=nested, timeout=2.0))  # falls in Zenoh, without an answer
    for leaf, payload, reason in (
        ("mission", nested[: 5 << 20], "at most 1048576"),
        ("mission", nested[: 1 << 20], "JSON"),
        ("mission", b"[" * 900_000, "nested too deeply"),
        ("mission", {"setpoints": "t,x,y,z\n0,0,0,1\n1000000,0,0,1"}, "at most 3600 s"),
        ("mission", {"setpoints": "t,x,y,z\n0,0,0,1\n1e-320,0,0,1\n2,0,0,1"}, "at least 0.001 s"),
        ("mission", {"command": ["land"] * 50}, "unknown command"),
        ("model", bytes(6 << 20), "at most 4194304"),
        ("model", b"{" * 100_000, "too long for a command"),
        ("record", {"name": "../companion.toml"}, "no record"),
        ("record", {"name": "a\0b"}, "no record"),
        ("record", {"name": "x", "offset": 10**400}, "whole numbers"),
        ("record", bytes(1 << 20), "at most 4096"),
        ("status", bytes(1 << 20), "at most 1024"),
    ):
        answer = companion.ask(leaf, payload)
        assert not answer["accepted"], answer
        assert reason in answer["reason"], (leaf, answer)
    selector = contract.key("quad5", "model") + "?shadow=nan"
    (reply,) = companion.session.get(selector, payload=b"x", timeout=20.0)
    assert "outside" in json.loads(reply.ok.payload.to_string())["reason"]
    for _ in range(500):
        companion.session.put(contract.key("quad5", "pose"), b"[" * 100)
    times = [t for t in tap.times[SET_ATTITUDE_TARGET] if t > since]
    gaps = [b - a for a, b in pairwise(times)]
    assert max(gaps) < 0.5 * OFFBOARD_LOSS
    assert companion.ticks[-1].phase == "mission"
    assert companion.ask("status")["requests_refused"] >= 4
    assert resident(companion) - before < 60, "what is refused is not kept"
    assert mission == companion.ask("status")["mission"]


def test_a_record_that_can_grow_no_more_is_told_in_the_air_and_the_flight_goes_on(
    flight: tuple[Companion, Wiretap],
) -> None:
    companion, _ = flight
    (told,) = wait_for(lambda: companion.told("record_failed"), "the event")
    assert "ends here" in told
    status = companion.ask("status")
    assert status["phase"] == "mission"
    assert status["recording"] == ""
    assert companion.ask("mission", {"command": "land"})["accepted"]
    done = companion.done(status["mission"])
    read = read_record(companion.records / done["record"])
    assert read.truncated
    assert len(read.ticks["t"]) > 100


def test_a_folder_taken_away_in_flight_comes_back_with_the_record(flight: tuple[Companion, Wiretap]) -> None:
    companion, _ = flight
    mission = companion.fly(trajectory="hover", parameters={"duration": 2.0})
    companion.phase("takeoff")
    wait_for(lambda: list(companion.records.glob(f"*-{mission}-*")), "the record")
    shutil.rmtree(companion.records)
    wait_for(lambda: companion.told("record_rescued"), "the event")
    done = companion.done(mission)
    assert done["state"] == "finished"
    assert [entry["name"] for entry in companion.ask("record")["records"]] == [done["record"]]
    read = read_record(companion.records / done["record"])
    assert not read.truncated
    assert "takeoff" in [event.kind for event in read.events]


def test_no_flight_begins_without_a_place_for_its_record(flight: tuple[Companion, Wiretap]) -> None:
    companion, _ = flight
    wait_for(lambda: companion.ask("status")["ready"], "ready")
    shutil.rmtree(companion.records)
    companion.records.write_text("in the way")
    answer = companion.ask("mission", {"trajectory": "hover"})
    assert not answer["accepted"]
    assert "no flight record can be written" in answer["reason"]
    assert "require_record" in answer["reason"]
    companion.records.unlink()
    wait_for(lambda: companion.ask("status")["ready"], "ready once there is a place")
    assert companion.child.poll() is None
