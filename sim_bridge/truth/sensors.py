"""What the vehicle's sensors and its estimator say of the truth: small noise and slowly varying errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trueflight.models.vehicle import GRAVITY


class Estimate(NamedTuple):
    """The vehicle's own view of itself at one moment. World ENU, body FLU, SI units.

    `time_us` is the vehicle's clock. `specific_force` is the accelerometer's. `rotor_speed` in rad/s, as the
    ESCs report it.
    """

    time_us: int
    position: tuple[float, float, float]
    velocity: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    angular_velocity: tuple[float, float, float]
    specific_force: tuple[float, float, float]
    battery_voltage: float
    rotor_speed: tuple[float, float, float, float]


@dataclass(frozen=True)
class Noise:
    """Standard deviations: white noise of each sample, and slow wander of the estimator with its time
    constant (s).

    The figures are those of a good small autopilot after its filters: accelerometer and gyroscope after the
    30 Hz low-pass and averaging, position and velocity of an estimator with motion capture or RTK.
    """

    accelerometer: float = 0.08  # m/s²
    gyroscope: float = 0.005  # rad/s
    position: float = 0.002  # m
    velocity: float = 0.008  # m/s
    attitude: float = 0.0006  # rad
    voltage: float = 0.01  # V
    position_wander: float = 0.015  # m
    velocity_wander: float = 0.010  # m/s
    attitude_wander: float = 0.0015  # rad
    wander_time: float = 12.0  # s


NO_NOISE = Noise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

BLOCK, DRAWS = 1024, 25
"""Samples drawn at a time, and numbers for each: nine of the wander, then position, velocity, attitude, gyroscope,
accelerometer and voltage."""


class Sensors:
    """Draws every sample's errors from one seeded generator.

    `accelerometer_bias` (m/s², body), `lever_arm` (m, of the accelerometer from the centre of mass, body) and `delay`
    (s, from a moment to its sample's arrival at a companion) are hidden effects. `wander` are the slow errors now, in
    standard deviations: position, velocity, attitude.
    """

    def __init__(self, noise: Noise, seed: int) -> None:
        self.noise = noise
        self.accelerometer_bias = (0.0, 0.0, 0.0)
        self.lever_arm: tuple[float, float, float] | None = None
        self.delay = 0.0
        self._generator = np.random.default_rng([seed, 0x5E45])
        self._rows: list[list[float]] = []
        self.wander = [float(x) for x in self._generator.standard_normal(9)]
        self._last_us = 0

    def draw_block(self) -> np.ndarray:
        """The next standard normal draws, a row a sample; the last row is used first."""
        # In blocks: one call for a thousand samples costs less than one call for each number.
        return self._generator.standard_normal((BLOCK, DRAWS))

    def sample(
        self,
        time_us: int,
        position: list[float],
        velocity: list[float],
        acceleration: tuple[float, float, float],
        rotation: tuple[float, ...],
        voltage: float,
        speeds: Sequence[float],
    ) -> Estimate:
        """One sample. `position` is x, y, z, quaternion and `velocity` linear (world) and angular (body), as
        in `World`.

        `acceleration` (of where the accelerometer is, world, m/s²) and `rotation` (nine numbers, body to world) belong
        to the step that has just been made, so that the specific force is the one that acted in it.
        """
        if not self._rows:
            self._rows = self.draw_block().tolist()
        n = self._rows.pop()
        noise, wander = self.noise, self.wander
        # The autopilot's own sample may be newer than the one that a companion is told next.
        if time_us > self._last_us:
            self._let_wander(time_us, n)
        x, y, z, *quaternion = position
        vx, vy, vz, p, q, r = velocity
        sp, sw = noise.position, noise.position_wander
        vp, vw = noise.velocity, noise.velocity_wander
        ap, aw = 0.5 * noise.attitude, 0.5 * noise.attitude_wander
        ex, ey, ez = ap * n[15] + aw * wander[6], ap * n[16] + aw * wander[7], ap * n[17] + aw * wander[8]
        ax, ay, az = acceleration
        az += GRAVITY
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation
        bx, by, bz = self.accelerometer_bias
        sa, sg = noise.accelerometer, noise.gyroscope
        return Estimate(
            time_us,
            (
                x + sp * n[9] + sw * wander[0],
                y + sp * n[10] + sw * wander[1],
                z + sp * n[11] + sw * wander[2],
            ),
            (
                vx + vp * n[12] + vw * wander[3],
                vy + vp * n[13] + vw * wander[4],
                vz + vp * n[14] + vw * wander[5],
            ),
            _turned(quaternion, ex, ey, ez),
            (p + sg * n[18], q + sg * n[19], r + sg * n[20]),
            (
                r00 * ax + r10 * ay + r20 * az + bx + sa * n[21],
                r01 * ax + r11 * ay + r21 * az + by + sa * n[22],
                r02 * ax + r12 * ay + r22 * az + bz + sa * n[23],
            ),
            voltage + noise.voltage * n[24],
            (speeds[0], speeds[1], speeds[2], speeds[3]),
        )

    def _let_wander(self, time_us: int, n: list[float]) -> None:
        """Move the slow errors on from the last time to this one."""
        decay = math.exp((time_us - self._last_us) * -1e-6 / self.noise.wander_time)
        kick = math.sqrt(1.0 - decay * decay)
        self.wander[:] = [decay * old + kick * new for old, new in zip(self.wander, n, strict=False)]
        self._last_us = time_us


def _turned(quaternion: list[float], ex: float, ey: float, ez: float) -> tuple[float, float, float, float]:
    """A small rotation in the world, then normalised: (1, e) times the true quaternion."""
    qw, qx, qy, qz = quaternion
    w = qw - ex * qx - ey * qy - ez * qz
    x = qx + ex * qw + ey * qz - ez * qy
    y = qy + ey * qw + ez * qx - ex * qz
    z = qz + ez * qw + ex * qy - ey * qx
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return scale * w, scale * x, scale * y, scale * z
