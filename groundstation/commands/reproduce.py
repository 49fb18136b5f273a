"""`groundstation reproduce`: the paper's experiment and its Table I, with one's own vehicle."""

from __future__ import annotations

import math
import os
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box

from trueflight.groundstation.commands.options import JobsOption, JsonOption, SaveOption
from trueflight.groundstation.output.terminal import counted, print_written
from trueflight.models.printed import print_json
from trueflight.models.shipped import QUAD5
from trueflight.models.terminal import Table, Terminal

if TYPE_CHECKING:
    import numpy as np

    from trueflight.groundstation.study.reproduce import Prepared, Scenario, Study

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command("reproduce", epilog="Example: groundstation reproduce --seeds 5 -o reproduction")(
        reproduce_command
    )


def reproduce_command(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for all it makes; the same one goes on.")
    ] = Path("reproduction"),
    seeds: Annotated[int, typer.Option(help="Vehicles, each with a truth of its own.", min=1, max=100)] = 5,
    first: Annotated[int, typer.Option(help="The first seed.", min=0)] = 1,
    minutes: Annotated[float, typer.Option(help="Flight to train on, for each vehicle.", min=5.0)] = 30.0,
    hidden: Annotated[
        list[str] | None, typer.Option(help="What the simulator hides: rich, or NAME, NAME:SIZE. Repeatable.")
    ] = None,
    scenario: Annotated[
        list[str] | None,
        typer.Option(help="unseen, low, half, old, wind, payload; default: all. Repeatable."),
    ] = None,
    companion: Annotated[
        bool,
        typer.Option(
            "--companion", help="Fly `unseen` and `low` through the companion as well, in real time."
        ),
    ] = False,
    vehicle: Annotated[
        Path, typer.Option(help="vehicle.toml with its design.json beside it.", show_default=False)
    ] = QUAD5,
    jobs: JobsOption = 0,
    save: SaveOption = None,
    as_json: JsonOption = False,
) -> None:
    """Collect, diagnose, train and fly every controller on flights no model has seen; print the paper's Table I.

    Each seed is another vehicle: the simulator draws what is hidden in it. MSE per axis is against the expected
    linear behaviour; each figure is the median over the seeds, with the least and the greatest.
    """
    from trueflight.groundstation.study import reproduce as r

    chosen = r.chosen_scenarios(scenario)
    asked = r.Asked(output, vehicle, tuple(hidden or ["rich"]), minutes)
    asked.open()
    real = [s for s in chosen if s.name in ("unseen", "low")] if companion else []
    cores = jobs or len(os.sched_getaffinity(0))
    prepared, flown = [], []
    with counted(as_json) as progress:
        task = progress.add_task("", total=seeds * (6 + len(chosen) * len(r.ARMS) + 2 + 3 * len(real)))
        for seed in range(first, first + seeds):

            def tell(what: str, done: int, seed: int = seed) -> None:
                progress.update(task, advance=done, description=f"vehicle {seed}: {what}")

            one, flights = r.one_vehicle(asked, seed, chosen, real, cores, tell)
            prepared.append(one)
            flown += flights
    study = r.Study(tuple(flown), tuple(prepared))
    if save is not None:
        r.write_unseen(save, output / f"vehicle-{first}", chosen[0])
    if as_json:
        print_json({**study_table(study, chosen), "recording": None if save is None else str(save)})
        return
    _print(study, chosen, bool(real))
    print_written(console, save)


def _print(study: Study, scenarios: Sequence[Scenario], companion: bool) -> None:
    from trueflight.groundstation.study.reproduce import ARMS

    for prepared in study.prepared:
        _print_prepared(prepared)
    names = [arm.name for arm in ARMS]
    table = Table(
        title="MSE against the expected linear behaviour, m²: median, least and greatest of the vehicles",
        box=box.SIMPLE,
        padding=(0, 1, 0, 0),
    )
    table.add_column("flight", no_wrap=True)
    for name in ("lqr", "integral", *names[2:-1], "both"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("÷ lqr, int.", justify="right", no_wrap=True)
    rows = [(s.name, s.name, "in-process") for s in scenarios]
    if companion:
        real = [s.name for s in scenarios if s.name in ("unseen", "low")]
        rows = [(f"{name}*", name, "companion") for name in real] + rows
    for label, scenario, through in rows:
        cells = {name: study.mse(scenario, name, through) for name in names}
        for axis, letter in enumerate("xyz"):
            columns = [cells[name][:, axis] for name in names]
            table.add_row(
                f"{label} {letter}",
                *(_cell(column) for column in columns),
                f"{_ratio(columns[0], columns[-1])}, {_ratio(columns[1], columns[-1])}",
            )
        table.add_section()
    _paper_rows(table)
    console.print(table)
    for one in scenarios:
        console.print(f"{one.name}: {one.title}", style="dim", highlight=False)
    if companion:
        console.print("*: by the companion over MAVLink, in real time; the others in-process", style="dim")
    _print_parts(study, scenarios[0])
    for f in study.flown:
        if f.outcome != "finished" or "tripped" in f.guard:
            console.print(
                f"vehicle {f.seed}, {f.scenario}, {f.controller}: {f.outcome}, guard {f.guard}",
                style="yellow",
            )


def _paper_rows(table: Table) -> None:
    """The figures of the paper, to compare with."""
    from trueflight.groundstation.study.reproduce import PAPER

    for where, figures in PAPER.items():
        lqr, integral, network = figures.values()
        for axis, letter in enumerate("xyz"):
            table.add_row(
                f"paper, {'sim.' if where == 'simulation' else 'real'} {letter}",
                *(_short(column[axis]) for column in (lqr, integral)),
                "",
                _short(network[axis]),
                "",
                f"{lqr[axis] / network[axis]:.0f}, {integral[axis] / network[axis]:.0f}",
                style="dim",
            )
        table.add_section()


def _print_parts(study: Study, scenario: Scenario) -> None:
    """What each part of the corrected controller brings."""
    from trueflight.groundstation.study.reproduce import ANATOMY, BOTH

    parts = Table(
        title=f"what each part of the corrected controller brings, {scenario.name}: MSE, m²",
        box=box.SIMPLE,
    )
    parts.add_column("effects and network")
    for letter in "xyz":
        parts.add_column(letter, justify="right")
    for arm in ANATOMY:
        mse = study.mse(scenario.name, BOTH if arm is ANATOMY[-1] else arm.name)
        parts.add_row(arm.name, *(_cell(mse[:, axis]) for axis in range(3)))
    console.print(parts)


def _print_prepared(prepared: Prepared) -> None:
    f = prepared.figures
    both, net = (f[f"{name}: held-out RMS"] for name in ("effects + network", "network"))
    console.print(
        f"vehicle {prepared.seed}: found {', '.join(prepared.found) or 'nothing'}; remainder on held-out flights "
        f"{f['network: held-out RMS before']:.2f} m/s², {net:.3f} with a network, {both:.3f} with both "
        f"(noise {f['noise floor']:.3f})",
        highlight=False,
    )


def _cell(values: np.ndarray) -> str:
    if values.size == 0:
        return ""
    low, median, high = float(values.min()), statistics.median(values.tolist()), float(values.max())
    if values.size == 1:
        return _short(median)
    power = math.floor(math.log10(median))
    return f"{_short(median)}\n[dim]{_scaled(low, power)}..{_scaled(high, power)}e{power}[/dim]"


def _scaled(value: float, power: int) -> str:
    """`value` in units of ten to `power`, two digits."""
    return f"{value / 10.0**power:.2g}" if value < 100.0 * 10.0**power else f"{value / 10.0**power:.0f}"


def _short(value: float) -> str:
    return f"{value:.1e}".replace("e-0", "e-")


def _ratio(before: np.ndarray, after: np.ndarray) -> str:
    if not before.size or not after.size:
        return ""
    return f"{statistics.median(before.tolist()) / statistics.median(after.tolist()):.0f}"


def study_table(study: Study, scenarios: Sequence[Scenario]) -> dict[str, Any]:
    """The JSON of a study."""
    from trueflight.groundstation.study.reproduce import PAPER

    cells: dict[str, dict[str, dict[str, Any]]] = {}
    for f in study.flown:
        key = f.scenario if f.through == "in-process" else f"{f.scenario}, {f.through}"
        cell = cells.setdefault(key, {}).setdefault(f.controller, {"seeds": [], "mse": []})
        cell["seeds"].append(f.seed)
        cell["mse"].append(list(f.mse))
    for columns in cells.values():
        for cell in columns.values():
            cell["median"] = [statistics.median(axis) for axis in zip(*cell["mse"], strict=True)]
    return {
        "unit": "m^2",
        "scenarios": {s.name: s.title for s in scenarios},
        "mse": cells,
        "paper": PAPER,
        "vehicles": [{"seed": p.seed, "found": list(p.found), "figures": p.figures} for p in study.prepared],
        "not_finished": [f.__dict__ for f in study.flown if f.outcome != "finished" or "tripped" in f.guard],
    }
