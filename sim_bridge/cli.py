"""Command line of the simulation bridge."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Annotated, Any

import typer

from models.errors import InputError, run_command_line

app = typer.Typer(no_args_is_help=True, add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@app.callback()
def _root() -> None:
    """A simulated vehicle that behaves as a PX4 would, with physical effects to hide in it."""


@app.command()
def run(
    vehicle: Annotated[Path, typer.Option(help="vehicle.toml: what its owner believes")],
    hidden: Annotated[list[str], typer.Option(help="effect to hide: NAME, NAME:SIZE, random or none")] = ["none"],  # noqa: B006
    seed: int = 0,
    mavlink: str = "udpout:127.0.0.1:14540",
    port: int = 14580,
    speed: float = 1.0,
    pilot_port: int = 14590,
) -> None:
    """Simulate one vehicle on MAVLink until interrupted."""
    from models.vehicle import load_vehicle
    from sim_bridge.autopilot import Autopilot
    from sim_bridge.mavlink.server import Link, Server
    from sim_bridge.parameters import Parameters
    from sim_bridge.simulator import Simulator
    from sim_bridge.truth.hidden import choose

    believed = load_vehicle(vehicle)
    simulator = Simulator(believed, choose(hidden, believed, seed), seed)
    autopilot = Autopilot(simulator, Parameters(believed))
    host, number = mavlink.split(":")[-2:]
    server = Server(autopilot, Link(("127.0.0.1", port), (host, int(number)), pilot_port), speed)
    stopped: list[int] = []
    for number_ in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number_, lambda caught, frame: stopped.append(caught))
    print(f"ready: {believed.name} on MAVLink, sending to {mavlink}", flush=True)
    server.run(lambda: not stopped)
    server.close()


def main() -> None:
    """Entry point of `sim-bridge`."""
    run_command_line(app)
