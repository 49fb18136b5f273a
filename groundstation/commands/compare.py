"""`groundstation compare` and `where`: models against flights."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trueflight.groundstation.commands.options import (
    DEFAULT_STORE,
    BandwidthOption,
    EffectsOption,
    FlightArgument,
    JsonOption,
    MappingOption,
    ModelOption,
    ModelsOption,
    SaveOption,
    StoreOption,
    VehicleOption,
)
from trueflight.groundstation.output.terminal import print_start, print_written, working
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.models.flight import Flight
    from trueflight.models.model import Model

console = Terminal()
AGAINST = "held against"


def register(app: typer.Typer) -> None:
    """Add these commands to the ground station's application."""
    app.command("compare")(compare_command)
    app.command("where")(where_command)


def compare_command(
    flights: Annotated[
        list[Path],
        typer.Argument(help="A flight, or several to compare: CSV, Parquet, MCAP record or PX4 ULog."),
    ],
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    model: ModelsOption = None,
    store: StoreOption = DEFAULT_STORE,
    effects: EffectsOption = None,
    bandwidth: BandwidthOption = None,
    save: SaveOption = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write an HTML report of the comparison here.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Model against measurement: residual per axis, noise floor, share explained, open-loop error.

    One flight: the linear model, and every version that led to the newest (or to --model). Several flights, or
    --model repeated: side by side, over the same bins.

    Example: groundstation compare before.csv after.csv --save compare.rrd -o compare.html
    """
    from trueflight.groundstation.reading.several import read_together

    read = read_together(flights, vehicle, mapping)

    # dear to load, and what cannot be read is told without it
    from trueflight.groundstation.versions.choice import choose_model
    from trueflight.groundstation.versions.store import lineage

    models = [[choose_model(f, which, store, effects) for which in model or (None,)] for f in read]
    if len(read) > 1 or len(models[0]) > 1:
        _side_by_side(read, models, bandwidth, save, output, as_json)
    else:
        _one_flight(read[0], lineage(store, models[0][0]), bandwidth, save, output, as_json)


def _one_flight(
    flight: Flight,
    line: list[Model],
    bandwidth: float | None,
    save: Path | None,
    output: Path | None,
    as_json: bool,
) -> None:
    """One flight against every model of a line."""
    from trueflight.groundstation.evaluate.compare import compare
    from trueflight.groundstation.evaluate.side_by_side import side_by_side
    from trueflight.groundstation.evaluate.where import where_it_fails
    from trueflight.groundstation.output.as_json import beside_table, comparison_table, where_table
    from trueflight.groundstation.output.tables import print_comparisons, print_where

    results = [compare(flight, m, bandwidth) for m in line]
    where = where_it_fails(results[-1])
    if save is not None:
        from trueflight.groundstation.views import write_comparison

        write_comparison(save, results, where)
    if output is not None:
        from trueflight.groundstation.report import render_side_by_side, write_report

        beside = side_by_side([flight], [line], bandwidth)
        write_report(output, render_side_by_side(beside, beside_table(beside)))
    if as_json:
        print_json(
            {
                **comparison_table(results[-1]),
                "versions": [comparison_table(c) for c in results],
                "where": where_table(where),
                **_written(save, output),
            }
        )
        return
    print_start(console, line[-1], AGAINST)
    print_comparisons(console, results)
    print_where(console, where)
    print_written(console, save, output)


def _side_by_side(
    flights: list[Flight],
    models: list[list[Model]],
    bandwidth: float | None,
    save: Path | None,
    output: Path | None,
    as_json: bool,
) -> None:
    """Several flights, or models, beside each other."""
    from trueflight.groundstation.evaluate.side_by_side import side_by_side
    from trueflight.groundstation.output.as_json import beside_table
    from trueflight.groundstation.output.tables import print_side_by_side

    with working(console, "comparing", as_json):
        beside = side_by_side(flights, models, bandwidth)
        table = beside_table(beside)
        if save is not None:
            from trueflight.groundstation.views import write_side_by_side

            write_side_by_side(save, beside)
        if output is not None:
            from trueflight.groundstation.report import render_side_by_side, write_report

            write_report(output, render_side_by_side(beside, table))
    if as_json:
        print_json({**table, **_written(save, output)})
        return
    for name, model in _which(beside.names, [model for its in models for model in its]):
        print_start(console, model, f"{name}{AGAINST}")
    print_side_by_side(console, beside)
    if told := _how_flown(flights):
        console.print(told, style="yellow", highlight=False, markup=False)
    print_written(console, save, output)


def _which(names: Sequence[str], models: Sequence[Model]) -> Iterator[tuple[str, Model]]:
    """What each is held against, behind its name; one for all behind none."""
    if all(model == models[0] for model in models):
        yield "", models[0]
        return
    for name, model in zip(names, models, strict=True):
        yield f"{name}: ", model


def _how_flown(flights: Sequence[Flight]) -> str:
    """That flights by different controllers are compared by what they track: a better one leaves the model as it is."""
    from trueflight.groundstation.reading.listing import controller_of

    flown = [controller_of(flight) for flight in flights]
    if len(set(flown)) < 2 or not all(flown):
        return ""
    return (
        f"flown by {', '.join(flown)}: these errors are the model's, not the controllers'. How near each flight came "
        f"to the linear behaviour: {shlex.join(['groundstation', 'track', *(f.origin for f in flights)])}"
    )


def _written(save: Path | None, output: Path | None) -> dict[str, Any]:
    return {
        "recording": None if save is None else str(save),
        "report": None if output is None else str(output),
    }


def where_command(
    flight: FlightArgument,
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    model: ModelOption = None,
    store: StoreOption = DEFAULT_STORE,
    effects: EffectsOption = None,
    bandwidth: BandwidthOption = None,
    save: SaveOption = None,
    as_json: JsonOption = False,
) -> None:
    """Where a model fails: the residual against height, speed, tilt, thrust, voltage, time and place.

    Example: groundstation where identify.csv --vehicle vehicle.toml --save where.rrd
    """
    from trueflight.groundstation.evaluate.compare import compare
    from trueflight.groundstation.evaluate.where import where_it_fails
    from trueflight.groundstation.output.as_json import where_table
    from trueflight.groundstation.output.tables import print_where
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.versions.choice import choose_model

    read = read_flight(flight, vehicle, mapping)
    chosen = choose_model(read, model, store, effects)
    result = compare(read, chosen, bandwidth, horizons=False)
    where = where_it_fails(result)
    if save is not None:
        from trueflight.groundstation.views import write_where

        write_where(save, result, where)
    if as_json:
        table = {"model": result.label, "rms": result.rms, **where_table(where)}
        print_json({**table, "recording": None if save is None else str(save)})
        return
    print_start(console, chosen, AGAINST)
    print_where(console, where)
    print_written(console, save, None)
