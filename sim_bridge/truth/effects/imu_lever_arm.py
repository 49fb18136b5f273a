"""An accelerometer away from the centre of mass."""

from __future__ import annotations

import math
import random
from typing import ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Airframe
from trueflight.sim_bridge.truth.effect import TruthEffect, times_larger
from trueflight.sim_bridge.truth.sensors import Sensors


class ImuLeverArm(TruthEffect):
    """The accelerometer sits away from the centre of mass and reads the acceleration of where it sits."""

    name = "imu_lever_arm"
    what = "the accelerometer sits away from the centre of mass"
    low, high, most, any_draws = 0.03, 0.07, 0.5, True
    units: ClassVar = {"length": "m", "x": "m", "y": "m", "z": "m"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A distance in any direction."""
        drawn = generator.uniform(self.low, self.high)
        size = drawn if size is None else size
        axis = [generator.gauss(0.0, 1.0) for _ in range(3)]
        length = math.sqrt(sum(a * a for a in axis))
        x, y, z = (size * a / length for a in axis)
        return {"length": size, "x": x, "y": y, "z": z}

    def scale(self, vehicle: Vehicle) -> float:
        """A distance on the frame."""
        return times_larger(vehicle)

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Where the accelerometer is; the simulator differentiates that point's velocity."""
        sensors.lever_arm = (numbers["x"], numbers["y"], numbers["z"])


EFFECT = ImuLeverArm()
