"""What the three programs have in common: a version, help by task, one line where a library is missing."""

import os
import subprocess
import sys
from pathlib import Path

import programs
import pytest
import typer

from trueflight import __version__
from trueflight.groundstation.commands.app import app
from trueflight.groundstation.commands.tasks import TASKS

FLIGHT = Path(__file__).parents[1] / "samples" / "rotorpy" / "nothing_hidden" / "identify.parquet"
BIN = Path(sys.executable).parent
WITHOUT = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"scipy", "torch", "control", "rerun", "mujoco", "threadpoolctl", "onnx", "pyulog"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
from trueflight.groundstation.commands.app import main
main()
"""
"""`groundstation` where only what the companion needs is installed."""


@pytest.mark.parametrize("program", ["groundstation", "companion", "sim-bridge"])
def test_every_program_tells_its_version(program: str) -> None:
    told = subprocess.run([str(BIN / program), "--version"], capture_output=True, text=True)
    assert (told.returncode, told.stdout) == (0, f"{program} {__version__}\n")


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (
            "groundstation diagnose x.csv --bandwidth -1",
            "groundstation diagnose: '--bandwidth': Input should be",
        ),
        ("groundstation fly", "groundstation fly: missing argument 'trajectory'"),
        ("groundstation model nope", "groundstation model: no such command 'nope'"),
        ("companion run --nope", "companion run: no such option: --nope"),
        ("sim-bridge fly --strength nan", "sim-bridge fly: '--strength': Input should be"),
    ],
)
def test_an_option_that_cannot_be_is_one_line_at_every_width(line: str, told: str) -> None:
    program, *words = line.split()
    environment = {**os.environ, "COLUMNS": "40"}
    done = subprocess.run([str(BIN / program), *words], capture_output=True, text=True, env=environment)
    (error,) = done.stderr.splitlines()
    assert error.startswith(f"error: {told}") and error.endswith(f"; see '{told.split(':')[0]} --help'")
    assert (done.returncode, done.stdout) == (2, "")


def test_a_program_alone_prints_its_help_once() -> None:
    for program in ("groundstation", "companion", "sim-bridge"):
        done = subprocess.run([str(BIN / program)], capture_output=True, text=True)
        assert (done.stdout + done.stderr).count("Usage: ") == 1 and done.returncode == 2


def test_every_command_stands_under_a_task_with_its_own_words() -> None:
    made = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    told = {name: entry.told for entries in TASKS.values() for name, entry in entries.items()}
    assert told == {name: " ".join(made[name].help.split("\n\n")[0].split()) for name in made}
    page = programs.run("groundstation", "--help").stdout
    assert sorted(TASKS, key=lambda task: page.index(f"─ {task} ─")) == list(TASKS)
    modules = (Path(__file__).parents[1] / "groundstation" / "commands").glob("*.py")
    registering = {m.stem for m in modules if "\ndef register(" in m.read_text()}
    assert registering == {entry.module for entries in TASKS.values() for entry in entries.values()}


def test_in_the_companions_environment_it_says_what_to_install() -> None:
    told = subprocess.run(
        [sys.executable, "-c", WITHOUT, "diagnose", str(FLIGHT)], capture_output=True, text=True
    )
    assert told.returncode == 2
    assert told.stderr == "error: scipy is not installed here; pip install 'trueflight[ground]'\n"
