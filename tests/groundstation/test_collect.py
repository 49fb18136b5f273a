"""`groundstation collect`, against a companion's telemetry without an autopilot and against a real companion."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from json_schemas import valid
from processes import with_parent

from trueflight.companion.telemetry import Telemetry, read_json
from trueflight.companion.zenoh_session import ZenohSettings, open_session
from trueflight.groundstation.commands.app import app
from trueflight.models.database import database
from trueflight.models.errors import run_command_line
from trueflight.models.record import read_record

pytestmark = pytest.mark.realtime

ROOT = Path(__file__).parents[2]
QUAD5 = ROOT / "models" / "vehicles" / "quad5" / "vehicle.toml"
BIN = Path(sys.executable).parent
SEED, MINUTES = 3, 1.5


def free_port(kind=socket.SOCK_STREAM):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Vehicle:
    """What a companion answers whose flights take no time; `voltage` falls by `use` V a flight."""

    def __init__(self, folder: Path) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.folder, self.voltage, self.use = folder, 16.6, 0.1
        self.ends, self.flown = "finished", []
        folder.mkdir()
        answers = {"status": lambda *asked: self.status(), "mission": self.mission}
        session = open_session(ZenohSettings(listen=(self.endpoint,)))
        self.telemetry = Telemetry(session, "quad5", answers, folder)

    def mission(self, payload, *_):
        if self.voltage < 14.4:
            return {
                "accepted": False,
                "reason": f"the battery has {self.voltage:.1f} V, a flight needs 14.4 V",
            }
        request = read_json(payload)
        number = len(self.flown) + 1
        record = f"m{number}.mcap"
        (self.folder / record).write_bytes(json.dumps(request).encode())
        self.flown.append(
            {"mission": f"m{number}", "state": self.ends, "reason": self.ends, "record": record}
        )
        self.voltage -= self.use
        return {"accepted": True, "reason": "next", "mission": f"m{number}", "duration": 1.0}

    def status(self):
        return {"accepted": True, "phase": "idle", "battery_voltage": self.voltage, "missions": self.flown}


@pytest.fixture
def vehicle(tmp_path):
    one = Vehicle(tmp_path / "on_board")
    yield one
    one.telemetry.close()


def collect(vehicle: Vehicle, folder: Path, capsys, *more: str) -> tuple[int, dict, str]:
    """Exit code, the JSON report, and the line on standard error."""
    arguments = ["collect", "-o", str(folder), "--seed", str(SEED), "--minutes", str(MINUTES), "--json"]
    arguments += ["-e", vehicle.endpoint, "--patience", "0", *more]
    code = 0
    try:
        run_command_line(lambda: app(arguments))
    except SystemExit as ended:
        code = int(ended.code or 0)
    out, err = capsys.readouterr()
    return code, valid("groundstation collect", json.loads(out)) if out else {}, err


def test_every_mission_of_the_database_is_flown_once_and_its_record_fetched(vehicle, tmp_path, capsys):
    code, report, told = collect(vehicle, tmp_path / "db", capsys)
    sorties = database(SEED, MINUTES)
    assert code == 0, told
    assert len(report["flights"]) == report["wanted"] == len(sorties)
    for number, sortie in enumerate(sorties, 1):
        record = tmp_path / "db" / f"{number:03d}-{sortie.trajectory}.mcap"
        request = {"trajectory": sortie.trajectory, "parameters": sortie.parameters, "controller": "lqr"}
        assert json.loads(record.read_bytes()) == request
    volts = [entry["voltage"] for entry in report["flights"].values()]
    assert volts == sorted(volts, reverse=True) and volts[0] == 16.6
    again, _, _ = collect(vehicle, tmp_path / "db", capsys)
    assert again == 0 and len(vehicle.flown) == len(sorties)


def test_a_low_battery_ends_it_with_what_was_collected_and_another_continues(vehicle, tmp_path, capsys):
    vehicle.voltage, vehicle.use = 15.0, 0.4
    code, report, told = collect(vehicle, tmp_path / "db", capsys)
    assert code == 2 and len(report["flights"]) == 2
    assert "2 of" in told and "the battery has 14.2 V" in told and "continues" in told
    assert len(told.strip().splitlines()) == 1
    vehicle.voltage = 16.6
    code, report, _ = collect(vehicle, tmp_path / "db", capsys)
    assert code == 0 and len(vehicle.flown) == len(report["flights"]) == report["wanted"]


def test_a_flight_that_did_not_end_by_itself_is_not_followed_by_another(vehicle, tmp_path, capsys):
    vehicle.ends = "aborted"
    code, report, told = collect(vehicle, tmp_path / "db", capsys)
    assert code == 2 and "aborted" in told
    assert len(vehicle.flown) == 1 and report["flights"] == {}
    assert [path.name for path in (tmp_path / "db").iterdir()] == ["collection.json"]


def test_another_seed_does_not_mix_with_what_is_there(vehicle, tmp_path, capsys):
    collect(vehicle, tmp_path / "db", capsys)
    code, _, told = collect(vehicle, tmp_path / "db", capsys, "--seed", "4")
    assert code == 2 and "begun with seed 3, now 4" in told


def test_a_real_companion_flies_a_mission_of_the_database(tmp_path):
    """Bridge with a rich truth, companion and ground station as separate processes."""
    mavlink, own = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    commands = [
        ["sim-bridge", "run", "--vehicle", QUAD5, "--hidden", "rich", "--seed", "1", "--pilot-port", "0"]
        + ["--sealed", tmp_path / "a.sealed", "--port", own, "--mavlink", f"udpout:127.0.0.1:{mavlink}"]
        + ["--charge", "0.9", "--battery-age", "1.2"],
        ["companion", "run", "--vehicle", QUAD5, "--connect", f"udpin://127.0.0.1:{mavlink}", "-l", endpoint]
        + ["--records", tmp_path / "on_board", "--models", tmp_path / "models"],
    ]
    running = []
    try:
        for command in commands:
            arguments = [str(BIN / command[0]), *map(str, command[1:])]
            child = subprocess.Popen(
                arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, preexec_fn=with_parent
            )
            running.append(child)
            line = child.stdout.readline()
            assert line.startswith("ready:"), line + child.stdout.read()
            threading.Thread(target=child.stdout.read, daemon=True).start()
        arguments = ["collect", "--seed", "6", "--minutes", "0.1", "-o", str(tmp_path / "db"), "-e", endpoint]
        told = subprocess.run(
            [str(BIN / "groundstation"), *arguments, "--json"], capture_output=True, text=True, timeout=200
        )
        assert told.returncode == 0, told.stderr
    finally:
        for child in reversed(running):
            child.send_signal(signal.SIGTERM)
            child.wait(90)
    (name,) = json.loads(told.stdout)["flights"]
    (sortie,) = database(6, 0.1)
    ticks = read_record(tmp_path / "db" / name).ticks
    flown = ticks["phase"] == "mission"
    assert flown.sum() > 90 * sortie.path.duration
    error = ticks["position"][flown] - ticks["position_reference"][flown]
    assert abs(error[:, 2]).max() < 1.0 and (error**2).mean() > 1e-5
