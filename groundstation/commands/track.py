"""`groundstation track`: flights against the linear behaviour expected of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trueflight.groundstation.commands.options import (
    DesignOption,
    JsonOption,
    MappingOption,
    SaveOption,
    VehicleOption,
)
from trueflight.groundstation.output.terminal import print_notes, print_written
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command("track", epilog="Example: groundstation track before.mcap after.mcap")(track_command)


def track_command(
    flights: Annotated[list[Path], typer.Argument(help="One flight or more, usually before and after.")],
    design: DesignOption = None,
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    rrd: SaveOption = None,
    as_json: JsonOption = False,
) -> None:
    """Flights against the linear behaviour expected of them: mean squared error per axis, as in the paper."""
    from trueflight.groundstation.evaluate.tracking import told_apart, track_file
    from trueflight.groundstation.output.as_json import tracked_table
    from trueflight.groundstation.output.flown import print_tracking

    tracked = told_apart([track_file(path, design, vehicle, mapping) for path in flights])
    if rrd is not None:
        from trueflight.groundstation.views import write_tracking

        write_tracking(rrd, tracked)
    if as_json:
        print_json([tracked_table(t, tracked[0]) for t in tracked])
        return
    for t in tracked:
        print_notes(console, t.flight)
    print_tracking(console, tracked)
    print_written(console, rrd)
