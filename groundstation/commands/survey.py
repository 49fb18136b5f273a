"""`groundstation survey`: a folder of flights as one analysis."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trueflight.groundstation.commands.options import (
    EffectsOption,
    JsonOption,
    MappingOption,
    PerFlightOption,
    SharedOption,
    VehicleOption,
)
from trueflight.groundstation.output.terminal import counted
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    pass

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command("survey", epilog="Example: groundstation survey flights --save survey --memory 1GB")(
        survey_command
    )


def survey_command(
    folder: Annotated[Path, typer.Argument(help="Folder with flights, and folders of flights in it.")],
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    effects: EffectsOption = None,
    save: Annotated[
        Path | None,
        typer.Option(
            "--save", help="Folder for rows and tables; the same one goes on where it was interrupted."
        ),
    ] = None,
    jobs: Annotated[int, typer.Option(help="Flights at a time; 0: one a core, 1: without Dask.", min=0)] = 0,
    memory: Annotated[str, typer.Option(help="Memory of each process: 1GB, 0.25 (a share), auto.")] = "auto",
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler: tcp://HOST:8786. Default: this machine.")
    ] = None,
    each_alone: Annotated[
        bool, typer.Option("--each-alone", help="Do not fit the flights of a vehicle together.")
    ] = False,
    per_flight: PerFlightOption = None,
    shared: SharedOption = None,
    as_json: JsonOption = False,
) -> None:
    """Diagnose every flight of a folder: how often each effect is missing, its spread over the fleet, its trend.

    The flights of each vehicle are then fitted together, and what has changed since the last good flight is told. A
    file that cannot be used is told and skipped, files that are no logs are counted. `--save` writes survey.jsonl (one
    line a flight, as they are done), survey.parquet and fleet.json.
    """
    from trueflight.groundstation.evaluate.survey import (
        fleet_of,
        histories,
        passed_over,
        row_table,
        stamp_of,
        survey,
        survey_files,
    )
    from trueflight.groundstation.evaluate.time_left import TimeLeft, in_words, kind_of
    from trueflight.groundstation.identify.ownership import ownership
    from trueflight.groundstation.output.as_json import fleet_table, plain
    from trueflight.groundstation.output.survey_tables import print_survey
    from trueflight.groundstation.study.kept_survey import keeping, kept_rows, write_survey

    own = tuple(per_flight or ()), tuple(shared or ())
    ownership(*own, None if effects is None else str(effects))
    files = survey_files(folder)
    known = [] if save is None else kept_rows(save, files, lambda text: console.print(text, style="yellow"))
    done = {(row.file, row.stamp) for row in known}
    left = [f for f in files if (str(f.resolve()), stamp_of(f)) not in done]
    rows = list(known)
    others = passed_over(folder, save)
    kinds = {str(f.resolve()): kind_of(f) for f in left}
    time_left, began = TimeLeft(list(kinds.values())), time.monotonic()
    with keeping(save, new=not known) as keep, counted(as_json, own_estimate=True) as bar:
        task = bar.add_task("starting", total=len(files), completed=len(known), left=in_words(None))

        def tell(what: str) -> None:
            bar.update(task, description=what)

        for row in survey(left, vehicle, mapping, effects, jobs, memory, scheduler, tell):
            rows.append(row)
            keep(row)
            time_left.done(kinds[row.file], row.seconds)
            bar.update(task, advance=1, left=in_words(time_left.left(time.monotonic() - began)))
        rows.sort(key=lambda row: row.file)
        bar.update(task, description="fitting the flights of each vehicle together", left="")
        together = (
            [] if each_alone else histories(rows, vehicle, mapping, effects, jobs, memory, scheduler, own)
        )
    fleet = fleet_of(rows, together, len(others))
    if save is not None:
        write_survey(save, rows, fleet)
    if as_json:
        print_json(plain({"flights": [row_table(r) for r in rows], "fleet": fleet_table(fleet)}))
    else:
        print_survey(console, rows, fleet, folder, others)
        if save is not None:
            console.print(f"saved in {save}: survey.jsonl, survey.parquet, fleet.json", highlight=False)
    if fleet.failed == fleet.flights:
        raise InputError(f"{folder}: none of its {fleet.flights} flights could be used; see why above")
