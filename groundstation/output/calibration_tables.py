"""What a study of the diagnosis looks like in a terminal."""

from __future__ import annotations

import math
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from trueflight.groundstation.evaluate.calibration import NOTHING, OUTCOMES, Calibration, Proportion
from trueflight.models.terminal import Table

SHOWN = 30
"""Wrong flights in the table of a terminal; all are in the page and in what `--json` gives."""


def print_calibration(console: Console, result: Calibration, folder: Path) -> None:
    """How often the diagnosis was right, by what, and whether it is as sure as it says."""
    told = f"{result.flights} flights"
    if result.not_flown:
        told += f", {result.not_flown} not finished"
    if result.failed:
        told += f", [red]{result.failed} without a diagnosis[/red]"
    console.print(f"[bold]{escape(str(folder))}[/bold]: {told}", highlight=False)
    for part in (_print_shares, _print_groups, _print_hidden, _print_coverage, _print_certainty):
        part(console, result)
    if result.wrong:
        _print_wrong(console, result)
    console.print(f"median time of a diagnosis {result.seconds:.1f} s", style="dim", highlight=False)


def _print_shares(console: Console, result: Calibration) -> None:
    table = Table(title="how often it was right, with 95 % intervals")
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
        ("wrong or incomplete, and nothing says so", result.unflagged),
        ("of the effects that begin in flight and are named, with the moment", result.timed),
    ):
        table.add_row(name, f"{share.count} of {share.of}", _share(share))
    console.print(table)


def _print_groups(console: Console, result: Calibration) -> None:
    table = Table(title="right, or in a group")
    table.add_column("by")
    table.add_column("")
    table.add_column("flights", justify="right")
    table.add_column("share", justify="right", no_wrap=True)
    for by, groups in result.by.items():
        for k, (name, share) in enumerate(groups.items()):
            table.add_row(by if k == 0 else "", name, f"{share.count} of {share.of}", _share(share))
        table.add_section()
    console.print(table)


def _print_hidden(console: Console, result: Calibration) -> None:
    table = Table(title="what became of the hidden effects")
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


def _print_coverage(console: Console, result: Calibration) -> None:
    table = Table(title="95 % intervals that hold the truth")
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


def _print_certainty(console: Console, result: Calibration) -> None:
    table = Table(title="how sure verdicts are, and how often they are right")
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
        table.add_row("", "Brier score", "", "–" if math.isnan(found.brier) else f"{found.brier:.4f}")
        table.add_section()
    console.print(table)


def _print_wrong(console: Console, result: Calibration) -> None:
    table = Table(title=f"what was wrong ({len(result.wrong)})")
    table.add_column("flight", justify="right")
    table.add_column("hidden")
    table.add_column("why")
    for wrong in result.wrong[:SHOWN]:
        table.add_row(f"{wrong.number:04d}", ", ".join(wrong.truth) or "nothing", escape(wrong.why))
    console.print(table)
    if len(result.wrong) > SHOWN:
        console.print(f"... and {len(result.wrong) - SHOWN} more in the report", style="dim")


def _share(share: Proportion) -> str:
    if share.of == 0:
        return "–"
    return f"{100 * share.share:.0f} % ({100 * share.low:.0f} to {100 * share.high:.0f})"
