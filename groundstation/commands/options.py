"""The arguments and options that several commands share, each declared once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trueflight.models.contract import CONTROLLERS

# --- flights, and what they are held against ------------------------------------------------------------------------

FlightArgument = Annotated[
    Path, typer.Argument(help="A flight: CSV, Parquet, PX4 ULog, MCAP of the companion or ROS 2.")
]
FlightsArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="FLIGHT...", help="A flight: CSV, Parquet, ULog, MCAP. Or several of one vehicle."
    ),
]
PerFlightOption = Annotated[
    list[str] | None,
    typer.Option(
        "--per-flight",
        metavar="EFFECT[.PARAMETER]",
        help="Of several flights: each has its own. Repeatable.",
    ),
]
SharedOption = Annotated[
    list[str] | None,
    typer.Option(
        "--shared",
        metavar="EFFECT[.PARAMETER]",
        help="Of several flights: one for all. Repeatable.",
    ),
]
VehicleOption = Annotated[
    Path | None, typer.Option("--vehicle", help="vehicle.toml; default: beside the flight.")
]
MappingOption = Annotated[
    list[str] | None,
    typer.Option("--mapping", help="TOML file that maps columns, or a line of one: 'velocity.turned = 20'."),
]
ValidateOption = Annotated[
    Path | None, typer.Option("--validate", help="Another flight, held out of every fit.")
]
ModelOption = Annotated[str | None, typer.Option("--model", help="A version number, or a model's JSON file.")]
ModelsOption = Annotated[
    list[str] | None,
    typer.Option("--model", help="A version number, or a model's JSON file. Repeat to compare models."),
]
StoreOption = Annotated[Path, typer.Option("--store", help="Folder of the model versions.")]
DEFAULT_STORE = Path("trueflight-models")
EffectsOption = Annotated[
    Path | None, typer.Option("--effects", help="Folder of your own effects, one file each.")
]
BandwidthOption = Annotated[
    float | None, typer.Option("--bandwidth", help="Low-pass for both sides, Hz.", min=0.1)
]
DesignOption = Annotated[
    Path | None, typer.Option("--design", help="Design file; default: that of the record.")
]

JobsOption = Annotated[int, typer.Option(help="Flights at a time; 0: one for each core.", min=0)]

# --- what comes out -------------------------------------------------------------------------------------------------

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
SaveOption = Annotated[Path | None, typer.Option("--save", "--rrd", help="Write a Rerun recording here.")]

ControllerOption = Annotated[
    str, typer.Option(help=f"One of {', '.join(CONTROLLERS)}; corrected needs a deployed model.")
]
