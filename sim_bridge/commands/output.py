"""How commands print and stop: JSON or text, progress, interrupts."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from typing import Any

import typer

from trueflight.models.printed import print_json_line


def tell(value: dict[str, Any], text: str, as_json: bool) -> None:
    """One answer on standard output."""
    if as_json:
        print_json_line(value)
    else:
        typer.echo(text)


def until_interrupted() -> Callable[[], bool]:
    """Whether Ctrl-C or a SIGTERM came since; they do nothing else from now on."""
    stopped: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda caught, frame: stopped.append(caught))
    return lambda: bool(stopped)


class Progress:
    """A bar on standard error for long flights, in seconds of flight."""

    def __init__(self, seconds: float, quiet: bool) -> None:
        self._seconds, self._done, self._shown = seconds, 0.0, 0.0
        self._bar: Any = None
        # A hundred fly in a second: below that a bar would only flicker.
        if seconds > 100.0 and not quiet and sys.stderr.isatty():
            from rich import progress

            from trueflight.models.terminal import Terminal

            self._bar = progress.Progress(console=Terminal(stderr=True), transient=True)

    def __enter__(self) -> Progress:
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task("flying", total=self._seconds)
        return self

    def __exit__(self, *caught: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def add(self, seconds: float) -> None:
        """So much more has been flown."""
        self._done += seconds
        if self._bar is not None and self._done - self._shown >= 10.0:
            self._shown = self._done
            self._bar.update(self._task, completed=self._done)
