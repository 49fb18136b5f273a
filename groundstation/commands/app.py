"""`groundstation`: see where a vehicle does not fly as designed, name why, correct it, and watch."""

from __future__ import annotations

import os

import typer

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
    identify,
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
from trueflight.models.program import offer_version

TASKS = {
    "Begin here": ("demo",),
    "Look at flights": ("flights", "import", "compare", "where", "track", "bound"),
    "Find what is missing": (
        "diagnose", "identify", "remainder", "plan-flight", "effects", "effect", "survey", "calibrate", "report",
    ),
    "Make it fly like its design": ("design", "model", "train", "ablate", "collect", "reproduce"),
    "Fly": ("fly", "deploy", "status", "monitor", "ros2-bridge", "keys"),
}  # fmt: skip
"""The commands by what somebody wants to do, in the order in which `--help` shows them."""

app = typer.Typer(
    name="groundstation",
    help="Runs on the operator's machine: reads flights, compares them with models, names missing effects, "
    "and commands the companion.",
    no_args_is_help=True,
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
identify.register(app)
plan.register(app)
survey.register(app)
calibrate.register(app)
choosing.offer_sources(app)
offer_version(app, "groundstation")


def _by_task() -> None:
    """Order commands and groups by task, each under its task's heading."""
    order = [name for names in TASKS.values() for name in names]
    task_of = {name: task for task, names in TASKS.items() for name in names}
    for command in app.registered_commands:
        command.rich_help_panel = task_of.get(command.name or "")
    for group in app.registered_groups:
        group.rich_help_panel = task_of.get(group.name or "")
    app.registered_commands.sort(key=lambda c: order.index(c.name) if c.name in order else len(order))


_by_task()


def main() -> None:
    """Entry point of the `groundstation` program."""
    # before numpy is loaded; identify/translation.py tells why
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    run_command_line(app, "ground")


if __name__ == "__main__":
    main()
