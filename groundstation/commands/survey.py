"""`groundstation survey`: a folder of flights as one analysis."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape

from trueflight.groundstation.commands.options import EffectsOption, JsonOption, MappingOption, VehicleOption
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.whole_file import write_whole

if TYPE_CHECKING:
    from trueflight.groundstation.evaluate.survey import Fleet, Row

console = Console()
SHOWN = 40
"""Flights in the table of a terminal; all are in what `--save` and `--json` give."""


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
    as_json: JsonOption = False,
) -> None:
    """Diagnose every flight of a folder: how often each effect is missing, its spread over the fleet, its trend.

    A file that cannot be used is told and skipped. `--save` writes survey.jsonl (one line a flight, as they are done),
    survey.parquet and fleet.json.
    """
    from trueflight.groundstation.evaluate.survey import fleet_of, row_table, stamp_of, survey, survey_files
    from trueflight.groundstation.output.as_json import plain

    files = survey_files(folder)
    known = [] if save is None else _already(save, files)
    done = {(row.file, row.stamp) for row in known}
    left = [f for f in files if (str(f.resolve()), stamp_of(f)) not in done]
    rows = list(known)
    with _kept(save, new=not known) as keep, _Bar(len(files), len(known), as_json) as bar:
        for row in survey(left, vehicle, mapping, effects, jobs, memory, scheduler, bar.ready):
            rows.append(row)
            keep(json.dumps(plain(row_table(row))))
            bar.step()
    rows.sort(key=lambda row: row.file)
    fleet = fleet_of(rows)
    if save is not None:
        _write(save, rows, fleet)
    if as_json:
        print_json(plain({"flights": [row_table(r) for r in rows], "fleet": asdict(fleet)}))
    else:
        print_survey(rows, fleet, folder)
        if save is not None:
            console.print(f"saved in {save}: survey.jsonl, survey.parquet, fleet.json", highlight=False)
    if fleet.failed == fleet.flights:
        raise InputError(f"{folder}: none of its {fleet.flights} flights could be used; see why above")


def _already(save: Path, files: Sequence[Path]) -> list[Row]:
    """Rows of an earlier run on the same files."""
    from trueflight.groundstation.evaluate.survey import row_from_table, stamp_of

    path = save / "survey.jsonl"
    if not path.is_file():
        return []
    now = {str(f.resolve()): stamp_of(f) for f in files}
    found: dict[str, Row] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        try:
            row = row_from_table(json.loads(line))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            # the last line of a run that was killed may be half a line
            console.print(f"{path}: line {number} is damaged; its flight is done again", style="yellow")
            continue
        if now.get(row.file) == row.stamp and not row.error:
            found[row.file] = row
    return list(found.values())


@contextmanager
def _kept(save: Path | None, new: bool) -> Iterator[Callable[[str], None]]:
    """Something that keeps a line at once, so that nothing is lost when the survey is interrupted."""
    if save is None:
        yield lambda line: None
        return
    try:
        save.mkdir(parents=True, exist_ok=True)
        with (save / "survey.jsonl").open("w" if new else "a", encoding="utf-8") as file:

            def keep(line: str) -> None:
                file.write(line + "\n")
                file.flush()

            yield keep
    except OSError as error:
        raise InputError(f"{save}: cannot write the survey ({error.strerror}); pass another --save") from None


def _write(save: Path, rows: Iterable[Row], fleet: Fleet) -> None:
    from trueflight.groundstation.evaluate.survey import SAVED_TABLE, write_table
    from trueflight.groundstation.output.as_json import plain

    write_table(list(rows), save / SAVED_TABLE)
    text = json.dumps(plain(asdict(fleet)), indent=1, allow_nan=False)
    write_whole(save / "fleet.json", text + "\n", "the survey", "pass another --save")


class _Bar:
    """Progress on standard error."""

    def __init__(self, total: int, done: int, quiet: bool) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
            disable=quiet,
        )
        self._task = self._bar.add_task("starting", total=total, completed=done)

    def __enter__(self) -> _Bar:
        self._bar.start()
        return self

    def __exit__(self, *caught: object) -> None:
        self._bar.stop()

    def ready(self, text: str) -> None:
        """What is at work."""
        self._bar.update(self._task, description=text)

    def step(self) -> None:
        """One more flight."""
        self._bar.advance(self._task)


def print_survey(rows: Sequence[Row], fleet: Fleet, folder: Path) -> None:
    """Flights, effects and parameters, in a terminal of 100 columns."""
    from rich.table import Table

    from trueflight.groundstation.output.tables import percent

    root = folder.resolve()
    table = Table(title=f"{folder}: {len(rows)} flights", title_justify="left")
    table.add_column("flight", overflow="fold")
    table.add_column("vehicle")
    table.add_column("m/s²", justify="right", no_wrap=True)
    table.add_column("missing")
    table.add_column("possible")
    for row in rows[:SHOWN]:
        name = escape(str(Path(row.file).relative_to(root)))
        if row.error:
            table.add_row(name, "", "", "[red]could not be used[/red]", "")
            continue
        missing = ", ".join(row.named("missing")) + (
            " [yellow]+ unexplained[/yellow]" if row.unexplained else ""
        )
        change = f"{row.rms_before:.2f} -> {row.rms_after:.2f}"
        table.add_row(name, row.vehicle, change, missing, ", ".join(row.named("possible")))
    console.print(table)
    if len(rows) > SHOWN:
        console.print(f"... and {len(rows) - SHOWN} more; --save or --json gives all", style="dim")
    for row in rows:
        if row.error:
            console.print(f"[red]skipped[/red] {escape(row.error)}", highlight=False)
    usable = fleet.flights - fleet.failed
    console.print(
        f"[bold]{usable} of {fleet.flights} flights could be used[/bold], "
        f"of {len(fleet.vehicles)} vehicle{'s' * (len(fleet.vehicles) != 1)}; "
        f"{fleet.clean} lack nothing, {fleet.unexplained} hold something that no effect explains",
        highlight=False,
    )
    table = Table(title="how often each effect is missing", title_justify="left")
    for column in (
        "effect",
        "missing",
        "possible",
        "not there",
        "not excited",
        "share of those that show it",
    ):
        table.add_column(column, justify="left" if column == "effect" else "right")
    for h in fleet.effects:
        if not h.counts["missing"] and not h.counts["possible"]:
            continue
        counts = [str(h.counts[v]) for v in ("missing", "possible", "not_supported", "not_excited")]
        share = (
            ""
            if h.share is None
            else f"{percent(h.share)} ({percent(h.low or 0.0)} to {percent(h.high or 0.0)})"
        )
        table.add_row(h.effect, *counts, share)
    if table.row_count:
        console.print(table)
    table = Table(title="parameters: mean, standard deviations, trend", title_justify="left")
    for column in ("parameter", "flights", "mean", "vehicles", "flights", "of a fit", "trend a day"):
        table.add_column(column, justify="left" if column == "parameter" else "right")
    for s in fleet.parameters:
        unit = "" if s.unit == "1" else f" {s.unit}"
        spreads = ["" if x is None else f"{x:.2g}" for x in (s.between_vehicles, s.between_flights)]
        trend = "" if s.trend_per_day is None else f"{s.trend_per_day:+.2g} (p {s.trend_p:.2g})"
        mean = f"{s.mean:.3g}{unit}"
        table.add_row(
            f"{s.effect} {s.parameter}", str(s.flights), mean, *spreads, f"{s.uncertainty:.2g}", trend
        )
    if table.row_count:
        console.print(table)
        console.print(
            "vehicles: from one to another; flights: of one vehicle, beyond the fit's own", style="dim"
        )
