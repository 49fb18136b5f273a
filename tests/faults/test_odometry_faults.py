"""Odometry that is late, frozen, jumps or is another's: the vehicle must not be led astray by it.

A real companion flies the simulated vehicle over real MAVLink; a man in the middle spoils what the companion hears, and
sees where the vehicle truly goes.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Link
from mitm import TIMESYNC, Fault, delayed, frozen, lost, nothing, reset, without
from rig import wait_for

from trueflight.models.record import read_record

pytestmark = pytest.mark.realtime

INJECT = Path(__file__).with_name("inject.py")
LATEST = 0.3
"""s by which any fault here delays what the companion is told of the flight mode."""
ASTRAY = 1.0
"""m that a hovering vehicle may be from where the trouble began while its landing is under way."""


@pytest.fixture
def hovering(link: Link) -> Iterator[Link]:
    """A hover 1.2 m up, which goes on for the next test where nothing ended it."""
    if not link.middle.armed or link.companion.ticks[-1].phase != "mission":
        landed(link)
        link.companion.fly(trajectory="hover", parameters={"duration": 3600.0, "height": 1.2})
        link.companion.phase("mission")
        time.sleep(0.5)
    yield link
    link.middle.fault = nothing
    wait_for(lambda: link.middle.empty, "what was delayed to be through")


def landed(link: Link) -> None:
    """No flight and no fault any more, and the vehicle on the ground."""
    link.middle.fault = nothing
    link.companion.ask("mission", {"command": "abort"})
    wait_for(lambda: not link.middle.armed, "disarmed")
    count = len(link.companion.ticks)
    wait_for(lambda: link.companion.ticks[-1].phase == "idle" and len(link.companion.ticks) > count, "idle")


def new_events(link: Link, count: int) -> list[str]:
    return [event.kind for event in list(link.companion.events)[count:]]


def ends(link: Link, fault: Fault, *kinds: str) -> None:
    """With this fault the flight ends by one of these events, before the vehicle is anywhere else."""
    known, begin = len(link.companion.events), time.monotonic()
    link.middle.fault = fault
    wait_for(lambda: set(kinds) & set(new_events(link, known)), f"one of {kinds}")
    wait_for(lambda: link.middle.left("OFFBOARD", begin) < 60.0, "the autopilot's own mode")
    taken = begin + link.middle.left("OFFBOARD", begin)
    wait_for(lambda: not link.middle.armed, "landed")
    seen = [row for row in link.middle.seen if begin <= row[0] <= taken]
    assert max(abs(row[1] - seen[0][1]) + abs(row[2] - seen[0][2]) for row in seen) < ASTRAY
    assert max(-row[3] for row in seen) < -seen[0][3] + ASTRAY
    assert link.middle.silence(taken + 0.1 + LATEST) == 0.0


@pytest.mark.parametrize(
    ("fault", "kinds"),
    [
        (frozen(), ("odometry_disagrees",)),
        pytest.param(
            frozen(only=("vx", "vy", "vz", "x", "y", "z")), ("odometry_disagrees",), marks=pytest.mark.long
        ),
        (frozen(stamp=True), ("no_odometry",)),
        (delayed(0.3, 331), ("late",)),
        (delayed(0.6, 331), ("stale", "failsafe", "odometry_gap", "no_odometry")),
        pytest.param(delayed(0.3), ("late",), marks=pytest.mark.long),
    ],
    ids=[
        "frozen",
        "no translation",
        "frozen with its stamp",
        "late",
        "stale",
        "all late",
    ],
)
def test_an_estimate_that_is_not_of_now_ends_the_flight(
    hovering: Link, fault: Fault, kinds: tuple[str, ...]
) -> None:
    ends(hovering, fault, *kinds)


def test_a_small_reset_that_is_told_moves_nothing(hovering: Link) -> None:
    known, begin = len(hovering.companion.events), time.monotonic()
    hovering.middle.fault = reset(down=0.9, east=-0.3)
    wait_for(lambda: "estimator_reset" in new_events(hovering, known), "the event")
    time.sleep(2.0)
    assert hovering.middle.strayed(begin) < 0.15
    assert hovering.companion.ticks[-1].phase == "mission"
    hovering.middle.fault = nothing  # back again, which the counter tells of as well
    time.sleep(2.0)
    assert hovering.middle.strayed(begin) < 0.15
    assert hovering.companion.ticks[-1].phase == "mission"


@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        (reset(down=3.0), "estimator_reset"),
        (reset(down=-0.9, told=False), "position_jump"),
        (reset(turn=0.8), "estimator_reset"),
        pytest.param(reset(turn=-0.8, told=False), "heading_jump", marks=pytest.mark.long),
    ],
    ids=["far", "untold", "turned", "turned, untold"],
)
def test_a_jump_that_cannot_be_carried_over_lands_on_the_spot(
    hovering: Link, fault: Fault, kind: str
) -> None:
    begin = time.monotonic()
    ends(hovering, fault, kind)
    seen = [row for row in hovering.middle.seen if row[0] > begin]
    assert max(abs(row[1] - seen[0][1]) + abs(row[2] - seen[0][2]) for row in seen) < 0.5


@pytest.mark.parametrize("who", ["vio", "vehicle2"])
def test_only_the_autopilot_tells_where_the_vehicle_is(hovering: Link, who: str) -> None:
    begin, known = time.monotonic(), len(hovering.companion.events)
    subprocess.run(
        [sys.executable, INJECT, who, str(hovering.middle.companion_port)], check=True, timeout=60.0
    )
    assert hovering.middle.strayed(begin) < 0.15
    assert hovering.companion.ticks[-1].phase == "mission"
    assert set(new_events(hovering, known)) <= {"others"}, "told, at most"
    assert any("197" in one or "system 2" in one for one in hovering.companion.ask("status")["others"])


def test_a_second_battery_hides_nothing(hovering: Link) -> None:
    before = hovering.companion.ticks[-1].battery_voltage
    for who in ("battery2", "smartbattery"):
        subprocess.run(
            [sys.executable, INJECT, who, str(hovering.middle.companion_port)], check=True, timeout=60.0
        )
        assert hovering.companion.ticks[-1].battery_voltage == pytest.approx(before, abs=0.5)
    assert hovering.companion.ticks[-1].phase == "mission"


@pytest.mark.parametrize(
    "direction",
    [(True,), pytest.param((False,), marks=pytest.mark.long), (True, False)],
    ids=["down", "up", "both"],
)
def test_a_lost_link_means_the_autopilots_failsafe(hovering: Link, direction: tuple[bool, ...]) -> None:
    begin = time.monotonic()
    hovering.middle.fault = lost(*direction)
    wait_for(lambda: hovering.middle.left("OFFBOARD", begin) < 60.0, "the failsafe")
    time.sleep(0.5)
    taken = begin + hovering.middle.left("OFFBOARD", begin)
    hovering.middle.fault = nothing
    wait_for(lambda: not hovering.middle.armed, "landed")
    # What the companion still sent against a dead link ended before the link was back.
    assert hovering.middle.silence(taken + 0.5) == 0.0


def test_age_is_known_from_pings_alone(hovering: Link) -> None:
    """PX4's answers to TIMESYNC do not come through MAVSDK."""
    hovering.middle.fault = without(TIMESYNC)
    time.sleep(2.0)
    fresh = [tick.age for tick in hovering.companion.ticks[-50:]]
    assert sorted(fresh)[25] < 0.03
    ends(hovering, without(TIMESYNC, delayed(0.2)), "late")


def test_age_stands_in_the_record(link: Link) -> None:
    landed(link)
    identity = link.companion.fly(trajectory="hover", parameters={"duration": 2.0})
    status = link.companion.done(identity)
    assert status["state"] == "finished", status
    age = read_record(link.companion.records / status["record"]).ticks["age"]
    assert link.companion.ask("status")["odometry"]["age_ms"] < 50.0
    assert -0.005 < sorted(age)[len(age) // 2] < 0.05
