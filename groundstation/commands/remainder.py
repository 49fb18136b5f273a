"""`groundstation remainder`: what no effect of the catalogue explains, and a file that makes an effect of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trueflight.groundstation.commands.options import (
    DEFAULT_STORE,
    BandwidthOption,
    EffectsOption,
    FlightArgument,
    JsonOption,
    MappingOption,
    ModelOption,
    StoreOption,
    VehicleOption,
)
from trueflight.groundstation.output.terminal import print_start, working
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.groundstation.results import Diagnosis, Unexplained

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command(
        "remainder", epilog="Example: groundstation remainder flight.mcap --write effects --name side_force"
    )(remainder_command)


def remainder_command(
    flight: FlightArgument,
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    model: ModelOption = None,
    store: StoreOption = DEFAULT_STORE,
    effects: EffectsOption = None,
    bandwidth: BandwidthOption = None,
    write: Annotated[
        Path | None, typer.Option("--write", help="Folder for the formula, as an effect of your own.")
    ] = None,
    name: Annotated[str, typer.Option("--name", help="Name of that effect.")] = "remainder",
    as_json: JsonOption = False,
) -> None:
    """What is left after every effect that the flight supports: where, when, which frequency, and a short formula.

    `--write` makes the formula an effect: `groundstation model add NAME --effects DIR` takes it.
    """
    from trueflight.groundstation.identify.sparse import effect_source
    from trueflight.groundstation.identify.translation import diagnose
    from trueflight.groundstation.output.as_json import remainder_table
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.versions.choice import choose_start
    from trueflight.groundstation.versions.effect_file import write_effect_file

    read = read_flight(flight, vehicle, mapping)
    base = choose_start(read, model, store, effects)
    with working(console, "explaining what can be explained", as_json):
        result = diagnose(read, base, bandwidth=bandwidth)
    left, path = result.unexplained, None
    if write is not None:
        if left.formula is None:
            raise InputError(
                f"{read.name}: no short formula holds what is left; "
                + (
                    left.advice
                    or f"{result.rms_after:.3f} m/s² are left, over a noise floor of {result.noise_floor:.3f}"
                )
            )
        source = effect_source(left.formula, name, read.name, read.data_hash)
        path = write_effect_file(name, source, write)
    if as_json:
        print_json(remainder_table(result, path))
        return
    _print(left, result, path, flight)


ABOVE_NOISE = 1.25
"""Times the noise up to which what is left may be noise alone: the noise is known to about a quarter."""


def _print(left: Unexplained, d: Diagnosis, path: Path | None, flight: Path) -> None:
    from trueflight.groundstation.identify.sparse import written
    from trueflight.groundstation.output.tables import percent
    from trueflight.models.terminal import Table

    print_start(console, d.base)
    console.print(
        f"{d.flight.name}: explained by {', '.join(d.model.names())}; left are {d.rms_after:.3f} m/s² "
        f"(noise floor {d.noise_floor:.3f})",
        highlight=False,
    )
    if not left.verdict:
        beyond = d.rms_after > ABOVE_NOISE * d.noise_floor
        told = (
            f"{d.rms_after / d.noise_floor:.1f} times the noise, and "
            if beyond and d.noise_floor > 0.0
            else ""
        )
        console.print(
            f"{told}nothing in it can be predicted", style="bold yellow" if beyond else "bold green"
        )
    else:
        chance = (
            f"by chance with a probability of at most {left.p_value:.2g}"
            if left.p_value < 0.05
            else "too short a flight to rule out chance"
        )
        console.print(
            f"none of these explains the rest: {percent(left.variance_share)} of it can be predicted on held-out parts "
            f"({chance})",
            style="bold yellow",
        )
    for text in left.where:
        console.print(f"  {text}", highlight=False)
    if left.axes:
        shares = ", ".join(f"{axis} {percent(share)}" for axis, share in left.axes.items())
        console.print(f"  body axes: {shares}", highlight=False)
    for start, end, share in left.moments:
        console.print(f"  {start:6.1f} to {end:.1f} s  {percent(share)} of it", highlight=False)
    if left.lines:
        table = Table(title="lines of the spectrum")
        for column in ("Hz", "axis", "RMS m/s²", "what it may be"):
            table.add_column(column, justify="left" if column.startswith(("a", "w")) else "right")
        for line in left.lines:
            table.add_row(f"{line.frequency:.2f}", line.axis, f"{line.rms:.3f}", line.text)
        console.print(table)
    if left.formula is not None:
        console.print("[bold]formula[/bold], body axes", highlight=False)
        for t in left.formula.terms:
            unit = "" if t.unit == "1" else f" {t.unit}"
            console.print(
                f"  a_{t.axis}: {t.coefficient:.4g}{unit} times {written(t.term)}   95 %: {t.low:.4g} to {t.high:.4g}",
                highlight=False,
            )
    if path is not None:
        console.print(f"{path}: add it with", highlight=False)
        console.print(
            f"  groundstation model add {path.stem} --flight {flight} --effects {path.parent}",
            highlight=False,
        )
    elif left.advice:
        console.print(left.advice.replace("FLIGHT", str(flight)), highlight=False)
