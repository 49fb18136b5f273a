"""What acts on the rotors and bodies of many vehicles: each formula once, for all vehicles in which it is at work."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from trueflight.sim_bridge.many.across import across
from trueflight.sim_bridge.truth.airframe import Acting, Law

_ROWS = (
    *("x", "y", "z", "vx", "vy", "vz", "u", "v", "w", "p", "q", "r"),
    *("r00", "r01", "r02", "r10", "r11", "r12", "r20", "r21", "r22", "voltage"),
)


class Part:
    """What some of the vehicles meet: the attributes of `truth.airframe.Motion`, each an array (n,); `speeds` and
    `thrusts` (4, n), `wrench` (6, n)."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray

    def __init__(self, motion: np.ndarray, thrusts: np.ndarray, wrench: np.ndarray) -> None:
        for row, name in enumerate(_ROWS):
            setattr(self, name, motion[row])
        self.speeds, self.thrusts, self.wrench = motion[22:26], thrusts, wrench


class _Pass:
    """One formula at work in the vehicles `where` (n,)."""

    def __init__(
        self, law: Law, numbers: Sequence[Any], where: np.ndarray, motion: np.ndarray, thrusts: np.ndarray
    ) -> None:
        self.key = law, tuple(numbers), tuple(where.tolist())
        self._act = law(*across(numbers))
        self._motion, self._thrusts = motion, thrusts
        self._where = None if len(where) == motion.shape[1] else where
        self._wrench = np.zeros((6, len(where)))
        if self._where is None:
            self._part = Part(motion, thrusts, self._wrench)
        else:
            self._here = np.empty((len(motion), len(where))), np.empty((4, len(where)))
            self._part = Part(*self._here, self._wrench)

    def on_rotors(self) -> None:
        """Change the thrusts."""
        self._gather()
        self._act(self._part)  # type: ignore[arg-type]  # the same attributes, as arrays
        if self._where is not None:
            self._thrusts[:, self._where] = self._here[1]

    def on_body(self, body: np.ndarray) -> None:
        """Add to force and torque (6, N)."""
        self._gather()
        self._wrench[:] = 0.0
        self._act(self._part)  # type: ignore[arg-type]
        if self._where is None:
            body += self._wrench
        else:
            body[:, self._where] += self._wrench

    def _gather(self) -> None:
        if self._where is None:
            return
        motion, thrusts = self._here
        self._motion.take(self._where, axis=1, out=motion, mode="clip")
        self._thrusts.take(self._where, axis=1, out=thrusts, mode="clip")


class Laws:
    """The formulas of many vehicles, in an order that is each vehicle's own: `acting` lists those of each of N.

    `motion` (26, N) and `thrusts` (4, N) are as in `Airframes`. What was at work `before` and still is goes on with
    what it remembers.
    """

    def __init__(
        self,
        acting: Sequence[Sequence[Acting]],
        motion: np.ndarray,
        thrusts: np.ndarray,
        before: Laws | None,
    ) -> None:
        known = {one.key: one for one in before.passes} if before is not None else {}
        self.passes: list[_Pass] = []
        waiting = [list(one) for one in acting]
        while any(waiting):
            law = self._next(waiting)
            where = [i for i, one in enumerate(waiting) if one and one[0].many is law]
            numbers = [waiting[i].pop(0).numbers for i in where]
            made = _Pass(law, numbers, np.array(where), motion, thrusts)
            self.passes.append(known.get(made.key, made))

    @staticmethod
    def _next(waiting: Sequence[Sequence[Acting]]) -> Law:
        """A formula that stands first wherever it is still to come, so that one pass does for all; or any."""
        first = dict.fromkeys(one[0].many for one in waiting if one)
        later = {acting.many for one in waiting for acting in one[1:]}
        return next((law for law in first if law not in later), next(iter(first)))

    def on_rotors(self) -> None:
        """Let all act on the thrusts."""
        for one in self.passes:
            one.on_rotors()

    def on_body(self, body: np.ndarray) -> None:
        """Let all act on force and torque (6, N) in the body."""
        for one in self.passes:
            one.on_body(body)
