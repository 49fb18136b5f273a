"""Command line of the stability bound: the tube that a flight must stay in."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from trueflight.groundstation.commands.options import DesignOption, JsonOption, SaveOption, VehicleOption
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    pass

console = Terminal()


class AroundWhat(StrEnum):
    """What the tube stands around."""

    design = "design"
    reference = "reference"


def register(app: typer.Typer) -> None:
    """Add the command to the ground station's application."""
    app.command(
        "bound", epilog="Example: groundstation bound flight.mcap --from earlier.mcap --save tube.rrd"
    )(bound_command)


def bound_command(
    flight: Annotated[Path, typer.Argument(help="A flight with its reference: record, table or ULog.")],
    bound_from: Annotated[
        Path | None,
        typer.Option("--from", help="Take the bound on d from this flight: the honest test of a prediction."),
    ] = None,
    design: DesignOption = None,
    vehicle: VehicleOption = None,
    around: Annotated[
        AroundWhat,
        typer.Option("--around", help="Middle of the tube: the linear design's flight, or the reference."),
    ] = AroundWhat.design,
    bandwidth: Annotated[
        float, typer.Option("--bandwidth", help="Low-pass on d and eta alike, Hz.", min=1.0)
    ] = 5.0,
    rrd: SaveOption = None,
    as_json: JsonOption = False,
) -> None:
    """The tube that a flight must stay in, and whether it did: the paper's stability bound in Lyapunov's form.

    d is by how much the acceleration differs from what the linear design has. As long as |d| keeps below its bound,
    the error decays into a ball around the linear design's own flight (or around the reference) and stays there.
    """
    from trueflight.groundstation.evaluate.bound import predict_tube
    from trueflight.groundstation.evaluate.tracking import read_designed
    from trueflight.groundstation.output.as_json import tube_table
    from trueflight.groundstation.output.flown import print_tube

    flown, believed, label = read_designed(flight, design, vehicle)
    source = None if bound_from is None else read_designed(bound_from, design, vehicle)[0]
    tube = predict_tube(flown, believed, label, around.value, source, bandwidth)
    if rrd is not None:
        from trueflight.groundstation.views import write_tube

        write_tube(rrd, tube)
    if as_json:
        print_json({**tube_table(tube), "recording": None if rrd is None else str(rrd)})
        return
    print_tube(console, tube)
    if rrd is not None:
        console.print(f"Rerun recording: {escape(str(rrd))}")
