"""A load picked up in flight."""

from __future__ import annotations

import random
from typing import ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.effect import Event, TruthEffect


class Payload(TruthEffect):
    """A load picked up in flight: more mass and inertia from a time after take-off until the motors stop.

    A cube as wide as a rotor's radius, its centre in the centre of mass, so that no torque comes with it. An
    event rather than an effect of the whole flight, so that neither `random` nor `rich` hides it.
    """

    name = "payload"
    what = "a share of the vehicle's mass is picked up at a time after take-off"
    low, high, most = 0.08, 0.15, 1.0
    units: ClassVar = {"mass_fraction": "1", "time": "s"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A share of the mass, after 12 s: the transfer to a trajectory's start is over, most of it is ahead."""
        drawn = generator.uniform(self.low, self.high)
        return {"mass_fraction": drawn if size is None else size, "time": 12.0}

    def event(self, vehicle: Vehicle, numbers: dict[str, float]) -> Event:
        """The load is fixed to the rigid body."""
        mass = numbers["mass_fraction"] * vehicle.mass
        inertia = mass * vehicle.rotor_radius**2 / 6.0
        return numbers["time"], lambda world: world.load(mass, inertia)


EFFECT = Payload()
