"""`groundstation model`: versions made, listed, shown and exported."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from trueflight.groundstation.commands.correction import CORRECTIONS, ONNX, export_correction
from trueflight.groundstation.commands.elsewhere import chosen, export_elsewhere, only_vehicle
from trueflight.groundstation.commands.options import (
    DEFAULT_STORE,
    BandwidthOption,
    EffectsOption,
    JsonOption,
    MappingOption,
    ModelOption,
    PerFlightOption,
    SaveOption,
    SharedOption,
    StoreOption,
    VehicleOption,
)
from trueflight.groundstation.output.terminal import print_start, print_written, working
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.models.flight import Flight
    from trueflight.models.model import Model

console = Terminal()
model_app = typer.Typer(no_args_is_help=True, help="Make, list, show and export model versions.")


def register(app: typer.Typer) -> None:
    """Add the commands of model versions to the ground station's application."""
    app.add_typer(model_app, name="model")


@model_app.command("add")
def model_add(
    *,
    effect: Annotated[
        list[str] | None,
        typer.Argument(
            help="Names of the effects, fitted together: groundstation effects", show_default=False
        ),
    ] = None,
    flight: Annotated[
        list[Path],
        typer.Option(
            "--flight", help="The flight to fit to. Repeat for several of one vehicle, oldest first."
        ),
    ],
    missing: Annotated[
        bool, typer.Option("--missing", help="Add whatever `groundstation diagnose` calls missing.")
    ] = False,
    validate: Annotated[
        Path | None, typer.Option("--validate", help="Another flight, to see the error fall on.")
    ] = None,
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    model: ModelOption = None,
    store: StoreOption = DEFAULT_STORE,
    effects: EffectsOption = None,
    bandwidth: BandwidthOption = None,
    per_flight: PerFlightOption = None,
    shared: SharedOption = None,
    save: SaveOption = None,
    as_json: JsonOption = False,
) -> None:
    """Add effects: refit, write a new model version, and show the error falling.

    Effects that are missing together are to be added together: alone, each takes up a part of the others. From several
    flights it takes what is the vehicle's; what is each flight's own is fitted beside and left out.

    Example: groundstation model add rotor_drag --flight identify.csv --validate validate.csv
    """
    if bool(effect) == missing:
        raise InputError("name the effects to add, or pass --missing; not both")
    from trueflight.groundstation.evaluate.compare import compare, waterfall
    from trueflight.groundstation.output import as_json as tables_json
    from trueflight.groundstation.output.several_tables import print_left_out
    from trueflight.groundstation.output.tables import print_waterfall
    from trueflight.groundstation.reading.several import read_held_out, read_together
    from trueflight.groundstation.versions.choice import choose_model, choose_start
    from trueflight.groundstation.versions.several import add_effect_to
    from trueflight.groundstation.versions.store import lineage
    from trueflight.groundstation.versions.store import save as save_version

    flights = read_together(flight, vehicle, mapping)
    read = flights[-1]
    held_out = None if validate is None else read_held_out(validate, flights, vehicle, mapping)
    base = choose_model(read, model, store, effects)
    names = effect or _missing(
        flights, choose_start(read, model, store, effects), held_out, bandwidth, as_json
    )
    if not names:
        raise InputError("nothing is missing that these flights could show: there is nothing to add")
    with working(console, f"fitting {', '.join(names)}", as_json):
        told = add_effect_to(base, names, flights, bandwidth, per_flight or (), shared or ())
    made, path = save_version(store, told.model, base if base.version else None)
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
                **tables_json.left_out_table(told.left_out, told.differing),
                "over_time": {n: tables_json.over_time_table(c) for n, c in told.courses.items()},
                "waterfall": tables_json.waterfall_table(steps),
                "recording": None if save is None else str(save),
            }
        )
        return
    print_start(console, base)
    print_waterfall(console, steps, read.name, None if held_out is None else held_out.name)
    _print_added(made, base)
    for name, course in told.courses.items():
        console.print(
            f"{name} changes in this flight: {'; '.join(course.lines)}. The model keeps what holds at its end; "
            "the error above is that of the whole flight.",
            style="yellow",
            highlight=False,
        )
    print_left_out(console, told.left_out, told.differing)
    console.print(f"model version: {path}")
    print_written(console, save)


def _missing(
    flights: list[Flight], start: Model, held_out: Flight | None, bandwidth: float | None, as_json: bool
) -> list[str]:
    """What a diagnosis calls missing, and holds for the vehicle now."""
    from trueflight.groundstation.identify.flights import diagnose_flights

    with working(console, "looking for missing effects", as_json) as progress:
        found = diagnose_flights(flights, start, held_out, bandwidth, progress=progress)
    return list(found.to_add)


def _print_added(made: Model, base: Model) -> None:
    from trueflight.groundstation.output.tables import term_numbers

    added = [t for t in made.terms if t.effect not in base.names() and t.values]
    if base.network is not None:
        console.print(
            f"v{made.version} has no network: that of v{base.version} was trained on what is left without "
            f"{', '.join(t.effect for t in added)}; train a new one with "
            f"'groundstation train FLIGHT... --model v{made.version}'",
            style="yellow",
        )
    for term in added:
        for told in term_numbers(made, term):
            console.print(f"{term.effect} {told}")


@model_app.command("list")
def model_list(
    vehicle: Annotated[str | None, typer.Argument(help="Name of the vehicle; default: all.")] = None,
    store: StoreOption = DEFAULT_STORE,
    as_json: JsonOption = False,
) -> None:
    """The versions in the store.

    Example: groundstation model list quad5
    """
    from trueflight.groundstation.output.as_json import model_table
    from trueflight.groundstation.output.tables import fit_rms
    from trueflight.groundstation.versions.store import versions
    from trueflight.models.model import read_model
    from trueflight.models.terminal import Table

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
    for column in ("vehicle", "version", "from", "effects", "fit RMS\nm/s²", "made"):
        table.add_column(column, overflow="fold")
    for m in models:
        parent = "linear" if m.parent is None else f"v{m.parent}"
        table.add_row(
            m.vehicle.name,
            f"v{m.version}",
            parent,
            ", ".join((*m.names(), *(() if m.network is None else (m.network.label,)))),
            f"{fit_rms(m):.3f}",
            m.created[:16].replace("T", " "),
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

    model = find(store, vehicle or only_vehicle(store), which)
    if as_json:
        print_json(model_table(model))
        return
    print_model(console, model)


@model_app.command("export")
def model_export(
    which: Annotated[
        str,
        typer.Argument(help="Version number, or the model's JSON file; 'linear': the vehicle file alone."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The file to write.")],
    to: Annotated[
        str,
        typer.Option(
            help="onnx, for the companion; c, for an autopilot; or mujoco, rotorpy, crazyflow, gazebo, px4, px4-sih, "
            "casadi, sympy."
        ),
    ] = ONNX,
    flight: Annotated[
        list[Path] | None,
        typer.Option(
            "--flight", help="For onnx and c: gives training range, golden vectors and actuation. Repeatable."
        ),
    ] = None,
    adaptive: Annotated[
        bool, typer.Option("--adaptive", help="For onnx: numbers of it can be learnt anew in flight.")
    ] = False,
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    store: StoreOption = DEFAULT_STORE,
    name: Annotated[
        str, typer.Option("--vehicle-name", help="Name of the vehicle, for a version number.")
    ] = "",
    hover_speed: Annotated[
        float | None, typer.Option(help="Speed of the rotors in a hover, rad/s; for other simulators.")
    ] = None,
    torque_length: Annotated[
        float | None, typer.Option(help="Drag torque of a rotor over its thrust, m; for other simulators.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a version as one file: for the companion, or for another simulator, autopilot or solver.

    An ONNX file has its contract and is ready to deploy; what the flights show of the rate loop goes with it: the
    corrected controller looks ahead over it. A C header computes the same on the autopilot itself. Of the others each
    says of every effect whether it holds it.

    Examples: groundstation model export v2 --flight identify.csv -o correction.onnx; groundstation model export v2 --to
    mujoco -o vehicle.xml
    """
    if to in CORRECTIONS:
        export_correction(
            console, which, to, flight or [], output, vehicle, mapping, store, as_json, adaptive
        )
        return
    if adaptive:
        raise InputError(f"{to}: it learns nothing in flight; leave out --adaptive, or export to onnx")
    model = chosen(to, which, vehicle, name, store)
    export_elsewhere(console, model, to, output, hover_speed, torque_length, as_json)
