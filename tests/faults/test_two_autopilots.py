"""Two vehicles that are heard on one link: the companion flies the one that was meant, or none."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from rig import Bridge, Companion, free_port, wait_for

pytestmark = pytest.mark.realtime


@pytest.fixture(scope="module")
def two_on_one_port() -> Iterator[int]:
    port = free_port()
    bridges = [Bridge(port, "--param", f"MAV_SYS_ID={system}") for system in (1, 2)]
    yield port
    for bridge in bridges:
        bridge.end()


def test_without_a_choice_no_flight_begins_and_both_are_named(two_on_one_port: int, tmp_path: Path) -> None:
    companion = Companion(tmp_path, two_on_one_port)
    try:
        wait_for(lambda: "2 autopilots" in companion.ask("status")["not_ready"], "both are heard")
        answer = companion.ask("mission", {"trajectory": "hover"})
        assert not answer["accepted"]
        assert "systems 1, 2" in answer["reason"]
        assert "--system" in answer["reason"]
    finally:
        companion.end()


@pytest.mark.parametrize("system", [1, 2])
def test_the_chosen_one_flies_and_the_other_stays_on_the_ground(
    system: int, two_on_one_port: int, tmp_path: Path
) -> None:
    companion = Companion(tmp_path, two_on_one_port, "--system", str(system))
    try:
        companion.fly(trajectory="hover", parameters={"duration": 60.0, "height": 1.0})
        companion.phase("mission")
        wait_for(lambda: companion.ticks[-1].position.z > 0.8, "the height of the mission")
        count = len(companion.ticks)
        wait_for(lambda: len(companion.ticks) > count + 30, "more ticks")
        heights = [tick.position.z for tick in companion.ticks[count:]]
        assert min(heights) > 0.5, "one vehicle's odometry throughout: the other stands on the ground"
    finally:
        companion.end()


def test_a_system_that_is_not_there_is_named(two_on_one_port: int, tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match=r"no autopilot with system id 9 .*heard there: 1, 2"):
        Companion(tmp_path, two_on_one_port, "--system", "9", "--timeout", "3")
