"""What is known of the path from command to motion, for many vehicles: `companion.law.actuation` has the sources."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from trueflight.companion.law.actuation import STEP
from trueflight.models.contract import ACTUATION_LIMITS


class RateModels:
    """The roll and pitch rate loops beside the real ones: what the commands on their way will still do."""

    def __init__(self, count: int, period: float) -> None:
        self._period = period
        self._angle, self._rate, self._integral = (np.zeros((2, count)) for _ in range(3))
        longest = math.ceil(ACTUATION_LIMITS["rate_delay"] / period) + 2
        self._past: deque[np.ndarray] = deque([np.zeros((2, 2, count))], maxlen=longest)
        """Angles and rates (2, 2, N), the newest first."""

    def advance(self, command: np.ndarray, lag: np.ndarray, integral: np.ndarray, dt: float) -> None:
        """Let the last commands (2, N) in rad/s have acted, without delay, for `dt` s, with `lag` (N,) s and `integral`
        (N,) 1/s."""
        angle, rate, grown = self._angle, self._rate, self._integral
        lagging = lag > 0.0
        if lagging.any():
            steps = max(1, math.ceil(dt / STEP))
            h = dt / steps
            some = np.where(lagging, lag, 1.0)
            follow = np.where(lagging, 1.0 - np.exp(-h / some), 1.0)
            gain = np.where(lagging, h * integral / some, 0.0)
            for _ in range(steps):
                change = follow * (command - rate + lag * grown)
                grown = grown + gain * (command - rate - 0.5 * change)
                # Without a lag the command acts at once.
                angle = angle + h * np.where(lagging, rate + 0.5 * change, command)
                rate = rate + change
            rate = np.where(lagging, rate, command)
        else:
            angle, rate = angle + dt * command, command
        self._angle, self._rate, self._integral = angle, rate, grown
        if dt > 0.0:
            self._past.appendleft(np.array([angle, rate]))

    def on_its_way(self, delay: np.ndarray) -> np.ndarray:
        """By how much angles (rad) and rates (rad/s), (2, 2, N), will have changed `delay` (N,) s from now."""
        now = self._past[0]
        back = np.minimum(delay / self._period, len(self._past) - 1.0)
        whole = back.astype(int)
        if not back.any():
            return np.zeros_like(now)
        past = np.array(self._past)
        here = np.arange(len(back))
        newer = past[whole, :, :, here]
        older = past[np.minimum(whole + 1, len(past) - 1), :, :, here]
        then = newer + (back - whole)[:, None, None] * (older - newer)
        coming: np.ndarray = now - then.transpose(1, 2, 0)
        return coming


class LagInverses:
    """What must be added to wanted body rates so that the rate loops' lags give the wanted ones."""

    def __init__(self, count: int) -> None:
        self._added = np.zeros((2, count))
        self._slope: np.ndarray | None = None

    def step(self, slope: np.ndarray, lag: np.ndarray, integral: np.ndarray, dt: float) -> np.ndarray:
        """Rates to add (2, N) in rad/s for the wanted rates' derivatives `slope` (2, N); `dt` s since the last step."""
        before, self._slope = self._slope, slope
        if before is None:
            return self._added
        washed = np.exp(-integral * dt) * (self._added + lag * (slope - before))
        self._added = np.where(integral == 0.0, lag * slope, washed)
        return self._added
