"""What is hidden, put into the vehicle that flies."""

from __future__ import annotations

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Airframe, Powertrain
from trueflight.sim_bridge.truth.effect import Event
from trueflight.sim_bridge.truth.effects import EFFECTS
from trueflight.sim_bridge.truth.hidden import Hidden
from trueflight.sim_bridge.truth.sensors import Sensors


def install(
    vehicle: Vehicle, hidden: tuple[Hidden, ...], believed: Powertrain, sensors: Sensors, dt: float
) -> tuple[Powertrain, Airframe]:
    """The true powertrain and airframe: what the owner believes, changed by what is hidden."""
    train = believed
    for one in hidden:
        train = EFFECTS[one.name].powertrain(train, vehicle, one.parameters)
    airframe = Airframe(vehicle, train, dt)
    names = frozenset(one.name for one in hidden)
    for one in hidden:
        EFFECTS[one.name].attach(airframe, sensors, one.parameters, names)
    return train, airframe


def after_takeoff(hidden: tuple[Hidden, ...], vehicle: Vehicle) -> list[Event]:
    """What happens to the rigid body in flight, in the order of its times after take-off (s)."""
    events = (EFFECTS[one.name].event(vehicle, one.parameters) for one in hidden)
    return sorted((event for event in events if event is not None), key=lambda event: event[0])
