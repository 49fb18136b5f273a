"""`groundstation calibrate`: how often the diagnosis is right, and whether it is as sure as it says."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trueflight.groundstation.commands.options import JobsOption, JsonOption
from trueflight.groundstation.output.terminal import counted
from trueflight.models.printed import print_json
from trueflight.models.shipped import QUAD5
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.groundstation.evaluate.calibration import Case

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command(
        "calibrate", epilog="Example: groundstation calibrate vehicle.toml --flights 100 -o calibration"
    )(calibrate_command)


def calibrate_command(
    vehicle: Annotated[
        Path, typer.Argument(help="vehicle.toml; default: the 5-inch quadrotor.", show_default=False)
    ] = QUAD5,
    flights: Annotated[int, typer.Option(help="How many flights.", min=1, max=100_000)] = 100,
    seed: Annotated[int, typer.Option(help="Of all that is drawn.", min=0)] = 1,
    seconds: Annotated[
        float,
        typer.Option(help="Usual length of a flight; a quarter is half, a quarter one and a half of it."),
    ] = 90.0,
    strength: Annotated[
        float,
        typer.Option(help="Factor on the sizes of what is hidden: 0.3 for weak effects.", min=0.01, max=3),
    ] = 1.0,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for all it makes; the same one goes on.")
    ] = Path("calibration"),
    design: Annotated[
        Path | None, typer.Option("--design", help="Design file; default: design.json beside the vehicle.")
    ] = None,
    jobs: JobsOption = 0,
    again: Annotated[
        bool, typer.Option("--again", help="Diagnose all flights anew, after a change of the diagnosis.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Fly seeded flights with known effects hidden in them, diagnose each, and count how often that was right.

    Three flights of ten hide nothing, four one effect, two two and one three, drawn from all that the simulator can
    hide, at two levels of noise, with and without rotor speeds, on surveys, tasks, gentle flights and fast descents.
    Writes report.html, its charts as PNG, and calibration.json into the folder.
    """
    from trueflight.groundstation.evaluate.calibration import calibrate
    from trueflight.groundstation.output.as_json import calibration_table
    from trueflight.groundstation.output.calibration_tables import print_calibration
    from trueflight.groundstation.report.calibration import write_calibration
    from trueflight.groundstation.study.calibration_study import forget_diagnoses, run, sorties, study_of

    study = study_of(output, vehicle, design, seed, seconds, strength)
    wanted = sorties(study, flights)
    study.open()
    if again:
        forget_diagnoses(study)
    with counted(as_json) as progress:
        flying = progress.add_task("flying", total=len(wanted))
        diagnosing = progress.add_task("diagnosing", total=len(wanted))

        def flown(more: int) -> None:
            progress.advance(flying, more)

        def done(case: Case) -> None:
            progress.advance(diagnosing)

        cases = run(study, wanted, jobs or len(os.sched_getaffinity(0)), done, flown)
    result = calibrate(cases)
    asked = {"vehicle": cases[0].vehicle, "seed": seed, "seconds_usual": seconds, "strength": strength}
    table = {**asked, **calibration_table(result, cases)}
    page = write_calibration(output, table)
    if as_json:
        print_json({**table, "report": str(page)})
        return
    print_calibration(console, result, output)
    console.print(f"report: {page}", highlight=False)
