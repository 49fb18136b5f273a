"""A command line run in the process of the tests: as its program does it, without a start that takes a second.

Each program is also started as a process of its own somewhere in the tests, and so is every command that starts
processes itself, is interrupted, or owns a terminal.
"""

from __future__ import annotations

import contextlib
import io
import subprocess
from pathlib import Path

import typer

from trueflight.groundstation.commands.app import app as groundstation
from trueflight.models.errors import run_command_line
from trueflight.sim_bridge.cli import app as sim_bridge

PROGRAMS: dict[str, typer.Typer] = {"groundstation": groundstation, "sim-bridge": sim_bridge}


def run(program: str, *arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Exit code, standard output and error of `program arguments`; what it does not catch is raised."""
    words = [str(argument) for argument in arguments]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        contextlib.chdir(cwd or Path.cwd()),
    ):
        try:
            run_command_line(lambda: PROGRAMS[program](words, standalone_mode=False))
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    return subprocess.CompletedProcess([program, *words], code, out.getvalue(), err.getvalue())
