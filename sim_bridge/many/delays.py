"""Setpoints on their way to many inner loops, each with a delay and a filter of its own."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from trueflight.sim_bridge.truth.airframe import Powertrain
from trueflight.sim_bridge.world import PHYSICS_STEP


class Delays:
    """The delay lines of N vehicles: `push` a setpoint a control tick, take what acts step by step.

    Setpoints are (4, N): normalised collective command and body rates (rad/s). Before the first one `still` acts. As in
    `sim_bridge.simulator`, a delay may end within a step, and rates may pass a filter.
    """

    def __init__(self, trains: Sequence[Powertrain], steps_per_tick: int, still: np.ndarray) -> None:
        delays = [train.delay / PHYSICS_STEP for train in trains]
        whole = [int(delay) for delay in delays]
        late = np.array([delay - steps for delay, steps in zip(delays, whole, strict=True)])
        self._late = late if late.any() else None
        self._groups = [(steps, np.flatnonzero(np.array(whole) == steps)) for steps in sorted(set(whole))]
        self._groups.sort(key=lambda group: -len(group[1]))
        self._steps_per_tick = steps_per_tick
        size = max(whole) // steps_per_tick + 3
        self._line = np.repeat(still[None], size, axis=0)
        # One object a slot, so that two steps of one setpoint are known to be the same.
        self._views: list[np.ndarray] = list(self._line)
        self._tick = 0
        self._before = self._views[0]
        """What arrived in the step before."""
        taus = [train.rate_filter for train in trains]
        keep = np.array([math.exp(-PHYSICS_STEP / tau) if tau > 0.0 else 0.0 for tau in taus])
        self._keep = keep if keep.any() else None
        self._filtered = np.zeros((3, len(trains)))

    def push(self, setpoint: np.ndarray) -> None:
        """The setpoint from this control tick on."""
        self._tick += 1
        self._line[self._tick % len(self._line)] = setpoint

    def acting(self, step: int) -> np.ndarray:
        """The setpoints (4, N) that act in this step of the tick, 0 the first; not to be changed. To be called for each
        step once."""
        acting = self._at(step)
        if self._late is not None:
            older, self._before = self._before, acting
            if older is not acting:
                acting = acting + self._late * (older - acting)
        if self._keep is not None:
            acting = acting.copy()
            rates = acting[1:]
            self._filtered = rates + self._keep * (self._filtered - rates)
            acting[1:] = self._filtered
        return acting

    def _at(self, step: int) -> np.ndarray:
        """What arrives in a step, without parts of steps; the same object where it is the same setpoint for all."""
        line, size = self._line, len(self._line)
        slots = [(self._tick + (step - whole) // self._steps_per_tick) % size for whole, _ in self._groups]
        if len(set(slots)) == 1:
            return self._views[slots[0]]
        mixed: np.ndarray = line[slots[0]].copy()
        for slot, (_, where) in zip(slots[1:], self._groups[1:], strict=True):
            if slot != slots[0]:
                mixed[:, where] = line[slot][:, where]
        return mixed
