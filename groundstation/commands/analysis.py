"""Command lines of the heart: compare, where, diagnose, model."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

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
    ValidateOption,
    VehicleOption,
)
from trueflight.groundstation.output.terminal import print_written
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.whole_file import write_whole

if TYPE_CHECKING:
    from trueflight.groundstation.evaluate.side_by_side import SideBySide
    from trueflight.models.flight import Flight
    from trueflight.models.model import Model

console = Console()
model_app = typer.Typer(no_args_is_help=True, help="Make, list, show and export model versions.")


def register(app: typer.Typer) -> None:
    """Add the analysis commands to the ground station's application."""
    app.command("compare")(compare_command)
    app.command("where")(where_command)
    app.command("diagnose")(diagnose_command)
    app.command("effects")(effects_command)
    app.add_typer(model_app, name="model")
    app.command("demo")(demo_command)


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
    from trueflight.groundstation.evaluate.compare import compare
    from trueflight.groundstation.evaluate.where import where_it_fails
    from trueflight.groundstation.output import as_json as tables_json
    from trueflight.groundstation.output.tables import print_comparisons, print_where
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.reading.several import read_together
    from trueflight.groundstation.versions.choice import choose_model
    from trueflight.groundstation.versions.store import lineage

    if len(flights) > 1 or len(model or ()) > 1:
        read = read_together(flights, vehicle, mapping)
        models = [[choose_model(f, which, store, effects) for which in model or (None,)] for f in read]
        _compare_side_by_side(read, models, bandwidth, save, output, as_json)
        return
    flight = read_flight(flights[0], vehicle, mapping)
    line = lineage(store, choose_model(flight, (model or (None,))[0], store, effects))
    results = [compare(flight, m, bandwidth) for m in line]
    where = where_it_fails(results[-1])
    if save is not None:
        from trueflight.groundstation.views import write_comparison

        write_comparison(save, results, where)
    if output is not None:
        from trueflight.groundstation.evaluate.side_by_side import side_by_side

        _write_side_by_side_report(output, side_by_side([flight], [line], bandwidth))
    if as_json:
        last = tables_json.comparison_table(results[-1])
        print_json(
            {
                **last,
                "versions": [tables_json.comparison_table(c) for c in results],
                "where": tables_json.where_table(where),
                "recording": None if save is None else str(save),
                "report": None if output is None else str(output),
            }
        )
        return
    print_comparisons(console, results)
    print_where(console, where)
    print_written(console, save, output)


def _compare_side_by_side(
    flights: list[Flight],
    models: list[list[Model]],
    bandwidth: float | None,
    save: Path | None,
    output: Path | None,
    as_json: bool,
) -> None:
    from trueflight.groundstation.evaluate.side_by_side import side_by_side
    from trueflight.groundstation.output.as_json import side_by_side_table
    from trueflight.groundstation.output.tables import print_side_by_side

    with nullcontext() if as_json else console.status("comparing"):
        beside = side_by_side(flights, models, bandwidth)
        if save is not None:
            from trueflight.groundstation.views import write_side_by_side

            write_side_by_side(save, beside)
        made = None if output is None else _write_side_by_side_report(output, beside)
    if as_json:
        print_json(
            {
                **(made or {"side_by_side": side_by_side_table(beside)}),
                "recording": None if save is None else str(save),
                "report": None if output is None else str(output),
            }
        )
        return
    print_side_by_side(console, beside)
    print_written(console, save, output)


def _write_side_by_side_report(path: Path, beside: SideBySide) -> dict[str, Any]:
    """Write the page; returns the JSON it was written from."""
    from dataclasses import asdict

    from trueflight.groundstation.evaluate.analysis import provenance
    from trueflight.groundstation.output.as_json import side_by_side_table
    from trueflight.groundstation.report import render_side_by_side, write_report

    made = provenance(*(("flight", c.flight) for c in beside.comparisons))
    table = {"side_by_side": side_by_side_table(beside), "provenance": asdict(made)}
    write_report(path, render_side_by_side(beside, table))
    return table


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
    from trueflight.groundstation.output import as_json as tables_json
    from trueflight.groundstation.output.tables import print_where
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.versions.choice import choose_model

    read = read_flight(flight, vehicle, mapping)
    result = compare(read, choose_model(read, model, store, effects), bandwidth, horizons=False)
    where = where_it_fails(result)
    if save is not None:
        from trueflight.groundstation.views import write_where

        write_where(save, result, where)
    if as_json:
        print_json({"model": result.label, "rms": result.rms, **tables_json.where_table(where)})
        return
    print_where(console, where)
    print_written(console, save, None)


def diagnose_command(
    flight: FlightArgument,
    vehicle: VehicleOption = None,
    validate: ValidateOption = None,
    mapping: MappingOption = None,
    model: ModelOption = None,
    store: StoreOption = DEFAULT_STORE,
    effects: EffectsOption = None,
    bandwidth: BandwidthOption = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Parameters of every effect, found or not.")
    ] = False,
    save: Annotated[
        Path | None,
        typer.Option("--save", "--rrd", help="Write a Rerun recording of the whole analysis here."),
    ] = None,
    thrust: Annotated[
        str,
        typer.Option(
            "--thrust", help="command, or rotors: thrust by rotor speeds, what is beyond them is judged."
        ),
    ] = "command",
    as_json: JsonOption = False,
) -> None:
    """Which effect is missing: ranked, with parameters and intervals, checked on held-out data.

    Example: groundstation diagnose identify.csv --vehicle vehicle.toml --validate validate.csv --save analysis.rrd
    """
    from trueflight.groundstation.identify.translation import diagnose
    from trueflight.groundstation.output.as_json import analysis_table, diagnosis_table
    from trueflight.groundstation.output.tables import print_diagnosis
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.reading.several import read_held_out
    from trueflight.groundstation.versions.choice import choose_design, choose_line

    read = read_flight(flight, vehicle, mapping)
    held_out = None if validate is None else read_held_out(validate, read, vehicle, mapping)
    if thrust not in ("command", "rotors"):
        raise InputError(f"--thrust {thrust}: choose command or rotors")
    if thrust == "rotors":
        from trueflight.groundstation.identify.rotors import thrust_from_rotors

        read = thrust_from_rotors(read)
        held_out = None if held_out is None else thrust_from_rotors(held_out)
    line = choose_line(read, model, store, effects)
    with nullcontext() if as_json else console.status("looking for missing effects") as status:
        progress = (lambda text: None) if status is None else status.update
        if save is None:
            result = diagnose(read, line[-1], held_out, bandwidth, progress=progress)
            table = diagnosis_table(result)
        else:
            from trueflight.groundstation.evaluate.analysis import analyse
            from trueflight.groundstation.views import write_analysis

            whole = analyse(read, line, held_out, bandwidth, choose_design(read), progress=progress)
            result, table = whole.diagnosis, {**analysis_table(whole), "recording": str(save)}
            write_analysis(save, whole)
    if as_json:
        print_json(table)
        return
    print_diagnosis(console, result, everything)
    print_written(console, save, None)


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
        bool, typer.Option("--viewer/--no-viewer", help="Open Rerun where there is a display.")
    ] = True,
) -> None:
    """The main job end to end on a simulated vehicle with a hidden effect, then on real flights.

    Example: groundstation demo --seed 7
    """
    from trueflight.groundstation.commands.demo import demonstrate, real_flights

    demonstrate(output, seed, hidden or [], console, viewer)
    if real:
        real_flights(console)


def effects_command(
    name: Annotated[str | None, typer.Argument(help="One effect, in full.")] = None,
    effects: EffectsOption = None,
    as_json: JsonOption = False,
) -> None:
    """The catalogue of effects: what each is, what excites it, what it is confounded with.

    Example: groundstation effects ground_effect
    """
    from rich.table import Table

    from trueflight.models.effects import catalogue, effect_named

    directory = None if effects is None else str(effects)
    shown = list(catalogue(directory).values()) if name is None else [effect_named(name, directory)]
    if as_json:
        print_json(
            [
                {
                    "name": e.name,
                    "title": e.title,
                    "formula": " ".join((e.formula.__doc__ or "").split()),
                    "parameters": {
                        p.name: {"unit": p.unit, "meaning": p.meaning, "low": p.low, "high": p.high}
                        for p in e.parameters
                    },
                    "needs": list(e.needs),
                    "needs_any": list(e.needs_any),
                    "seen_in": "rotation" if e.rotational else "acceleration",
                    "manoeuvre": e.manoeuvre,
                    "confounded_with": list(e.confounded_with),
                    "citation": e.citation,
                    "exports": e.exports,
                }
                for e in shown
            ]
        )
        return
    if name is not None:
        e = shown[0]
        console.print(f"[bold]{e.name}[/bold]: {e.title}")
        console.print(" ".join((e.formula.__doc__ or "").split()), highlight=False, markup=False)
        for p in e.parameters:
            unit = "" if p.unit == "1" else f" {p.unit}"
            console.print(f"  {p.name}: {p.meaning}, {p.low:g} to {p.high:g}{unit}")
        either = f"{', ' if e.needs else ''}{' or '.join(e.needs_any)}" if e.needs_any else ""
        console.print(f"needs: {', '.join(e.needs)}{either}")
        console.print(f"fly: {e.manoeuvre}")
        console.print(f"confounded with: {', '.join((*e.confounded_with, *e.aliases)) or e.unconfounded}")
        console.print(f"source: {e.citation}")
        return
    table = Table()
    table.add_column("effect", no_wrap=True)
    table.add_column("what it is")
    table.add_column("parameters")
    for e in shown:
        table.add_row(
            e.name,
            e.title,
            ", ".join(p.name if p.unit == "1" else f"{p.name} ({p.unit})" for p in e.parameters),
        )
    console.print(table)


@model_app.command("add")
def model_add(
    effect: Annotated[str, typer.Argument(help="Name of the effect: groundstation effects")],
    flight: Annotated[Path, typer.Option("--flight", help="The flight to fit to.")],
    validate: Annotated[
        Path | None, typer.Option("--validate", help="Another flight, to see the error fall on.")
    ] = None,
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    model: ModelOption = None,
    store: StoreOption = DEFAULT_STORE,
    effects: EffectsOption = None,
    bandwidth: BandwidthOption = None,
    save: SaveOption = None,
    as_json: JsonOption = False,
) -> None:
    """Add an effect: refit, write a new model version, and show the error falling.

    Example: groundstation model add rotor_drag --flight identify.csv --validate validate.csv
    """
    from trueflight.groundstation.evaluate.compare import compare, waterfall
    from trueflight.groundstation.output import as_json as tables_json
    from trueflight.groundstation.output.tables import print_waterfall
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.reading.several import read_held_out
    from trueflight.groundstation.versions.choice import choose_model
    from trueflight.groundstation.versions.store import add_effect, lineage
    from trueflight.groundstation.versions.store import save as save_version

    read = read_flight(flight, vehicle, mapping)
    held_out = None if validate is None else read_held_out(validate, read, vehicle, mapping)
    base = choose_model(read, model, store, effects)
    with nullcontext() if as_json else console.status(f"fitting {effect}"):
        made = add_effect(base, effect, [read], bandwidth)
    made, path = save_version(store, made, base if base.version else None)
    line = lineage(store, made)
    steps = waterfall(read, held_out, line, bandwidth)
    if save is not None:
        from trueflight.groundstation.views import write_before_after

        shown = read if held_out is None else held_out
        before, after = (compare(shown, m, bandwidth, horizons=False) for m in (line[0], made))
        write_before_after(save, before, after, steps)
    if as_json:
        print_json(
            {
                **tables_json.model_table(made),
                "path": str(path),
                "network_dropped": base.network is not None,
                "waterfall": tables_json.waterfall_table(steps),
                "recording": None if save is None else str(save),
            }
        )
        return
    print_waterfall(console, steps, read.name, None if held_out is None else held_out.name)
    if base.network is not None:
        console.print(
            f"v{made.version} has no network: that of v{base.version} was trained on what is left without {effect}; "
            f"train a new one with 'groundstation train FLIGHT... --model v{made.version}'",
            style="yellow",
        )
    term = made.terms[-1]
    for name, value in term.values.items():
        low, high = term.intervals[name]
        console.print(f"{effect} {name} = {value:.4g}  [{low:.4g}, {high:.4g}]")
    console.print(f"model version: {path}")
    print_written(console, save, None)


@model_app.command("list")
def model_list(
    vehicle: Annotated[str | None, typer.Argument(help="Name of the vehicle; default: all.")] = None,
    store: StoreOption = DEFAULT_STORE,
    as_json: JsonOption = False,
) -> None:
    """The versions in the store.

    Example: groundstation model list quad5
    """
    from rich.table import Table

    from trueflight.groundstation.output.as_json import model_table
    from trueflight.groundstation.output.tables import fit_rms
    from trueflight.groundstation.versions.store import versions
    from trueflight.models.model import read_model

    if not store.is_dir():
        raise InputError(
            f"{store}: no model store here; 'groundstation model add' makes one, --store DIR names another"
        )
    names = [vehicle] if vehicle else sorted(p.name for p in store.iterdir() if p.is_dir())
    models, damaged = [], []
    for path in (path for name in names for path in versions(store, name)):
        try:
            models.append(read_model(path))
        except InputError as error:
            damaged.append({"path": str(path), "error": str(error)})
    if as_json:
        print_json([*(model_table(m) for m in models), *damaged])
        return
    table = Table()
    for column in ("vehicle", "version", "from", "effects", "fit RMS m/s²", "made"):
        table.add_column(column)
    for m in models:
        parent = "linear" if m.parent is None else f"v{m.parent}"
        table.add_row(
            m.vehicle.name,
            f"v{m.version}",
            parent,
            ", ".join((*m.names(), *(() if m.network is None else (m.network.label,)))),
            f"{fit_rms(m):.3f}",
            m.created,
        )
    console.print(table)
    for one in damaged:
        console.print(escape(one["error"]), style="red", highlight=False)


@model_app.command("show")
def model_show(
    which: Annotated[str, typer.Argument(help="Version number, or the model's JSON file.")],
    vehicle: Annotated[
        str, typer.Option("--vehicle-name", help="Name of the vehicle, for a version number.")
    ] = "",
    store: StoreOption = DEFAULT_STORE,
    as_json: JsonOption = False,
) -> None:
    """One version: its effects and parameters.

    Example: groundstation model show v2 --vehicle-name quad5
    """
    from trueflight.groundstation.output.as_json import model_table
    from trueflight.groundstation.output.tables import print_model
    from trueflight.groundstation.versions.store import find

    model = find(store, vehicle or _only_vehicle(store), which)
    if as_json:
        print_json(model_table(model))
        return
    print_model(console, model)


@model_app.command("export")
def model_export(
    which: Annotated[str, typer.Argument(help="Version number, or the model's JSON file.")],
    flight: Annotated[
        list[Path],
        typer.Option(
            "--flight", help="Flight that gives training range, golden vectors and actuation. Repeatable."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The ONNX file to write.")],
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    store: StoreOption = DEFAULT_STORE,
    as_json: JsonOption = False,
) -> None:
    """Write a version as one ONNX file with its contract, ready to deploy.

    What the flights show of the rate loop goes with it: the corrected controller looks ahead over it.

    Example: groundstation model export v2 --flight identify.csv -o correction.onnx
    """
    from trueflight.groundstation.identify.actuation import actuation_of
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.versions.choice import check_vehicle
    from trueflight.groundstation.versions.store import find
    from trueflight.models.contract import model_hash
    from trueflight.models.export import export_onnx, not_exported

    flights = [read_flight(path, vehicle, mapping) for path in flight]
    model = find(store, flights[0].vehicle.name, which)
    for one in flights:
        check_vehicle(model, one)
    actuation = actuation_of(model, flights)
    data = export_onnx(model, *flights, actuation=actuation)
    write_whole(output, data, "the model", "choose another -o")
    left = not_exported(model)
    if as_json:
        print_json(
            {
                "path": str(output),
                "hash": model_hash(data),
                "bytes": len(data),
                "not_exported": list(left),
                "actuation": actuation,
            }
        )
        return
    console.print(f"{output}: {model.label}, {len(data) / 1000:.0f} kB, hash {model_hash(data)}")
    rates = (
        f"rates {1e3 * actuation['rate_delay']:.0f} ms delay and {1e3 * actuation['rate_lag']:.0f} ms lag"
        if "rate_lag" in actuation
        else "nothing of the rate loop (these flights do not show it)"
    )
    console.print(
        f"looks ahead over: thrust {1e3 * actuation['thrust_delay']:.0f} ms delay and "
        f"{1e3 * actuation['thrust_lag']:.0f} ms lag, {rates}",
        highlight=False,
    )
    if left:
        console.print(
            f"not in it, for a static correction has no memory and no sensor: {', '.join(left)}",
            style="yellow",
        )


def _only_vehicle(store: Path) -> str:
    names = sorted(p.name for p in store.iterdir() if p.is_dir()) if store.is_dir() else []
    if len(names) != 1:
        raise InputError(f"{store}: holds {len(names)} vehicles; say which with --vehicle-name")
    return names[0]
