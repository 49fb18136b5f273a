"""The expected linear behaviours of many vehicles, beside the flights: `companion.law.behaviour` for one of them."""

from __future__ import annotations

import numpy as np

from trueflight.companion.law.behaviour import LONGEST_GAP
from trueflight.models.vehicle import GRAVITY
from trueflight.sim_bridge.many.cascade import Cascades, to_heading, wrapped
from trueflight.sim_bridge.many.courses import References


class Behaviours:
    """The linear closed loops from a start, one step a tick; `states` (9, N): position, velocity, roll, pitch, yaw."""

    def __init__(self, law: Cascades, count: int) -> None:
        self._k_eta, self._k_zeta, self._mass = law.k_eta, law.k_zeta, law.mass
        self.states = np.zeros((9, count))
        self._reference: References | None = None

    def begin(self, which: np.ndarray, position: np.ndarray, velocity: np.ndarray, zeta: np.ndarray) -> None:
        """Begin some (N,) anew, at these positions, velocities and attitudes (3, N)."""
        self.states = np.where(which, np.concatenate((position, velocity, zeta)), self.states)

    def step(self, reference: References, dt: float) -> None:
        """Go on by `dt` s to the time of `reference`; in between, references run linearly (midpoint rule)."""
        before, self._reference = self._reference or reference, reference
        dt = min(LONGEST_GAP, max(0.0, dt))
        middle = self.states + 0.5 * dt * self._slope(self.states, before, before, 0.0)
        self.states = self.states + dt * self._slope(middle, before, reference, 0.5)

    def _slope(self, states: np.ndarray, before: References, after: References, share: float) -> np.ndarray:
        position, velocity, (roll, pitch, yaw) = states[:3], states[3:6], states[6:]
        wanted, speed, acceleration = (
            one + share * (other - one)
            for one, other in (
                (before.position, after.position),
                (before.velocity, after.velocity),
                (before.acceleration, after.acceleration),
            )
        )
        wanted_yaw = before.yaw + share * wrapped(after.yaw - before.yaw)
        c, s = np.cos(yaw), np.sin(yaw)
        error = np.concatenate((to_heading(c, s, position - wanted), to_heading(c, s, velocity - speed)))
        asked = -np.add.reduce(self._k_eta * error, axis=1)
        ax, ay, az = acceleration
        asked[0] -= (c * ay - s * ax) / GRAVITY
        asked[1] += (c * ax + s * ay) / GRAVITY
        lift = asked[2] / self._mass + az
        tilt = np.array([roll - asked[0], pitch - asked[1], wrapped(yaw - wanted_yaw)])
        rates = -np.add.reduce(self._k_zeta * tilt, axis=1)
        fx, fy = GRAVITY * pitch, -GRAVITY * roll
        return np.concatenate((velocity, [c * fx - s * fy, s * fx + c * fy, lift], rates))
