"""Rotors that lean against the body."""

from __future__ import annotations

import math
import random
from math import sqrt
from typing import Any, ClassVar

import numpy as np

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Act, Airframe, Motion, by_rotor
from trueflight.sim_bridge.truth.effect import TruthEffect
from trueflight.sim_bridge.truth.sensors import Sensors


class ThrustMisalignment(TruthEffect):
    """Rotors are mounted with a common tilt against the autopilot."""

    name = "thrust_misalignment"
    what = "every rotor's axis leans by the same angle against the body"
    low, high, most, any_draws = 0.02, 0.05, 0.3, True
    units: ClassVar = {"angle": "rad", "x": "rad", "y": "rad"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """An angle in any direction."""
        angle, direction = generator.uniform(self.low, self.high), generator.uniform(-math.pi, math.pi)
        angle = angle if size is None else size
        return {"angle": angle, "x": angle * math.cos(direction), "y": angle * math.sin(direction)}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """The force of each rotor along its leaning axis, and its torque at the hub."""
        sx, sy = math.sin(numbers["x"]), math.sin(numbers["y"])
        short = 1.0 - sqrt(1.0 - sx * sx - sy * sy)
        hubs = tuple(airframe.vehicle.rotor_positions)
        airframe.act_on_body(leaning, sx, sy, short, hubs, many=many_leaning)


def leaning(sx: Any, sy: Any, short: Any, hubs: Any) -> Act:
    """Force and torque of each thrust along (sx, sy, 1 - short) instead of (0, 0, 1)."""

    def act(m: Motion) -> None:
        body = m.wrench
        for thrust, (x, y, z) in zip(m.thrusts, hubs, strict=True):
            fx, fy, fz = sx * thrust, sy * thrust, -short * thrust
            body[0] += fx
            body[1] += fy
            body[2] += fz
            body[3] += y * fz - z * fy
            body[4] += z * fx - x * fz
            body[5] += x * fy - y * fx

    return act


def many_leaning(sx: Any, sy: Any, short: Any, hubs: Any) -> Act:
    """The same for many vehicles, of all rotors at once."""
    x, y, z = by_rotor(hubs)

    def act(m: Motion) -> None:
        total, along, across = (np.add.reduce(part) for part in (m.thrusts, x * m.thrusts, y * m.thrusts))
        up = np.add.reduce(z * m.thrusts)
        body = m.wrench
        body[0] += sx * total
        body[1] += sy * total
        body[2] -= short * total
        body[3] += -short * across - sy * up
        body[4] += sx * up + short * along
        body[5] += sy * along - sx * across

    return act


EFFECT = ThrustMisalignment()
