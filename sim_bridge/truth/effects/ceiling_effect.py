"""Thrust that rises near a ceiling."""

from __future__ import annotations

import random
from typing import Any, ClassVar

import numpy as np

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Act, Airframe, Motion, by_rotor
from trueflight.sim_bridge.truth.effect import TruthEffect
from trueflight.sim_bridge.truth.sensors import Sensors


class CeilingEffect(TruthEffect):
    """A ceiling above the flight draws each rotor up.

    Law and constants of Sanchez-Cuevas, Heredia and Ollero, "Multirotor UAS for bridge inspection by contact using
    the ceiling effect", ICUAS 2017: thrust over 1 - (R / (d + 0.0378 m))² / 6.924, with the effective radius R.
    """

    name = "ceiling_effect"
    what = "each rotor's thrust rises near a ceiling above the flight"
    low, high, most = 2.0, 3.0, 6.0
    units: ClassVar = {"radius_factor": "1", "height": "m"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """An effective radius, below a ceiling just above the survey flight's highest hover."""
        drawn = generator.uniform(self.low, self.high)
        height = generator.uniform(2.78, 2.85)
        return {"radius_factor": drawn if size is None else size, "height": height}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Each hub by its own distance."""
        hubs = tuple(airframe.vehicle.rotor_positions)
        square = (numbers["radius_factor"] * airframe.vehicle.rotor_radius) ** 2 / 6.924
        height = numbers["height"]
        airframe.act_on_rotors(below_ceiling, square, height, hubs, many=many_below_ceiling)


def below_ceiling(square: float, height: float, hubs: Any) -> Act:
    """Thrusts over 1 - square / (distance + 0.0378 m)², square in m²."""

    def act(m: Motion) -> None:
        z, r20, r21, r22 = m.z, m.r20, m.r21, m.r22
        thrusts = m.thrusts
        for i, (x, y, up) in enumerate(hubs):
            distance = height - (z + r20 * x + r21 * y + r22 * up)
            near = square / (max(distance, 0.0) + 0.0378) ** 2
            thrusts[i] /= 1.0 - (near if near < 0.5 else 0.5)

    return act


def many_below_ceiling(square: Any, height: Any, hubs: Any) -> Act:
    """The same for many vehicles, of all rotors at once."""
    x, y, up = by_rotor(hubs)

    def act(m: Motion) -> None:
        distance = height - (m.z + m.r20 * x + m.r21 * y + m.r22 * up)
        m.thrusts /= 1.0 - np.minimum(square / (np.maximum(distance, 0.0) + 0.0378) ** 2, 0.5)

    return act


EFFECT = CeilingEffect()
