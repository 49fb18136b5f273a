"""One weak rotor."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Powertrain
from trueflight.sim_bridge.truth.effect import TruthEffect


class RotorDamage(TruthEffect):
    """A chipped propeller: one rotor gives less thrust, and drags less, at the same speed."""

    name = "rotor_damage"
    what = "one rotor gives less thrust than the others at the same speed"
    low, high, most, any_draws = 0.08, 0.16, 0.7, True
    may_begin = True
    units: ClassVar = {"loss": "1", "rotor": "1"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A share of the thrust of any one rotor, 1 to 4."""
        drawn, rotor = generator.uniform(self.low, self.high), generator.randint(1, 4)
        return {"loss": drawn if size is None else size, "rotor": float(rotor)}

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """Its thrust constant is smaller."""
        constants = list(train.thrust_constants)
        constants[round(numbers["rotor"]) - 1] *= 1.0 - numbers["loss"]
        a, b, c, d = constants
        return replace(train, thrust_constants=(a, b, c, d))


EFFECT = RotorDamage()
