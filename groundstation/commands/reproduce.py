"""`groundstation reproduce`: the paper's experiment and its Table I, with one's own vehicle."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from trueflight.groundstation.commands.options import JsonOption
from trueflight.models.errors import InputError
from trueflight.models.outside import read_text
from trueflight.models.printed import print_json
from trueflight.models.vehicle import QUAD5
from trueflight.models.whole_file import write_whole

if TYPE_CHECKING:
    from trueflight.groundstation.study.reproduce import Prepared, Scenario, Study

console = Console()


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
    jobs: Annotated[int, typer.Option(help="Flights at a time; 0: one for each core.", min=0)] = 0,
    save: Annotated[
        Path | None,
        typer.Option("--save", "--rrd", help="Write a Rerun recording of the unseen scenario here."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Collect, diagnose, train and fly every controller on flights no model has seen; print the paper's Table I.

    Each seed is another vehicle: the simulator draws what is hidden in it. MSE per axis is against the expected
    linear behaviour; each figure is the median over the seeds, with the least and the greatest.
    """
    from trueflight.groundstation.study import reproduce as r

    chosen = _scenarios(scenario, r.SCENARIOS)
    truth = [word for name in (hidden or ["rich"]) for word in ("--hidden", name)]
    if not vehicle.is_file():
        raise InputError(f"{vehicle}: no such vehicle file; give --vehicle")
    output.mkdir(parents=True, exist_ok=True)
    asked = {"hidden": hidden or ["rich"], "minutes": minutes, "vehicle": vehicle.read_text(encoding="utf-8")}
    _same_study(output, asked)
    flights = len(chosen) * len(r.ARMS) + 2
    real = [s for s in chosen if s.name in ("unseen", "low")] if companion else []
    prepared, flown = [], []
    with _bar(as_json) as progress:
        task = progress.add_task("", total=seeds * (6 + flights + 3 * len(real)))
        for seed in range(first, first + seeds):
            folder = output / f"vehicle-{seed}"

            def tell(what: str, seed: int = seed) -> None:
                progress.update(task, advance=1, description=f"vehicle {seed}: {what}")

            one = r.prepare(folder, vehicle, seed, truth, minutes, tell)
            progress.update(task, description=f"vehicle {seed}: fly")
            step = lambda: progress.advance(task)  # noqa: E731
            flown += r.fly_all(
                folder, vehicle, one, truth, chosen, jobs or len(os.sched_getaffinity(0)), step
            )
            progress.update(task, description=f"vehicle {seed}: fly with the companion")
            flown += r.fly_companion(folder, vehicle, one, truth, real, step)
            prepared.append(one)
    study = r.Study(tuple(flown), tuple(prepared))
    if save is not None:
        _save(save, output / f"vehicle-{first}", chosen[0])
    if as_json:
        print_json(_table(study, chosen))
        return
    _print(study, chosen, bool(real))
    if save is not None:
        console.print(f"Rerun recording: {save}", highlight=False)


def _scenarios(names: list[str] | None, known: Sequence[Scenario]) -> list[Scenario]:
    if not names:
        return list(known)
    by_name = {s.name: s for s in known}
    for name in names:
        if name not in by_name:
            raise InputError(f"--scenario {name}: unknown; choose from {', '.join(by_name)}")
    return [by_name[name] for name in dict.fromkeys(names)]


def _same_study(output: Path, asked: dict[str, Any]) -> None:
    """Keep what was asked in the folder; raises `InputError` where it holds another study or foreign files."""
    import json

    path = output / "study.json"
    text = json.dumps(asked, indent=1)
    if path.exists() and path.stat().st_size:  # empty where an earlier version was killed
        if read_text(path, "the study", "choose another --output") != text:
            raise InputError(f"{output}: holds another study (see {path.name}); choose another --output")
    elif any(p != path and not p.name.startswith(".") for p in output.iterdir()):
        raise InputError(f"{output}: holds files that are no study's; choose another --output")
    else:
        write_whole(path, text, "the study", "choose another --output")


def _bar(quiet: bool) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        disable=quiet,
        transient=True,
    )


def _save(path: Path, folder: Path, scenario: Scenario) -> None:
    from dataclasses import replace

    from trueflight.groundstation.evaluate.tracking import track_file
    from trueflight.groundstation.views import write_tracking

    names = {"lqr": "lqr", "lqr-+-integral": "lqr_integral", "effects-+-network": "corrected"}
    tracked = [
        replace(track_file(folder / f"{scenario.name}-{stem}.mcap"), label=label)
        for stem, label in names.items()
    ]
    write_tracking(path, tracked)


def _print(study: Study, scenarios: Sequence[Scenario], companion: bool) -> None:
    from trueflight.groundstation.study.reproduce import ANATOMY, ARMS, BOTH, PAPER

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
    console.print(table)
    for one in scenarios:
        console.print(f"{one.name}: {one.title}", style="dim", highlight=False)
    if companion:
        console.print("*: by the companion over MAVLink, in real time; the others in-process", style="dim")
    parts = Table(
        title=f"what each part of the corrected controller brings, {scenarios[0].name}: MSE, m²",
        box=box.SIMPLE,
    )
    parts.add_column("effects and network")
    for letter in "xyz":
        parts.add_column(letter, justify="right")
    for arm in ANATOMY:
        mse = study.mse(scenarios[0].name, BOTH if arm is ANATOMY[-1] else arm.name)
        parts.add_row(arm.name, *(_cell(mse[:, axis]) for axis in range(3)))
    console.print(parts)
    for f in study.flown:
        if f.outcome != "finished" or "tripped" in f.guard:
            console.print(
                f"vehicle {f.seed}, {f.scenario}, {f.controller}: {f.outcome}, guard {f.guard}",
                style="yellow",
            )


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
    median, low, high = (float(x) for x in (np.median(values), values.min(), values.max()))
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
    return f"{float(np.median(before) / np.median(after)):.0f}" if before.size and after.size else ""


def _table(study: Study, scenarios: Sequence[Scenario]) -> dict[str, Any]:
    from trueflight.groundstation.study.reproduce import PAPER

    cells: dict[str, dict[str, dict[str, Any]]] = {}
    for f in study.flown:
        key = f.scenario if f.through == "in-process" else f"{f.scenario}, {f.through}"
        cell = cells.setdefault(key, {}).setdefault(f.controller, {"seeds": [], "mse": []})
        cell["seeds"].append(f.seed)
        cell["mse"].append(list(f.mse))
    for columns in cells.values():
        for cell in columns.values():
            cell["median"] = np.median(np.array(cell["mse"]), axis=0).tolist()
    return {
        "unit": "m^2",
        "scenarios": {s.name: s.title for s in scenarios},
        "mse": cells,
        "paper": PAPER,
        "vehicles": [{"seed": p.seed, "found": list(p.found), "figures": p.figures} for p in study.prepared],
        "not_finished": [f.__dict__ for f in study.flown if f.outcome != "finished" or "tripped" in f.guard],
    }
