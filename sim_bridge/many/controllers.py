"""The controllers of many vehicles, as arrays: those of `companion.law.controllers` that need no model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from trueflight.companion.law.control import ControlLaw
from trueflight.companion.law.controllers import INTEGRAL_AUTHORITY, LqrIntegral
from trueflight.companion.law.outer_loop import LONGEST_STEP
from trueflight.models.vehicle import GRAVITY
from trueflight.sim_bridge.many.across import stacked
from trueflight.sim_bridge.many.cascade import Cascades, States, Steps, euler, to_heading
from trueflight.sim_bridge.many.courses import References


class Crew(Protocol):
    """The controllers of some of the vehicles, all of one kind; `inference` (n,) s spent in each one's model."""

    inference: np.ndarray

    def start(self, which: np.ndarray) -> None:
        """For some (N,) of its vehicles the mission begins with the next tick."""
        ...

    def step(self, states: States, reference: References, tick: int, dt: float) -> Steps:
        """One tick of all; `dt` s since the one before."""
        ...

    def guard(self) -> Sequence[str] | None:
        """What each one's guard says; None where none has one."""
        ...


class ManyLqr:
    """The linear cascade alone."""

    def __init__(self, laws: Sequence[ControlLaw]) -> None:
        self._law = Cascades(laws)
        self.inference = np.zeros(len(laws))

    def start(self, which: np.ndarray) -> None:
        """Nothing: it has no memory."""

    def guard(self) -> None:
        """There is none."""

    def step(self, states: States, reference: References, tick: int, dt: float) -> Steps:
        """One tick of the cascades."""
        law = self._law
        zeta = euler(states.quaternion)
        heading = np.cos(zeta[2]), np.sin(zeta[2])
        attitude = law.feedback(states.position, states.velocity, heading, reference)
        return _plain(law, zeta, attitude, reference)


class ManyLqrIntegral:
    """The cascade with an integral of the position error in the position loop."""

    def __init__(self, laws: Sequence[ControlLaw]) -> None:
        for law in laws:
            LqrIntegral(law)  # refuses a design without an integral
        self._law = Cascades(laws)
        self.inference = np.zeros(len(laws))
        gains = [law.design.integral for law in laws]
        self._k_eta = stacked([one.K_eta for one in gains if one is not None])
        self._k_i = stacked([one.K_i for one in gains if one is not None])
        k = self._k_i
        per_axis = np.array([GRAVITY * abs(k[1, 0]), GRAVITY * abs(k[0, 1]), k[2, 2] / self._law.mass])
        self._most = np.where(
            per_axis > 0.0, INTEGRAL_AUTHORITY / np.where(per_axis > 0.0, per_axis, 1.0), 0.0
        )
        self._integral = np.zeros_like(per_axis)

    def start(self, which: np.ndarray) -> None:
        """Keep the integral: what it has learned in the climb still holds."""

    def guard(self) -> None:
        """There is none."""

    def step(self, states: States, reference: References, tick: int, dt: float) -> Steps:
        """One tick; an integral does not grow while tilt or thrust are at their limits."""
        law = self._law
        zeta = euler(states.quaternion)
        c, s = heading = np.cos(zeta[2]), np.sin(zeta[2])
        grown = self._integral + min(LONGEST_STEP, max(0.0, dt)) * (states.position - reference.position)
        grown = np.clip(grown, -self._most, self._most)
        more = -np.add.reduce(self._k_i * to_heading(c, s, grown), axis=1)
        attitude = law.feedback(states.position, states.velocity, heading, reference, self._k_eta, more)
        self._integral = np.where(law.at_limit(attitude), self._integral, grown)
        return _plain(law, zeta, attitude, reference)


def _plain(law: Cascades, zeta: np.ndarray, attitude: np.ndarray, reference: References) -> Steps:
    rates = law.turning(zeta, law.euler_rates(zeta, attitude, reference.yaw))
    return Steps.plain(attitude[2], rates, law.normalised(attitude[2]))
