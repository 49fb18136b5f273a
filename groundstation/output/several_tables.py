"""What several flights of one vehicle say together, in a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.markup import escape

from trueflight.groundstation.results import Diagnosis, ParameterEstimate, SharedNumber
from trueflight.models.terminal import Table


def print_several(console: Console, d: Diagnosis) -> None:
    """Each flight's residual and own numbers, and the vehicle's numbers that differ between the flights."""
    table = Table(title="each flight")
    table.add_column("flight", overflow="fold")
    table.add_column("m/s²", justify="right", no_wrap=True)
    table.add_column("noise\nfloor", justify="right", no_wrap=True)
    table.add_column("its own numbers, 95 % interval")
    for f in d.flights:
        own = [
            f"{e.name} {p.name} not determined"
            if f"{p.name}@{p.flight}" in e.undetermined
            else f"{e.name} {told(p)}"
            for e in d.effects
            if e.verdict in ("missing", "possible")
            for p in e.parameters
            if p.flight == f.flight.name
        ]
        table.add_row(
            escape(f.flight.name),
            f"{f.rms_before:.3f} -> {f.rms_after:.3f}",
            f"{f.noise_floor:.3f}",
            "\n".join(own),
        )
    console.print(table)
    for number in d.differing:
        console.print(escape(difference(number)), style="bold yellow", highlight=False)
    same = [f"{n.effect} {n.parameter}" for n in d.shared if not n.differs]
    if same:
        console.print(f"[dim]The same in all flights:[/dim] {', '.join(same)}", highlight=False)
    if d.set_aside:
        console.print(
            f"[dim]Each flight's own, and no part of the vehicle's model:[/dim] {', '.join(d.set_aside)}",
            highlight=False,
        )


def print_left_out(
    console: Console,
    left_out: Mapping[str, Sequence[ParameterEstimate]],
    differing: Sequence[SharedNumber],
) -> None:
    """What a model of the vehicle did not take from several flights."""
    for effect, numbers in left_out.items():
        own = "; ".join(f"{p.flight} {told(p)}" for p in numbers)
        console.print(
            f"left out, for it is each flight's own: {effect} ({escape(own)})",
            style="yellow",
            highlight=False,
        )
    for number in differing:
        console.print(
            f"{escape(difference(number))}; the version has it as in the last flight",
            style="yellow",
            highlight=False,
        )


def difference(n: SharedNumber) -> str:
    """One number that is not the same in all flights, with the flights that disagree."""
    evidence = f"likelihood ratio {n.ratio:.0f}, p {max(n.p_value, 1e-99):.1g}"
    values = {v.flight: v for v in n.values}
    apart = "; ".join(f"{name}: {told(values[name])}" for name in n.apart)
    if n.common is None:
        return f"{n.effect} {n.parameter} differs from flight to flight: {apart} ({evidence})"
    return f"{n.effect} {n.parameter} differs: {apart}; all others: {told(n.common)} ({evidence})"


def told(p: ParameterEstimate) -> str:
    """A number with its interval."""
    unit = "" if p.unit == "1" else f" {p.unit}"
    return f"{p.name} = {p.value:.3g}{unit}  [{p.low:.3g}, {p.high:.3g}]"
