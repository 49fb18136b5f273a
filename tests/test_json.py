"""What every command prints with `--json` follows a schema, with `--save` as without."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from json_schemas import SCHEMAS, schema_of, valid
from jsonschema import Draft202012Validator
from processes import with_parent
from rig import free_port
from typer.testing import CliRunner

from trueflight.companion.cli import app as companion
from trueflight.groundstation.commands.app import app as groundstation
from trueflight.groundstation.commands.reproduce import study_table
from trueflight.groundstation.output.as_json import over_time_table
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.writing import write_flight
from trueflight.groundstation.results import DriftingParameter, OverTime
from trueflight.groundstation.study.reproduce import ARMS, SCENARIOS, Flown, Prepared, Study
from trueflight.sim_bridge.cli import app as sim_bridge

ROOT = Path(__file__).parent.parent
VEHICLE = ROOT / "models" / "vehicles" / "quad5" / "vehicle.toml"
PROGRAMS = {"groundstation": groundstation, "companion": companion, "sim-bridge": sim_bridge}

ELSEWHERE = {
    "groundstation calibrate": "groundstation/test_calibration.py",
    "groundstation collect": "groundstation/test_collect.py",
    "groundstation compare-controllers": "groundstation/test_compare_controllers.py",
    "groundstation deploy": "companion/test_deployment.py",
    "groundstation fly": "groundstation/test_link.py",
    "groundstation status": "groundstation/test_link.py",
    "groundstation monitor": "groundstation/test_live.py",
    "groundstation survey": "groundstation/test_survey.py",
    "companion check": "companion/test_companion_cli.py",
    "companion doctor": "companion/test_doctor.py",
    "companion preflight": "companion/test_preflight.py",
    "sim-bridge sitl": "sim_bridge/test_bridge_sitl.py",
}
"""Commands that need a vehicle or minutes: the document that this test has of them is held against the schema there."""


def run(command: str, *arguments: object) -> Any:
    """What a command prints with `--json`, held against its schema."""
    program, *words = command.split()
    done = CliRunner().invoke(
        PROGRAMS[program], [*words, *map(str, arguments), "--json"], catch_exceptions=False
    )
    assert done.exit_code == 0, done.output
    return valid(command, json.loads(done.stdout))


def commands_with_json() -> set[str]:
    found = set()
    for program, app in PROGRAMS.items():
        waiting = [(program, typer.main.get_command(app))]
        while waiting:
            name, one = waiting.pop()
            waiting += [(f"{name} {word}", sub) for word, sub in getattr(one, "commands", {}).items()]
            if any("--json" in parameter.opts for parameter in one.params):
                found.add(name)
    return found


def test_every_command_with_json_has_a_schema_and_every_schema_a_command() -> None:
    assert {schema_of(name) for name in commands_with_json()} | {"parts.json"} == set(SCHEMAS)
    for schema in SCHEMAS.values():
        Draft202012Validator.check_schema(schema)


def test_every_schema_is_held_against_a_document() -> None:
    here = Path(__file__).read_text()
    for name in commands_with_json():
        file = ELSEWHERE.get(name)
        text = here if file is None else (Path(__file__).parent / file).read_text()
        held = re.search(rf'(?:run|valid)\(\s*"{name}"', text)
        assert held, f"{name}: nothing is held against its schema in {file or 'this file'}"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a record of a flight of 30 s, in-process, its vehicle's design, and a table of it."""
    folder = tmp_path_factory.mktemp("flown")
    told = run(
        "sim-bridge fly", "--vehicle", VEHICLE, "--trajectory", "lemniscate", "--hidden", "random", "--seed", 3,
        "--sealed", folder / "answer.sealed", "-o", folder / "flight.mcap", "--repeat", 3,
    )  # fmt: skip
    assert told["sealed"]
    run("sim-bridge reveal", folder / "answer.sealed")
    write_flight(read_flight(folder / "flight.mcap"), folder / "table.csv")
    return folder


def test_the_simulator(tmp_path: Path) -> None:
    assert run("sim-bridge effects")["schema"] == 1
    told = run(
        "sim-bridge fly-many", "--vehicle", VEHICLE, "--trajectory", "hover", "--set", "duration=1", "--seeds", 2,
        "--hidden", "any", "-o", tmp_path / "many", "--tell-hidden", "--jobs", 1,
    )  # fmt: skip
    assert [flight["name"] for flight in told["flights"]] == ["0001", "0002"]
    run(
        "sim-bridge collect", "--vehicle", VEHICLE, "--minutes", 0.2, "--jobs", 1, "-o", tmp_path / "database"
    )


def test_a_simulated_vehicle_and_its_pilot() -> None:
    own, pilot = free_port(), free_port()
    words = ["run", "--vehicle", VEHICLE, "--duration", 6, "--port", own, "--pilot-port", pilot, "--json"]
    program = "from trueflight.sim_bridge.cli import main; main()"
    bridge = subprocess.Popen(
        [sys.executable, "-c", program, *map(str, words)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        preexec_fn=with_parent,
    )
    assert bridge.stdout is not None
    lines = [bridge.stdout.readline()]
    run("sim-bridge pilot", "--mode", "POSCTL", "--pilot-port", pilot)
    lines += bridge.communicate(timeout=120)[0].splitlines()
    ready, stopped = (valid("sim-bridge run", json.loads(line)) for line in lines)
    assert ready["ready"] and stopped["mode"] == "POSCTL"


def test_the_companion(tmp_path: Path) -> None:
    run("companion trajectories")
    run("companion install-service", "--vehicle", VEHICLE, "--dry-run", "-o", tmp_path)


def test_flights_designs_and_keys(flown: Path, tmp_path: Path) -> None:
    assert len(run("groundstation flights", flown)) == 2
    run("groundstation import", flown / "table.csv", "-o", tmp_path / "again.csv")
    run("groundstation design", VEHICLE, "-o", tmp_path / "design.json")
    run("groundstation track", flown / "flight.mcap", flown / "flight.mcap")
    run("groundstation keys", tmp_path / "keys", "--vehicle", "quad5", "--engineer", "anna")
    run("groundstation effects")
    valid(
        "groundstation fly", json.loads(CliRunner().invoke(groundstation, ["fly", "list", "--json"]).stdout)
    )


def test_models_against_flights_say_the_same_with_a_recording_as_without(flown: Path, tmp_path: Path) -> None:
    flight = flown / "flight.mcap"
    saved = ("--save", tmp_path / "recording.rrd")
    runs = {
        "compare": [run("groundstation compare", flight, *more) for more in ((), saved)],
        "where": [run("groundstation where", flight, *more) for more in ((), saved)],
        "bound": [run("groundstation bound", flight, *more) for more in ((), saved)],
        "diagnose": [run("groundstation diagnose", flight, *more) for more in ((), saved)],
    }
    assert runs["diagnose"][0]["identify"]["numbers"] and runs["diagnose"][0]["motor_shares"]["rotor"] is None
    told = run("groundstation identify", flight)
    assert told["inputs"] == "motors" and [e["horizon"] for e in told["fitted"][0]["errors"]] == [
        0.1,
        0.5,
        1.0,
    ]
    for name, (without, with_recording) in runs.items():
        assert without.keys() == with_recording.keys(), name
        assert without["recording"] is None and with_recording["recording"] == str(saved[1]), name
    assert runs["where"][0]["maps"] == runs["where"][1]["maps"]
    assert runs["diagnose"][0]["effects"] == runs["diagnose"][1]["effects"]
    page = run("groundstation report", flight, "-o", tmp_path / "report.html")
    assert page.keys() - runs["diagnose"][0].keys() == {"report"}
    beside = [run("groundstation compare", flight, flown / "table.csv", *more) for more in ((), saved)]
    assert beside[0].keys() == beside[1].keys()


def test_versions_networks_and_what_is_left(flown: Path, tmp_path: Path) -> None:
    flight, store = flown / "flight.mcap", ("--store", tmp_path / "versions")
    run("groundstation model add", "thrust_gain", "--flight", flight, *store)
    run("groundstation model list", *store)
    run("groundstation model show", "1", *store)
    run("groundstation model export", "1", "--flight", flight, "-o", tmp_path / "model.onnx", *store)
    run("groundstation train", flight, "--layers", "4", "--epochs", 1, *store)
    run("groundstation ablate", flight, "--widths", "4", "--depths", "1", "--epochs", 1, *store)
    run("groundstation remainder", flight)
    run(
        "groundstation plan-flight", "--vehicle", VEHICLE, "--between", "thrust_gain", "--between", "thrust_curve",
        "--duration", 8, "-o", tmp_path / "plan.csv",
    )  # fmt: skip


def test_the_paper_reproduced_as_far_as_its_figures_go() -> None:
    """The command itself takes minutes: the document is made of figures as it makes them."""
    scenario, arm = SCENARIOS[0], ARMS[0]
    flown = (Flown(1, scenario.name, arm.name, (1e-4, 2e-4, 3e-4), "tripped", "tripped: authority"),)
    study = Study(flown, (Prepared(1, {}, ("rotor_drag",), {"noise floor": 0.05}),))
    valid("groundstation reproduce", {"schema": 1, **study_table(study, [scenario]), "recording": None})


def test_what_drifts_in_flight_is_a_document() -> None:
    times = np.array([0.5, 1.5])
    drift = DriftingParameter("lift", "1/m", times, times, np.array([np.nan, 0.1]), times)
    document = json.loads(json.dumps(over_time_table(OverTime(drift=(drift,)))))
    assert document["drift"]["lift"]["t"] == [0.5, 1.5] and document["drift"]["lift"]["low"] == [None, 0.1]
