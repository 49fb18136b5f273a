"""What the analyses look like in a terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.text import Text

from trueflight.groundstation.evaluate.side_by_side import SideBySide
from trueflight.groundstation.results import Comparison, IdentifiedVehicle, WaterfallStep, WhereItFails
from trueflight.models.effects import effect_named
from trueflight.models.flight import Flight
from trueflight.models.model import Model, Term
from trueflight.models.terminal import Table

VERDICT_STYLE = {
    "missing": "bold red",
    "possible": "yellow",
    "included": "green",
    "minor": "dim",
    "not_excited": "cyan",
    "not_supported": "dim",
}
SAID = {
    "missing": "MISSING",
    "possible": "possible",
    "included": "in the model",
    "minor": "minor",
    "not_excited": "not excited",
    "not_supported": "not supported",
}


def unit_after(unit: str) -> str:
    """A unit as it stands behind a number: with a blank before it, and nothing of '1'."""
    return "" if unit == "1" else f" {unit}"


def percent(share: float) -> str:
    """A share as people read it: 71 %, 0.4 %, < 0.1 %."""
    if 0.0 < share < 0.0005:
        return "< 0.1 %"
    return f"{100 * share:.0f} %" if share >= 0.01 or share == 0.0 else f"{100 * share:.1f} %"


def print_comparisons(console: Console, comparisons: Sequence[Comparison]) -> None:
    """Residual per axis and open-loop error, one row a model."""
    first = comparisons[0]
    table = Table(
        title=f"{first.flight.name}: measured minus predicted acceleration, RMS in m/s², heading frame, "
        f"below {first.bandwidth:g} Hz",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),  # whole on 80 columns
        pad_edge=False,
    )
    table.add_column("model", overflow="fold")
    for a in first.axes:
        table.add_column(a.axis, justify="right", no_wrap=True)
        table.add_column("expl.", justify="right", no_wrap=True)
    for h in first.horizons:
        table.add_column(f"{h.horizon:g} s", justify="right", no_wrap=True)
    for c in comparisons:
        cells = [c.label]
        for a in c.axes:
            cells += [f"{a.rms:.3f}", percent(a.share_explained)]
        cells += [f"{100 * sum(x * x for x in h.position) ** 0.5:.1f}" for h in c.horizons]
        table.add_row(*cells)
    cells = ["noise floor"]
    for a in first.axes:
        cells += [f"{a.noise_floor:.3f}", ""]
    table.add_row(*cells, *([""] * len(first.horizons)), style="dim")
    console.print(table)
    told = "expl.: share of the linear model's squared error above the noise floor that is explained"
    if first.horizons:
        told += "; times: position error in cm of an open-loop prediction that long"
    console.print(told, style="dim")
    share = float(first.used.mean())
    if share < 0.95:
        console.print(
            f"{percent(share)} of the samples count; in the others the collective command does not tell the thrust.",
            style="dim",
        )
    for note in first.flight.notes:
        console.print(f"note: {note}", style="dim")


def print_consistency(console: Console, flight: Flight) -> None:
    """Which columns of the flight agree with each other."""
    for check in flight.consistency:
        told = f"; {check.text}" if check.text else ""
        share = "" if np.isnan(check.left) else f" ({100 * check.left:.1f} % of the motion's energy apart)"
        console.print(f"{check.pair}: {check.verdict}{share}{told}", highlight=False, markup=False)


def print_where(console: Console, where: WhereItFails) -> None:
    """The regions that hold the error, and the worst moments."""
    console.print(Text("Where it fails", style="bold"))
    if not where.regions:
        console.print("  evenly: no region holds much more than its share of the error")
    for region in where.regions:
        console.print(f"  {region.text}")
    if where.worst:
        console.print(Text("Worst moments", style="bold"))
        table = Table.grid(padding=(0, 2, 0, 0))
        for whole in (True, True, False):
            table.add_column(no_wrap=whole)
        for moment in where.worst[:3]:
            table.add_row(
                f"  {moment.start:6.1f} to {moment.end:.1f} s", f"{moment.rms:.2f} m/s²", Text(moment.text)
            )
        console.print(table)


def print_waterfall(
    console: Console, steps: Sequence[WaterfallStep], fitted: str, held_out: str | None
) -> None:
    """The error falling over the model versions, with bars."""
    console.print(
        f"fitted: {fitted}" + (f"; held out: {held_out}" if held_out else ""), highlight=False, markup=False
    )
    table = Table(title="residual RMS in m/s² as effects are added")
    table.add_column("model", no_wrap=True)
    table.add_column("fitted", justify="right")
    if held_out:
        table.add_column("held out", justify="right")
    table.add_column("", no_wrap=True)
    most = max(s.fitted for s in steps)
    for s in steps:
        cells = [s.label, f"{s.fitted:.3f}"]
        if held_out:
            cells.append("" if s.held_out is None else f"{s.held_out:.3f}")
        table.add_row(*cells, Text("█" * max(1, round(24 * s.fitted / most)), style="red"))
    cells = ["noise floor", f"{steps[-1].noise_floor:.3f}"] + ([""] if held_out else [])
    table.add_row(*cells, Text("█" * round(24 * steps[-1].noise_floor / most), style="dim"), style="dim")
    console.print(table)


def print_side_by_side(console: Console, beside: SideBySide) -> None:
    """Residual per axis and open-loop error, one row a flight or model, and what each fails at."""
    first = beside.comparisons[0]
    table = Table(
        title="measured minus predicted acceleration, RMS in m/s², heading frame, "
        f"below {first.bandwidth:g} Hz",
    )
    table.add_column("", overflow="fold")
    axes = [a.axis for a in first.axes]
    for name in (*axes, "all", "change", "noise\nfloor", "position\nafter 1 s"):
        table.add_column(name, justify="right", no_wrap=True)
    for name, c, change in zip(beside.names, beside.comparisons, beside.change, strict=True):
        by_axis = {a.axis: f"{a.rms:.3f}" for a in c.axes}
        table.add_row(
            escape(name),
            *(by_axis.get(axis, "") for axis in axes),
            f"{c.rms:.3f}",
            "" if c is first else f"{100 * change:+.0f} %",
            f"{c.noise_floor:.3f}",
            f"{100 * sum(x * x for x in c.horizons[-1].position) ** 0.5:.1f} cm" if c.horizons else "",
        )
    console.print(table)
    for name, where in zip(beside.names, beside.where, strict=True):
        told = where.regions[0].text if where.regions else "evenly, no region holds much more than its share"
        console.print(f"[bold]{escape(name)}[/bold]: {escape(told)}", highlight=False)


def print_model(console: Console, model: Model) -> None:
    """One version: its effects with values and 95 % intervals, and its network."""
    made = f"made {model.created}" if model.created else "not saved"
    console.print(f"{model.label} of {model.vehicle.name}, {made}, fit RMS {fit_rms(model):.3f} m/s²")
    for term in model.terms:
        console.print(
            f"  {term.effect}  {', '.join(term_numbers(model, term))}", highlight=False, markup=False
        )
    if (n := model.network) is not None:
        console.print(
            f"  {n.label}  {n.parameters} parameters, recipe {n.recipe}, seed {n.seed}, hash {n.hash}; held-out RMS "
            f"{n.fit.get('before_rms', 0):.3f} -> {n.fit.get('validation_rms', 0):.3f} m/s² "
            f"(noise floor {n.fit.get('noise_floor', 0):.3f})",
            highlight=False,
        )
        ranges = zip(n.features, n.low, n.high, strict=True)
        told = ", ".join(f"{name} {low:.3g} to {high:.3g}" for name, low, high in ranges)
        console.print(f"  trained within {told}", highlight=False)


def term_numbers(model: Model, term: Term) -> list[str]:
    """The numbers of one of a model's effects, each with its unit and, where it was fitted, its 95 % interval."""
    units = {p.name: p.unit for p in effect_named(term.effect, model.effects_directory).parameters}
    return [
        f"{name} = {value:.4g}{unit_after(units.get(name, '1'))}"
        + (" [{:.4g}, {:.4g}]".format(*term.intervals[name]) if name in term.intervals else "")
        for name, value in term.values.items()
    ]


def fit_rms(model: Model) -> float:
    """Residual RMS of the fit, m/s²: of the network's training where there is one."""
    return model.fit.get("rms", 0.0) if model.network is None else model.network.fit.get("train_rms", 0.0)


def print_identified(console: Console, found: IdentifiedVehicle) -> None:
    """The vehicle's numbers as each flight shows them, and how well its full state is predicted."""
    for each in found.numbers:
        table = Table(title=f"{each.flight}: the vehicle's numbers")
        for head in ("number", "95 % interval", "believed", "rests on"):
            table.add_column(head, no_wrap=head != "rests on")
        for n in each.numbers:
            believed = "" if n.believed is None else f"{n.believed:.4g}"
            interval = f"{n.value:.4g} [{n.low:.4g}, {n.high:.4g}] {n.unit}"
            table.add_row(n.name, interval, believed, n.told)
        if each.numbers:
            console.print(table)
        if each.undetermined:
            console.print(f"{each.flight}: does not tell {', '.join(each.undetermined)}", highlight=False)
        explained = ", ".join(
            f"{percent(e)} about {a}" for a, e in zip(each.axes, each.explained, strict=True)
        )
        console.print(
            f"explained of the angular acceleration below {each.bandwidth:.0f} Hz ({each.source}): {explained}",
            style="dim", highlight=False,
        )  # fmt: skip
    if not found.fitted and found.held_out is None:
        console.print(
            "the full state is not predicted: it needs position, velocity, attitude and a second of flight"
        )
        return
    table = Table(title="full state predicted, mean error")
    for head in ("flight", "after", "position m", "velocity m/s", "attitude rad", "rate rad/s"):
        table.add_column(head, justify="left" if head == "flight" else "right")
    for state, name in [(f, f.flight) for f in found.fitted] + (
        [] if found.held_out is None else [(found.held_out, f"{found.held_out.flight} (held out)")]
    ):
        for e in state.errors:
            table.add_row(
                name, f"{e.horizon:g} s", f"{e.position:.3f}", f"{e.velocity:.3f}", f"{e.attitude:.3f}",
                f"{e.rate:.3f}",
            )  # fmt: skip
            name = ""
    console.print(table)
    told = f"from {found.inputs}, by {', '.join(found.model.names()) or 'the linear model'}"
    console.print(f"{told}; as in IDSIA's nano-drone benchmark", style="dim", highlight=False)
