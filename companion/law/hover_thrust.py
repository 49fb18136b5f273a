"""PX4's estimator of the thrust that hovers: a Kalman filter with one state, of the vertical acceleration.

`a = g T / T_h - g` for a vertical thrust command T; a measurement outside the gate is not taken, and after many of
them the state's variance grows, so that a payload is found again. Its noise is learnt from what is left over.

Source: PX4 1.17, `mc_hover_thrust_estimator` (`zero_order_hover_thrust_ekf.cpp`) and its parameters' defaults.
"""

from __future__ import annotations

import math

from trueflight.models.vehicle import GRAVITY

PROCESS = 0.0036  # HTE_HT_NOISE, 1/s
GATE = 3.0  # HTE_ACC_GATE, standard deviations
UNCERTAINTY = 0.1  # HTE_HT_ERR_INIT
SPEED_ACROSS, SPEED_UP = 10.0, 2.0  # HTE_VXY_THR, HTE_VZ_THR, m/s: above them drag biases what is measured
RANGE = 0.2  # HTE_THR_RANGE, either side of the thrust that is believed
NOISE, NOISE_LEAST, NOISE_MOST = 5.0, 1.0, 400.0  # (m/s²)²
SETTLED, SETTLED_FOR = 1e-3, 2.0  # variance below which it is used, after so many s
LEARNING, REMEMBERING = 2.0, 1.0  # s, of the noise and of what is left over
REJECTED, BUMP = 0.2, 1e3


class HoverThrust:
    """One flight of it; `value` is the normalised command that hovers, once it has settled that of the vehicle file."""

    def __init__(self, believed: float) -> None:
        self.value = believed
        self._state, self._variance, self._noise = believed, UNCERTAINTY**2, NOISE
        self._low, self._high = max(0.1, believed - RANGE), min(0.9, believed + RANGE)
        self._left = self._ratio = self._settled = 0.0

    def step(
        self, acceleration: float, thrust: float, velocity: tuple[float, float, float], dt: float
    ) -> None:
        """Take a vertical acceleration (m/s², without gravity) at a vertical command (normalised) and a velocity
        (m/s, world), `dt` s after the last."""
        self._variance += (PROCESS * dt) ** 2
        slope = -GRAVITY * thrust / self._state**2
        fast = max(abs(velocity[2]) - SPEED_UP, math.hypot(velocity[0], velocity[1]) - SPEED_ACROSS) + 1.0
        noise = self._noise * max(1.0, fast) ** 2
        spread = max(slope * slope * self._variance + noise, noise)
        off = self._off(acceleration, thrust)
        ratio = off * off / (GATE * GATE * spread)
        left = off
        if ratio < 1.0:
            gain = self._variance * slope / spread
            self._state = min(self._high, max(self._low, self._state + gain * off))
            self._variance = min(1.0, max(1e-10, (1.0 - gain * slope) * self._variance))
            left = self._off(acceleration, thrust)
        elif abs(self._ratio) > REJECTED:
            self._variance += BUMP * PROCESS**2 * dt
        self._learn(left, math.copysign(min(1.0, ratio), off), slope, dt)
        self._settle(ratio, dt)

    def _off(self, acceleration: float, thrust: float) -> float:
        return acceleration - GRAVITY * (thrust / self._state - 1.0)

    def _learn(self, left: float, ratio: float, slope: float, dt: float) -> None:
        share = dt / (REMEMBERING + dt)
        self._left += share * (left - self._left)
        self._ratio += share * (ratio - self._ratio)
        share = dt / (LEARNING + dt)
        seen = (left - self._left) ** 2 + slope * slope * self._variance
        self._noise = min(NOISE_MOST, max(NOISE_LEAST, self._noise + share * (seen - self._noise)))

    def _settle(self, ratio: float, dt: float) -> None:
        sure = self._variance < SETTLED and (ratio < 1.0 or self._settled >= SETTLED_FOR)
        self._settled = self._settled + dt if sure else 0.0
        if self._settled >= SETTLED_FOR:
            self.value = self._state
