"""The command line: what cannot work is one line and exit code 2, and loses nothing."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from json_schemas import valid
from onnx_models import drag_model
from rig import VEHICLE, Bridge, Companion, free_port

from trueflight.companion.settings import Settings, load_settings
from trueflight.models.contract import model_hash
from trueflight.models.errors import InputError

pytestmark = pytest.mark.realtime

EXAMPLE = Path(__file__).parents[2] / "companion" / "companion.toml"


def companion(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from trueflight.companion.cli import main; main()", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=90,
    )


def refused(*arguments: object) -> str:
    """The one line of a run that must be refused."""
    result = companion(*arguments)
    assert result.returncode == 2, result.stdout + result.stderr
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    return lines[0]


@pytest.fixture
def bridge() -> Iterator[tuple[Bridge, int]]:
    port = free_port()
    bridge = Bridge(port, "--param", "EKF2_PREDICT_US=10000", "--param", "COM_OF_LOSS_T=1")
    yield bridge, port
    bridge.end()


@pytest.mark.parametrize("command", ["run", "check", "trajectories"])
def test_help_has_an_example_that_names_the_command(command: str) -> None:
    text = companion(command, "--help").stdout
    assert f"Example: companion {command}" in text


def test_trajectories_are_listed_for_people_and_programs() -> None:
    assert "lemniscate" in companion("trajectories").stdout
    listing = json.loads(companion("trajectories", "--json").stdout)
    assert listing["circle"]["parameters"]["radius"] == {"default": 1.5, "unit": "m"}


def test_check_tells_what_arrives(bridge: tuple[Bridge, int]) -> None:
    report = json.loads(companion("check", "--connect", f"udpin://127.0.0.1:{bridge[1]}", "--json").stdout)
    valid("companion check", report)
    assert 80.0 < report["rates"]["odometry"] <= 101.0
    assert report["accelerometer"]
    assert report["rotor_speeds"] == 4
    assert report["parameters"]["COM_OF_LOSS_T"] == 1.0
    assert report["parameters"]["COM_OBL_RC_ACT"] == 0
    assert report["flight_mode"] == "HOLD"
    assert not report["armed"]


LEFT_OUT = (
    "typer",
    "rich",
    "onnxruntime",
    "cryptography",
    "torch",
    "scipy",
    "onnx",
    "trueflight.companion.cli",
)


def test_the_process_that_flies_has_loaded_nothing_that_it_does_not_fly_with(
    bridge: tuple[Bridge, int], tmp_path: Path
) -> None:
    """Python itself tells what it imports; the flying process begins with the last headline of that."""
    (tmp_path / "models").mkdir()
    onnx = drag_model(0.05)
    (tmp_path / "models" / f"{model_hash(onnx)}.onnx").write_bytes(onnx)
    (tmp_path / "models" / "history.json").write_text(json.dumps([model_hash(onnx)]))
    companion = Companion(tmp_path, bridge[1], environment={"PYTHONPROFILEIMPORTTIME": "1"})
    try:
        mission = companion.fly(trajectory="hover", parameters={"duration": 1.0}, controller="corrected")
        companion.phase("mission")
        assert companion.ticks[-1].model == model_hash(onnx)
        companion.ask("mission", {"command": "land"})
        companion.done(mission)
    finally:
        companion.end()
    imported = [
        line.rpartition("|")[2].strip() for line in companion.lines if line.startswith("import time:")
    ]
    flying = imported[len(imported) - imported[::-1].index("imported package") :]
    assert "trueflight.companion.app" in flying and "trueflight.companion.law.straight_line" in flying
    assert not [
        name for name in flying if name in LEFT_OUT or name.startswith(tuple(f"{one}." for one in LEFT_OUT))
    ]


def test_too_low_a_rate_is_refused(bridge: tuple[Bridge, int], tmp_path: Path) -> None:
    line = refused(
        *("run", "--vehicle", VEHICLE, "--connect", f"udpin://127.0.0.1:{bridge[1]}", "--rate", 250),
        *("--records", tmp_path / "r", "--models", tmp_path / "m"),
        *("-l", f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"),
    )
    assert "250 Hz were asked for" in line


def common(tmp_path: Path) -> list[object]:
    return [
        *("--connect", f"udpin://127.0.0.1:{free_port()}", "--timeout", 0.5),
        *("--records", tmp_path / "r", "--models", tmp_path / "m"),
        *("-l", f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"),
    ]


def test_no_autopilot_is_told_with_the_time_it_took(tmp_path: Path) -> None:
    assert "no autopilot answering" in refused("run", "--vehicle", VEHICLE, *common(tmp_path))
    line = refused("check", "--connect", f"udpin://127.0.0.1:{free_port()}", "--timeout", 0.5)
    assert "within 0.5 s" in line


def test_a_port_in_use_is_told(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        assert str(port) in refused("check", "--connect", f"udpin://127.0.0.1:{port}", "--timeout", 0.5)
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        line = refused("run", "--vehicle", VEHICLE, *common(tmp_path), "-l", f"tcp/127.0.0.1:{port}")
        assert "another companion" in line


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "no vehicle file"),
        (["--vehicle", "none.toml"], "none.toml"),
        (["--vehicle", VEHICLE, "--design", "none.json"], "groundstation design"),
        (["--vehicle", VEHICLE, "--rate", "5"], "10 to 1000"),
        (["--vehicle", VEHICLE, "--connect", "carrier-pigeon"], "carrier-pigeon"),
        (["--vehicle", VEHICLE, "-m", "pear"], "mode"),
        (["--vehicle", VEHICLE, "-c", "none.json5"], "none.json5"),
        (["--vehicle", VEHICLE, "--cfg", "nonsense"], "KEY:VALUE"),
        (["--config", "none.toml"], "none.toml"),
    ],
)
def test_wrong_flags_are_one_line(flags: list[object], message: str, tmp_path: Path) -> None:
    assert message in refused("run", *common(tmp_path), *flags)


class TestSettings:
    def test_the_example_holds_the_defaults(self) -> None:
        assert load_settings(EXAMPLE).safety == Settings().safety
        assert load_settings(EXAMPLE).guard == Settings().guard
        assert load_settings(EXAMPLE).limits == Settings().limits
        assert load_settings(EXAMPLE).zenoh == Settings().zenoh

    def test_file_names_are_relative_to_the_file(self, tmp_path: Path) -> None:
        (tmp_path / "companion.toml").write_text('vehicle = "my.toml"\nrecords = "/var/flights"\n')
        settings = load_settings(tmp_path / "companion.toml")
        assert settings.vehicle == str(tmp_path / "my.toml")
        assert settings.design_path == tmp_path / "design.json"
        assert settings.records == "/var/flights"

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("rat = 100", "unknown key 'rat'; did you mean 'rate'"),
            ("[safety]\nfence_hight = 3", "unknown key 'safety.fence_hight'; did you mean 'fence_height'"),
            ("[guard]\nauthority = [1, 2]", "must have 3 numbers"),
            ("[guard]\nauthority = 2", "must be a list"),
            ("rate = 'fast'", "must be a positive number"),
            ("rate = -1", "must be a positive number"),
            ("rate = nan", "must be a positive number"),
            ("safety = 3", "must be a section"),
            ("connect = 3", "must be a text"),
            ("rate 100", "not valid TOML"),
        ],
    )
    def test_what_is_misspelt_or_of_the_wrong_kind_is_told(
        self, text: str, message: str, tmp_path: Path
    ) -> None:
        (tmp_path / "companion.toml").write_text(text)
        with pytest.raises(InputError, match=r"companion\.toml") as caught:
            load_settings(tmp_path / "companion.toml")
        assert message in str(caught.value)
