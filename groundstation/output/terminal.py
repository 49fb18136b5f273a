"""What every command prints with. Nothing heavy is loaded here: `--help` is to answer at once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import typer
from rich.console import Console


def print_json(table: Any) -> None:
    """One JSON document on standard output."""
    typer.echo(json.dumps(table, indent=1, allow_nan=False))


def print_written(console: Console, recording: Path | None, report: Path | None = None) -> None:
    """Say what was written, and where."""
    if recording is not None:
        console.print(f"Rerun recording: {recording}")
    if report is not None:
        console.print(f"report: {report}")
