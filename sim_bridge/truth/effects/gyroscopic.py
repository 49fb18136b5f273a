"""Angular momentum of the rotors."""

from __future__ import annotations

from typing import Any, ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Act, Airframe, Motion
from trueflight.sim_bridge.truth.effect import USUAL_MASS, TruthEffect, times_larger
from trueflight.sim_bridge.truth.sensors import Sensors


class Gyroscopic(TruthEffect):
    """Rotors have angular momentum: turning their axes and changing their speed takes torque from the body.

    The momentum of all rotors along the body's z axis, J sum s_i W_i, changes with the body's rates and with the
    rotors' speeds; the body gets the opposite (Newton-Euler; Bouabdallah 2007, thesis EPFL 3727).
    """

    name = "gyroscopic"
    what = "the rotors' angular momentum couples roll and pitch, and their spin-up turns the body"
    low, high, most = 1.5e-5, 4e-5, 1.0
    units: ClassVar = {"inertia": "kg m^2"}

    def scale(self, vehicle: Vehicle) -> float:
        """A moment of inertia, of rotors that weigh the same share of the vehicle."""
        return vehicle.mass / USUAL_MASS * times_larger(vehicle) ** 2

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Minus the change of momentum as seen from the body."""
        inertia, directions = numbers["inertia"], tuple(airframe.vehicle.rotor_directions)
        airframe.act_on_body(momentum_of_rotors, inertia, directions, 1.0 / airframe.dt)


def momentum_of_rotors(inertia: Any, directions: Any, rate: float) -> Act:
    """Minus the change of momentum as seen from the body; `rate` is 1 / step, 1/s."""
    before: list[Any] = []

    def act(m: Motion) -> None:
        momentum = inertia * sum(s * w for s, w in zip(directions, m.speeds, strict=True))
        spin_up = (momentum - before[0]) * rate if before else 0.0
        before[:] = [momentum]
        body = m.wrench
        body[3] -= m.q * momentum
        body[4] += m.p * momentum
        body[5] -= spin_up

    return act


EFFECT = Gyroscopic()
