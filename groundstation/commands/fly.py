"""`groundstation fly`: a mission asked for, followed, and its record fetched."""

from __future__ import annotations

import queue
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from trueflight.groundstation.commands.linked import linked
from trueflight.groundstation.commands.options import (
    ControllerOption,
    JsonOption,
)
from trueflight.groundstation.output.terminal import print_event, print_warning
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json, print_json_line
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.groundstation.operate.link import Link
    from trueflight.groundstation.operate.settings import Settings
    from trueflight.models.record_pb2 import Event

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command(
        "fly", epilog="Example: groundstation fly lemniscate --set speed=2 --controller corrected --wait"
    )(linked(fly_command))


def fly_command(
    trajectory: Annotated[
        str, typer.Argument(help="Name of a trajectory (`groundstation fly list`), or a CSV of setpoints.")
    ],
    controller: ControllerOption = "lqr",
    parameters: Annotated[
        list[str] | None, typer.Option("--set", help="Parameter of the trajectory, NAME=VALUE.")
    ] = None,
    repeat: Annotated[int, typer.Option(help="How often.", min=1, max=100)] = 1,
    wait: Annotated[
        bool, typer.Option("--wait", help="Follow the flight to its end and fetch its record.")
    ] = False,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder for the record.")] = None,
    *,
    settings: Settings,
    as_json: JsonOption = False,
) -> None:
    """Ask the companion to fly a trajectory; with --wait, follow it and fetch the flight record."""
    if trajectory == "list":
        _list_trajectories(as_json)
        return
    from trueflight.groundstation.operate.link import Link
    from trueflight.groundstation.operate.mission import mission_of

    mission = mission_of(trajectory, controller, parameters or (), repeat)
    with Link(settings) as link:
        print_warning(link.warning)
        if wait:
            _fly_and_fetch(link, mission, output or Path(settings.flights), as_json)
            return
        answer = link.request("mission", mission)
    if as_json:
        print_json_line(answer)
    else:
        console.print(f"accepted as {answer['mission']}, {answer['duration']:.0f} s ({answer['reason']})")


def _fly_and_fetch(link: Link, mission: dict[str, Any], folder: Path, as_json: bool) -> None:
    """Fly a mission to its end and bring its record home. Raises `InputError` where it was not finished."""
    events: queue.SimpleQueue[Event] = queue.SimpleQueue()
    link.follow(on_event=events.put)
    name = link.request("mission", mission)["mission"]
    ended = _accompany(link, name, events, as_json)
    state, reason, record = ended["state"], ended["reason"], ""
    if ended["record"]:
        record = str(_fetch(link, ended["record"], folder, as_json))
    if as_json:
        print_json_line({"mission": name, "state": state, "reason": reason, "record": record})
    elif state == "finished":
        console.print(f"flown: {escape(record)}")
    if state != "finished":
        kept = f" (record: {record})" if record else ""
        raise InputError(f"mission {name} {state}: {reason}{kept}; see `groundstation status`")


def _list_trajectories(as_json: bool) -> None:
    from trueflight.models.reference import KINDS

    if as_json:
        print_json(
            {
                k.name: {"text": k.text, "parameters": {p.name: p.default for p in k.parameters}}
                for k in KINDS.values()
            }
        )
        return
    from trueflight.models.terminal import Table

    table = Table()
    table.add_column("trajectory", no_wrap=True)
    table.add_column("what it is")
    table.add_column("parameters (--set NAME=VALUE)")
    for kind in KINDS.values():
        words = [
            f"{p.name}={p.default:g} {p.unit}".strip()
            if isinstance(p.default, float)
            else f"{p.name}={p.default}"
            for p in kind.parameters
        ]
        table.add_row(kind.name, escape(kind.text), escape(", ".join(words)))
    console.print(table)


def _accompany(link: Link, mission: str, events: queue.SimpleQueue[Event], quiet: bool) -> dict[str, Any]:
    """Print events until the mission has ended; returns its entry of the companion's status."""
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(
        *columns, console=console, transient=True, disable=quiet or not console.is_terminal
    ) as progress:
        task = progress.add_task(f"{mission}: waiting", total=None)

        def tell(status: dict[str, Any], entry: dict[str, Any]) -> None:
            _print_events(events, progress.console, quiet)
            phase = status["phase"] if entry["state"] == "flying" else entry["state"]
            progress.update(
                task,
                description=f"{mission} {entry['trajectory']} {entry['controller']}: {phase}, "
                f"{status['battery_voltage']:.1f} V, guard {status['guard']}",
            )

        try:
            ended = link.end_of(mission, tell)
        except KeyboardInterrupt:
            Terminal(stderr=True).print(
                f"{mission} flies on, and its record stays on board; groundstation status tells of it",
                style="yellow",
            )
            raise
        time.sleep(0.2)  # the event that says why is on its way
        _print_events(events, progress.console, quiet)
        return ended


def _fetch(link: Link, record: str, folder: Path, quiet: bool) -> Path:
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn

    with Progress(
        TextColumn("fetching the record"),
        BarColumn(),
        DownloadColumn(),
        console=console,
        transient=True,
        disable=quiet or not console.is_terminal,
    ) as progress:
        task = progress.add_task("", total=None)
        return link.fetch_record(
            record, folder, lambda done, size: progress.update(task, completed=done, total=size)
        )


def _print_events(events: queue.SimpleQueue[Event], to: Console, quiet: bool) -> None:
    while not events.empty():
        event = events.get()
        if not quiet:
            print_event(to, event)
