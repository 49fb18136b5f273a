"""`groundstation compare-controllers`: the project's controllers beside those of other papers, and one's own."""

from __future__ import annotations

import os
import statistics
from collections.abc import Sequence
from dataclasses import asdict
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
    from trueflight.groundstation.study.controllers import Cell
    from trueflight.groundstation.study.disturbances import Disturbance, Limit
    from trueflight.groundstation.study.margins import Margin

console = Terminal()
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
    margins: Annotated[
        bool,
        typer.Option(
            "--margins", help="Find how much delay, wind, force, ... each stands as well: many flights."
        ),
    ] = False,
    companion: Annotated[
        bool,
        typer.Option(
            "--companion",
            help="Fly none, wind, payload and old through the companion as well, in real time: the first vehicle, with "
            "lqr, indi and corrected.",
        ),
    ] = False,
    jobs: JobsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Fly every controller on the same vehicles, winds, payloads, batteries and paths, and print how far each is off.

    RMSE in cm over three axes, median of the seeds with the least and the greatest: to the reference, and to the
    expected linear behaviour. `corrected` learns each vehicle first, without the disturbance.
    """
    from trueflight.groundstation.study import controllers as c
    from trueflight.groundstation.study.disturbances import LIMITS, chosen_disturbances
    from trueflight.groundstation.study.margins import ROUNDS, find_margins
    from trueflight.groundstation.study.reproduce import Asked

    flights, names = chosen_disturbances(disturbance), c.chosen_controllers(controller)
    asked = Asked(output, vehicle, tuple(hidden or ["rich"]), minutes)
    asked.open()
    vehicles, cores = range(first, first + seeds), jobs or len(os.sched_getaffinity(0))
    real = [one for one in flights if one.name in c.HEADLINE] if companion else []
    pieces = seeds * (len(flights) * len(names) + ROUNDS * margins) + len(real) * len(c.HEADLINE_CONTROLLERS)
    found: list[Margin] = []
    with counted(as_json) as progress:
        task = progress.add_task("", total=pieces)

        def tell(what: str, done: int) -> None:
            progress.update(task, advance=done, description=what)

        cells = c.compare(asked, vehicles, flights, names, cores, tell)
        if margins:
            found = find_margins(asked, vehicles, LIMITS, names, cores, tell)
        for_real = c.compare_for_real(asked, first, real, tell) if real else []
    limits = LIMITS if margins else ()
    if as_json:
        print_json(comparison(cells, flights, found, limits, for_real))
        return
    _print(cells, flights, names)
    if found:
        _print_margins(found, limits, names)
    if for_real:
        console.print(f"The same through the companion, vehicle {first}, cm", style="bold")
        console.print(_table_for_real(for_real, cells))


def _print(cells: Sequence[Cell], flights: Sequence[Disturbance], names: Sequence[str]) -> None:
    for measure, title in MEASURES.items():
        console.print(f"RMSE {title}, cm: median, least..greatest of the vehicles", style="bold")
        console.print(_table(cells, flights, names, measure))
    for one in flights:
        console.print(f"{one.name}: {one.title}", style="dim", highlight=False)
    for cell in cells:
        if not _finished(cell):
            console.print(
                f"vehicle {cell.seed}, {cell.disturbance}, {cell.controller}: {cell.outcome}", style="yellow"
            )


def _finished(cell: Cell) -> bool:
    from trueflight.groundstation.study.controllers import FINISHED

    return cell.outcome == FINISHED


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
                here = [c for c in cells if (c.disturbance, c.controller) == (flight.name, name)]
                row.append(f"lost {sum(not _finished(c) for c in here)} of {len(here)}")
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
        if here and all(map(_finished, here)):
            found[name] = statistics.median(getattr(c, measure) for c in here)
    return found


def _print_margins(found: Sequence[Margin], limits: Sequence[Limit], names: Sequence[str]) -> None:
    """What each stands: median of the vehicles, and `>` where the greatest size asked for was flown."""
    console.print(
        "The most at which no flight is lost: median, least..greatest of the vehicles", style="bold"
    )
    table = Table(box=box.SIMPLE, padding=(0, 1, 0, 0))
    table.add_column("controller")
    for limit in limits:
        table.add_column(limit.name if limit.unit == "1" else f"{limit.name}, {limit.unit}", justify="right")
    medians = {limit.name: _median_margins(found, limit.name) for limit in limits}
    for name in names:
        row = []
        for limit in limits:
            here = [one for one in found if (one.limit, one.controller) == (limit.name, name)]
            sizes, median = [one.size for one in here if one.size is not None], medians[limit.name][name]
            if median is None:
                row.append(f"lost {len(here) - len(sizes)} of {len(here)}")
                continue
            text = f"{'> ' if median >= limit.most else ''}{median:.3g}"
            if median == max(m for m in medians[limit.name].values() if m is not None):
                text = f"[bold]{text}[/bold]"
            row.append(text + (f"\n[dim]{min(sizes):.3g}..{max(sizes):.3g}[/dim]" if len(sizes) > 1 else ""))
        table.add_row(name, *row)
    console.print(table)
    for limit in limits:
        console.print(
            f"{limit.name}: {limit.title}, to {(limit.most - limit.least) / 64:.2g}",
            style="dim",
            highlight=False,
        )


def _median_margins(found: Sequence[Margin], limit: str) -> dict[str, float | None]:
    """By controller; None where a flight is lost without any of it."""
    out: dict[str, float | None] = {}
    for name in dict.fromkeys(one.controller for one in found):
        sizes = [one.size for one in found if (one.limit, one.controller) == (limit, name)]
        known = [size for size in sizes if size is not None]
        out[name] = statistics.median(known) if len(known) == len(sizes) else None
    return out


def _table_for_real(real: Sequence[Cell], cells: Sequence[Cell]) -> Table:
    """The flights through the companion, beside those in-process of the same vehicle where they were flown."""
    table = Table(box=box.SIMPLE, padding=(0, 1, 0, 0))
    for title in ("disturbance", "controller"):
        table.add_column(title)
    for title in MEASURES.values():
        table.add_column(title, justify="right")
        table.add_column("in-process", justify="right")
    beside = {(c.seed, c.disturbance, c.controller): c for c in cells}
    for one in real:
        other = beside.get((one.seed, one.disturbance, one.controller))
        row = []
        for measure in MEASURES:
            row.append(f"{100 * getattr(one, measure):.1f}" if _finished(one) else one.outcome)
            row.append(
                ""
                if other is None
                else f"{100 * getattr(other, measure):.1f}"
                if _finished(other)
                else "lost"
            )
        table.add_row(one.disturbance, one.controller, *row)
    return table


def comparison(
    cells: Sequence[Cell],
    flights: Sequence[Disturbance],
    found: Sequence[Margin] = (),
    limits: Sequence[Limit] = (),
    real: Sequence[Cell] = (),
) -> dict[str, Any]:
    """The JSON of a comparison."""
    medians = {
        measure: {one.name: _medians(cells, one.name, measure) for one in flights} for measure in MEASURES
    }
    spread = {
        measure: {
            one.name: {
                name: [min(values), max(values)]
                for name in medians[measure][one.name]
                if (values := _values(cells, one.name, name, measure))
            }
            for one in flights
        }
        for measure in MEASURES
    }
    return {
        "unit": "m",
        "disturbances": {one.name: one.title for one in flights},
        "median": medians,
        "spread": spread,
        "flights": [asdict(cell) for cell in (*cells, *real)],
        "limits": {one.name: {"title": one.title, "unit": one.unit, "most": one.most} for one in limits},
        "median_margins": {one.name: _median_margins(found, one.name) for one in limits},
        "margins": [asdict(one) for one in found],
    }
