"""`groundstation`: see where a vehicle does not fly as designed, name why, correct it, and watch."""

from __future__ import annotations

import typer
from threadpoolctl import threadpool_limits

from trueflight.groundstation.commands import (
    bound,
    calibrate,
    choosing,
    collect,
    compare,
    demo,
    deploy,
    design,
    diagnose,
    effect,
    flights,
    fly,
    keys,
    model,
    plan,
    remainder,
    report,
    reproduce,
    status,
    survey,
    track,
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
flights.register(app)
design.register(app)
track.register(app)
compare.register(app)
diagnose.register(app)
effect.register(app)
model.register(app)
demo.register(app)
report.register(app)
bound.register(app)
train.register(app)
fly.register(app)
deploy.register(app)
status.register(app)
collect.register(app)
keys.register(app)
reproduce.register(app)
remainder.register(app)
plan.register(app)
survey.register(app)
calibrate.register(app)
choosing.offer_sources(app)


def main() -> None:
    """Entry point of the `groundstation` program."""
    # numpy and scipy are loaded by now; identify/translation.py tells why
    with threadpool_limits(1, user_api="blas"):
        run_command_line(app)


if __name__ == "__main__":
    main()
