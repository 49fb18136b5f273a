"""The ground station's commands by what somebody wants to do, each loaded when it is called: `--help` needs none."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from trueflight.groundstation.commands.choosing import offer_sources


class Entry(NamedTuple):
    """A command or group: the module of `groundstation.commands` whose `register` makes it, and what `--help` says of
    it, which is the first paragraph of its own help."""

    module: str
    told: str


TASKS: dict[str, dict[str, Entry]] = {
    "Begin here": {
        "open": Entry(
            "open",
            "Open the workbench: compare, see where the model fails, add what is missing, watch the error fall.",
        ),
        "demo": Entry(
            "demo",
            "The main job end to end on a simulated vehicle with a hidden effect, then on real flights.",
        ),
    },
    "Look at flights": {
        "flights": Entry(
            "flights", "The flights in a folder: what was flown, how long, and what was measured."
        ),
        "import": Entry(
            "flights",
            "Read any flight, check it, and write it in the project's own format with its vehicle file beside it.",
        ),
        "compare": Entry(
            "compare",
            "Model against measurement: residual per axis, noise floor, share explained, open-loop error.",
        ),
        "where": Entry(
            "compare",
            "Where a model fails: the residual against height, speed, tilt, thrust, voltage, time and place.",
        ),
        "track": Entry(
            "track",
            "Flights against the linear behaviour expected of them: mean squared error per axis, as in the paper.",
        ),
        "bound": Entry(
            "bound",
            "The tube that a flight must stay in, and whether it did: the paper's stability bound in Lyapunov's "
            "form.",
        ),
    },
    "Find what is missing": {
        "diagnose": Entry(
            "diagnose",
            "Which effect is missing: ranked, with parameters and intervals, checked on held-out data.",
        ),
        "identify": Entry(
            "identify",
            "Inertia, torque constant and rotor lag with intervals; the full state predicted from what was sent.",
        ),
        "remainder": Entry(
            "remainder",
            "What is left after every effect that the flight supports: where, when, which frequency, and a short "
            "formula.",
        ),
        "plan-flight": Entry(
            "plan",
            "Design the short flight that best separates the remaining candidates, and say what it will resolve.",
        ),
        "effects": Entry(
            "effect", "The catalogue of effects: what each is, what excites it, what it is confounded with."
        ),
        "effect": Entry("effect", "Write an effect of your own."),
        "survey": Entry(
            "survey",
            "Diagnose every flight of a folder: how often each effect is missing, its spread over the fleet, its "
            "trend.",
        ),
        "calibrate": Entry(
            "calibrate",
            "Fly seeded flights with known effects hidden in them, diagnose each, and count how often that was "
            "right.",
        ),
        "report": Entry(
            "report",
            "Diagnose a flight, or several together, and write it as one HTML page, for those who were not there.",
        ),
    },
    "Make it fly like its design": {
        "design": Entry(
            "design",
            "Gains of the linear cascade by LQR, with and without integral, and what the closed loop will do.",
        ),
        "model": Entry("model", "Make, list, show and export model versions."),
        "train": Entry(
            "train", "Train a network on what a model leaves over, and write a new model version with it."
        ),
        "ablate": Entry(
            "train",
            "How small a network may be: layers and widths against error, size and inference time.",
        ),
        "collect": Entry(
            "collect",
            "Fly a whole training database through the companion and fetch each record: translations, steps, "
            "rotations, spirals, circles, lemniscates, low passes and surveys.",
        ),
        "reproduce": Entry(
            "reproduce",
            "Collect, diagnose, train and fly every controller on flights no model has seen; print the paper's "
            "Table I.",
        ),
        "compare-controllers": Entry(
            "compare_controllers",
            "Fly every controller on the same vehicles, winds, payloads, batteries and paths, and print how far each "
            "is off.",
        ),
    },
    "Fly": {
        "fly": Entry(
            "fly",
            "Ask the companion to fly a trajectory; with --wait, follow it and fetch the flight record.",
        ),
        "deploy": Entry(
            "deploy",
            "Send a model to the companion, which checks it and lets it prove itself, or says why not.",
        ),
        "status": Entry("status", "What the companion is doing, and whether it could fly now."),
        "monitor": Entry(
            "monitor",
            "Watch vehicles live in Rerun, and hear what a diagnosis will say: what is missing, and what changed.",
        ),
        "ros2-bridge": Entry(
            "status",
            "Publish a vehicle to ROS 2 (rmw_zenoh): odometry, reference, command, IMU, battery, diagnostics. "
            "Needs no ROS.",
        ),
        "foxglove": Entry(
            "status",
            "Serve what ros2-bridge publishes to Foxglove, Lichtblick and PlotJuggler themselves, without any ROS.",
        ),
        "keys": Entry(
            "keys",
            "Make a certificate authority and keys for vehicles and people, or add some to those that are there.",
        ),
    },
}
"""In the order in which `--help` shows them."""

MARKUP: Any = "markdown"


class Loading(Mapping[str, TyperCommand | TyperGroup]):
    """The commands by name; one that is asked for is made, with those of its module, and not before."""

    def __init__(self) -> None:
        self._entries = {name: entry for task in TASKS.values() for name, entry in task.items()}
        self._made: dict[str, Any] = {}

    def __getitem__(self, name: str) -> TyperCommand | TyperGroup:
        if name not in self._made:
            from trueflight.groundstation.commands.picture import offer_pictures

            part = typer.Typer(rich_markup_mode=MARKUP)
            module = import_module(f"trueflight.groundstation.commands.{self._entries[name].module}")
            module.register(part)
            offer_sources(part)
            offer_pictures(part)
            self._made |= typer.main.get_group(part).commands
        made: TyperCommand | TyperGroup = self._made[name]
        return made

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)


class Tasks(TyperGroup):
    """The program's group: its help stands in `TASKS`, and what is called is loaded."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = Loading()  # type: ignore[assignment]

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help of the program, its commands under their tasks."""
        listed = {
            name: TyperCommand(name, help=entry.told, rich_help_panel=task, rich_markup_mode=MARKUP)
            for task, entries in TASKS.items()
            for name, entry in entries.items()
        }
        page = TyperGroup(
            name=self.name, commands=dict(listed), params=self.params, help=self.help, rich_markup_mode=MARKUP
        )
        page.format_help(ctx, formatter)
