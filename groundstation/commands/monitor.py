"""`groundstation monitor`: vehicles watched while they fly, or records as if they flew now."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.markup import escape

from trueflight.groundstation.commands.linked import linked
from trueflight.groundstation.commands.options import (
    DEFAULT_STORE,
    EffectsOption,
    JsonOption,
    ModelOption,
    StoreOption,
    VehicleOption,
)
from trueflight.groundstation.output.terminal import print_warning
from trueflight.models.errors import InputError
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.groundstation.live.sources import Source
    from trueflight.groundstation.operate.settings import Settings
    from trueflight.models.model import Model
    from trueflight.models.vehicle import Vehicle

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command("monitor", epilog="Example: groundstation monitor --save flight.rrd")(linked(monitor_command))


def monitor_command(
    save: Annotated[
        Path | None, typer.Option("--save", help="Write a Rerun recording instead of opening the viewer.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", help="Stop after this long; default: until Ctrl-C.", min=0.1)
    ] = None,
    replay: Annotated[
        list[Path] | None,
        typer.Option("--replay", help="A record, as if it flew now. Repeat for several vehicles."),
    ] = None,
    speed: Annotated[
        float, typer.Option(help="Of --replay, times real time; 0: as fast as it can be looked at.", min=0.0)
    ] = 1.0,
    window: Annotated[float, typer.Option(help="s of flight that are looked at.", min=20.0, max=60.0)] = 40.0,
    diagnosis: Annotated[
        bool,
        typer.Option("--diagnosis/--no-diagnosis", help="Whether the flight is looked at, or only shown."),
    ] = True,
    view: Annotated[
        bool, typer.Option("--view/--no-view", help="Whether Rerun opens; lines are printed in any case.")
    ] = True,
    vehicle: VehicleOption = None,
    model: ModelOption = None,
    store: StoreOption = DEFAULT_STORE,
    effects: EffectsOption = None,
    as_json: JsonOption = False,
    *,
    settings: Settings,
) -> None:
    """Watch vehicles live in Rerun, and hear what a diagnosis will say: what is missing, and what changed.

    The last seconds of the flight are looked at about once a second, in a process of their own. Every vehicle that
    answers is watched, unless --name says which. --json prints one document a line, and opens no viewer.
    """
    from trueflight.groundstation.live.engine import engine
    from trueflight.groundstation.live.watch import Shown, Watch
    from trueflight.groundstation.operate.processes import told_to_end
    from trueflight.groundstation.output.live_lines import JsonLines, Lines
    from trueflight.groundstation.versions.choice import choose_start
    from trueflight.models.flight import Flight
    from trueflight.models.vehicle import load_vehicle

    believed = None if vehicle is None else load_vehicle(vehicle)
    with ExitStack() as stack:
        looking = stack.enter_context(engine()) if diagnosis else None
        sources = stack.enter_context(_sources(replay or (), speed, believed, settings))
        names = [source.name for source in sources]
        shown: list[Shown] = [JsonLines() if as_json else Lines(console, events=bool(replay) or not view)]
        if save is not None or (view and not as_json):
            from trueflight.groundstation.views import viewer

            shown.append(stack.enter_context(viewer(names, save, diagnosis)))
        if not as_json:
            console.print(f"watching {_quoted(names)}; Ctrl-C ends", highlight=False)

        def start(flown: Vehicle) -> Model:
            return choose_start(Flight(flown.name, flown, np.zeros(0)), model, store, effects)

        watch = Watch(sources, shown, looking, start, window)
        with told_to_end() as told:
            in_step = replay and speed == 0.0
            seen = watch.run_in_step(told) if in_step else watch.run(told, seconds)
    if not as_json:
        written = f", written to {escape(str(save))}" if save is not None else ""
        console.print(f"{seen} ticks seen{written}")


def _quoted(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)


@contextmanager
def _sources(
    replay: Sequence[Path], speed: float, vehicle: Vehicle | None, settings: Settings
) -> Iterator[list[Source]]:
    """Records that are played again, or the companions that answer."""
    from trueflight.groundstation.live.sources import FromLink, FromRecord
    from trueflight.groundstation.operate.link import Link, companions

    if replay:
        played = [FromRecord(path, speed, vehicle) for path in replay]
        names = [one.name for one in played]
        for one, path in zip(played, replay, strict=True):
            if names.count(one.name) > 1:  # two flights of one vehicle, side by side
                one.name = path.stem
        if len({one.name for one in played}) < len(played):
            raise InputError("--replay: records of one vehicle need different file names; rename one of them")
        yield list(played)
        return
    with ExitStack() as stack:
        there = [settings.name] if settings.name else companions(settings)
        several = [replace(settings, name=name) for name in there] if len(there) > 1 else [settings]
        links = [stack.enter_context(Link(one)) for one in several]
        for link in links:
            print_warning(link.warning)
        sources = [FromLink(link, vehicle) for link in links]
        for source in sources:
            stack.callback(source.close)
        yield list(sources)
