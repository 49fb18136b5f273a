"""What is hidden, put into the vehicle that flies."""

from __future__ import annotations

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Airframe, Powertrain
from trueflight.sim_bridge.truth.effect import Event
from trueflight.sim_bridge.truth.effects import EFFECTS
from trueflight.sim_bridge.truth.hidden import Hidden
from trueflight.sim_bridge.truth.sensors import Sensors
from trueflight.sim_bridge.world import World


def install(
    vehicle: Vehicle, hidden: tuple[Hidden, ...], believed: Powertrain, sensors: Sensors, dt: float
) -> tuple[Powertrain, Airframe]:
    """The true powertrain and airframe at take-off: what the owner believes, changed by what is hidden."""
    train = believed
    first = tuple(one for one in hidden if not one.begins)
    for one in first:
        train = EFFECTS[one.name].powertrain(train, vehicle, one.parameters)
    airframe = Airframe(vehicle, train, dt)
    names = frozenset(one.name for one in hidden)
    for one in first:
        EFFECTS[one.name].attach(airframe, sensors, one.parameters, names)
    airframe.keep()
    return train, airframe


def after_takeoff(
    hidden: tuple[Hidden, ...], vehicle: Vehicle, airframe: Airframe, sensors: Sensors
) -> list[Event]:
    """What happens in flight, in the order of its times after take-off (s)."""
    events = [EFFECTS[one.name].event(vehicle, one.parameters) for one in hidden]
    names = frozenset(one.name for one in hidden)
    events += [_beginning(one, airframe, sensors, names) for one in hidden if one.begins]
    return sorted((event for event in events if event is not None), key=lambda event: event[0])


def _beginning(one: Hidden, airframe: Airframe, sensors: Sensors, names: frozenset[str]) -> Event:
    effect = EFFECTS[one.name]

    def begin(_: World) -> None:
        airframe.powertrain = effect.powertrain(airframe.powertrain, airframe.vehicle, one.parameters)
        effect.attach(airframe, sensors, one.parameters, names)

    return one.begins, begin
