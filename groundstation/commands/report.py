"""The command line of the report: one page of a whole analysis."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trueflight.groundstation.commands.options import (
    DEFAULT_STORE,
    BandwidthOption,
    DesignOption,
    EffectsOption,
    FlightsArgument,
    JsonOption,
    MappingOption,
    ModelsOption,
    PerFlightOption,
    SaveOption,
    SharedOption,
    StoreOption,
    ValidateOption,
    VehicleOption,
)
from trueflight.groundstation.output.terminal import print_written, working
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add the report to the ground station's application."""
    app.command(
        "report",
        epilog="Example: groundstation report identify.csv --validate validate.csv -o report.html",
    )(report_command)


def report_command(
    flight: FlightsArgument,
    output: Annotated[Path, typer.Option("--output", "-o", help="The HTML file to write.")] = Path(
        "report.html"
    ),
    validate: ValidateOption = None,
    beside: Annotated[
        list[Path] | None, typer.Option("--beside", help="Another flight to compare with. Repeatable.")
    ] = None,
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    model: ModelsOption = None,
    design: DesignOption = None,
    per_flight: PerFlightOption = None,
    shared: SharedOption = None,
    without: Annotated[
        list[str] | None, typer.Option("--without", help="Leave this section out. Repeatable.")
    ] = None,
    store: StoreOption = DEFAULT_STORE,
    effects: EffectsOption = None,
    bandwidth: BandwidthOption = None,
    save: SaveOption = None,
    as_json: JsonOption = False,
) -> None:
    """Diagnose a flight, or several together, and write it as one HTML page, for those who were not there.

    The page needs nothing else, opens offline and prints to PDF. With --model repeated, the diagnosis starts from the
    last of them, and all are compared side by side. Sections: ranking, flights, waterfall, prediction, where, worst,
    tracking, side_by_side, blind, provenance.
    """
    from trueflight.groundstation.reading.several import read_beside, read_held_out, read_together, told_apart
    from trueflight.groundstation.report import chosen, render, write_report

    sections = chosen(without or ())
    together = read_together(flight, vehicle, mapping)
    read = together[-1]
    held_out = None if validate is None else read_held_out(validate, together, vehicle, mapping)
    flights = told_apart([*together, *(read_beside(path, read, vehicle, mapping) for path in beside or ())])

    # dear to load, and what cannot be read is told without it
    from trueflight.groundstation.evaluate.analysis import gather
    from trueflight.groundstation.evaluate.side_by_side import side_by_side
    from trueflight.groundstation.identify.flights import diagnose_flights
    from trueflight.groundstation.output.as_json import analysis_table
    from trueflight.groundstation.output.ranking import print_diagnosis
    from trueflight.groundstation.versions.choice import choose_design, choose_line, choose_model

    named = [[choose_model(f, which, store, effects) for which in model or (None,)] for f in flights]
    line = choose_line(read, model[-1] if model else None, store, effects)
    with working(console, "comparing", as_json) as progress:
        asked = bool(beside) or len(named[0]) > 1
        table_of = side_by_side(flights, named, bandwidth) if asked else None
        progress("looking for missing effects")
        found = diagnose_flights(
            together, line[-1], held_out, bandwidth, per_flight or (), shared or (), progress
        )
        whole = gather(found, line, held_out, bandwidth, choose_design(read, design), table_of, progress)
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
    print_written(console, save, output)
