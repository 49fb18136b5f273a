"""`groundstation compare-controllers`: the project's controllers beside those of other papers, and one's own."""

from __future__ import annotations

import os
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box

from trueflight.groundstation.commands.options import JobsOption, JsonOption
from trueflight.groundstation.output.terminal import counted
from trueflight.models.printed import print_json
from trueflight.models.shipped import QUAD5
from trueflight.models.terminal import Table, Terminal

if TYPE_CHECKING:
    from trueflight.groundstation.study.controllers import Cell, Disturbance

console = Terminal()
FINISHED = "finished"
MEASURES = {"reference": "to the reference", "linear": "to the linear behaviour"}


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command(
        "compare-controllers",
        epilog="Example: groundstation compare-controllers --seeds 2 --controller lqr --controller indi "
        "--disturbance wind",
    )(compare_controllers)


def compare_controllers(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for all it makes; the same one goes on.")
    ] = Path("controllers"),
    seeds: Annotated[int, typer.Option(help="Vehicles, each with a truth of its own.", min=1, max=100)] = 5,
    first: Annotated[int, typer.Option(help="The first seed.", min=0)] = 1,
    controller: Annotated[
        list[str] | None, typer.Option(help="One of them; default: all that are installed. Repeatable.")
    ] = None,
    disturbance: Annotated[
        list[str] | None, typer.Option(help="One of them; default: all. Repeatable.")
    ] = None,
    minutes: Annotated[float, typer.Option(help="Flight that `corrected` learns from.", min=5.0)] = 30.0,
    hidden: Annotated[
        list[str] | None, typer.Option(help="What the simulator hides: rich, or NAME, NAME:SIZE. Repeatable.")
    ] = None,
    vehicle: Annotated[
        Path, typer.Option(help="vehicle.toml with its design.json beside it.", show_default=False)
    ] = QUAD5,
    jobs: JobsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Fly every controller on the same vehicles, winds, payloads, batteries and paths, and print how far each is off.

    RMSE in cm over three axes, median of the seeds with the least and the greatest: to the reference, and to the
    expected linear behaviour. `corrected` learns each vehicle first, without the disturbance.
    """
    from trueflight.groundstation.study import controllers as c
    from trueflight.groundstation.study.reproduce import Asked

    flights, names = c.chosen_disturbances(disturbance), c.chosen_controllers(controller)
    asked = Asked(output, vehicle, tuple(hidden or ["rich"]), minutes)
    asked.open()
    with counted(as_json) as progress:
        task = progress.add_task("", total=seeds * len(flights) * len(names))

        def tell(what: str, done: int) -> None:
            progress.update(task, advance=done, description=what)

        cells = c.compare(
            asked, range(first, first + seeds), flights, names, jobs or len(os.sched_getaffinity(0)), tell
        )
    if as_json:
        print_json(comparison(cells, flights))
        return
    for measure, title in MEASURES.items():
        console.print(f"RMSE {title}, cm: median, least..greatest of the vehicles", style="bold")
        console.print(_table(cells, flights, names, measure))
    for one in flights:
        console.print(f"{one.name}: {one.title}", style="dim", highlight=False)
    for cell in cells:
        if cell.outcome != FINISHED:
            console.print(
                f"vehicle {cell.seed}, {cell.disturbance}, {cell.controller}: {cell.outcome}", style="yellow"
            )


def _table(
    cells: Sequence[Cell], flights: Sequence[Disturbance], names: Sequence[str], measure: str
) -> Table:
    """One row a controller, so that it stays narrow however many are installed; the best of a column is bold."""
    table = Table(box=box.SIMPLE, padding=(0, 1, 0, 0))
    table.add_column("controller")
    for flight in flights:
        table.add_column(flight.name, justify="right")
    columns = {flight.name: _medians(cells, flight.name, measure) for flight in flights}
    for name in names:
        row = []
        for flight in flights:
            median = columns[flight.name].get(name)
            values = _values(cells, flight.name, name, measure)
            if median is None:
                row.append("lost")
                continue
            text = f"{100 * median:.1f}"
            if median == min(columns[flight.name].values()):
                text = f"[bold]{text}[/bold]"
            spread = (
                f"\n[dim]{100 * min(values):.1f}..{100 * max(values):.1f}[/dim]" if len(values) > 1 else ""
            )
            row.append(text + spread)
        table.add_row(name, *row)
    return table


def _values(cells: Sequence[Cell], disturbance: str, name: str, measure: str) -> list[float]:
    return [getattr(c, measure) for c in cells if (c.disturbance, c.controller) == (disturbance, name)]


def _medians(cells: Sequence[Cell], disturbance: str, measure: str) -> dict[str, float]:
    """The median of each controller that finished every flight of a disturbance."""
    found = {}
    for name in dict.fromkeys(c.controller for c in cells):
        here = [c for c in cells if (c.disturbance, c.controller) == (disturbance, name)]
        if here and all(c.outcome == FINISHED for c in here):
            found[name] = statistics.median(getattr(c, measure) for c in here)
    return found


def comparison(cells: Sequence[Cell], flights: Sequence[Disturbance]) -> dict[str, Any]:
    """The JSON of a comparison."""
    return {
        "unit": "m",
        "disturbances": {one.name: one.title for one in flights},
        "median": {
            measure: {one.name: _medians(cells, one.name, measure) for one in flights} for measure in MEASURES
        },
        "flights": [
            {
                "seed": c.seed,
                "disturbance": c.disturbance,
                "controller": c.controller,
                "reference": c.reference,
                "linear": c.linear,
                "outcome": c.outcome,
            }
            for c in cells
        ],
    }
