"""What a survey of many flights looks like in a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from trueflight.groundstation.evaluate.history import History
from trueflight.groundstation.evaluate.survey import Fleet, Row
from trueflight.groundstation.output.tables import percent
from trueflight.groundstation.reading.betaflight_table import BLACKBOX, CONVERT
from trueflight.models.terminal import Table

SHOWN = 40
"""Flights in the table of a terminal; all are in what `--save` and `--json` give."""


NAMED = 3
"""Files that are no logs whose names are told; those without an ending first, which may be damaged logs of a card."""


def print_survey(
    console: Console, rows: Sequence[Row], fleet: Fleet, folder: Path, others: Sequence[Path] = ()
) -> None:
    """Flights, effects and parameters; `others` are the files of the folder that are no logs."""
    _print_flights(console, rows, folder)
    usable = fleet.flights - fleet.failed
    console.print(
        f"[bold]{usable} of {fleet.flights} flights could be used[/bold], "
        f"of {len(fleet.vehicles)} vehicle{'s' * (len(fleet.vehicles) != 1)}; "
        f"{fleet.clean} lack nothing, {fleet.unexplained} hold something that no effect explains",
        highlight=False,
    )
    for line in _told(others, folder):
        console.print(f"[dim]{escape(line)}[/dim]", highlight=False)
    for h in fleet.histories:
        _print_history(console, h)
    _print_effects(console, fleet)
    _print_parameters(console, fleet)


def _told(others: Sequence[Path], folder: Path) -> Iterator[str]:
    """How many files are no logs, and how many are to be converted first."""
    raw = [f for f in others if f.suffix.lower() in BLACKBOX]
    if raw:
        counted = f"{raw[0].relative_to(folder)} is" if len(raw) == 1 else f"{len(raw)} files are"
        yield f"{counted} {CONVERT}"
    rest = sorted((f for f in others if f not in set(raw)), key=lambda f: (f.suffix != "", f))
    if rest:
        names = ", ".join(str(f.relative_to(folder)) for f in rest[:NAMED])
        more = f" and {len(rest) - NAMED} more" if len(rest) > NAMED else ""
        what = "1 file is no log" if len(rest) == 1 else f"{len(rest)} files are no logs"
        yield f"{what}, by ending and beginning, and passed over: {names}{more}"


def _print_history(console: Console, h: History) -> None:
    """What has changed of one vehicle."""
    name = f"[bold]{escape(h.vehicle)}[/bold]"
    if h.error:
        console.print(f"{name}: its flights could not be fitted together: {escape(h.error)}", highlight=False)
        return
    for change in h.changes:
        console.print(f"{name}: {escape(change.text)}", style="yellow", highlight=False)
    if not h.changes and len(h.flights) > 1:
        console.print(
            f"{name}: {len(h.flights)} flights fitted together, the newest is as those before",
            highlight=False,
        )
    for reason in h.left_out:
        console.print(f"[dim]{escape(h.vehicle)}: left out: {escape(reason)}[/dim]", highlight=False)


def _print_flights(console: Console, rows: Sequence[Row], folder: Path) -> None:
    root = folder.resolve()
    table = Table(title=f"{folder}: {len(rows)} flights")
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


def _print_effects(console: Console, fleet: Fleet) -> None:
    table = Table(title="how often each effect is missing")
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


def _print_parameters(console: Console, fleet: Fleet) -> None:
    table = Table(title="parameters: mean, standard deviations, trend")
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
