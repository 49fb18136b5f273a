"""`sim-bridge fly-many`: many flights in-process at once, each into a record of its own."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trueflight.models.errors import InputError
from trueflight.sim_bridge.commands.options import (
    DrawnAndBattery,
    Flying,
    Json,
    OwnerAndDesign,
    Wanted,
    settings_of,
    with_groups,
)
from trueflight.sim_bridge.commands.output import Progress, tell

if TYPE_CHECKING:
    from trueflight.sim_bridge.in_process import Flown
    from trueflight.sim_bridge.many.variations import Row, Variation
    from trueflight.sim_bridge.settings import Settings


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        epilog="Example: sim-bridge fly-many --trajectory excitation --vehicle vehicle.toml --hidden any --seeds 100 "
        "-o flights"
    )(with_groups(fly_many))


def fly_many(
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the flight records (MCAP).")],
    flights: Annotated[
        Path | None,
        typer.Option(
            help="CSV, a row a flight: columns named as these options, `name`, lists with `;` between."
        ),
    ] = None,
    seeds: Annotated[
        int, typer.Option(help="So many flights, each with the next seed.", min=0, max=100_000)
    ] = 0,
    trajectory: Annotated[str, typer.Option(help="Name of a trajectory, or a CSV file of setpoints.")] = "",
    owner: OwnerAndDesign,
    flying: Flying,
    wanted: Wanted,
    strength: Annotated[
        float, typer.Option(help="Factor on the sizes of what is hidden by name, `random` or `any`.", min=0.0)
    ] = 1.0,
    draw: DrawnAndBattery,
    rotor_speeds: Annotated[
        bool, typer.Option("--rotor-speeds/--no-rotor-speeds", help="Whether records have rotor speeds.")
    ] = True,
    tell_hidden: Annotated[
        bool, typer.Option("--tell-hidden", help="Print what is hidden (with --json), and seal nothing.")
    ] = False,
    jobs: Annotated[int, typer.Option(help="Processes; 0: one for each core.", min=0, max=256)] = 0,
    as_json: Json = False,
) -> None:
    """Fly many flights in-process at once, as arrays: each is what `fly` makes of the same options, within float error.

    What a row of --flights leaves empty is as the options say. What is drawn (`random`, `any`, `rich`) is sealed beside
    each record.
    """
    if (flights is None) == (seeds == 0):
        raise InputError("pass either --flights FILE or --seeds N")
    settings = settings_of(owner, wanted, draw)
    from trueflight.sim_bridge.many.batches import record_all, seconds_of
    from trueflight.sim_bridge.many.variations import of_seeds, rows_of, varied

    usual = _usual(settings, trajectory, flying, strength, rotor_speeds)
    wished = varied(rows_of(flights, usual) if flights is not None else of_seeds(usual, seeds))
    cores = jobs or len(os.sched_getaffinity(0))
    begin = time.perf_counter()
    flown: dict[str, dict[str, Any]] = {}
    with Progress(sum(seconds_of(one.plan) for one in wished), as_json) as progress:
        for one, how in record_all(wished, output, cores):
            progress.add(seconds_of(one.plan))
            flown[one.name] = _report(one, how, output, tell_hidden)
    wall = time.perf_counter() - begin
    report = {"flights": [flown[one.name] for one in wished], "wall": wall}
    tell(report, _text(report, output), as_json)


def _usual(settings: Settings, trajectory: str, flying: Flying, strength: float, rotor_speeds: bool) -> Row:
    from trueflight.sim_bridge.many.variations import Row

    row = Row(
        trajectory=trajectory, set=tuple(flying.parameter or ()), vehicle=settings.vehicle, design=settings.design,
        hidden=settings.hidden, hidden_count=settings.hidden_count, strength=strength, seed=settings.seed,
        noise=settings.noise, charge=settings.charge, battery_age=settings.battery_age, controller=flying.controller,
        model=str(flying.model or ""), settle=flying.settle, repeat=flying.repeat, rate=flying.rate,
        rotor_speeds=rotor_speeds,
    )  # fmt: skip
    own: dict[str, Any] = {"trim": flying.trim, "observer": flying.observer}
    return replace(row, **{name: value for name, value in own.items() if value is not None})


def _report(one: Variation, flown: Flown, folder: Path, tell_hidden: bool) -> dict[str, Any]:
    from trueflight.sim_bridge.many.batches import path_of
    from trueflight.sim_bridge.seal import seal

    record = path_of(folder, one)
    sealed = None
    if not tell_hidden and {"random", "any", "rich"} & set(one.row.hidden):
        sealed = record.with_suffix(".sealed")
        seal(one.plan.hidden, one.plan.vehicle.name, one.plan.seed, sealed)
    x, y, z = flown.rms_error
    return {
        "name": one.name,
        "record": str(record),
        "outcome": flown.outcome,
        "ticks": flown.ticks,
        "simulated": flown.simulated,
        "rms_error": {"x": x, "y": y, "z": z, "unit": "m"},
        "guard": flown.guard,
        "ticks_on_ground": flown.touching,
        "sealed": str(sealed) if sealed else None,
        "hidden": [hidden.answer() for hidden in one.plan.hidden] if tell_hidden else None,
    }


def _text(report: dict[str, Any], folder: Path) -> str:
    flights, wall = report["flights"], report["wall"]
    seconds = sum(one["simulated"] for one in flights)
    outcomes = [one["outcome"] for one in flights]
    ends = ", ".join(f"{outcomes.count(outcome)} {outcome}" for outcome in dict.fromkeys(outcomes))
    lines = [
        f"{one['name']}: {one['outcome']} after {one['simulated']:.1f} s"
        for one in flights
        if one["outcome"] != "finished"
    ]
    return "\n".join(
        [
            *lines,
            f"{folder}: {ends}; {seconds:.0f} s of flight in {wall:.1f} s ({seconds / wall:.0f} times real time)",
        ]
    )
