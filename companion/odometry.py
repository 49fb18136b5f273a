"""Odometry, accelerometer, setpoints and poses between MAVLink, which speaks NED and FRD, and ENU and FLU.

Nothing else in the companion knows of NED and FRD. Pure functions of the fields of a message; the wire itself is
`companion.vehicle_link`.
"""

from __future__ import annotations

import json
import math
from typing import Any, NamedTuple

import numpy as np

from trueflight.models import frames
from trueflight.models.pose import Pose

Vector = tuple[float, float, float]

_ROOT_HALF = math.sqrt(0.5)
_FRAMES_WORLD_NED = (1,)  # MAV_FRAME_LOCAL_NED: what PX4 says of its odometry's velocity
_FRAMES_BODY_FRD = (8, 12)  # MAV_FRAME_BODY_NED (deprecated name) and MAV_FRAME_BODY_FRD


class Odometry(NamedTuple):
    """One odometry message, ENU and FLU, SI; `vehicle_time_us` is the vehicle's clock, `host_time_ns` ours.

    `age` s passed by the vehicle's clock from the stamp to `host_time_ns`; `overtaken` samples before this one were not
    looked at, because newer ones were waiting.
    """

    vehicle_time_us: int
    host_time_ns: int
    position: Vector
    velocity: Vector
    quaternion: tuple[float, float, float, float]
    angular_velocity: Vector
    reset_counter: int
    age: float = 0.0
    overtaken: int = 0


class ImuSample(NamedTuple):
    """One HIGHRES_IMU message: the vehicle's clock in us, m/s² and rad/s in FLU."""

    time_us: int
    specific_force: Vector
    gyro: Vector


class VisionEstimate(NamedTuple):
    """A pose as VISION_POSITION_ESTIMATE tells it: position m NED, `angles` rad (roll, pitch, yaw of FRD).

    `taken_us` since 1970. `covariance` is the upper right triangle of the 6 x 6 matrix of both, row by row, or a single
    NaN where it is not known.
    """

    taken_us: int
    position: Vector
    angles: Vector
    covariance: list[float]
    reset_counter: int


def odometry_from_wire(fields: dict[str, Any], age: float = 0.0, overtaken: int = 0) -> Odometry | None:
    """An ODOMETRY message (fields as on the wire, NED and FRD, `arrived` ns) in ENU and FLU.

    The velocity is turned according to `child_frame_id`. None where a number that is needed is not there (PX4
    sends NaN for an estimate it has not got) or the quaternion is not unit. Raises `ValueError` for a frame
    that is unknown.
    """
    numbers = [fields[k] for k in ("x", "y", "z", "vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed")]
    numbers += fields["q"]
    if None in numbers or not math.isfinite(sum(numbers)):
        return None
    x, y, z, vx, vy, vz, p, q, r, w, i, j, k = numbers
    size = w * w + i * i + j * j + k * k
    if not 0.98 < size < 1.02:
        return None
    size = 1.0 / math.sqrt(size)
    w, i, j, k = w * size, i * size, j * size, k * size
    frame = fields["child_frame_id"]
    if frame in _FRAMES_BODY_FRD:
        # Body FRD to NED by the attitude: v + 2 q x (q x v + w v).
        a, b, c = j * vz - k * vy + w * vx, k * vx - i * vz + w * vy, i * vy - j * vx + w * vz
        vx, vy, vz = vx + 2 * (j * c - k * b), vy + 2 * (k * a - i * c), vz + 2 * (i * b - j * a)
    elif frame not in _FRAMES_WORLD_NED:
        raise ValueError(f"velocity in the frame {frame}, which is neither local NED nor body FRD")
    # The same map as models.frames.enu_flu_from_ned_frd, for one sample.
    attitude = (_ROOT_HALF * (w + k), _ROOT_HALF * (i + j), _ROOT_HALF * (i - j), _ROOT_HALF * (w - k))
    return Odometry(
        int(fields["time_usec"]),
        fields["arrived"],
        (y, x, -z),
        (vy, vx, -vz),
        attitude,
        (p, -q, -r),
        int(fields.get("reset_counter", 0)),
        age,
        overtaken,
    )


def imu_from_wire(text: str) -> ImuSample | None:
    """A HIGHRES_IMU message (JSON as on the wire, FRD) in FLU; None where a number that is needed is not there."""
    try:
        fields = json.loads(text)
        force = fields["xacc"], -fields["yacc"], -fields["zacc"]
        gyro = fields["xgyro"], -fields["ygyro"], -fields["zgyro"]
        if not math.isfinite(sum(force) + sum(gyro)):
            return None
        return ImuSample(int(fields["time_usec"]), force, gyro)
    except (KeyError, TypeError, ValueError):
        return None


def without_covariance(text: str) -> str:
    """The JSON of a message without its covariances: 42 numbers that nobody here reads and that take half the
    time.
    """
    for name in ('"pose_covariance":[', '"velocity_covariance":['):
        begin = text.find(name)
        if begin >= 0:
            text = text[:begin] + text[text.index("],", begin) + 2 :]
    return text


def vision_estimate(pose: Pose, taken_us: int, reset_counter: int) -> VisionEstimate:
    """A pose in ENU and FLU as the autopilot wants it: NED, and roll, pitch, yaw of FRD."""
    north, east, down = (float(x) for x in frames.enu_from_ned(np.array(pose.position)))
    attitude = frames.enu_flu_from_ned_frd(np.array(pose.quaternion))
    roll, pitch, yaw = (float(x) for x in frames.euler_from_quaternion(attitude))
    covariance = [math.nan]
    if math.isfinite(pose.position_std) and math.isfinite(pose.attitude_std):
        covariance = [0.0] * 21
        for i, std in zip(
            (0, 6, 11, 15, 18, 20), (pose.position_std,) * 3 + (pose.attitude_std,) * 3, strict=True
        ):
            covariance[i] = std * std
    return VisionEstimate(taken_us, (north, east, down), (roll, pitch, yaw), covariance, reset_counter)


def setpoint_on_wire(system: int, time_us: int, thrust: float, body_rate: Vector) -> str:
    """JSON of a SET_ATTITUDE_TARGET for `system`: normalised collective, body rates (rad/s, FLU); attitude ignored."""
    p, q, r = body_rate
    return (
        f'{{"time_boot_ms":{time_us // 1000 & 0xFFFFFFFF},"target_system":{system},'
        f'"target_component":1,"type_mask":128,"body_roll_rate":{p:.7g},'
        f'"body_pitch_rate":{-q:.7g},"body_yaw_rate":{-r:.7g},"thrust":{thrust:.7g}}}'
    )
