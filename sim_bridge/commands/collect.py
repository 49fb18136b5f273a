"""`sim-bridge collect`: a training database, flown in-process."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from trueflight.models.errors import InputError
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.commands.options import (
    BatteryAge,
    Draw,
    Json,
    OwnerAndDesign,
    Wanted,
    settings_of,
    with_groups,
)
from trueflight.sim_bridge.commands.output import Progress, tell


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        epilog="Example: sim-bridge collect --vehicle vehicle.toml --hidden rich --seed 1 --minutes 30 -o database"
    )(with_groups(collect))


def collect(
    *,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the records: new, or to continue.")
    ],
    owner: OwnerAndDesign,
    minutes: Annotated[float, typer.Option(help="Flight time to collect, at least.")] = 30.0,
    model: Annotated[
        Path | None, typer.Option(help="ONNX model; the guarded correction then flies with it.")
    ] = None,
    rate: Annotated[float, typer.Option(help="Control rate, Hz.")] = 100.0,
    wanted: Wanted,
    draw: Draw,
    battery_age: BatteryAge = None,
    jobs: Annotated[int, typer.Option(help="Processes; 0: one for each core.", min=0, max=256)] = 0,
    as_json: Json = False,
) -> None:
    """Fly a whole training database in-process: one record each of translations, steps, rotations, spirals, circles,
    lemniscates, low passes and surveys, on batteries from full to nearly empty.

    `--seed` draws the truth, the flights and their noise. What was flown stays when interrupted; the same command
    continues.
    """
    settings = settings_of(owner, wanted, draw, battery_age=battery_age)
    believed = load_vehicle(settings.vehicle)
    from trueflight.sim_bridge.collect import begin
    from trueflight.sim_bridge.plan import bytes_of
    from trueflight.sim_bridge.seal import hidden_text, seal_where_asked

    database = begin(output, settings, believed, minutes, rate, None if model is None else bytes_of(model))
    answer = seal_where_asked(settings, database.hidden, believed.name, output / "hidden.sealed")
    already, since = len(database.collection.flown), time.perf_counter()
    with Progress(database.seconds, as_json) as progress:
        progress.add(database.flown_seconds)
        try:
            for _, entry in database.fly(jobs or len(os.sched_getaffinity(0))):
                progress.add(entry["seconds"])
        except KeyboardInterrupt:
            raise InputError(
                f"interrupted: {len(database.collection.flown)} of {len(database.flights)} flights are in {output}; "
                "the same command continues"
            ) from None
    wall = time.perf_counter() - since
    entries = database.entries()
    seconds, new = sum(entry["seconds"] for entry in entries), len(entries) - already
    report = {
        "folder": str(output),
        "flights": database.collection.flown,
        "seconds": seconds,
        "flown_now": new,
        "wall": wall,
        "sealed": str(answer) if answer else None,
    }
    if not as_json:
        _print_collected(entries)
    told = hidden_text(settings, answer)
    text = (
        f"{output}: {len(entries)} flights, {seconds / 60:.1f} min, {new} of them now in {wall:.1f} s; {told}"
    )
    tell(report, text, as_json)


def _print_collected(entries: list[dict[str, Any]]) -> None:
    """One row for each trajectory: how often, how long, how far from the reference."""
    from trueflight.models.terminal import Table, Terminal

    table = Table()
    for column in ("trajectory", "flights", "s", "charge", "RMS x, y, z (m)", "on ground", "not finished"):
        table.add_column(column, justify="left" if column == "trajectory" else "right", no_wrap=True)
    for name in sorted({entry["trajectory"] for entry in entries}):
        of = [entry for entry in entries if entry["trajectory"] == name]
        ticks = sum(entry["ticks"] for entry in of)
        errors = (
            math.sqrt(sum(entry["ticks"] * entry["rms_error"][i] ** 2 for entry in of) / ticks)
            for i in range(3)
        )
        charges = [entry["charge"] for entry in of]
        table.add_row(
            name,
            str(len(of)),
            f"{sum(entry['seconds'] for entry in of):.0f}",
            f"{min(charges):.2f} to {max(charges):.2f}",
            ", ".join(f"{error:.3f}" for error in errors),
            f"{sum(entry['ticks_on_ground'] for entry in of) / ticks:.1%}",
            str(sum(entry["outcome"] != "finished" for entry in of) or ""),
        )
    Terminal().print(table)
