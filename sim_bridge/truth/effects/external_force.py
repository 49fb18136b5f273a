"""A steady force on the body."""

from __future__ import annotations

import math
import random
from typing import Any, ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Act, Airframe, Motion
from trueflight.sim_bridge.truth.effect import USUAL_MASS, TruthEffect
from trueflight.sim_bridge.truth.sensors import Sensors


class ExternalForce(TruthEffect):
    """A force that stays as it is in the world and acts in the centre of mass: a tether, a hanging hose.

    After the disturbance "force" of Zhang et al., "A simulation evaluation suite for robust adaptive quadcopter
    control" (AdaptiveQuadBench), arXiv:2510.03471: up to 1 N along each axis.
    """

    name = "external_force"
    what = "a steady force, the same in the world however the vehicle turns"
    low, high, most = 0.5, 1.5, 1000.0
    may_begin = True
    units: ClassVar = {"force": "N", "x": "N", "y": "N", "z": "N"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """A force from any direction of space."""
        drawn = generator.uniform(self.low, self.high)
        up, turn = generator.uniform(-1.0, 1.0), generator.uniform(-math.pi, math.pi)
        force, flat = drawn if size is None else size, math.sqrt(1.0 - up * up)
        return {
            "force": force,
            "x": force * flat * math.cos(turn),
            "y": force * flat * math.sin(turn),
            "z": force * up,
        }

    def scale(self, vehicle: Vehicle) -> float:
        """A force, of the same share of the weight."""
        return vehicle.mass / USUAL_MASS

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Add it to what acts on the body."""
        airframe.act_on_body(push, numbers["x"], numbers["y"], numbers["z"])


def push(x: Any, y: Any, z: Any) -> Act:
    """A force (N) of the world, in the axes of the body."""

    def act(m: Motion) -> None:
        body = m.wrench
        body[0] += m.r00 * x + m.r10 * y + m.r20 * z
        body[1] += m.r01 * x + m.r11 * y + m.r21 * z
        body[2] += m.r02 * x + m.r12 * y + m.r22 * z

    return act


EFFECT = ExternalForce()
