"""Wind that never rests."""

from __future__ import annotations

import random
from typing import ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Airframe
from trueflight.sim_bridge.truth.effect import TruthEffect
from trueflight.sim_bridge.truth.effects.rotor_drag import attach_rotor_drag
from trueflight.sim_bridge.truth.sensors import Sensors
from trueflight.sim_bridge.truth.turbulence import Turbulence


class Gusts(TruthEffect):
    """Turbulence, with or without a steady wind beside it. Like that it acts through drag.

    After the disturbance "wind" of Zhang et al. (AdaptiveQuadBench), arXiv:2510.03471, which has Dryden's gusts.
    """

    name = "gusts"
    what = "turbulent wind (Dryden's spectrum), acting through rotor drag"
    low, high, most = 1.0, 2.5, 15.0
    units: ClassVar = {"deviation": "m/s", "draw": "1", "drag": "1/s"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A standard deviation (m/s) of the horizontal wind; `draw` is what the gusts are drawn by."""
        deviation, draw = generator.uniform(self.low, self.high), float(generator.randrange(1 << 31))
        return {
            "deviation": deviation if size is None else size,
            "draw": draw,
            "drag": generator.uniform(0.18, 0.28),
        }

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Move the air; bring rotor drag along if nothing else drags."""
        airframe.turbulence = Turbulence(numbers["deviation"], int(numbers["draw"]), airframe.dt)
        if not others & {"rotor_drag", "parasitic_drag", "wind"}:
            attach_rotor_drag(airframe, numbers["drag"], numbers["drag"])


EFFECT = Gusts()
