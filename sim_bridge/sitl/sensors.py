"""The raw sensors that PX4's estimator fuses, taken from the truth: IMU, magnetometer, barometer, GPS, external vision.

World ENU and body FLU go in; what comes out is in PX4's frames (NED, FRD) and units (gauss, hPa).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from trueflight.models.vehicle import GRAVITY
from trueflight.sim_bridge.mavlink import wire
from trueflight.sim_bridge.mavlink.wire import Quaternion, Vector
from trueflight.sim_bridge.simulator import Moment

FIELD = (0.0127, 0.2175, -0.4310)
"""The Earth's magnetic field at `wire.ORIGIN`, gauss, ENU (World Magnetic Model 2025: 48.3 microtesla, 63.2 deg down,
3.3 deg east). PX4 compares it with its own table of the model.
"""

_SEA_LEVEL = 1013.25  # hPa
_LAPSE, _EXPONENT = 2.25577e-5, 5.25588  # International Standard Atmosphere, troposphere
_BLOCK = 1024


@dataclass(frozen=True)
class RawNoise:
    """Standard deviations of one sample before any filter of PX4's, and slow wander with its time constant (s).

    IMU: a MEMS part at 250 Hz on a small frame with damped vibration, half of what EKF2 reckons with by default
    (EKF2_ACC_NOISE 0.35 m/s², EKF2_GYR_NOISE 0.015 rad/s). GPS: a receiver with good sky, inside EKF2_GPS_P_NOISE 0.5 m
    and EKF2_GPS_V_NOISE 0.3 m/s. Vision: motion capture.
    """

    accelerometer: float = 0.17  # m/s²
    gyroscope: float = 0.0075  # rad/s
    magnetometer: float = 0.002  # gauss
    pressure: float = 0.02  # hPa, 0.17 m
    gps_position: float = 0.02  # m, and twice that vertically
    gps_velocity: float = 0.03  # m/s
    gps_wander: float = 0.25  # m, likewise
    gps_wander_time: float = 40.0  # s
    vision_position: float = 0.002  # m
    vision_velocity: float = 0.008  # m/s
    vision_attitude: float = 0.002  # rad

    def times(self, factor: float) -> RawNoise:
        """The same noise, louder or quieter. IMU, magnetometer and barometer keep a digit of it even at 0: PX4 takes
        a sensor that repeats itself for a dead one.
        """
        scaled = {f.name: factor * getattr(self, f.name) for f in fields(self) if f.name != "gps_wander_time"}
        for name, digit in _DIGITS.items():
            scaled[name] = max(scaled[name], digit)
        return replace(self, **scaled)


# Steps of PX4's simulated IMU: 16 g and 2000 deg/s in 16 bits.
FORCE_STEP, RATE_STEP = 9.80665 / 2048, math.radians(2000) / 32768
_DIGITS = {
    "accelerometer": 2 * FORCE_STEP,
    "gyroscope": 2 * RATE_STEP,
    "magnetometer": 2e-4,
    "pressure": 2e-3,
}


class Imu(NamedTuple):
    """Specific force (m/s²) and body rates (rad/s), FRD."""

    specific_force: Vector
    body_rate: Vector


class Gps(NamedTuple):
    """Latitude and longitude (deg), altitude (m), velocity (m/s, NED)."""

    latitude: float
    longitude: float
    altitude: float
    velocity: Vector


class Vision(NamedTuple):
    """Position (m) and velocity (m/s) in local NED, attitude FRD to NED."""

    position: Vector
    velocity: Vector
    quaternion: Quaternion


def specific_force(acceleration: Vector, rotation: tuple[float, ...]) -> Vector:
    """What an ideal accelerometer reads, m/s², FLU, at an acceleration (m/s², ENU); `rotation` body to world."""
    ax, ay, az = acceleration
    az += GRAVITY
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation
    return (
        r00 * ax + r10 * ay + r20 * az,
        r01 * ax + r11 * ay + r21 * az,
        r02 * ax + r12 * ay + r22 * az,
    )


def magnetic_field(quaternion: Quaternion) -> Vector:
    """The Earth's field in the body, gauss, FRD, for an attitude FLU to ENU."""
    w, x, y, z = quaternion
    east, north, up = FIELD
    return (
        (1 - 2 * (y * y + z * z)) * east + 2 * (x * y + w * z) * north + 2 * (x * z - w * y) * up,
        -(2 * (x * y - w * z) * east + (1 - 2 * (x * x + z * z)) * north + 2 * (y * z + w * x) * up),
        -(2 * (x * z + w * y) * east + 2 * (y * z - w * x) * north + (1 - 2 * (x * x + y * y)) * up),
    )


def pressure(altitude: float) -> float:
    """Static pressure, hPa, at an altitude (m above sea level) of the standard atmosphere."""
    return float(_SEA_LEVEL * (1.0 - _LAPSE * altitude) ** _EXPONENT)


def pressure_altitude(hectopascal: float) -> float:
    """The altitude, m, at which the standard atmosphere has a pressure (hPa)."""
    return float((1.0 - (hectopascal / _SEA_LEVEL) ** (1.0 / _EXPONENT)) / _LAPSE)


def rounded_by_px4(reading: Vector, step: float) -> Vector:
    """A reading that PX4's simulated IMU, which cuts to whole steps towards zero, will round to them."""
    x, y, z = (value + math.copysign(0.5 * step, value) for value in reading)
    return x, y, z


class RawSensors:
    """Draws the errors of every sample from one seeded generator; `accelerometer_bias` (m/s², FLU) is hidden."""

    def __init__(self, noise: RawNoise, seed: int, accelerometer_bias: Vector = (0.0, 0.0, 0.0)) -> None:
        self.noise = noise
        self.accelerometer_bias = accelerometer_bias
        self._generator = np.random.default_rng([seed, 0x9A4])
        self._rows: list[list[float]] = []
        self._wander = [float(value) for value in self._generator.standard_normal(3)]
        self._wandered_us = 0

    def _draw(self) -> list[float]:
        if not self._rows:
            # Drawn in blocks: one call for a thousand samples costs less than one call for each number.
            self._rows = self._generator.standard_normal((_BLOCK, 6)).tolist()
        return self._rows.pop()

    def imu(self, before: Moment, now: Moment) -> Imu:
        """One sample of the IMU over two physics steps: an IMU averages over its sampling interval."""
        fx, fy, fz = specific_force(before[3], before[4])
        gx, gy, gz = specific_force(now[3], now[4])
        bx, by, bz = self.accelerometer_bias
        _, _, _, p, q, r = now[2]
        n = self._draw()
        sa, sg = self.noise.accelerometer, self.noise.gyroscope
        return Imu(
            (
                0.5 * (fx + gx) + bx + sa * n[0],
                -(0.5 * (fy + gy) + by + sa * n[1]),
                -(0.5 * (fz + gz) + bz + sa * n[2]),
            ),
            (p + sg * n[3], -q + sg * n[4], -r + sg * n[5]),
        )

    def magnetometer(self, now: Moment) -> Vector:
        """The field in the body, gauss, FRD."""
        n, size = self._draw(), self.noise.magnetometer
        w, x, y, z = now[1][3:]
        mx, my, mz = magnetic_field((w, x, y, z))
        return mx + size * n[0], my + size * n[1], mz + size * n[2]

    def barometer(self, now: Moment) -> float:
        """Static pressure, hPa."""
        return pressure(wire.ORIGIN[2] + now[1][2]) + self.noise.pressure * self._draw()[0]

    def gps(self, then: Moment) -> Gps:
        """Position and velocity of a receiver, at a moment that may be a little past."""
        noise, n, m = self.noise, self._draw(), self._draw()
        elapsed = max(then[0] - self._wandered_us, 0)
        self._wandered_us = then[0]
        keep = math.exp(elapsed * -1e-6 / noise.gps_wander_time)
        kick = math.sqrt(1.0 - keep * keep)
        self._wander = [keep * old + kick * new for old, new in zip(self._wander, m[:3], strict=True)]
        x, y, z = (
            true + scale * (noise.gps_position * white + noise.gps_wander * slow)
            for true, scale, white, slow in zip(then[1][:3], (1, 1, 2), n[:3], self._wander, strict=True)
        )
        vx, vy, vz = (
            true + noise.gps_velocity * white for true, white in zip(then[2][:3], n[3:], strict=True)
        )
        return Gps(*wire.geodetic((x, y, z)), wire.ned((vx, vy, vz)))

    def vision(self, then: Moment) -> Vision:
        """Pose and velocity from motion capture, at a moment that may be a little past."""
        noise, n, m = self.noise, self._draw(), self._draw()
        x, y, z, qw, qx, qy, qz = then[1]
        vx, vy, vz = then[2][:3]
        sp, sv, half = noise.vision_position, noise.vision_velocity, 0.5 * noise.vision_attitude
        # A small rotation in the world, then normalised: (1, e) times the true quaternion.
        ex, ey, ez = half * m[0], half * m[1], half * m[2]
        w = qw - ex * qx - ey * qy - ez * qz
        a = qx + ex * qw + ey * qz - ez * qy
        b = qy + ey * qw + ez * qx - ex * qz
        c = qz + ez * qw + ex * qy - ey * qx
        scale = 1.0 / math.sqrt(w * w + a * a + b * b + c * c)
        return Vision(
            wire.ned((x + sp * n[0], y + sp * n[1], z + sp * n[2])),
            wire.ned((vx + sv * n[3], vy + sv * n[4], vz + sv * n[5])),
            wire.attitude((scale * w, scale * a, scale * b, scale * c)),
        )
