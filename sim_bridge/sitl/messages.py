"""What a simulator tells PX4, as MAVLink: the sensors at their rates, and the ground truth for its log."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from enum import Enum
from typing import Any

from pymavlink.dialects.v20 import common as mav

from trueflight.sim_bridge.mavlink import wire
from trueflight.sim_bridge.simulator import Moment
from trueflight.sim_bridge.sitl.sensors import (
    FORCE_STEP,
    RATE_STEP,
    RawSensors,
    pressure_altitude,
    rounded_by_px4,
)
from trueflight.sim_bridge.world import PHYSICS_STEP

SENSOR_STEPS = 2
"""Physics steps between two HIL_SENSOR messages: 250 Hz, PX4's IMU_INTEG_RATE in simulation."""

SENSOR_PERIOD = SENSOR_STEPS * PHYSICS_STEP

# Bits of HIL_SENSOR.fields_updated.
_IMU_FIELDS, _MAGNETOMETER_FIELDS, _BAROMETER_FIELDS = 0x3F, 0x1C0, 0x1A00
_MAGNETOMETER_EVERY, _BAROMETER_EVERY, _GPS_EVERY = 4, 5, 25  # HIL_SENSOR messages: 62.5, 50 and 10 Hz
_TRUTH_EVERY = 2  # 125 Hz


class Position(Enum):
    """What tells PX4 where it is."""

    GPS = "gps"
    VISION = "vision"
    BOTH = "both"


@dataclass(frozen=True)
class Offer:
    """What PX4 is given: the source of its position, the rate of vision (Hz), and how late vision and GPS are (s)."""

    position: Position = Position.GPS
    vision_rate: float = 50.0
    delay: float = 0.0


class SensorMessages:
    """The messages of one flight, from the moment that it begins with."""

    def __init__(self, sensors: RawSensors, offer: Offer, begin: Moment) -> None:
        self._sensors, self._offer = sensors, offer
        self._link = mav.MAVLink(None, srcSystem=1, srcComponent=200)
        late = round(offer.delay / SENSOR_PERIOD)
        self._past: list[Moment] = [begin] * (late + 1)
        self._vision_every = max(round(1.0 / (offer.vision_rate * SENSOR_PERIOD)), 1)
        self._utc_us = time.time_ns() // 1000

    def of(self, tick: int, time_us: int, before: Moment, now: Moment) -> bytes:
        """What the sensors say after step `tick`, from the last two moments; to be called once a step, in order."""
        sensors = self._sensors
        self._past = [*self._past[1:], now] if tick else self._past
        imu = sensors.imu(before, now)
        fields = _IMU_FIELDS
        field_x = field_y = field_z = hectopascal = altitude = 0.0
        if tick % _MAGNETOMETER_EVERY == 0:
            fields |= _MAGNETOMETER_FIELDS
            field_x, field_y, field_z = sensors.magnetometer(now)
        if tick % _BAROMETER_EVERY == 0:
            fields |= _BAROMETER_FIELDS
            hectopascal = sensors.barometer(now)
            altitude = pressure_altitude(hectopascal)
        force = rounded_by_px4(imu.specific_force, FORCE_STEP)
        rates = rounded_by_px4(imu.body_rate, RATE_STEP)
        messages = [
            mav.MAVLink_hil_sensor_message(
                *(time_us, *force, *rates, field_x, field_y, field_z),
                *(hectopascal, 0.0, altitude, 20.0, fields, 0),
            )
        ]
        if self._offer.position is not Position.VISION and tick % _GPS_EVERY == 0:
            messages.append(self._gps(time_us))
        if self._offer.position is not Position.GPS and tick % self._vision_every == 0:
            messages.append(self._vision(time_us))
        if tick % _TRUTH_EVERY == 0:
            messages.append(_truth(time_us, now))
        return b"".join(self._pack(message) for message in messages)

    def _pack(self, message: Any) -> bytes:
        packed: bytes = message.pack(self._link)
        self._link.seq = (self._link.seq + 1) % 256
        return packed

    def _gps(self, time_us: int) -> Any:
        gps = self._sensors.gps(self._past[0])
        north, east, down = gps.velocity
        ground = math.hypot(north, east)
        return mav.MAVLink_hil_gps_message(
            self._utc_us + time_us,
            mav.GPS_FIX_TYPE_3D_FIX,
            *(round(gps.latitude * 1e7), round(gps.longitude * 1e7), round(gps.altitude * 1e3)),
            *(50, 80, round(ground * 100)),
            *(round(north * 100), round(east * 100), round(down * 100)),
            round(math.degrees(math.atan2(east, north)) % 360.0 * 100) % 36000,
            16,
        )

    def _vision(self, time_us: int) -> Any:
        seen = self._sensors.vision(self._past[0])
        noise = self._sensors.noise
        # Upper triangles of 6 x 6 by rows: the diagonal is at 0, 6, 11, 15, 18, 20.
        pose, twist = [0.0] * 21, [0.0] * 21
        pose[0] = pose[6] = pose[11] = max(noise.vision_position, 0.001) ** 2
        pose[15] = pose[18] = pose[20] = max(noise.vision_attitude, 0.001) ** 2
        twist[0] = twist[6] = twist[11] = max(noise.vision_velocity, 0.001) ** 2
        nan = math.nan
        return mav.MAVLink_odometry_message(
            time_us,
            mav.MAV_FRAME_LOCAL_NED,
            mav.MAV_FRAME_LOCAL_NED,
            *seen.position,
            seen.quaternion,
            *seen.velocity,
            *(nan, nan, nan),
            pose,
            twist,
            0,
            mav.MAV_ESTIMATOR_TYPE_VISION,
            100,
        )


def _truth(time_us: int, now: Moment) -> Any:
    """The ground truth for PX4's own log."""
    _, position, velocity, acceleration, _, _, _ = now
    x, y, z, w, a, b, c = position
    latitude, longitude, altitude = wire.geodetic((x, y, z))
    vx, vy, vz, p, q, r = velocity
    north, east, down = wire.ned((vx, vy, vz))
    ax, ay, az = wire.ned(acceleration)
    speed = round(math.sqrt(vx * vx + vy * vy + vz * vz) * 100)
    return mav.MAVLink_hil_state_quaternion_message(
        time_us,
        wire.attitude((w, a, b, c)),
        *(p, -q, -r),
        *(round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3)),
        *(_int16(north * 100), _int16(east * 100), _int16(down * 100)),
        *(min(speed, 65535), min(speed, 65535)),
        *(_int16(ax / 9.80665e-3), _int16(ay / 9.80665e-3), _int16(az / 9.80665e-3)),
    )


def _int16(value: float) -> int:
    return min(max(round(value), -32768), 32767)
