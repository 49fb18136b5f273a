"""Drag of the frame."""

from __future__ import annotations

import random
from typing import Any, ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import AIR_DENSITY, Act, Airframe, Motion
from trueflight.sim_bridge.truth.effect import TruthEffect, times_larger
from trueflight.sim_bridge.truth.sensors import Sensors


class ParasiticDrag(TruthEffect):
    """Dynamic pressure on the frame, with an area of its own along each body axis.

    Source: Hoerner, "Fluid-Dynamic Drag", 1965: drag 0.5 rho C_D A |V| V.
    """

    name = "parasitic_drag"
    what = "the frame drags with the square of the air's velocity"
    low, high, most = 0.05, 0.14, 5.0
    drawn = True
    may_begin = True
    units: ClassVar = {"x": "1/m", "y": "1/m", "z": "1/m"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """Acceleration per speed squared along body x; y and z have larger areas."""
        x = generator.uniform(self.low, self.high)
        y_ratio, z_ratio = generator.uniform(1.0, 1.3), generator.uniform(1.2, 1.8)
        x = x if size is None else size
        return {"x": x, "y": y_ratio * x, "z": z_ratio * x}

    def scale(self, vehicle: Vehicle) -> float:
        """Area over mass, of a body of the same density."""
        return 1.0 / times_larger(vehicle)

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Force -0.5 rho (C_D A)_axis |V| V_axis at the centre of mass."""
        areas = [2.0 * airframe.vehicle.mass * numbers[axis] / AIR_DENSITY for axis in "xyz"]
        ax, ay, az = (0.5 * AIR_DENSITY * area for area in areas)
        airframe.act_on_body(with_square_of_speed, ax, ay, az)


def with_square_of_speed(ax: Any, ay: Any, az: Any) -> Act:
    """Force -a |V| V for each axis, a in N s²/m²."""

    def act(m: Motion) -> None:
        u, v, w = m.u, m.v, m.w
        speed = (u * u + v * v + w * w) ** 0.5
        body = m.wrench
        body[0] -= ax * speed * u
        body[1] -= ay * speed * v
        body[2] -= az * speed * w

    return act


EFFECT = ParasiticDrag()
