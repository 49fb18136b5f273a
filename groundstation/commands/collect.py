"""`groundstation collect`: a training database flown by the companion, one mission after the other."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from trueflight.groundstation.commands.linked import linked
from trueflight.groundstation.commands.options import (
    ControllerOption,
    JsonOption,
)
from trueflight.groundstation.output.terminal import print_warning
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json_line
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.groundstation.operate.link import Link
    from trueflight.groundstation.operate.settings import Settings
    from trueflight.models.database import Collection, Sortie

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command("collect", epilog="Example: groundstation collect --seed 1 --minutes 30 -o database")(
        linked(collect_command)
    )


def collect_command(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder of the records: new, or one to continue.")
    ],
    seed: Annotated[int, typer.Option(help="Of the flights' order, sizes, speeds and headings.", min=0)] = 0,
    minutes: Annotated[float, typer.Option(help="Flight time to collect, at least.")] = 30.0,
    controller: ControllerOption = "lqr",
    patience: Annotated[
        float, typer.Option(help="s to wait on the ground for a companion that refuses.", min=0.0)
    ] = 60.0,
    *,
    settings: Settings,
    as_json: JsonOption = False,
) -> None:
    """Fly a whole training database through the companion and fetch each record: translations, steps, rotations,
    spirals, circles, lemniscates, low passes and surveys.

    Each flight takes off and lands. Ends early when one is not flown to its end (a pilot took over, the battery is
    low); the same command continues with the flights that are missing, on another battery for instance.
    """
    from trueflight.groundstation.operate.link import Link
    from trueflight.models.controllers import check_controller
    from trueflight.models.database import Collection, database, record_name

    check_controller(controller, "--controller")
    sorties = {
        record_name(number, sortie): sortie for number, sortie in enumerate(database(seed, minutes), 1)
    }
    with Link(settings) as link:
        print_warning(link.warning)
        asked = {"vehicle": link.vehicle, "seed": seed, "minutes": minutes, "controller": controller}
        collection = Collection(output, {"flown_by": "groundstation collect", **asked})
        reason = _fly_missing(link, sorties, collection, controller, patience, as_json)
    seconds = sum(entry["seconds"] for entry in collection.flown.values())
    if as_json:
        report = {"folder": str(output), "wanted": len(sorties), "seconds": seconds, "reason": reason}
        print_json_line({**report, "flights": collection.flown})
    else:
        _print_collected(collection.flown)
    told = f"{output}: {len(collection.flown)} of {len(sorties)} flights, {seconds / 60:.1f} min"
    if reason:
        raise InputError(f"{told}; ended because {reason}; the same command continues")
    if not as_json:
        console.print(escape(told), highlight=False)


def _fly_missing(
    link: Link,
    sorties: dict[str, Sortie],
    collection: Collection,
    controller: str,
    patience: float,
    quiet: bool,
) -> str:
    """Fly what the collection lacks; '' when it lacks nothing any more, otherwise what came in between."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from trueflight.groundstation.operate.collection import fly_sortie

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:.0f} %"))
    with Progress(
        *columns,
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=quiet or not console.is_terminal,
    ) as progress:
        total = sum(sortie.path.duration for sortie in sorties.values())
        done = sum(entry["seconds"] for entry in collection.flown.values())
        task = progress.add_task("", total=total, completed=done)
        for record, sortie in sorties.items():
            if record in collection.flown:
                continue

            def tell(what: str, flight: str = record.removesuffix(".mcap")) -> None:
                progress.update(task, description=f"{flight}: {what}")

            try:
                entry, reason = fly_sortie(
                    link, sortie, controller, patience, collection.folder / record, tell
                )
            except KeyboardInterrupt:
                return f"it was interrupted (a flight under way is flown to its end: {record})"
            if reason:
                return reason
            collection.add(record, entry)
            progress.update(task, advance=sortie.path.duration)
    return ""


def _print_collected(flown: dict[str, dict[str, Any]]) -> None:
    """One row for each trajectory: how often, how long, on which batteries."""
    from trueflight.models.terminal import Table

    table = Table()
    for column in ("trajectory", "flights", "s", "battery before (V)"):
        table.add_column(column, justify="left" if column == "trajectory" else "right", no_wrap=True)
    for name in sorted({entry["trajectory"] for entry in flown.values()}):
        of = [entry for entry in flown.values() if entry["trajectory"] == name]
        volts = [entry["voltage"] for entry in of]
        seconds = sum(entry["seconds"] for entry in of)
        table.add_row(name, str(len(of)), f"{seconds:.0f}", f"{min(volts):.1f} to {max(volts):.1f}")
    if flown:
        console.print(table)
