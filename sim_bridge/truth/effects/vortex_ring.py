"""Thrust lost in descent."""

from __future__ import annotations

import math
from math import sqrt
from typing import Any, ClassVar

import numpy as np

from trueflight.sim_bridge.truth.airframe import AIR_DENSITY, Act, Airframe, Motion, by_rotor
from trueflight.sim_bridge.truth.effect import TruthEffect
from trueflight.sim_bridge.truth.sensors import Sensors


class VortexRing(TruthEffect):
    """A rotor that sinks into its own wake loses thrust.

    A raised cosine over the descent speed of each hub, from 0.3 to 1.5 of the hover's induced velocity, as the loss of
    small propellers measured by Shetty and Selig, AIAA 2011-1254; gone at edgewise speeds above the induced velocity.
    """

    name = "vortex_ring"
    what = "each rotor loses thrust where it sinks nearly as fast as its own wake"
    low, high, most = 0.15, 0.35, 0.8
    units: ClassVar = {"loss": "1"}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Thrust of rotor i times one minus the loss."""
        vehicle = airframe.vehicle
        disc = math.pi * vehicle.rotor_radius**2
        induced = math.sqrt(0.25 * vehicle.weight / (2.0 * AIR_DENSITY * disc))
        hubs, loss = tuple(vehicle.rotor_positions), numbers["loss"]
        airframe.act_on_rotors(in_own_wake, loss, induced, hubs, many=many_in_own_wake)


def in_own_wake(loss: float, induced: float, hubs: Any) -> Act:
    """Thrusts times one minus the loss; `induced` in m/s."""

    def act(m: Motion) -> None:
        u, v, w, p, q = m.u, m.v, m.w, m.p, m.q
        edgewise = sqrt(u * u + v * v) / induced
        if edgewise >= 1.0:
            return
        thrusts = m.thrusts
        for i, (x, y, _) in enumerate(hubs):
            sinking = -(w + p * y - q * x) / induced
            if 0.3 < sinking < 1.5:
                ring = 0.5 - 0.5 * math.cos(2.0 * math.pi * (sinking - 0.3) / 1.2)
                thrusts[i] *= 1.0 - loss * ring * (1.0 - edgewise)

    return act


def many_in_own_wake(loss: Any, induced: Any, hubs: Any) -> Act:
    """The same for many vehicles, of all rotors at once."""
    x, y, _ = by_rotor(hubs)

    def act(m: Motion) -> None:
        sinking = m.q * x - m.p * y - m.w
        sinking /= induced
        if not np.any(sinking > 0.3):
            return
        flat = loss * np.maximum(1.0 - np.sqrt(m.u * m.u + m.v * m.v) / induced, 0.0)
        ring = 0.5 - 0.5 * np.cos(2.0 * math.pi * (np.clip(sinking, 0.3, 1.5) - 0.3) / 1.2)
        m.thrusts *= 1.0 - flat * ring

    return act


EFFECT = VortexRing()
