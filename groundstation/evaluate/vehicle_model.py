"""A vehicle identified from its flights: its numbers, a model that predicts its full state, and how far it does."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from trueflight.groundstation.evaluate.full_state import predict, with_rates
from trueflight.groundstation.identify.airframe import identify
from trueflight.groundstation.identify.flights import diagnose_flights
from trueflight.groundstation.identify.spin import COMMANDS, MOTORS, fit_spin, inputs_of
from trueflight.groundstation.results import IdentifiedVehicle
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.model import Model


def identified(
    flights: Sequence[Flight],
    model: Model,
    held_out: Flight | None = None,
    inputs: str = "",
    find: bool = True,
    progress: Callable[[str], None] = lambda _: None,
) -> IdentifiedVehicle:
    """The vehicle of `flights`: its numbers by each of them, and its full state on each and on `held_out`.

    Thrust and forces are those of `model`, with `find` and what the flights show beyond it. The rotation is predicted
    from `inputs`, "motors" or "commands", where that is not told from what was logged. Raises `InputError` where they
    lack body rates and attitude, or both inputs.
    """
    turning = [f for f in map(with_rates, flights) if f is not None]
    inputs = inputs or (inputs_of(turning[0]) if turning else "")
    if len(turning) < len(flights) or not inputs or any(_lacks(f, inputs) for f in turning):
        first = flights[0]
        needed = {MOTORS: "motor_command or rotor_speed", COMMANDS: "body_rate_command"}
        raise InputError(
            f"{first.origin or first.name}: needs angular_velocity or an attitude, and "
            f"{needed.get(inputs, 'motor_command, rotor_speed or body_rate_command')} in every flight; record them"
        )
    progress("the vehicle's numbers")
    numbers = tuple(n for n in map(identify, flights) if n is not None)
    if find:
        progress("looking for what acts on it")
        model = diagnose_flights(flights, model, held_out, progress=progress).model
    progress("the rotation")
    spin = fit_spin(turning, inputs)
    if spin is None:
        raise InputError(
            f"{flights[0].origin or flights[0].name}: no second of unbroken flight to fit the rotation to"
        )
    progress("predicting")
    seen = [predict(f, model, spin) for f in turning]
    rated = None if held_out is None else with_rates(held_out)
    unseen = None if rated is None or _lacks(rated, inputs) else predict(rated, model, spin)
    return IdentifiedVehicle(
        numbers, model, inputs, spin.delay, spin.lag, tuple(s for s in seen if s is not None), unseen
    )


def _lacks(flight: Flight, inputs: str) -> bool:
    return inputs_of(flight) != MOTORS if inputs == MOTORS else not flight.has("body_rate_command")
