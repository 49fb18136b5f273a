"""What every command prints with. Nothing heavy is loaded here: `--help` is to answer at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.models.flight import Flight
    from trueflight.models.model import Model
    from trueflight.models.record_pb2 import Event


def print_written(console: Console, recording: Path | None, report: Path | None = None) -> None:
    """Say what was written, and where."""
    if recording is not None:
        console.print(f"Rerun recording: {recording}")
    if report is not None:
        console.print(f"report: {report}")


def print_start(console: Console, model: Model, role: str = "starting from") -> None:
    """From which model a command begins."""
    console.print(f"{role} {contents_of(model)}", style="dim", highlight=False, markup=False)


def contents_of(model: Model) -> str:
    """A model in words: its version, what it holds, and what it was fitted to."""
    from trueflight.models.effects import EXACT_ROTATION

    holds = [n for n in model.names() if n != EXACT_ROTATION.name]
    holds += [] if model.network is None else [model.network.label]
    turns = " with exact rotation of thrust" if model.rotates_exactly else ""
    words = f"v{model.version} " if model.version else ""
    words += f"({', '.join(holds)})" if holds else f"the linear model{turns}"
    if model.fitted_to:
        words += f", fitted to {' and '.join(model.fitted_to)}"
    return words + (f"; effects of your own in {model.effects_directory}" if model.effects_directory else "")


STYLES = {"warning": "yellow", "error": "red"}


def print_event(console: Console, event: Event) -> None:
    """What a companion tells."""
    console.print(f"{event.kind}: {escape(event.text)}", style=STYLES.get(event.level, ""))


def print_warning(warning: str) -> None:
    """In red, beside what is printed: that anybody on the network could do the same; nothing of an empty text."""
    if warning:
        Terminal(stderr=True).print(f"[bold red]{escape(warning)}[/] (groundstation keys)", highlight=False)


def print_notes(console: Console, flight: Flight) -> None:
    """What a reader had to do to a flight."""
    for note in flight.notes:
        console.print(f"note: {escape(note)}", style="yellow")


@contextmanager
def working(console: Console, what: str, quiet: bool) -> Iterator[Callable[[str], None]]:
    """A line that says what is being done, unless `quiet`; yields what changes its words."""
    if quiet:
        yield lambda text: None
        return
    with console.status(what) as status:
        yield lambda text: status.update(text)


def counted(quiet: bool, own_estimate: bool = False) -> Progress:
    """A bar on standard error for work in countable pieces; gone when it is done, and never there if `quiet`. With
    `own_estimate` each task tells the time left as its field `left`, for pieces that differ much."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[left]}") if own_estimate else TimeRemainingColumn(),
        console=Terminal(stderr=True),
        disable=quiet,
        transient=True,
    )
