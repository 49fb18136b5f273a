"""A torque on the body that comes and goes."""

from __future__ import annotations

import math
import random
from typing import Any, ClassVar

import numpy as np

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Act, Airframe, Motion
from trueflight.sim_bridge.truth.effect import USUAL_MASS, TruthEffect, times_larger
from trueflight.sim_bridge.truth.sensors import Sensors


class PeriodicTorque(TruthEffect):
    """A sine of torque about an axis of the rotors' plane that turns with the body: a load that swings below it."""

    name = "periodic_torque"
    what = "a torque about an axis of the rotors' plane that comes and goes as a sine"
    low, high, most = 0.04, 0.12, 1000.0
    units: ClassVar = {"amplitude": "N m", "x": "N m", "y": "N m", "frequency": "Hz"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """An amplitude about any axis of the rotors' plane, at 0.5 to 2 Hz: pendulums of 1 m to 6 cm."""
        drawn, direction = generator.uniform(self.low, self.high), generator.uniform(-math.pi, math.pi)
        frequency = generator.uniform(0.5, 2.0)
        size = drawn if size is None else size
        return {
            "amplitude": size,
            "x": size * math.cos(direction),
            "y": size * math.sin(direction),
            "frequency": frequency,
        }

    def scale(self, vehicle: Vehicle) -> float:
        """A torque, of the same share of the weight on the frame's arm."""
        return vehicle.mass / USUAL_MASS * times_larger(vehicle)

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Add it to what acts on the body; its time is the simulation's."""
        turn = 2.0 * math.pi * numbers["frequency"] * airframe.dt
        airframe.act_on_body(swing, numbers["x"], numbers["y"], turn)


def swing(x: Any, y: Any, turn: Any) -> Act:
    """A torque (N m) in the axes of the body whose phase goes on by `turn` (rad) a step."""
    steps = 0

    def act(m: Motion) -> None:
        nonlocal steps
        sine = np.sin(turn * steps)
        steps += 1
        m.wrench[3] += x * sine
        m.wrench[4] += y * sine

    return act


EFFECT = PeriodicTorque()
