"""Command line of the simulation bridge. Heavy imports wait until a command needs them."""

from __future__ import annotations

import typer

from trueflight.models.errors import run_command_line
from trueflight.models.program import offer_version
from trueflight.sim_bridge.commands import answers, collect, fly, fly_many, run, sitl

app = typer.Typer(
    name="sim-bridge",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="A simulated vehicle that behaves as a PX4 would, with physical effects to hide in it.",
)
run.register(app)
sitl.register(app)
fly.register(app)
fly_many.register(app)
collect.register(app)
answers.register(app)
offer_version(app, "sim-bridge")


def main() -> None:
    """Entry point of `sim-bridge`."""
    run_command_line(lambda: app(standalone_mode=False), "sim")
