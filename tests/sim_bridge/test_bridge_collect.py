"""`sim-bridge collect`: the same records whatever the processes, and nothing lost when interrupted."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from bridge_process import QUAD5
from processes import with_parent

from trueflight.models.database import database
from trueflight.models.design import Design
from trueflight.models.record import read_record
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.collect import fingerprint, flights
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.seal import reveal
from trueflight.sim_bridge.truth.hidden import choose

PROGRAM = [sys.executable, "-c", "from trueflight.sim_bridge.cli import main; main()", "collect"]
RICH = ["--vehicle", str(QUAD5 / "vehicle.toml"), "--hidden", "rich", "--seed", "2", "--json"]


def collect(folder: Path, *more: str) -> subprocess.CompletedProcess[str]:
    command = [*PROGRAM, *RICH, "-o", str(folder), *more]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, object]]:
    """Three minutes of flight, in one process."""
    folder = tmp_path_factory.mktemp("collect") / "one"
    done = collect(folder, "--minutes", "3", "--jobs", "1")
    assert done.returncode == 0, done.stderr
    return folder, json.loads(done.stdout)


def test_a_collection_holds_the_database_one_record_a_flight(collected) -> None:
    folder, report = collected
    sorties = database(2, 3.0)
    names = [f"{number:03d}-{sortie.trajectory}.mcap" for number, sortie in enumerate(sorties, 1)]
    assert sorted(contents(folder)) == [*names, "collection.json", "hidden.sealed"]
    assert report["seconds"] >= 180.0 and list(report["flights"]) == names
    for name, sortie in zip(names, sorties, strict=True):
        read = read_record(folder / name)
        assert not read.truncated and read.metadata["trajectory"] == sortie.trajectory
        assert read.ticks["t"][-1] == pytest.approx(sortie.path.duration, abs=0.02)
        entry = report["flights"][name]
        assert (entry["charge"], entry["outcome"]) == (sortie.charge, "finished")
    assert len(reveal(folder / "hidden.sealed")["effects"]) == 8


def test_two_processes_write_the_same_bytes_and_a_second_call_writes_none(collected, tmp_path: Path) -> None:
    folder, _ = collected
    done = collect(tmp_path / "two", "--minutes", "3", "--jobs", "2")
    assert done.returncode == 0, done.stderr
    assert contents(tmp_path / "two") == contents(folder)
    stamps = {path: path.stat().st_mtime_ns for path in (tmp_path / "two").glob("*.mcap")}
    again = json.loads(collect(tmp_path / "two", "--minutes", "3").stdout)
    assert again["flown_now"] == 0
    assert stamps == {path: path.stat().st_mtime_ns for path in stamps}


def test_what_was_flown_before_an_interruption_stays_and_the_rest_follows(collected, tmp_path: Path) -> None:
    folder, _ = collected
    target = tmp_path / "cut"
    command = [*PROGRAM, *RICH, "-o", str(target), "--minutes", "3", "--jobs", "1"]
    child = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=with_parent,
    )
    end = time.monotonic() + 60
    while not list(target.glob("*.mcap")) and time.monotonic() < end:
        time.sleep(0.01)
    child.send_signal(signal.SIGINT)
    _, told = child.communicate(timeout=60)
    assert child.returncode == 2 and "the same command continues" in told and "Traceback" not in told
    kept = {name: data for name, data in contents(target).items() if name.endswith(".mcap")}
    assert 0 < len(kept) < len(contents(folder)) - 2
    assert not [name for name in contents(target) if name.endswith(".part")]
    assert all(contents(folder)[name] == data for name, data in kept.items())
    assert collect(target, "--minutes", "3").returncode == 0
    assert contents(target) == contents(folder)


def test_other_settings_and_foreign_folders_are_refused(collected, tmp_path: Path) -> None:
    folder, _ = collected
    for more, says in (
        (("--minutes", "2"), "begun with minutes 3.0, now 2.0"),
        (("--minutes", "3", "--noise", "0"), "begun with noise 1.0, now 0.0"),
        (("--minutes", "0"), "--minutes 0"),
        (("--minutes", "3", "--rate", "120"), "must divide"),
    ):
        done = collect(folder, *more)
        assert done.returncode == 2 and says in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
    (tmp_path / "thesis.txt").write_text("important")
    done = collect(tmp_path, "--minutes", "1")
    assert done.returncode == 2 and "not empty, and no collection" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_flights_share_the_truth_and_have_noise_and_battery_of_their_own(
    vehicle: Vehicle, design: Design
) -> None:
    plan = Plan(vehicle, design, trajectory("hover"), choose(["rich"], vehicle, 1), 1)
    wanted = flights(database(1, 5.0), plan)
    assert plan.hidden and [flight.plan.hidden for flight in wanted] == [plan.hidden] * len(wanted)
    assert len(wanted) > 1
    assert len({flight.plan.seed for flight in wanted}) == len(wanted)
    assert [flight.plan.battery.charge for flight in wanted] == [flight.sortie.charge for flight in wanted]
    other = Plan(vehicle, design, trajectory("hover"), choose(["rich"], vehicle, 2), 1)
    assert fingerprint(other) != fingerprint(plan)
