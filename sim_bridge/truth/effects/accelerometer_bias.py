"""A constant error of the accelerometer."""

from __future__ import annotations

import math
import random
from typing import ClassVar

from trueflight.models.vehicle import GRAVITY, Vehicle
from trueflight.sim_bridge.truth.airframe import Airframe
from trueflight.sim_bridge.truth.effect import TruthEffect
from trueflight.sim_bridge.truth.sensors import Sensors


class AccelerometerBias(TruthEffect):
    """The accelerometer reads a constant in body axes."""

    name = "accelerometer_bias"
    what = "the accelerometer reads a constant off, in body axes"
    low, high, most = 0.2, 0.5, 0.3 * GRAVITY
    drawn = True
    units: ClassVar = {"size": "m/s^2", "x": "m/s^2", "y": "m/s^2", "z": "m/s^2"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A size (m/s²) in any direction."""
        drawn = generator.uniform(self.low, self.high)
        size = drawn if size is None else size
        axis = [generator.gauss(0.0, 1.0) for _ in range(3)]
        length = math.sqrt(sum(x * x for x in axis))
        x, y, z = (size * component / length for component in axis)
        return {"size": size, "x": x, "y": y, "z": z}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Added to every reading."""
        sensors.accelerometer_bias = (numbers["x"], numbers["y"], numbers["z"])


EFFECT = AccelerometerBias()
