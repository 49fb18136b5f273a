"""A steady torque on the body."""

from __future__ import annotations

import math
import random
from typing import Any, ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Act, Airframe, Motion
from trueflight.sim_bridge.truth.effect import USUAL_MASS, TruthEffect, times_larger
from trueflight.sim_bridge.truth.sensors import Sensors


class ExternalTorque(TruthEffect):
    """A torque about an axis of the rotors' plane that turns with the body.

    After the disturbance "torque" of Zhang et al. (AdaptiveQuadBench), arXiv:2510.03471: up to 0.1 N m about each axis.
    None about the body's z axis: a quadrotor of this size can hold about a twentieth of that there.
    """

    name = "external_torque"
    what = "a steady torque about an axis of the rotors' plane"
    low, high, most = 0.04, 0.12, 1000.0
    may_begin = True
    units: ClassVar = {"torque": "N m", "x": "N m", "y": "N m"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A torque about any axis of the rotors' plane."""
        drawn, direction = generator.uniform(self.low, self.high), generator.uniform(-math.pi, math.pi)
        size = drawn if size is None else size
        return {"torque": size, "x": size * math.cos(direction), "y": size * math.sin(direction)}

    def scale(self, vehicle: Vehicle) -> float:
        """A torque, of the same share of the weight on the frame's arm."""
        return vehicle.mass / USUAL_MASS * times_larger(vehicle)

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Add it to what acts on the body."""
        airframe.act_on_body(twist, numbers["x"], numbers["y"])


def twist(x: Any, y: Any) -> Act:
    """A torque (N m) in the axes of the body."""

    def act(m: Motion) -> None:
        m.wrench[3] += x
        m.wrench[4] += y

    return act


EFFECT = ExternalTorque()
