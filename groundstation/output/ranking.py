"""What a diagnosis looks like in a terminal of any width: what is missing first, then the figures, then what to do."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.text import Text

from trueflight.groundstation.output.several_tables import print_several
from trueflight.groundstation.output.tables import SAID, VERDICT_STYLE, percent, unit_after
from trueflight.groundstation.output.terminal import print_start
from trueflight.groundstation.results import Diagnosis, EffectVerdict, Gusts
from trueflight.models.effects import effect_named
from trueflight.models.errors import InputError
from trueflight.models.terminal import Table

SHOWN = ("missing", "possible")
"""Verdicts that are always told in full."""


def print_diagnosis(
    console: Console, d: Diagnosis, everything: bool = False, validate: Path | None = None
) -> None:
    """The ranking of effects, the residual before and after, and the next step as a command that can be pasted; with
    `everything` all that was looked for. `validate` is the held-out flight's file."""
    console.print(Text(_headline(d), style="bold" if d.named("missing") else "bold green"))
    print_start(console, d.base)
    _print_effects(console, d, everything)
    _print_figures(console, d)
    for names in d.alternatives:
        console.print(f"As well explained by {' with '.join(names)}", style="yellow", highlight=False)
    if d.gusts is not None:
        console.print(_gusts(d.gusts), style="yellow", highlight=False)
    if d.unexplained.verdict:
        console.print(
            f"Unexplained: {percent(d.unexplained.variance_share)} of what is left is more than noise and fits no "
            f"known effect: {'; '.join(d.unexplained.where)}. More: "
            f"groundstation remainder {shlex.quote(d.flight.origin or d.flight.name)}",
            style="yellow",
            highlight=False,
        )
    for note in d.flight.notes:
        console.print(f"note: {escape(note)}", style="dim")
    if not everything:
        _print_rest(console, d)
    if command := next_command(d, validate):
        console.print(f"[bold]next:[/bold] {escape(command)}", highlight=False, soft_wrap=True)


def next_command(d: Diagnosis, validate: Path | None = None) -> str:
    """The command that adds what is missing to the model, with the user's own files; '' where nothing is to be
    added."""
    flights = [f.flight for f in d.flights] or [d.flight]
    if not d.to_add or not all(f.origin for f in flights):
        return ""
    words = ["groundstation", "model", "add", *d.to_add]
    for flight in flights:
        words += ["--flight", flight.origin]
    source = d.flight.vehicle.source
    if Path(source).is_file():  # a record has it inside
        words += ["--vehicle", source]
    if validate is not None:
        words += ["--validate", str(validate)]
    return shlex.join(words)


def _headline(d: Diagnosis) -> str:
    name = d.flight.name if not d.flights else f"{len(d.flights)} flights of {d.flight.vehicle.name}"
    ended = {
        e.name: e.over_time for e in d.effects if e.verdict == "missing" and e.over_time and e.over_time.ended
    }
    missing = [n for n in d.named("missing") if n not in ended]
    was = [f"{n} was until {course.changes[-1].time:.1f} s" for n, course in ended.items()]
    possible = d.named("possible")
    if missing:
        return f"{name}: {', '.join([' and '.join(missing) + ' missing', *was])}"
    if was:
        return f"{name}: nothing is missing at its end; {', '.join(was)}"
    if possible:
        return f"{name}: nothing is surely missing, {' or '.join(possible)} may be"
    return f"{name}: nothing is missing that this flight could show"


def _print_effects(console: Console, d: Diagnosis, everything: bool) -> None:
    """One block an effect: its verdict beside what it is, how sure, how much."""
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for e in d.effects:
        if everything or e.verdict in SHOWN:
            table.add_row(
                Text(SAID[e.verdict], style=VERDICT_STYLE[e.verdict]), Text("\n").join(_block(d, e))
            )
    if table.row_count:
        console.print(table)


def _block(d: Diagnosis, e: EffectVerdict) -> Iterator[Text]:
    figures = [f"{percent(e.variance_share)} of the error"] if e.rank else []
    if e.confidence is not None:
        figures.append(f"sure {'over 99 %' if e.confidence > 0.99 else percent(e.confidence)}")
    yield Text.assemble(
        (e.name, "bold"), f" ({_title(d, e.name)})", f": {', '.join(figures)}" if figures else ""
    )
    if e.verdict != "included":
        yield from map(Text, _numbers(e))
    if e.indistinguishable_from:
        yield Text(f"not told from {', '.join(e.indistinguishable_from)}", style="yellow")
    if e.rests_on:
        yield Text(e.rests_on, style="dim")
    advice = e.advice.removeprefix("add it to the model").removeprefix("; ")
    if advice and not advice.startswith("no flight can tell it from"):  # told above
        yield Text(advice, style="dim")


def _title(d: Diagnosis, name: str) -> str:
    try:
        return effect_named(name, d.base.effects_directory).title
    except InputError:
        return "an effect of your own"


def _numbers(e: EffectVerdict) -> list[str]:
    if e.over_time is not None:
        return list(e.over_time.lines)
    told = [
        f"{p.name} not determined"
        if p.name in e.undetermined
        else f"{p.name} = {p.value:.3g}{unit_after(p.unit)}  [{p.low:.3g}, {p.high:.3g}]"
        for p in e.parameters
        if not p.flight
    ]
    own = dict.fromkeys(p.name for p in e.parameters if p.flight)
    told += [f"{', '.join(own)}: each flight's own"] if own else []
    several = any(p.flight for p in e.parameters)
    products = [p for p in e.products if not several or "@" not in p.name]
    return told + [f"{p.name} = {p.value:.3g}  [{p.low:.3g}, {p.high:.3g}]" for p in products]


def _gusts(g: Gusts) -> str:
    a, tau = g.acceleration, g.time_constant
    speed = "" if g.speed is None else f", {g.speed:.1f} m/s through the drag that was found"
    return (
        f"Gusts: {a.value:.2g} m/s² [{a.low:.2g}, {a.high:.2g}] RMS on each horizontal axis{speed}, "
        f"with a time constant of {tau.value:.1f} s [{tau.low:.1f}, {tau.high:.1f}]"
    )


def _print_figures(console: Console, d: Diagnosis) -> None:
    """The residual before and after, seen in the acceleration, in the rotation and in the rotors."""
    line = f"residual {d.rms_before:.3f} -> {d.rms_after:.3f} m/s² (noise floor {d.noise_floor:.3f})"
    if d.validation_before is not None and d.validation_after is not None:
        line += f"; held-out flight {d.validation_before:.3f} -> {d.validation_after:.3f} m/s²"
    console.print(Text(line, style="bold"))
    if d.flights:
        print_several(console, d)
    for remark in d.remarks:
        console.print(remark, style="yellow", highlight=False)
    if d.rotational is not None:
        r = d.rotational
        told = (
            f"angular acceleration {r.before:.3f} -> {r.after:.3f} rad/s² (noise floor {r.noise_floor:.3f})"
        )
        if r.source == "attitude":
            told += f", from the attitude, which holds up to {r.bandwidth:.1f} Hz: no gyroscope was logged"
        console.print(told, highlight=False)
    if d.shares is not None:
        carried = " ".join(f"{100 * x:.1f}" for x in d.shares.shares)
        told = f"each rotor's part of the thrust, %: {carried}"
        told += f"; {d.shares.told}" if d.shares.told else ""
        console.print(told, style="yellow" if d.shares.rotor else "", highlight=False)


def _print_rest(console: Console, d: Diagnosis) -> None:
    """What was not found, in one line."""
    told = [
        f"{SAID[verdict]}: {', '.join(d.named(verdict))}"
        for verdict in ("minor", "not_excited")
        if d.named(verdict)
    ]
    count = len(d.named("not_supported"))
    told += [f"looked for and not there: {count} more"] if count else []
    if told:
        console.print(f"{'; '.join(told)} (--all tells of each)", style="dim", highlight=False)
