"""No command cuts a number or a name, at any width of a terminal: each is run here, or printed from figures as it
makes them."""

import ast
import io
import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from pathlib import Path

import pytest
import typer
from test_json import PROGRAMS, VEHICLE
from typer.testing import CliRunner
from widths import whole_at_every_width

from trueflight.companion import cli, onboard_commands
from trueflight.companion.findings import DANGER, FAIL, NOTE, OK, Finding
from trueflight.companion.preflight import Parameter, Preflight
from trueflight.groundstation.commands import collect, compare_controllers, demo, reproduce, status
from trueflight.groundstation.commands.train import no_help
from trueflight.groundstation.evaluate.compare import waterfall
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.output.tables import print_waterfall
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.writing import write_flight
from trueflight.groundstation.results import WaterfallStep
from trueflight.groundstation.study.controllers import Cell
from trueflight.groundstation.study.disturbances import DISTURBANCES, LIMITS
from trueflight.groundstation.study.margins import Margin
from trueflight.groundstation.study.reproduce import ARMS, SCENARIOS, Flown, Prepared, Study
from trueflight.groundstation.versions.store import add_effect
from trueflight.models.contract import CONTROLLERS
from trueflight.models.model import rigid_body_model
from trueflight.models.terminal import Terminal
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.commands.sitl import _Teller

ROOT = Path(__file__).parent.parent
NO_TABLE = {
    "groundstation effect new": "the file it wrote",
    "groundstation monitor": "how many ticks it saw",
    "groundstation ros2-bridge": "what it publishes",
    "groundstation foxglove": "what it serves, and where",
    "groundstation deploy": "accepted, or why not",
    "companion run": "that it is ready",
    "companion doctor": "as preflight",
    "sim-bridge run": "that it is ready",
    "groundstation open": "the address of the page",
    "groundstation report": "where the page is",
    "sim-bridge fly-many": "how many flights, where",
    "sim-bridge pilot": "the mode",
}
"""Commands that print no table, and what they print."""


def shown(command: str, *arguments: object) -> str:
    """What a command prints in a pipe, which it is held to at other widths."""
    program, *words = command.split()
    with whole_at_every_width():
        done = CliRunner().invoke(PROGRAMS[program], [*words, *map(str, arguments)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "…" not in done.stdout
    return done.stdout


ELSEWHERE = {
    "groundstation calibrate": "groundstation/test_calibration.py",
    "groundstation survey": "groundstation/test_survey.py",
}
"""Commands whose figures are made by another file's tests, which print them at every width."""


@contextmanager
def figures(command: str) -> Iterator[Terminal]:
    """A terminal for the tables of a command that needs a vehicle, or minutes."""
    with whole_at_every_width() as tables, redirect_stdout(io.StringIO()):
        yield Terminal(file=io.StringIO())
    assert tables, command


def commands() -> set[str]:
    found = set()
    for program, app in PROGRAMS.items():
        waiting = [(program, typer.main.get_command(app))]
        while waiting:
            name, one = waiting.pop()
            below = getattr(one, "commands", {})
            waiting += [(f"{name} {word}", sub) for word, sub in below.items()]
            if not below:
                found.add(name)
    return found


def test_every_command_is_held_to_its_figures_here() -> None:
    held = set(re.findall(r'(?:shown|figures)\(\s*"([^"]+)"', Path(__file__).read_text()))
    assert held | set(NO_TABLE) | set(ELSEWHERE) == commands()
    assert not held & set(NO_TABLE)
    for file in ELSEWHERE.values():
        assert "whole_at_every_width()" in (Path(__file__).parent / file).read_text()


def test_every_table_and_every_console_is_the_projects_own() -> None:
    for path in sorted(p for room in PROGRAMS_ROOMS for p in (ROOT / room).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rich."):
                names = {alias.name for alias in node.names}
                assert not names & {"Table", "Panel", "Columns"}, f"{path}: take models.terminal.Table"
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id != "Console", f"{path}:{node.lineno}: take models.terminal.Terminal"


PROGRAMS_ROOMS = ("groundstation", "companion", "sim_bridge")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A record with a long name of a short flight with drag, as CSV as well; sealed answer beside it."""
    folder = tmp_path_factory.mktemp("a folder of flights whose name is long and has spaces")
    shown(
        "sim-bridge fly", "--vehicle", VEHICLE, "--trajectory", "lemniscate", "--hidden", "rotor_drag", "--seed", 3,
        "--sealed", folder / "answer.sealed", "-o", folder / "20261126-152733.123_crazypad_weight_W3_M3.mcap",
    )  # fmt: skip
    shown("sim-bridge reveal", folder / "answer.sealed")
    write_flight(read_flight(folder / "20261126-152733.123_crazypad_weight_W3_M3.mcap"), folder / "table.csv")
    return folder


def test_the_simulator_and_the_companion(tmp_path: Path) -> None:
    shown("sim-bridge effects")
    shown("sim-bridge collect", "--vehicle", VEHICLE, "--minutes", 0.2, "--jobs", 1, "-o", tmp_path / "data")
    shown("companion trajectories")
    shown("companion install-service", "--vehicle", VEHICLE, "--dry-run", "-o", tmp_path)
    with figures("sim-bridge sitl"):
        _Teller(False).differences(load_vehicle(VEHICLE), {})
    with figures("companion check"):
        cli._print_checked(CHECKED)
    with figures("companion preflight"):
        onboard_commands._print_preflight(PREFLIGHT, "serial:///dev/serial/by-id/usb-FTDI:921600", (), False)


def test_flights_vehicles_and_keys(flown: Path, tmp_path: Path) -> None:
    (record,) = flown.glob("*.mcap")
    assert record.name in shown("groundstation flights", flown)
    shown("groundstation import", flown / "table.csv", "-o", tmp_path / "again.csv")
    shown("groundstation import", flown / "table.csv", "--check")
    log = ROOT / "samples" / "px4" / "sih_lemniscate.ulg"
    shown("groundstation import", log, "--draft-vehicle", tmp_path / "drafted.toml")
    shown("groundstation design", VEHICLE, "-o", tmp_path / "design.json")
    shown("groundstation track", record, record)
    shown("groundstation bound", record)
    again = tmp_path / "again.mcap"
    words = ("--vehicle", VEHICLE, "--trajectory", "lemniscate", "--controller", "lqr_integral", "-o", again)
    shown("sim-bridge fly", *words)
    told = shown("groundstation compare", record, again)
    assert f"groundstation track {shlex.quote(str(record))} {again}" in told
    shown("groundstation keys", tmp_path / "keys", "--vehicle", "quad5", "--engineer", "anna")
    shown("groundstation effects")
    shown("groundstation effects", "rotor_drag")
    shown("groundstation fly", "list")
    with figures("groundstation status"):
        status._print_status(STATUS, 12)
    with figures("groundstation collect"):
        flights = {"1.mcap": {"trajectory": "excitation", "voltage": 16.2, "seconds": 40.0}}
        collect._print_collected(flights)


def test_models_against_flights(flown: Path, tmp_path: Path) -> None:
    (record,) = flown.glob("*.mcap")
    store = ("--store", tmp_path / "versions")
    assert "next: groundstation model add rotor_drag" in shown("groundstation diagnose", record, *store)
    added = shown(
        "groundstation model add", "rotor_drag", "--flight", record, "--validate", flown / "table.csv", *store
    )
    assert re.search(r"rotor_drag x = \S+ 1/s \[", added)
    told = [
        shown("groundstation diagnose", record, *store),
        shown("groundstation compare", record, *store),
        shown("groundstation compare", record, flown / "table.csv", *store),
        shown("groundstation compare", record, "--model", "linear", "--model", "v1", *store),
        shown("groundstation where", record, *store),
        shown("groundstation identify", record, *store),
        shown("groundstation remainder", record, *store),
    ]
    assert all(f"v1 (rotor_drag), fitted to {record.stem}\n" in text for text in told)
    shown("groundstation model list", *store)
    assert re.search(r"rotor_drag  x = \S+ 1/s \[", shown("groundstation model show", "1", *store))
    shown("groundstation model export", "1", "--to", "mujoco", "-o", tmp_path / "vehicle.xml", *store)
    shown("groundstation train", record, "--layers", "4", "--epochs", 1, *store)
    shown("groundstation ablate", record, "--widths", "4", "--depths", "1", "--epochs", 1, *store)


def test_what_is_told_of_a_worst_moment_keeps_its_place_in_a_narrow_terminal(flown: Path) -> None:
    (record,) = flown.glob("*.mcap")
    narrow = CliRunner(env={"COLUMNS": "80"}).invoke(PROGRAMS["groundstation"], ["where", str(record)])
    first, *rest = narrow.stdout.split("Worst moments\n")[1].splitlines()
    place = re.search(r"m/s²  (?=height)", first)
    assert place and any(line.startswith(" " * place.end()) for line in rest)
    assert all(re.match(r" +\d", line) or line.startswith(" " * place.end()) for line in rest)


def test_the_falling_error_is_a_table_in_80_columns_whatever_flights_are_called() -> None:
    narrow, name = Terminal(file=io.StringIO(), width=80), "20261127-200205-m1-excitation-lqr"
    steps = [WaterfallStep("v1 + thrust_gain + rotor_drag", 0.5, 0.6, 0.05)]
    print_waterfall(narrow, steps, name, f"another-{name}")
    text = narrow.file.getvalue()  # type: ignore[attr-defined]
    assert f"fitted: {name}; held out:" in text and "│ v1 + thrust_gain + rotor_drag │" in text


def test_a_network_that_does_not_help_is_told_with_the_version_to_fly_instead() -> None:
    model = replace(rigid_body_model(load_vehicle(VEHICLE)), version=3)
    assert no_help({"validation_rms": 0.04, "before_rms": 0.05}, model) == ""
    assert "fly and diagnose without it (--model v3)" in no_help(
        {"validation_rms": 0.05, "before_rms": 0.05}, model
    )


def test_a_version_is_shown_with_all_that_it_has_beyond_the_one_before() -> None:
    flight = read_flight(ROOT / "samples" / "rotorpy" / "rotor_drag" / "validate.parquet")
    base = rigid_body_model(flight.vehicle)
    two = add_effect(base, ["rotor_drag", "thrust_gain"], [flight])
    labels = [step.label for step in waterfall(flight, None, [base, two])]
    assert labels == ["+ rigid_body", "+ rotor_drag + thrust_gain"]


def test_a_flight_planned(tmp_path: Path) -> None:
    shown(
        "groundstation plan-flight", "--vehicle", VEHICLE, "--between", "thrust_gain", "--between", "thrust_curve",
        "--duration", 8, "-o", tmp_path / "plan.csv",
    )  # fmt: skip


def test_the_paper_and_the_demonstration(flown: Path) -> None:
    made = tuple(
        Flown(seed, s.name, arm.name, (1e-4 * seed, 2e-4, 3e-4), "finished", "active")
        for seed in (1, 2)
        for s in SCENARIOS
        for arm in ARMS
    )
    names = (
        "noise floor",
        "network: held-out RMS before",
        "network: held-out RMS",
        "effects + network: held-out RMS",
    )
    with figures("groundstation reproduce"):
        prepared = Prepared(1, {}, ("rotor_drag", "ground_effect"), dict.fromkeys(names, 0.05))
        reproduce._print(Study(made, (prepared,)), SCENARIOS, False)
    flight = read_flight(ROOT / "samples" / "rotorpy" / "rotor_drag" / "identify.parquet")
    cells = [
        Cell(seed, one.name, name, 0.01 * seed, 0.02, "finished", 0.4, 0.5)
        for seed in (1, 2)
        for one in DISTURBANCES
        for name in CONTROLLERS
    ]
    with figures("groundstation compare-controllers") as terminal:
        terminal.print(compare_controllers._table(cells, DISTURBANCES, CONTROLLERS, "reference"))
        margins = [
            Margin(seed, one.name, name, 0.1 * seed, False)
            for seed in (1, 2)
            for one in LIMITS
            for name in CONTROLLERS
        ]
        compare_controllers._print_margins(margins, LIMITS, CONTROLLERS)
        terminal.print(compare_controllers._table_for_real(cells[:3], cells))
    with figures("groundstation demo"):
        demo._print_real([("carries a payload", diagnose(flight, rigid_body_model(flight.vehicle)))])


CHECKED = {
    "address": "serial:///dev/serial/by-id/usb-FTDI_FT232R_USB_UART_A9XYZ-if00-port0:921600",
    "wanted_rate": 100.0,
    "rates": {"odometry": 99.8, "attitude": 100.0, "battery": 1.0, "imu": 50.0},
    "flight_mode": "POSCTL",
    "batteries": [{"id": 1, "voltage": 16.24, "cells": 4}],
    "parameters": {"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 4, "COM_RC_IN_MODE": 1, "EKF2_PREDICT_US": None},
}
PREFLIGHT = Preflight(
    "PX4 1.15.4 (aedf4a1f)",
    (Finding("Preflight Fail: Accel 0 uncalibrated", "now", "", "calibrate it in QGroundControl", FAIL),),
    (
        Parameter(
            "COM_OBL_RC_ACT", "0", "4 (land)", "what PX4 does when the companion falls silent", DANGER, 4
        ),
        Parameter("EKF2_PREDICT_US", "not there", "10000", "a rate of the estimator of 100 Hz", OK),
    ),
    (Finding("ODOMETRY", "99.8 Hz, at most 12 ms apart", "100 Hz", "each one makes a tick", OK),),
    (Parameter("hover thrust", "0.5123", "0.5000", "of the flight records and of the vehicle file", NOTE),),
)
STATUS = {
    "vehicle": "quad5", "ready": False, "not_ready": "no position: PX4's estimator has not yet fused a pose of mocap",
    "rates": {"odometry": 99.8, "attitude": 100.0}, "phase": "idle", "flight_mode": "POSCTL", "armed": False,
    "battery_voltage": 16.24, "live": "0123456789ab", "last_good": "ba9876543210", "shadow": None, "guard": "active",
    "staged": {"hash": "ba9876543210", "name": "quad5", "version": "3"},
    "models": [{"hash": "0123456789ab", "name": "quad5", "version": "2"}],
    "access": {"signers": {"0123456789ab": "anna"}}, "others": ["MAVLink system 3, a camera", "QGroundControl"],
    "missions": [
        {"mission": "20261126-152733", "trajectory": "lemniscate", "controller": "corrected", "state": "finished",
         "reason": ""},
    ],
}  # fmt: skip
