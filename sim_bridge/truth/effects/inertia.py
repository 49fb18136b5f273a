"""Moments of inertia other than believed."""

from __future__ import annotations

from typing import ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.effect import Event, TruthEffect


class Inertia(TruthEffect):
    """The moments of inertia of the vehicle file are wrong, all by one factor: nobody weighs them.

    After the disturbance "uncertainty" of Zhang et al. (AdaptiveQuadBench), arXiv:2510.03471.
    """

    name = "inertia"
    what = "the moments of inertia are not what the vehicle file says, by this factor"
    low, high, least, most = 0.7, 1.4, 0.1, 20.0
    units: ClassVar = {"factor": "1"}

    def neutral(self, vehicle: Vehicle) -> float:
        """As believed."""
        return 1.0

    def event(self, vehicle: Vehicle, numbers: dict[str, float]) -> Event:
        """The rigid body's own, from the moment it is in the air."""
        x, y, z = ((numbers["factor"] - 1.0) * moment for moment in vehicle.inertia)
        return 0.0, lambda world: world.spread((x, y, z))


EFFECT = Inertia()
