"""`sim-bridge run`: a simulated vehicle on MAVLink."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.commands.options import (
    DrawAndBattery,
    Json,
    OnMavlink,
    Owner,
    Wanted,
    settings_of,
    with_groups,
)
from trueflight.sim_bridge.commands.output import tell, until_interrupted


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        epilog="Example: sim-bridge run --vehicle models/vehicles/quad5/vehicle.toml --hidden random --seed 7"
    )(with_groups(run))


def run(
    owner: Owner,
    wanted: Wanted,
    draw: DrawAndBattery,
    link: OnMavlink,
    param: Annotated[
        list[str] | None, typer.Option(help="Parameter of the autopilot, NAME=VALUE. Repeatable.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Fly a simulated vehicle on MAVLink, as PX4 would, until interrupted.

    Prints a line that begins with `ready:` as soon as it can be connected to. Faster than real time
    (`--speed`) the vehicle's clock and all its messages run faster; MAVSDK's heartbeats, timeouts and re-sent
    setpoints do not, so with MAVSDK speeds above about 4 make Offboard's loss timeout too short.
    """
    settings = settings_of(owner, wanted, draw, link)
    believed = load_vehicle(settings.vehicle)
    from trueflight.sim_bridge.mavlink.session import Session
    from trueflight.sim_bridge.seal import hidden_text, seal_where_asked
    from trueflight.sim_bridge.truth.hidden import choose

    hidden = choose(list(settings.hidden), believed, settings.seed, settings.hidden_count)
    with Session(believed, hidden, settings, param or []) as session:
        answer = seal_where_asked(
            settings, hidden, believed.name, Path(f"hidden-seed-{settings.seed}.sealed")
        )
        interrupted = until_interrupted()
        ready = {
            "ready": True,
            "vehicle": believed.name,
            "mavlink": settings.mavlink,
            "port": settings.port,
            "pilot_port": settings.pilot_port,
            "speed": settings.speed,
            "sealed": str(answer) if answer else None,
        }
        pace = "" if settings.speed == 1 else f", {settings.speed:g} times real time"
        told = hidden_text(settings, answer)
        tell(ready, f"ready: {believed.name} sends to {settings.mavlink}{pace}; {told}", as_json)
        sys.stdout.flush()
        session.run(interrupted)
    autopilot = session.autopilot
    seconds = autopilot.time_us * 1e-6
    summary = {"simulated": seconds, "armed": autopilot.armed, "mode": autopilot.mode.name}
    tell(summary, f"stopped after {seconds:.1f} s of simulated time", as_json)
