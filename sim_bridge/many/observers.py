"""The disturbance observers of many vehicles: `companion.law.residual` for one of them has sources and reasons."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from trueflight.companion.law.control import ControlLaw
from trueflight.companion.law.outer_loop import LONGEST_STEP
from trueflight.companion.law.residual import BELIEVED, BIAS_BANDWIDTH, DISBELIEVED, STUCK
from trueflight.models.vehicle import GRAVITY
from trueflight.sim_bridge.many.cascade import States, to_heading
from trueflight.sim_bridge.plan import Plan


class Observers:
    """`pushed` (3, N) is what acts as a disturbance as of the last tick, m/s², heading frame."""

    def __init__(self, laws: Sequence[ControlLaw], plans: Sequence[Plan]) -> None:
        count = len(plans)
        self._measured = _Accelerometers(count)
        vehicles = [law.vehicle for law in laws]
        self._mass = np.array([v.mass for v in vehicles])
        self._delay = np.array([v.command_delay for v in vehicles])
        self._lag = np.array([v.motor_time_constant for v in vehicles])
        self._sent: list[np.ndarray] = []
        self._due, self._clock = np.full(count, -1), 0.0
        self._clocks: list[float] = []
        self._acting = np.array([v.weight for v in vehicles])
        self._weight = self._acting.copy()
        self._rate = 2.0 * math.pi * np.array([plan.observer.frequency for plan in plans])
        self._most = np.array([plan.observer.authority for plan in plans])
        self._ground = np.array([plan.observer.ground for plan in plans])
        self._lift = np.zeros(count)
        self._first, self._second = np.zeros((3, count)), np.zeros((3, count))
        self._acceleration = np.zeros((3, count))
        self.pushed = np.zeros((3, count))

    def look(self, states: States, actuation: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Accelerations now (3, N) in the world, as far as they are believed, and the thrusts that act (N,) in N."""
        self._acceleration = self._measured.step(states, dt)
        self._lift = self._most * np.clip(states.height / self._ground, 0.0, 1.0)
        known = (actuation[3] > 0.0) | (actuation[4] > 0.0)
        self._delay = np.where(known, actuation[3], self._delay)
        self._lag = np.where(known, actuation[4], self._lag)
        step = min(LONGEST_STEP, max(0.0, dt))
        self._clock += step
        due = np.searchsorted(np.array(self._clocks), self._clock - self._delay + 1e-9, side="right") - 1
        self._due = np.maximum(self._due, due)
        if self._sent:
            oldest = int(self._due.min())
            arrived = np.array(self._sent)[np.maximum(self._due, 0), np.arange(len(self._due))]
            arrived = np.where(self._due >= 0, arrived, self._weight)
            if oldest > 0:  # what every one of them has had
                del self._sent[:oldest], self._clocks[:oldest]
                self._due = self._due - oldest
        else:
            arrived = self._weight
        share = np.where(self._lag > 0.0, -np.expm1(-step / np.where(self._lag > 0.0, self._lag, 1.0)), 1.0)
        self._acting = self._acting + share * (arrived - self._acting)
        return self._acceleration, self._acting

    @property
    def trust(self) -> np.ndarray:
        """How far each accelerometer is believed, 0 to 1 (N,)."""
        return self._measured.trust

    def beyond_linear(self, zeta: np.ndarray, heading: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Error accelerations now (3, N), as far as each accelerometer is believed."""
        linear = np.array([GRAVITY * zeta[1], -GRAVITY * zeta[0], self._acting / self._mass - GRAVITY])
        beyond: np.ndarray = to_heading(*heading, self._acceleration) - self._measured.trust * linear
        return beyond

    def commanded(self, thrust: np.ndarray) -> None:
        """Thrusts (N,) in N go out now."""
        self._sent.append(thrust)
        self._clocks.append(self._clock)

    def step(
        self, zeta: np.ndarray, heading: tuple[np.ndarray, np.ndarray], modelled: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """What pushes (3, N), and how fast that changes along x and y (2, N) in m/s³."""
        c, s = heading
        residual = self.beyond_linear(zeta, heading) - self._measured.trust * modelled
        x, y, z = np.clip(residual, -self._most, self._most)
        share = -np.expm1(-self._rate * min(LONGEST_STEP, max(0.0, dt)))
        self._first = self._first + share * (np.array([c * x - s * y, s * x + c * y, z]) - self._first)
        self._second = self._second + share * (self._first - self._second)
        self.pushed = to_heading(c, s, self._second)
        self.pushed[2] = np.minimum(self.pushed[2], self._lift)
        return self.pushed, to_heading(c, s, self._rate * (self._first - self._second))[:2]


class _Accelerometers:
    """Accelerations in the world, without the accelerometers' bias; `trust` (N,) is how far each is believed."""

    def __init__(self, count: int) -> None:
        self.trust = np.zeros(count)
        self._velocity, self._bias = np.zeros((3, count)), np.zeros((3, count))
        self._force, self._same = np.zeros((3, count)), np.zeros(count)
        self._begun = np.zeros(count, dtype=bool)

    def step(self, states: States, dt: float) -> np.ndarray:
        """(3, N) in m/s²; nothing where none can be believed."""
        force, told = states.specific_force, states.velocity
        self._same = np.where((force == self._force).all(axis=0), self._same + dt, 0.0)
        self._force = force
        alive = self._same <= STUCK
        acceleration = world_from_body(states.quaternion, force - self._bias)
        acceleration[2] -= GRAVITY
        dt = min(LONGEST_STEP, max(0.0, dt))
        ahead = self._velocity + dt * acceleration
        off = told - ahead
        keep = math.exp(-BIAS_BANDWIDTH * dt)
        learn = (1.0 - keep) ** 2 / dt if dt > 0.0 else 0.0
        w, x, y, z = states.quaternion
        bias = self._bias - learn * world_from_body(np.array([w, -x, -y, -z]), off)
        trust = (DISBELIEVED - np.sqrt(np.add.reduce(off * off))) / (DISBELIEVED - BELIEVED)
        on = alive & self._begun
        self.trust = np.where(on, np.clip(trust, 0.0, 1.0), 0.0)
        self._velocity = np.where(on, ahead + (1.0 - keep * keep) * off, told)
        self._bias = np.where(on, bias, np.where(alive, 0.0, self._bias))
        self._begun = alive
        believed: np.ndarray = self.trust * acceleration
        return believed


def world_from_body(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors (3, N) in body axes turned into the world."""
    w, x, y, z = quaternion
    vx, vy, vz = vector
    a, b, c = y * vz - z * vy + w * vx, z * vx - x * vz + w * vy, x * vy - y * vx + w * vz
    return np.array([vx + 2.0 * (y * c - z * b), vy + 2.0 * (z * a - x * c), vz + 2.0 * (x * b - y * a)])
