"""Which model and which design go with a flight: the one place that chooses, for commands and library alike."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from trueflight.groundstation.reading.ros_bag import is_ros_bag
from trueflight.groundstation.versions.store import DEFAULT_STORE, find, lineage, newest
from trueflight.models.design import Design, load_design
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.model import Model, linear_model, rigid_body_model
from trueflight.models.record import read_record
from trueflight.models.vehicle import Vehicle

DECIDES = ("mass", "hover_thrust", "thrust_model")
"""What of a vehicle a model depends on: with another value its parameters mean something else."""


def choose_model(
    flight: Flight,
    which: Model | str | int | Path | None = None,
    store: str | Path = DEFAULT_STORE,
    effects: str | Path | None = None,
) -> Model:
    """The model that `flight` is held against.

    `which` is a model, a version number (`3`, "v3"), a model's JSON file, or "linear" for the paper's linear model;
    None is the newest version of the flight's vehicle in `store`, and where there is none yet exact rotation alone.
    `effects` is a folder of the user's own effects. Raises `InputError` where there is no such version, and for a model
    of another vehicle.
    """
    directory = None if effects is None else str(effects)
    if which == "linear":
        return replace(linear_model(flight.vehicle), effects_directory=directory)
    model: Model | None
    if isinstance(which, Model):
        model = which
    elif which is None:
        model = newest(Path(store), flight.vehicle, directory)
    else:
        model = find(Path(store), flight.vehicle.name, str(which))
    if model is None:
        return rigid_body_model(flight.vehicle, directory)
    check_vehicle(model, flight)
    return replace(model, effects_directory=directory or model.effects_directory)


def choose_start(
    flight: Flight,
    which: Model | str | int | Path | None = None,
    store: str | Path = DEFAULT_STORE,
    effects: str | Path | None = None,
) -> Model:
    """The model that a diagnosis starts from: as `choose_model`, with exact rotation in any case.

    Raises `InputError` as `choose_model`, and for a network that was trained on what the linear model leaves.
    """
    model = choose_model(flight, which, store, effects)
    if model.rotates_exactly:
        return model
    if model.network is not None:
        raise InputError(
            f"the network of {model.label} was trained beside the linear model, and diagnosis starts from exact "
            "rotation; pass --model with a version that has rigid_body, or --model linear"
        )
    return rigid_body_model(flight.vehicle, model.effects_directory)


def choose_line(
    flight: Flight,
    which: Model | str | int | Path | None = None,
    store: str | Path = DEFAULT_STORE,
    effects: str | Path | None = None,
) -> list[Model]:
    """As `choose_start`, with the models that led to it: the linear one first, the chosen one last."""
    return lineage(Path(store), choose_start(flight, which, store, effects))


def choose_design(flight: Flight, given: str | Path | None = None) -> Design | None:
    """The design that `flight` was flown by: the file `given`, else that of its record, else None.

    Raises `InputError` for a file that is no design of the flight's vehicle.
    """
    if given is not None:
        return load_design(given, flight.vehicle)
    record = Path(flight.origin)
    if record.suffix.lower() != ".mcap" or is_ros_bag(record):
        return None
    return read_record(record, ticks=False).design


def design_to_fly(vehicle: Vehicle, flight: Flight | None = None, given: str | Path | None = None) -> Design:
    """The design that a vehicle will fly by: the file `given`, else that of the record `flight`, else design.json
    beside the vehicle file. Raises `InputError` where there is none."""
    if given is not None:
        return load_design(given, vehicle)
    if flight is not None and (recorded := choose_design(flight)) is not None:
        return recorded
    beside = Path(vehicle.source).with_name("design.json") if vehicle.source else Path("design.json")
    if not beside.is_file():
        make = f"groundstation design {vehicle.source or 'VEHICLE'} -o {beside}"
        raise InputError(
            f"{beside}: no design to predict the flight by; make one ({make}), or pass --design FILE"
        )
    return load_design(beside, vehicle)


def check_vehicle(model: Model, flight: Flight) -> None:
    """Raise `InputError` where a model was made for another vehicle than the one that flew."""
    if model.vehicle.name != flight.vehicle.name:
        raise InputError(
            f"{model.label} was made for vehicle '{model.vehicle.name}', the flight {flight.name} is of "
            f"'{flight.vehicle.name}'; pass another --model or --vehicle"
        )
    for name in DECIDES:
        if getattr(model.vehicle, name) != getattr(flight.vehicle, name):
            raise InputError(
                f"{model.label} was made for {name} = {getattr(model.vehicle, name)}, "
                f"{flight.vehicle.source or 'the flight'} "
                f"says {getattr(flight.vehicle, name)}; make a new model, or pass the vehicle file it was made with"
            )
