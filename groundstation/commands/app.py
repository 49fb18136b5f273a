"""`groundstation`: see where a vehicle does not fly as designed, name why, correct it, and watch."""

from __future__ import annotations

import os

import typer

from trueflight.groundstation.commands.tasks import MARKUP, Tasks
from trueflight.models.errors import run_command_line
from trueflight.models.program import offer_version

app = typer.Typer(
    cls=Tasks,
    name="groundstation",
    help="Runs on the operator's machine: reads flights, compares them with models, names missing effects, "
    "and commands the companion.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=MARKUP,
)
offer_version(app, "groundstation")


def main() -> None:
    """Entry point of the `groundstation` program."""
    # before numpy is loaded; identify/translation.py tells why
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    run_command_line(lambda: app(standalone_mode=False), "ground")


if __name__ == "__main__":
    main()
