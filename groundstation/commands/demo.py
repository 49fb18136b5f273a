"""`groundstation demo`: the main job end to end, and what came of it."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trueflight.models.shipped import QUAD5
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.groundstation.results import Comparison, Diagnosis, WaterfallStep, WhereItFails
    from trueflight.groundstation.study.demonstration import Outcome

console = Terminal()
LINE = 100
"""Most columns of the line above a step."""
# Resolved: the samples lie beside the folders, not beside the links to them.
SAMPLES = Path(__file__).resolve().parents[2] / "samples" / "crazyflie"


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command("demo")(demo_command)


def demo_command(
    seed: Annotated[int, typer.Option("--seed", help="Draws the hidden effect and the noise.")] = 7,
    hidden: Annotated[
        list[str] | None, typer.Option("--hidden", help="Hide this effect instead of a drawn one.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for everything it makes.")] = Path(
        "out/demo"
    ),
    real: Annotated[bool, typer.Option("--real/--no-real", help="Also analyse real flights.")] = True,
    viewer: Annotated[
        bool, typer.Option("--viewer/--no-viewer", help="End with the workbench where there is a display.")
    ] = True,
) -> None:
    """The main job end to end on a simulated vehicle with a hidden effect, then on real flights.

    Example: groundstation demo --seed 7
    """
    from trueflight.groundstation.operate.processes import has_display
    from trueflight.groundstation.study.demonstration import demonstrate

    audience = _Terminal()
    outcome = demonstrate(output, QUAD5, seed, hidden or [], audience)
    audience.step("Before and after", str(output))
    _print_outcome(outcome)
    if real:
        show_real_flights()
    survey, task = (output / f"{name}-lqr.mcap" for name in ("excitation", "lemniscate"))
    again = ["groundstation", "open", survey, "--validate", task, "--store", output / "workbench-models"]
    console.print(
        f"do it yourself in the browser: {shlex.join(map(str, again))}", highlight=False, soft_wrap=True
    )
    if viewer and has_display() and sys.stdout.isatty():
        from trueflight.groundstation.commands.open import open_command

        open_command([survey], validate=task, store=output / "workbench-models", folder=output / "workbench")


def show_real_flights() -> bool:
    """What is found in the real flights of the repository; False, and one line, where an installation lacks them."""
    from trueflight.groundstation.study.demonstration import REAL, real_flights

    if not all((SAMPLES / file).is_file() for file, _ in REAL):
        console.print(
            "No real flights: samples/crazyflie is in the repository, not in this installation. For a flight of your "
            "own: groundstation diagnose FLIGHT",
            highlight=False,
            soft_wrap=True,
        )
        return False
    audience = _Terminal()
    audience.step("Real flights of Crazyflies", "groundstation diagnose samples/crazyflie/...")
    _print_real(real_flights(SAMPLES, audience))
    return True


class _Terminal:
    """The audience of a demonstration: a terminal."""

    def step(self, title: str, command: str) -> None:
        """A heading, and below it the command that does the same, whole on its line."""
        console.print("\n" + "─" * min(console.width, LINE), style="dim")
        console.print(title, style="bold", highlight=False, markup=False)
        console.print(command, style="dim", highlight=False, markup=False, soft_wrap=True)

    def busy(self, text: str) -> AbstractContextManager[object]:
        """A line that goes away."""
        return console.status(text)

    def said(self, text: str, warning: bool = False) -> None:
        """A line."""
        console.print(text, style="yellow" if warning else None, highlight=warning)

    def compared(self, comparisons: Sequence[Comparison], where: WhereItFails) -> None:
        """The tables of `compare`."""
        from trueflight.groundstation.output.tables import print_comparisons, print_where

        print_comparisons(console, comparisons)
        print_where(console, where)

    def diagnosed(self, diagnosis: Diagnosis, held_out: Path) -> None:
        """The tables of `diagnose`."""
        from trueflight.groundstation.output.ranking import print_diagnosis

        print_diagnosis(console, diagnosis, validate=held_out)

    def fell(self, steps: tuple[WaterfallStep, ...], fitted: str, held_out: str) -> None:
        """The table of `model add`."""
        from trueflight.groundstation.output.tables import print_waterfall

        print_waterfall(console, steps, fitted, held_out)


def _print_outcome(o: Outcome) -> None:
    from trueflight.models.terminal import Table

    table = Table(show_header=True)
    for column, side in (
        ("error", "left"),
        ("unit", "left"),
        ("before", "right"),
        ("after", "right"),
        ("", "right"),
    ):
        table.add_column(column, justify=side)  # type: ignore[arg-type]
    d = o.diagnosis

    def row(what: str, unit: str, before: float, after: float) -> None:
        ratio = f"÷ {before / after:.1f}" if before >= after else f"× {after / before:.1f}"
        table.add_row(what, unit, f"{before:.3g}", f"{after:.3g}", ratio)

    row("model, fitted flight (residual RMS)", "m/s²", d.rms_before, d.rms_after)
    table.add_row("  of which sensor noise", "m/s²", "", f"{d.noise_floor:.3g}", "", style="dim")
    if d.validation_before is not None and d.validation_after is not None:
        row("model, held-out flight (residual RMS)", "m/s²", d.validation_before, d.validation_after)
    for b, a in zip(o.before.horizons[-1:], o.after.horizons[-1:], strict=True):
        row(
            f"open-loop position after {b.horizon:g} s",
            "m",
            sum(x * x for x in b.position) ** 0.5,
            sum(x * x for x in a.position) ** 0.5,
        )
    lqr, corrected = o.tracking
    for i, axis in enumerate("xyz"):
        row(f"tracking the linear behaviour, {axis} (MSE)", "m²", lqr.mse[i], corrected.mse[i])
    console.print(table)
    found = d.named("missing") or d.named("possible")
    console.print(
        f"found: [bold]{', '.join(found) or 'nothing missing'}[/bold]; hidden was: {o.revealed}",
        highlight=False,
    )
    for note in corrected.flight.notes:
        if note.startswith("correction"):
            console.print(f"the corrected flight: {note}", style="yellow", highlight=False)
    console.print(
        f"Rerun recordings: {' '.join(str(p) for p in o.recordings)}", highlight=False, soft_wrap=True
    )
    console.print(f"{o.seconds:.0f} s", style="dim")


def _print_real(found: Iterable[tuple[str, Diagnosis]]) -> None:
    from trueflight.groundstation.output.tables import SAID, percent
    from trueflight.models.terminal import Table

    table = Table()
    for column in ("flight, and what is known", "found", "share", "parameters, 95 % interval"):
        table.add_column(column, no_wrap=column == "found", justify="right" if column == "share" else "left")
    for known, result in found:
        name = (
            f"{result.flight.name}: {known}\nresidual {result.rms_before:.2f} -> {result.rms_after:.3f} m/s²"
        )
        for e in (e for e in result.effects if e.rank):
            values = "\n".join(
                f"{p.name} = {p.value:.3g} [{p.low:.3g}, {p.high:.3g}] {p.unit}" for p in e.parameters
            )
            effect = e.name if e.verdict == "missing" else f"{e.name} ({SAID[e.verdict]})"
            table.add_row(
                name, effect, percent(e.variance_share), values.replace(" 1\n", "\n").removesuffix(" 1")
            )
            name = ""
        table.add_section()
    console.print(table)
