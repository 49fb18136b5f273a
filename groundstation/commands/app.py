"""`groundstation`: see where a vehicle does not fly as designed, name why, correct it, and watch."""

from __future__ import annotations

import typer

from trueflight.groundstation.commands import (
    analysis,
    bound,
    calibrate,
    collect,
    effect,
    flight,
    keys,
    pilot,
    plan,
    remainder,
    report,
    reproduce,
    survey,
    train,
)
from trueflight.models.errors import run_command_line

app = typer.Typer(
    name="groundstation",
    help="Runs on the operator's machine: reads flights, compares them with models, names missing effects, "
    "and commands the companion.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
flight.register(app)
analysis.register(app)
report.register(app)
bound.register(app)
train.register(app)
pilot.register(app)
collect.register(app)
keys.register(app)
effect.register(app)
reproduce.register(app)
remainder.register(app)
plan.register(app)
survey.register(app)
calibrate.register(app)


def main() -> None:
    """Entry point of the `groundstation` program."""
    run_command_line(app)


if __name__ == "__main__":
    main()
