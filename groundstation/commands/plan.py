"""`groundstation plan-flight`: the short flight that tells apart what a diagnosis left open."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trueflight.groundstation.commands.options import (
    DEFAULT_STORE,
    EffectsOption,
    JsonOption,
    MappingOption,
    ModelOption,
    StoreOption,
    VehicleOption,
)
from trueflight.groundstation.output.terminal import print_start, working
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal
from trueflight.models.whole_file import write_whole

if TYPE_CHECKING:
    from trueflight.groundstation.identify.planning import FlightPlan

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command(
        "plan-flight",
        epilog="Example: groundstation plan-flight flight.mcap --between wind --between rotor_drag -o plan.csv",
    )(plan_command)


def plan_command(
    flight: Annotated[
        Path | None,
        typer.Argument(help="A flight whose diagnosis left something open; its noise is taken, too."),
    ] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="The setpoints to write.")] = Path(
        "plan.csv"
    ),
    between: Annotated[
        list[str] | None, typer.Option("--between", help="An effect to tell from the others. Repeatable.")
    ] = None,
    vehicle: VehicleOption = None,
    design: Annotated[
        Path | None,
        typer.Option(help="Design file; default: the record's, or design.json beside the vehicle."),
    ] = None,
    mapping: MappingOption = None,
    model: ModelOption = None,
    store: StoreOption = DEFAULT_STORE,
    effects: EffectsOption = None,
    radius: Annotated[float, typer.Option(help="m around home.", min=0.5)] = 3.0,
    low: Annotated[float, typer.Option(help="Lowest height above ground, m.", min=0.05)] = 0.4,
    high: Annotated[float, typer.Option(help="Greatest height, m.", min=0.8)] = 2.5,
    speed: Annotated[float, typer.Option(help="Greatest speed, m/s.", min=0.3)] = 3.0,
    acceleration: Annotated[float, typer.Option(help="Greatest acceleration, m/s².", min=0.5, max=9.0)] = 5.0,
    duration: Annotated[float, typer.Option(help="Longest flight, s.", min=8.0)] = 40.0,
    as_json: JsonOption = False,
) -> None:
    """Design the short flight that best separates the remaining candidates, and say what it will resolve.

    The file is flown like any table of setpoints: `groundstation fly plan.csv`, `sim-bridge fly --trajectory plan.csv`.
    """
    from trueflight.groundstation.identify.planning import Limits, plan_flight, setpoints
    from trueflight.groundstation.identify.translation import diagnose
    from trueflight.groundstation.output.as_json import plan_table
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.versions.choice import choose_start, design_to_fly
    from trueflight.models.vehicle import load_vehicle

    if flight is None and vehicle is None:
        raise InputError("pass a flight, or --vehicle with --between")
    limits = Limits(radius, low, high, speed, acceleration, duration)
    directory = None if effects is None else str(effects)
    with working(console, "reading", as_json) as progress:
        read = None if flight is None else read_flight(flight, vehicle, mapping)
        believed = load_vehicle(str(vehicle)) if read is None else read.vehicle
        gains = design_to_fly(believed, read, design)  # before what takes long
        diagnosis = None
        if read is not None:
            diagnosis = diagnose(read, choose_start(read, model, store, effects), progress=progress)
        plan = plan_flight(gains, believed, limits, diagnosis, between or (), directory, progress)
    write_whole(output, setpoints(plan.trajectory), "the plan", "choose another -o")
    if as_json:
        print_json(plan_table(plan, output))
        return
    if diagnosis is not None:
        print_start(console, diagnosis.base)
    _print(plan, output)


def _print(plan: FlightPlan, output: Path) -> None:
    from trueflight.models.terminal import Table

    low, high = plan.trajectory.bounds
    console.print(
        f"[bold]{output}[/bold]: {plan.trajectory.duration:.0f} s, x {low[0]:.1f} to {high[0]:.1f} m, "
        f"y {low[1]:.1f} to {high[1]:.1f} m, z {low[2]:.1f} to {high[2]:.1f} m, up to "
        f"{plan.trajectory.max_speed:.1f} m/s and {plan.trajectory.max_acceleration:.1f} m/s²",
        highlight=False,
    )
    for text in plan.manoeuvres:
        console.print(f"  {text}", highlight=False)
    table = Table(title="what it will tell (evidence above 6 tells two explanations apart)")
    for column in ("if it is", "and not", "evidence so far", "expected", ""):
        table.add_column(column, justify="right" if column[:1] == "e" else "left")
    for q in plan.questions:
        table.add_row(
            " with ".join(q.one),
            " with ".join(q.other) or "nothing",
            "" if q.before is None else f"{q.before:.0f}",
            f"{q.after:.0f}",
            "[green]told apart[/green]" if q.answered else "[red]stays open[/red]",
        )
    console.print(table)
    table = Table(title="half width of the 95 % intervals")
    for column in ("effect", "parameter", "size planned for", "so far", "expected"):
        table.add_column(column, justify="left" if column in ("effect", "parameter") else "right")
    for p in plan.precision:
        unit = "" if p.unit == "1" else f" {p.unit}"
        before = "" if p.before is None else f"± {p.before:.2g}"
        table.add_row(p.effect, p.parameter, f"{p.value:.3g}{unit}", before, f"± {p.after:.2g}")
    console.print(table)
    for name, why in plan.left_out.items():
        console.print(f"{name}: {why}", style="yellow")
    console.print(f"fly it: groundstation fly {output}", highlight=False)
