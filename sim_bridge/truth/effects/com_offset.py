"""A centre of mass off the rotors' centre."""

from __future__ import annotations

import math
import random
from typing import Any, ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Act, Airframe, Motion
from trueflight.sim_bridge.truth.effect import TruthEffect, times_larger
from trueflight.sim_bridge.truth.sensors import Sensors


class CentreOfMassOffset(TruthEffect):
    """The battery slipped: the centre of mass is not where the rotors' positions are measured from."""

    name = "com_offset"
    what = "the centre of mass is off the rotors' centre, so that thrust turns the vehicle"
    low, high, most, any_draws = 0.004, 0.010, 0.2, True
    units: ClassVar = {"distance": "m", "x": "m", "y": "m"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A distance in any direction of the rotors' plane."""
        drawn, direction = generator.uniform(self.low, self.high), generator.uniform(-math.pi, math.pi)
        size = drawn if size is None else size
        return {"distance": size, "x": size * math.cos(direction), "y": size * math.sin(direction)}

    def scale(self, vehicle: Vehicle) -> float:
        """A distance on the frame."""
        return times_larger(vehicle)

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Every rotor's arm is shorter by the offset."""
        airframe.act_on_body(off_centre, numbers["x"], numbers["y"])


def off_centre(cx: Any, cy: Any) -> Act:
    """Torque (N m) of all thrusts on the arm -x, -y (m)."""

    def act(m: Motion) -> None:
        body = m.wrench
        for thrust in m.thrusts:
            body[3] += -cy * thrust
            body[4] -= -cx * thrust

    return act


EFFECT = CentreOfMassOffset()
