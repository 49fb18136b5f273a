"""Rotors slower than believed."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Powertrain
from trueflight.sim_bridge.truth.effect import TruthEffect


class MotorLag(TruthEffect):
    """Rotors take longer to change speed than measured on the bench."""

    name = "motor_lag"
    what = "the rotors' speed lags its command with another time constant"
    low, high, least, most = 0.045, 0.058, 0.0, 1.0
    drawn = True
    units: ClassVar = {"time_constant": "s"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """At least 25 ms above the believed one, else it would not be hidden but absent."""
        least = max(self.low, vehicle.motor_time_constant + 0.025)
        drawn = generator.uniform(least, max(self.high, least + 0.013))
        return {"time_constant": drawn if size is None else size}

    def neutral(self, vehicle: Vehicle) -> float:
        """The believed time constant."""
        return vehicle.motor_time_constant

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """The true time constant of rotor speed."""
        return replace(train, time_constant=numbers["time_constant"])


EFFECT = MotorLag()
