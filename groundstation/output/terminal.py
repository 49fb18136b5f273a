"""What every command prints with. Nothing heavy is loaded here: `--help` is to answer at once."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console


def print_written(console: Console, recording: Path | None, report: Path | None = None) -> None:
    """Say what was written, and where."""
    if recording is not None:
        console.print(f"Rerun recording: {recording}")
    if report is not None:
        console.print(f"report: {report}")
