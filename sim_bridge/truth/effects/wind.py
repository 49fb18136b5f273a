"""Steady wind."""

from __future__ import annotations

import math
import random
from typing import ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Airframe
from trueflight.sim_bridge.truth.effect import TruthEffect
from trueflight.sim_bridge.truth.effects.rotor_drag import attach_rotor_drag
from trueflight.sim_bridge.truth.sensors import Sensors


class Wind(TruthEffect):
    """Steady wind. It acts through drag: where no drag is hidden with it, the rotors drag as known for such
    frames.
    """

    name = "wind"
    what = "a steady horizontal wind, acting through rotor drag"
    low, high, most = 3.0, 5.5, 15.0
    drawn = True
    may_begin = True
    units: ClassVar = {"speed": "m/s", "east": "m/s", "north": "m/s", "drag": "1/s"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A speed (m/s) from any direction."""
        speed, direction = generator.uniform(self.low, self.high), generator.uniform(-math.pi, math.pi)
        speed = speed if size is None else size
        east, north = speed * math.cos(direction), speed * math.sin(direction)
        return {"speed": speed, "east": east, "north": north, "drag": generator.uniform(0.18, 0.28)}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Move the air; bring rotor drag along if nothing else drags."""
        airframe.wind = (numbers["east"], numbers["north"], 0.0)
        if not others & {"rotor_drag", "parasitic_drag"}:
            attach_rotor_drag(airframe, numbers["drag"], numbers["drag"])


EFFECT = Wind()
