"""Thrust that rises with the airspeed in the rotors' plane."""

from __future__ import annotations

from typing import Any, ClassVar

from trueflight.sim_bridge.truth.airframe import Act, Airframe, Motion, by_rotor
from trueflight.sim_bridge.truth.effect import TruthEffect
from trueflight.sim_bridge.truth.sensors import Sensors


class TranslationalLift(TruthEffect):
    """Blade elements of a rotor in edgewise flow meet faster air on one side than they miss on the other.

    Averaged over a turn the square of a blade element's airspeed grows by half the square of the edgewise airspeed:
    thrust rises by the square of the airspeed at the hub, whatever the rotor's speed (Leishman, "Principles of
    Helicopter Aerodynamics", ch. 3).
    """

    name = "translational_lift"
    what = "each rotor's thrust rises with the square of the airspeed in its plane"
    low, high, most, any_draws = 0.03, 0.08, 0.5, True
    units: ClassVar = {"lift": "1/m"}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """A quarter of the gain at every hub, with the velocity that the body's rates give the hub."""
        gain = 0.25 * airframe.vehicle.mass * numbers["lift"]
        hubs = tuple(airframe.vehicle.rotor_positions)
        airframe.act_on_rotors(with_edgewise_flow, gain, hubs, many=many_with_edgewise_flow)


def with_edgewise_flow(gain: Any, hubs: Any) -> Act:
    """Thrusts plus gain (N s²/m²) times the square of the airspeed in the plane at each hub (m)."""

    def act(m: Motion) -> None:
        u, v, p, q, r = m.u, m.v, m.p, m.q, m.r
        thrusts = m.thrusts
        for i, (x, y, z) in enumerate(hubs):
            hx, hy = u + q * z - r * y, v + r * x - p * z
            thrusts[i] += gain * (hx * hx + hy * hy)

    return act


def many_with_edgewise_flow(gain: Any, hubs: Any) -> Act:
    """The same for many vehicles, of all rotors at once."""
    x, y, z = by_rotor(hubs)

    def act(m: Motion) -> None:
        hx, hy = m.u + m.q * z - m.r * y, m.v + m.r * x - m.p * z
        m.thrusts += gain * (hx * hx + hy * hy)

    return act


EFFECT = TranslationalLift()
