"""Reports older than believed."""

from __future__ import annotations

import random
from typing import ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Airframe
from trueflight.sim_bridge.truth.effect import TruthEffect
from trueflight.sim_bridge.truth.sensors import Sensors
from trueflight.sim_bridge.world import PHYSICS_STEP


class EstimatorDelay(TruthEffect):
    """Sensors, filters, estimator and link take time: a companion is told of a moment this much later.

    The messages carry the time of the moment that they tell of. The autopilot's own loops are not late: they
    use the gyroscope itself. Not a force, so that `random` does not draw it.
    """

    name = "estimator_delay"
    what = "a companion is told of every moment this much later, to whole 2 ms"
    low, high, most = 0.006, 0.014, 0.2
    units: ClassVar = {"delay": "s"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A delay (s) that the simulator can do."""
        drawn = self.possible(generator.uniform(self.low, self.high))
        return {"delay": drawn if size is None else size}

    def possible(self, size: float) -> float:
        """A whole number of physics steps."""
        return round(size / PHYSICS_STEP) * PHYSICS_STEP

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """The age of what is reported."""
        sensors.delay = numbers["delay"]


EFFECT = EstimatorDelay()
