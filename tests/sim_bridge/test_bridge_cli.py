"""Command lines: what they report, what they refuse, and that an answer stays sealed."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from bridge_process import QUAD5, Bridge, free_ports

from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.parameters import Parameters
from trueflight.sim_bridge.seal import reveal, seal
from trueflight.sim_bridge.settings import load_settings
from trueflight.sim_bridge.truth.effects import EFFECTS
from trueflight.sim_bridge.truth.hidden import RICH, choose, pool

pytestmark = pytest.mark.realtime

VEHICLE = ("--vehicle", str(QUAD5 / "vehicle.toml"))


def command(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from trueflight.sim_bridge.cli import main; main()", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=cwd,
    )


def test_a_sealed_answer_opens_to_what_was_hidden(vehicle: Vehicle, tmp_path: Path) -> None:
    hidden = choose(["random"], vehicle, 7, 2)
    path = tmp_path / "a.sealed"
    seal(hidden, vehicle.name, 7, path)
    answer = reveal(path)
    assert answer["vehicle"] == "quad5" and answer["seed"] == 7
    assert answer["effects"] == [one.answer() for one in hidden]


def test_a_seal_shows_nothing(vehicle: Vehicle, tmp_path: Path) -> None:
    paths = []
    for names in (["none"], ["wind:4"], ["rotor_drag", "wind", "ground_effect"]):
        paths.append(tmp_path / f"{len(names)}{names[0]}.sealed")
        seal(choose(names, vehicle, 3), vehicle.name, 3, paths[-1])
    texts = [path.read_text() for path in paths]
    assert len({len(text) for text in texts}) == 1  # not even how much is hidden
    assert not any(name in text for name in EFFECTS for text in texts)


@pytest.mark.parametrize("damage", ["flip", "cut", "other", "binary", "missing"])
def test_a_damaged_seal_is_told_in_one_line(vehicle: Vehicle, tmp_path: Path, damage: str) -> None:
    path = tmp_path / "a.sealed"
    seal(choose(["wind"], vehicle, 7), vehicle.name, 7, path)
    text = path.read_text()
    if damage == "flip":
        path.write_text(text[:200] + ("A" if text[200] != "A" else "B") + text[201:])
    elif damage == "cut":
        path.write_text(text[:300])
    elif damage == "other":
        path.write_text("t,x,y\n1,2,3\n")
    elif damage == "binary":
        path.write_bytes(b"\x89\xff\x00")
    else:
        path.unlink()
    with pytest.raises(InputError, match=r"a\.sealed"):
        reveal(path)


def test_fly_writes_a_record_and_seals_the_answer(tmp_path: Path) -> None:
    design = ("--design", str(QUAD5 / "design.json"))
    fly = ("fly", "--trajectory", "hover", "--set", "duration=2", *VEHICLE, *design, "-o", "one.mcap")
    done = command(*fly, "--hidden", "random", "--seed", "7", "--csv", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["outcome"] == "finished" and report["ticks"] == 200
    assert {path.name for path in tmp_path.iterdir()} == {"one.mcap", "one.csv", "one.sealed"}
    opened = command("reveal", str(tmp_path / "one.sealed"), "--json")
    (effect,) = json.loads(opened.stdout)["effects"]
    assert effect["name"] in EFFECTS
    words = command("reveal", str(tmp_path / "one.sealed")).stdout
    for name, told in effect["parameters"].items():
        unit = "" if told["unit"] == "1" else f" {told['unit']}"
        assert f"{name} {told['value']:.4g}{unit}" in re.split(r"[:,]\s|\n", words)
    assert effect["name"] not in done.stdout + done.stderr
    before = (tmp_path / "one.sealed").read_bytes()
    again = command(*fly, "--hidden", "random", "--seed", "8", cwd=tmp_path)
    assert again.returncode == 2 and "one.mcap: is there already" in again.stderr
    assert (tmp_path / "one.sealed").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("run",), "no vehicle"),
        (("run", "--vehicle", "missing.toml"), "missing.toml: cannot read"),
        (("run", *VEHICLE, "--hidden", "rotor_drg"), "did you mean 'rotor_drag'"),
        (("run", *VEHICLE, "--mavlink", "tcp:1.2.3.4"), "udpout:HOST:PORT"),
        (("run", *VEHICLE, "--speed", "0"), "--speed 0"),
        (("run", *VEHICLE, "--param", "COM_OF_LOSS_T=soon"), "COM_OF_LOSS_T is a number"),
        (("run", *VEHICLE, "--param", "NO_SUCH=1"), "NAME=VALUE"),
        (("run", *VEHICLE, "--config", "missing.toml"), "missing.toml: cannot read"),
        (("run", *VEHICLE, "--pilot-mode", "ASLEEP"), "choose one of"),
        (("run", *VEHICLE, "--charge", "1.2"), "--charge 1.2 is outside 0.05 to 1"),
        (("run", *VEHICLE, "--battery-age", "9"), "--battery-age 9"),
        (("run", *VEHICLE, "--hidden", "riche"), "did you mean 'rich'"),
        (("fly", "--trajectory", "nowhere", *VEHICLE, "-o", "x.mcap"), "no trajectory 'nowhere'"),
        (("reveal", "missing.sealed"), "missing.sealed: cannot read"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments: tuple[str, ...], says: str, tmp_path: Path) -> None:
    done = command(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_port_in_use_is_told(bridge, tmp_path: Path) -> None:
    running: Bridge = bridge()
    hide = ("--hidden", "random", "--sealed", "earlier.sealed")
    (tmp_path / "earlier.sealed").write_text("the answer to an earlier flight")
    done = command("run", *VEHICLE, *hide, "--port", str(running.port), "--pilot-port", "0", cwd=tmp_path)
    assert done.returncode == 2
    assert (tmp_path / "earlier.sealed").read_text() == "the answer to an earlier flight"
    assert f"UDP port {running.port} on 127.0.0.1 is in use" in done.stderr


def test_a_pilot_without_a_vehicle_is_told() -> None:
    done = command("pilot", "--mode", "POSCTL", "--pilot-port", str(free_ports(1)[0]))
    assert done.returncode == 2 and "no simulated vehicle answers" in done.stderr


def test_effects_lists_what_can_be_hidden() -> None:
    listed = json.loads(command("effects", "--json").stdout)["effects"]
    assert [row["name"] for row in listed] == list(EFFECTS)
    assert {row["name"]: tuple(row["rich"]) for row in listed if row["rich"]} == RICH
    assert [row["name"] for row in listed if row["random"]] == pool("random")
    assert [row["name"] for row in listed if row["any"]] == pool("any")
    assert {"estimator_delay", "payload"}.isdisjoint(pool("any"))


def test_a_flight_on_a_weak_battery_sinks_where_thrust_follows_the_voltage(tmp_path: Path) -> None:
    errors = []
    for charge in ("0.97", "0.4"):
        hover = ("fly", "--trajectory", "hover", *VEHICLE, "--hidden", "battery_sag:1.5", "--charge", charge)
        done = command(*hover, "-o", f"{charge}.mcap", "--json", cwd=tmp_path)
        errors.append(json.loads(done.stdout)["rms_error"]["z"])
    assert errors[0] < 0.1 < 0.15 < errors[1]


def test_the_example_configuration_holds_the_defaults(vehicle: Vehicle) -> None:
    example = Path(__file__).parents[2] / "sim_bridge/sim-bridge.toml"
    settings = load_settings(example, {"seed": 3, "hidden": ["wind:4"], "port": None})
    assert (settings.seed, settings.hidden, settings.port) == (3, ("wind:4",), 14580)
    plain = load_settings(None, {"vehicle": settings.vehicle})
    assert load_settings(example, {}) == plain
    assert Path(settings.vehicle).samefile(QUAD5 / "vehicle.toml")


@pytest.mark.parametrize(
    ("text", "says"),
    [("sped = 2", "did you mean 'speed'"), ('seed = "a"', "whole number"), ("seed =", "not valid TOML")],
)
def test_a_wrong_configuration_is_told(tmp_path: Path, text: str, says: str) -> None:
    config = tmp_path / "c.toml"
    config.write_text(text)
    with pytest.raises(InputError, match=says):
        load_settings(config, {})


def test_parameters_keep_their_type_and_range(vehicle: Vehicle) -> None:
    parameters = Parameters(vehicle)
    assert parameters["MPC_THR_HOVER"] == vehicle.hover_thrust
    assert not parameters.set("COM_OBL_RC_ACT", 4.0)
    assert not parameters.set("COM_OF_LOSS_T", 1)
    assert not parameters.set("COM_OF_LOSS_T", float("nan"))
    assert parameters.set("COM_OF_LOSS_T", 0.5) and parameters["COM_OF_LOSS_T"] == 0.5


def test_the_bridge_needs_neither_the_ground_nor_the_fitted_effects() -> None:
    code = (
        "import sys, trueflight.sim_bridge.cli, trueflight.sim_bridge.in_process\n"
        "import trueflight.sim_bridge.mavlink.server, trueflight.sim_bridge.seal\n"
        "banned = ('torch', 'rerun', 'control', 'trueflight.groundstation', "
        "'trueflight.models.effects', 'trueflight.models.effect')\n"
        "print([name for name in banned if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]", done.stderr
