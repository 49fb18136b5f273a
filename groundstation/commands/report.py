"""The command line of the report: one page of a whole analysis."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from trueflight.groundstation.commands.analysis import (
    DEFAULT_STORE,
    BandwidthOption,
    EffectsOption,
    FlightArgument,
    JsonOption,
    MappingOption,
    ModelsOption,
    SaveOption,
    StoreOption,
    VehicleOption,
    chosen_model,
    console,
    design_of,
    print_json,
    print_written,
    read_other,
    same_vehicle,
    starting_line,
)


def register(app: typer.Typer) -> None:
    """Add the report to the ground station's application."""
    app.command(
        "report",
        epilog="Example: groundstation report identify.csv --validate validate.csv -o report.html",
    )(report_command)


def report_command(
    flight: FlightArgument,
    output: Annotated[Path, typer.Option("--output", "-o", help="The HTML file to write.")] = Path(
        "report.html"
    ),
    validate: Annotated[
        Path | None, typer.Option("--validate", help="Another flight, held out of every fit.")
    ] = None,
    beside: Annotated[
        list[Path] | None, typer.Option("--beside", help="Another flight to compare with. Repeatable.")
    ] = None,
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    model: ModelsOption = None,
    design: Annotated[
        Path | None, typer.Option("--design", help="Design file, for tracking; default: that of the record.")
    ] = None,
    without: Annotated[
        list[str] | None, typer.Option("--without", help="Leave this section out. Repeatable.")
    ] = None,
    store: StoreOption = DEFAULT_STORE,
    effects: EffectsOption = None,
    bandwidth: BandwidthOption = None,
    save: SaveOption = None,
    as_json: JsonOption = False,
) -> None:
    """Diagnose a flight and write it as one HTML page, for those who were not there.

    The page needs nothing else, opens offline and prints to PDF. With --model repeated, the diagnosis starts from the
    last of them, and all are compared side by side. Sections: ranking, waterfall, prediction, where, worst, tracking,
    side_by_side, blind, provenance.
    """
    from trueflight.groundstation.evaluate.analysis import analyse
    from trueflight.groundstation.evaluate.side_by_side import side_by_side, told_apart
    from trueflight.groundstation.output.as_json import analysis_table
    from trueflight.groundstation.output.tables import print_diagnosis
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.report import chosen, render, write_report

    sections = chosen(without or ())
    read = read_flight(flight, vehicle, mapping)
    held_out = None if validate is None else read_flight(validate, vehicle or same_vehicle(read), mapping)
    flights = told_apart([read, *(read_other(path, vehicle, mapping, read) for path in beside or ())])
    named = [[chosen_model(which, f, store, effects) for which in model or (None,)] for f in flights]
    line = starting_line(model[-1] if model else None, read, store, effects)
    with nullcontext() if as_json else console.status("comparing") as status:
        progress = (lambda text: None) if status is None else status.update
        several = len(flights) > 1 or len(named[0]) > 1
        together = side_by_side(flights, named, bandwidth) if several else None
        whole = analyse(
            read, line, held_out, bandwidth, design_of(flight, design, read), together, progress=progress
        )
        progress("drawing")
        table = analysis_table(whole)
        write_report(output, render(whole, table, sections))
        if save is not None:
            from trueflight.groundstation.views import write_analysis

            write_analysis(save, whole)
    if as_json:
        print_json({**table, "report": str(output), "recording": None if save is None else str(save)})
        return
    print_diagnosis(console, whole.diagnosis)
    print_written(save, output)
