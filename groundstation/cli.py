"""`groundstation`: see where a vehicle does not fly as designed, name why, correct it, and watch."""

from __future__ import annotations

import typer

from groundstation import (
    analysis_commands,
    bound_commands,
    calibrate_commands,
    collect_commands,
    effect_commands,
    flight_commands,
    keys_commands,
    pilot_commands,
    plan_commands,
    remainder_commands,
    report_commands,
    reproduce_commands,
    survey_commands,
    train_commands,
)
from models.errors import run_command_line

app = typer.Typer(
    name="groundstation",
    help="Runs on the operator's machine: reads flights, compares them with models, names missing effects, "
    "and commands the companion.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
flight_commands.register(app)
analysis_commands.register(app)
report_commands.register(app)
bound_commands.register(app)
train_commands.register(app)
pilot_commands.register(app)
collect_commands.register(app)
keys_commands.register(app)
effect_commands.register(app)
reproduce_commands.register(app)
remainder_commands.register(app)
plan_commands.register(app)
survey_commands.register(app)
calibrate_commands.register(app)


def main() -> None:
    """Entry point of the `groundstation` program."""
    run_command_line(app)


if __name__ == "__main__":
    main()
