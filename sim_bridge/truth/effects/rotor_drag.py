"""Drag in the rotors' plane."""

from __future__ import annotations

import random
from typing import Any, ClassVar

import numpy as np

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Act, Airframe, Motion, by_rotor
from trueflight.sim_bridge.truth.effect import TruthEffect
from trueflight.sim_bridge.truth.sensors import Sensors


class RotorDrag(TruthEffect):
    """H-force of each rotor, proportional to its speed and to the air's velocity at its hub, in the rotor
    plane.

    Source: Martin and Salaün, "The true role of accelerometer feedback in quadrotor control", ICRA 2010;
    Faessler et al., "Differential flatness of quadrotor dynamics subject to rotor drag", RA-L 2018.
    """

    name = "rotor_drag"
    what = "each rotor drags in its plane, in proportion to its speed and the air's velocity there"
    low, high, most = 0.15, 0.45, 5.0
    drawn = True
    may_begin = True
    units: ClassVar = {"x": "1/s", "y": "1/s"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """Acceleration per speed at hover along body x, and up to 25 % more along y."""
        x = generator.uniform(self.low, self.high)
        ratio = generator.uniform(1.0, 1.25)
        x = x if size is None else size
        return {"x": x, "y": ratio * x}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Force -c omega_i V_i at every hub, V_i with the velocity that the body's rates give the hub."""
        attach_rotor_drag(airframe, numbers["x"], numbers["y"])


def attach_rotor_drag(airframe: Airframe, x_per_s: float, y_per_s: float) -> None:
    """Let the H-force of four rotors act, given as acceleration per speed (1/s) when all turn at hover speed."""
    per_rotor = airframe.vehicle.mass / (4 * airframe.powertrain.hover_speed)
    hubs = tuple(airframe.vehicle.rotor_positions)
    airframe.act_on_body(h_force, x_per_s * per_rotor, y_per_s * per_rotor, hubs, many=many_h_forces)


def h_force(cx: Any, cy: Any, hubs: Any) -> Act:
    """The H-force of all rotors: -c times rotor speed times the air's velocity at the hub (m), c in N s²/m/rad."""

    def act(m: Motion) -> None:
        u, v, p, q, r = m.u, m.v, m.p, m.q, m.r
        fx = fy = tx = ty = tz = 0.0
        for speed, (x, y, z) in zip(m.speeds, hubs, strict=True):
            hx = -cx * speed * (u + q * z - r * y)
            hy = -cy * speed * (v + r * x - p * z)
            fx += hx
            fy += hy
            tx -= z * hy
            ty += z * hx
            tz += x * hy - y * hx
        body = m.wrench
        body[0] += fx
        body[1] += fy
        body[3] += tx
        body[4] += ty
        body[5] += tz

    return act


def many_h_forces(cx: Any, cy: Any, hubs: Any) -> Act:
    """The same for many vehicles, of all rotors at once."""
    x, y, z = by_rotor(hubs)

    def act(m: Motion) -> None:
        p, q, r = m.p, m.q, m.r
        hx = (q * z - r * y + m.u) * m.speeds
        hx *= -cx
        hy = (r * x - p * z + m.v) * m.speeds
        hy *= -cy
        body = m.wrench
        body[0] += np.add.reduce(hx)
        body[1] += np.add.reduce(hy)
        body[3] -= np.add.reduce(z * hy)
        body[4] += np.add.reduce(z * hx)
        body[5] += np.add.reduce(x * hy - y * hx)

    return act


EFFECT = RotorDrag()
