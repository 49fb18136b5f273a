"""`groundstation diagnose`: which effect is missing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trueflight.groundstation.commands.options import (
    DEFAULT_STORE,
    BandwidthOption,
    EffectsOption,
    FlightsArgument,
    JsonOption,
    MappingOption,
    ModelOption,
    PerFlightOption,
    SaveOption,
    SharedOption,
    StoreOption,
    ValidateOption,
    VehicleOption,
)
from trueflight.groundstation.output.terminal import print_written, working
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command("diagnose")(diagnose_command)


def diagnose_command(
    flight: FlightsArgument,
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
    save: SaveOption = None,
    thrust: Annotated[
        str,
        typer.Option(
            "--thrust", help="command, or rotors: thrust by rotor speeds, what is beyond them is judged."
        ),
    ] = "command",
    per_flight: PerFlightOption = None,
    shared: SharedOption = None,
    healthy: Annotated[
        list[Path] | None,
        typer.Option(
            "--healthy",
            help="A flight of the same vehicle when all was well: what each rotor carries is compared.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Which effect is missing: ranked, with parameters and intervals, checked on held-out data.

    Several flights of one vehicle, in the order of time, are fitted together: what is the vehicle's is shared, wind,
    offsets of the sensor and the clock are each flight's own, and what differs is told.

    Example: groundstation diagnose identify.csv --vehicle vehicle.toml --validate validate.csv --save analysis.rrd
    """
    from trueflight.groundstation.reading.several import read_held_out, read_together

    if thrust not in ("command", "rotors"):
        raise InputError(f"--thrust {thrust}: choose command or rotors")
    flights = read_together(flight, vehicle, mapping)
    held_out = None if validate is None else read_held_out(validate, flights, vehicle, mapping)
    well = [read_held_out(path, flights, vehicle, mapping) for path in healthy or ()]

    # dear to load, and what cannot be read is told without it
    from trueflight.groundstation.evaluate.analysis import gather
    from trueflight.groundstation.identify.flights import diagnose_flights
    from trueflight.groundstation.identify.rotors import thrust_from_rotors
    from trueflight.groundstation.output.as_json import analysis_table
    from trueflight.groundstation.output.ranking import print_diagnosis
    from trueflight.groundstation.versions.choice import choose_design, choose_line

    if thrust == "rotors":
        flights = [thrust_from_rotors(one) for one in flights]
        held_out = None if held_out is None else thrust_from_rotors(held_out)
    line = choose_line(flights[0], model, store, effects)
    with working(console, "looking for missing effects", as_json) as progress:
        found = diagnose_flights(
            flights, line[-1], held_out, bandwidth, per_flight or (), shared or (), progress, well
        )
        if save is None and not as_json:
            print_diagnosis(console, found, everything, validate)
            return
        whole = gather(found, line, held_out, bandwidth, choose_design(found.flight), progress=progress)
    if save is not None:
        from trueflight.groundstation.views import write_analysis

        write_analysis(save, whole)
    if as_json:
        print_json({**analysis_table(whole), "recording": None if save is None else str(save)})
        return
    print_diagnosis(console, whole.diagnosis, everything, validate)
    print_written(console, save)
