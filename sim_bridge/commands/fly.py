"""`sim-bridge fly`: one flight in-process, into a record."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.commands.options import (
    DrawAndBattery,
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


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        epilog="Example: sim-bridge fly --trajectory excitation --vehicle vehicle.toml --hidden random -o 1.mcap"
    )(with_groups(fly))


def fly(
    *,
    trajectory: Annotated[str, typer.Option(help="Name of a trajectory, or a CSV file of setpoints.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The flight record to write (MCAP).")],
    owner: OwnerAndDesign,
    flying: Flying,
    wanted: Wanted,
    strength: Annotated[
        float, typer.Option(help="Factor on the sizes of what is hidden by name, `random` or `any`.", min=0.0)
    ] = 1.0,
    draw: DrawAndBattery,
    rotor_speeds: Annotated[
        bool, typer.Option("--rotor-speeds/--no-rotor-speeds", help="Whether the record has rotor speeds.")
    ] = True,
    table: Annotated[bool, typer.Option("--csv", help="Write a CSV beside the record, too.")] = False,
    as_json: Json = False,
) -> None:
    """Fly in-process, without MAVLink, by the companion's own control law, and write the same flight
    record.
    """
    settings = settings_of(owner, wanted, draw)
    believed = load_vehicle(settings.vehicle)
    from trueflight.companion.law.controllers import TrimLimits
    from trueflight.companion.law.residual import ObserverLimits
    from trueflight.sim_bridge.in_process import record
    from trueflight.sim_bridge.plan import Plan, bytes_of, design_of, trajectory_of
    from trueflight.sim_bridge.seal import hidden_text, seal_where_asked
    from trueflight.sim_bridge.truth.hidden import choose

    plan = Plan(
        believed,
        design_of(settings, believed),
        trajectory_of(trajectory, flying.parameter or []),
        choose(list(settings.hidden), believed, settings.seed, settings.hidden_count, strength),
        settings.seed,
        flying.repeat,
        flying.rate,
        None if flying.model is None else bytes_of(flying.model),
        settings.sensor_noise,
        settings.battery,
        flying.controller,
        flying.settle,
        TrimLimits() if flying.trim is None else TrimLimits(bandwidth=flying.trim),
        ObserverLimits() if flying.observer is None else ObserverLimits(flying.observer),
        rotor_speeds,
    )
    csv_file = output.with_suffix(".csv") if table else None
    with Progress(plan.repeat * plan.trajectory.duration, as_json) as progress:
        flown = record(plan, output, csv_file, lambda sample: progress.add(1.0 / plan.rate))
    answer = seal_where_asked(settings, plan.hidden, believed.name, output.with_suffix(".sealed"))
    tell(
        _report(flown, output, csv_file, answer), _text(flown, output, hidden_text(settings, answer)), as_json
    )


def _report(flown: Flown, output: Path, csv_file: Path | None, answer: Path | None) -> dict[str, Any]:
    x, y, z = flown.rms_error
    return {
        "record": str(output),
        "csv": str(csv_file) if csv_file else None,
        "outcome": flown.outcome,
        "ticks": flown.ticks,
        "simulated": flown.simulated,
        "times_real_time": flown.times_real_time,
        "rms_error": {"x": x, "y": y, "z": z, "unit": "m"},
        "guard": flown.guard,
        "ticks_on_ground": flown.touching,
        "sealed": str(answer) if answer else None,
    }


def _text(flown: Flown, output: Path, hidden: str) -> str:
    error = ", ".join(f"{axis} {value:.3f}" for axis, value in zip("xyz", flown.rms_error, strict=True))
    text = (
        f"{output}: {flown.outcome}, {flown.simulated:.1f} s in {flown.wall:.2f} s "
        f"({flown.times_real_time:.0f} times real time); RMS error to the reference {error} m; {hidden}"
    )
    touched = f"; touched the ground in {flown.touching} of {flown.ticks} ticks" if flown.touching else ""
    return text + touched
