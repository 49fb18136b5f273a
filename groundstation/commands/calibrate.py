"""`groundstation calibrate`: how often the diagnosis is right, and whether it is as sure as it says."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from trueflight.groundstation.commands.options import JsonOption
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.vehicle import QUAD5

if TYPE_CHECKING:
    from trueflight.groundstation.evaluate.calibration import Calibration, Case, Proportion

console = Console()

SHOWN = 30
"""Wrong flights in the table of a terminal; all are in the page and in what `--json` gives."""


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
    jobs: Annotated[int, typer.Option(help="Flights at a time; 0: one for each core.", min=0)] = 0,
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
    from trueflight.groundstation.report.calibration import write_calibration
    from trueflight.groundstation.study.calibration_study import (
        Study,
        forget_diagnoses,
        hideable,
        run,
        sorties,
    )

    if not 40.0 <= seconds <= 1800.0:
        raise InputError(
            f"--seconds {seconds:g}: must be 40 to 1800, shorter flights cannot be held out in blocks"
        )
    if not vehicle.is_file():
        raise InputError(f"{vehicle}: no such vehicle file")
    believed = design or vehicle.with_name("design.json")
    if not believed.is_file():
        raise InputError(
            f"{believed}: no design to fly by; make one: groundstation design {vehicle}, or pass --design"
        )
    study = Study(output, vehicle, believed, seed, seconds, hideable(), strength)
    wanted = sorties(study, flights)
    study.open()
    if again:
        forget_diagnoses(study)
    with _bar(as_json) as progress:
        task = progress.add_task("flying and diagnosing", total=len(wanted))

        def done(case: Case) -> None:
            progress.advance(task)

        cases = run(study, wanted, jobs or len(os.sched_getaffinity(0)), done)
    result = calibrate(cases)
    table = calibration_table(result, cases)
    table = {
        "vehicle": cases[0].vehicle,
        "seed": seed,
        "seconds_usual": seconds,
        "strength": strength,
        **table,
    }
    page = write_calibration(output, table)
    if as_json:
        print_json({**table, "report": str(page)})
        return
    print_calibration(result, output)
    console.print(f"report: {page}", highlight=False)


def _bar(quiet: bool) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=quiet,
        transient=True,
    )


def print_calibration(result: Calibration, folder: Path) -> None:
    """The study in a terminal of 100 columns."""
    from rich.table import Table

    from trueflight.groundstation.evaluate.calibration import NOTHING, OUTCOMES

    told = f"{result.flights} flights"
    if result.not_flown:
        told += f", {result.not_flown} not finished"
    if result.failed:
        told += f", [red]{result.failed} without a diagnosis[/red]"
    console.print(f"[bold]{escape(str(folder))}[/bold]: {told}", highlight=False)

    table = Table(title="how often it was right, with 95 % intervals", title_justify="left")
    table.add_column("")
    table.add_column("flights", justify="right")
    table.add_column("share", justify="right", no_wrap=True)
    for name, share in (
        ("missing effects are exactly the hidden ones", result.exact),
        ("... or in a group that cannot be told apart", result.right),
        ("... or said to be out of the flight's reach", result.honest),
        ("an effect that is not there is called missing", result.false_effects),
        ("  in flights with nothing hidden (false alarm)", result.false_alarm),
        ("  or possible, or something is unexplained", result.doubt),
    ):
        table.add_row(name, f"{share.count} of {share.of}", _share(share))
    console.print(table)

    table = Table(title="right, or in a group", title_justify="left")
    table.add_column("by")
    table.add_column("")
    table.add_column("flights", justify="right")
    table.add_column("share", justify="right", no_wrap=True)
    for by, groups in result.by.items():
        for k, (name, share) in enumerate(groups.items()):
            table.add_row(by if k == 0 else "", name, f"{share.count} of {share.of}", _share(share))
        table.add_section()
    console.print(table)

    table = Table(title="what became of the hidden effects", title_justify="left")
    table.add_column("hidden", no_wrap=True)
    for heading in ("times", "missing", "in a\ngroup", "not\nexcited", "denied"):
        table.add_column(heading, justify="right")
    table.add_column("called missing\nin its place", overflow="fold")
    for row in result.confusion:
        instead = ", ".join(f"{name} {count}" for name, count in row.instead.items())
        if row.effect == NOTHING:
            table.add_section()
            table.add_row("beside all that is true", str(row.hidden), "", "", "", "", instead)
        else:
            counts = [str(row.outcomes[o] or "") for o in OUTCOMES]
            table.add_row(row.effect, str(row.hidden), *counts, instead)
    console.print(table)

    table = Table(title="95 % intervals that hold the truth", title_justify="left")
    table.add_column("parameter", no_wrap=True)
    for heading in ("intervals", "hold it", "95 % need them\nwider by", "error,\nmedian"):
        table.add_column(heading, justify="right")
    for held in result.coverage:
        if held.parameter:
            continue
        table.add_row(
            held.effect or "[bold]all[/bold]",
            str(held.inside.of),
            _share(held.inside),
            f"{held.widen:.2f}",
            f"{100 * held.error:.1f} %",
        )
    console.print(table)

    table = Table(title="how sure verdicts are, and how often they are right", title_justify="left")
    table.add_column("verdict")
    table.add_column("says it is sure", justify="right")
    table.add_column("verdicts", justify="right")
    table.add_column("right", justify="right", no_wrap=True)
    for name, found in (("it is there", result.present), ("it is not there", result.absent)):
        for k, one in enumerate(found.bins):
            edges = f"{100 * one.low:g} to {100 * one.high:g} %"
            table.add_row(name if k == 0 else "", edges, str(one.right.of), _share(one.right))
        sure = found.called_sure
        table.add_row("", "[bold]95 % or more[/bold]", str(sure.of), _share(sure))
        table.add_section()
    console.print(table)

    if result.wrong:
        table = Table(title=f"what was wrong ({len(result.wrong)})", title_justify="left")
        table.add_column("flight", justify="right")
        table.add_column("hidden")
        table.add_column("why")
        for wrong in result.wrong[:SHOWN]:
            table.add_row(f"{wrong.number:04d}", ", ".join(wrong.truth) or "nothing", escape(wrong.why))
        console.print(table)
        if len(result.wrong) > SHOWN:
            console.print(f"... and {len(result.wrong) - SHOWN} more in the report", style="dim")
    console.print(f"median time of a diagnosis {result.seconds:.1f} s", style="dim", highlight=False)


def _share(share: Proportion) -> str:
    if share.of == 0:
        return "–"
    return f"{100 * share.share:.0f} % ({100 * share.low:.0f} to {100 * share.high:.0f})"
