"""`groundstation identify`: the numbers of the vehicle, and its full state predicted."""

from __future__ import annotations

from typing import Annotated

import typer

from trueflight.groundstation.commands.options import (
    DEFAULT_STORE,
    EffectsOption,
    FlightsArgument,
    JsonOption,
    MappingOption,
    ModelOption,
    StoreOption,
    ValidateOption,
    VehicleOption,
)
from trueflight.groundstation.output.terminal import print_start, working
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command(
        "identify",
        epilog="Example: groundstation identify flight.csv --vehicle vehicle.toml --validate another.csv",
    )(identify_command)


def identify_command(
    flights: FlightsArgument,
    vehicle: VehicleOption = None,
    validate: ValidateOption = None,
    mapping: MappingOption = None,
    model: ModelOption = None,
    store: StoreOption = DEFAULT_STORE,
    effects: EffectsOption = None,
    inputs: Annotated[
        str,
        typer.Option(
            "--inputs", help="What predicts the rotation: motors or commands; default: what is logged."
        ),
    ] = "",
    as_json: JsonOption = False,
) -> None:
    """Inertia, torque constant and rotor lag with intervals; the full state predicted from what was sent.

    Thrust and forces are those of --model, or of what `diagnose` finds in the flights; the rotation is fitted to them.
    Errors are means over all starts, as in IDSIA's nano-drone benchmark; those of --validate are of a flight that no
    fit has seen.
    """
    from trueflight.groundstation.evaluate.vehicle_model import identified
    from trueflight.groundstation.output.as_json import identified_table
    from trueflight.groundstation.output.tables import print_identified
    from trueflight.groundstation.reading.several import read_held_out, read_together
    from trueflight.groundstation.versions.choice import choose_start

    if inputs not in ("", "motors", "commands"):
        raise InputError(f"--inputs {inputs}: choose motors or commands")
    read = read_together(flights, vehicle, mapping)
    held_out = None if validate is None else read_held_out(validate, read, vehicle, mapping)
    start = choose_start(read[0], model, store, effects)
    with working(console, "identifying the vehicle", as_json) as progress:
        found = identified(read, start, held_out, inputs, find=model is None, progress=progress)
    if as_json:
        print_json(identified_table(found))
        return
    print_start(console, start)
    print_identified(console, found)
