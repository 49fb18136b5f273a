"""Another curve from command to rotor speed."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Powertrain
from trueflight.sim_bridge.truth.effect import TruthEffect


class ThrustCurve(TruthEffect):
    """The speed controller turns commands into rotor speed by another curve, with the same hover."""

    name = "thrust_curve"
    what = "the map from command to rotor speed is another curve, right at hover only"
    low, high, least, most = 0.35, 0.9, -0.5, 1.5
    drawn = True
    units: ClassVar = {"speed_blend": "1"}

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """Rotor speed becomes a blend of the square-root and the proportional map."""
        return replace(train, speed_blend=numbers["speed_blend"])


EFFECT = ThrustCurve()
