"""Many inner loops as arrays: body rates to motor commands, as `sim_bridge.rates` for one vehicle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.many.across import stacked
from trueflight.sim_bridge.rates import IDLE_SHARE, RateController
from trueflight.sim_bridge.world import PHYSICS_STEP


class RateLoops:
    """The rate controllers and mixers of N vehicles.

    Where a motor's range does not suffice, which is rare, the vehicle's own mixer decides what gives way.
    """

    def __init__(self, vehicles: Sequence[Vehicle]) -> None:
        known: dict[Vehicle, RateController] = {}
        loops = [known.setdefault(v, known.get(v) or RateController(v, PHYSICS_STEP)) for v in vehicles]
        count = len(vehicles)
        self._mixers = [loop.mixer for loop in loops]
        gains = stacked([loop.gains for loop in loops])
        self._kp, ki, self._kd = gains[:, 0].copy(), gains[:, 1], gains[:, 2].copy()
        self._grow = ki * PHYSICS_STEP
        self._limits = stacked([loop.limits for loop in loops])
        self._smooth = loops[0].smooth
        rows = stacked([mixer.rows for mixer in self._mixers])
        self._rows = rows
        self._same_rows = rows[:, :, 0].copy() if np.all(rows == rows[:, :, :1]) else None
        self._hover = np.array([mixer.hover for mixer in self._mixers])
        self._linear = np.array([mixer.linear for mixer in self._mixers])
        self._top = np.array([mixer.top for mixer in self._mixers])
        self._integral, self._slope = np.zeros((3, count)), np.zeros((3, count))
        self._rate = np.zeros((3, count))
        self._asked = np.zeros((4, count))

    def relative(self, command: np.ndarray) -> np.ndarray:
        """Believed thrust over hover thrust of normalised collective commands (N,)."""
        ratio = command / self._hover
        relative: np.ndarray = np.where(self._linear, ratio, ratio * ratio)
        return relative

    def motors(self, relative: np.ndarray, setpoint: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Motor commands (4, N) for thrusts `relative` to hover (N,), body-rate setpoints (3, N) and rates (3, N)."""
        slope, asked = self._slope, self._asked
        change = rate - self._rate
        change /= PHYSICS_STEP
        change -= slope
        change *= self._smooth
        slope += change
        self._rate[:] = rate
        error = setpoint - rate
        asked[0] = relative
        torque = np.multiply(self._kp, error, out=asked[1:])
        torque += self._integral
        np.multiply(self._kd, slope, out=change)
        torque -= change
        if self._same_rows is not None:
            shares = self._same_rows @ asked
        else:
            shares = np.add.reduce(self._rows * asked, axis=1)
        least, most = shares.min(axis=0), shares.max(axis=0)
        crowded = (least < IDLE_SHARE) | (most > self._top)
        error *= self._grow
        error += self._integral
        np.minimum(error, self._limits, out=error)
        np.maximum(error, -self._limits, out=error)
        if crowded.any():
            for i in np.flatnonzero(crowded).tolist():
                shares[:, i] = self._mixers[i].give_way(*asked[:, i].tolist())
            np.copyto(self._integral, error, where=~crowded)
        else:
            self._integral = error
        if self._linear.all():
            shares *= self._hover
            return shares
        roots = np.sqrt(shares)
        return self._hover * (roots if not self._linear.any() else np.where(self._linear, shares, roots))
