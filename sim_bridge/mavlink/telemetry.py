"""Every message that the simulated vehicle sends in streams: contents, and PX4's default rates on an onboard
link.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mav

from trueflight.sim_bridge.autopilot import Autopilot
from trueflight.sim_bridge.land_detector import Landed
from trueflight.sim_bridge.mavlink import wire
from trueflight.sim_bridge.mavlink.esc_status import ESC_STATUS, EscStatus
from trueflight.sim_bridge.modes import Mode

Build = Callable[[Autopilot], Any]

_UNKNOWN_COVARIANCE = (math.nan,) + (0.0,) * 20
_NAN = math.nan

_SENSORS = (
    mav.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mav.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mav.MAV_SYS_STATUS_SENSOR_GPS
    | mav.MAV_SYS_STATUS_SENSOR_ANGULAR_RATE_CONTROL
    | mav.MAV_SYS_STATUS_SENSOR_ATTITUDE_STABILIZATION
    | mav.MAV_SYS_STATUS_SENSOR_Z_ALTITUDE_CONTROL
    | mav.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL
    | mav.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
    | mav.MAV_SYS_STATUS_AHRS
    | mav.MAV_SYS_STATUS_SENSOR_BATTERY
)

CAPABILITIES = (
    mav.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mav.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mav.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | mav.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | mav.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | mav.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
    | mav.MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
    | mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)

_VERSION = 1 << 24 | 15 << 16 | 255  # behaves as PX4 1.15, release


def _heartbeat(a: Autopilot) -> Any:
    base = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    if a.armed:
        base |= mav.MAV_MODE_FLAG_SAFETY_ARMED
    if a.mode.by_pilot:
        base |= mav.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
    if a.mode.value[0] == 4:
        base |= mav.MAV_MODE_FLAG_AUTO_ENABLED
    if a.mode not in (Mode.MANUAL, Mode.ACRO):
        base |= mav.MAV_MODE_FLAG_STABILIZE_ENABLED
    state = mav.MAV_STATE_ACTIVE if a.armed else mav.MAV_STATE_STANDBY
    if a.killed:
        state = mav.MAV_STATE_FLIGHT_TERMINATION
    elif a.failsafe and a.armed:
        state = mav.MAV_STATE_CRITICAL
    return mav.MAVLink_heartbeat_message(
        mav.MAV_TYPE_QUADROTOR, mav.MAV_AUTOPILOT_PX4, base, a.mode.custom_mode, state, 3
    )


def _sys_status(a: Autopilot) -> Any:
    health = _SENSORS
    if not a.arming_refusals():
        health |= mav.MAV_SYS_STATUS_PREARM_CHECK
    battery = a.simulator.airframe.battery
    return mav.MAVLink_sys_status_message(
        _SENSORS | mav.MAV_SYS_STATUS_PREARM_CHECK,
        _SENSORS | mav.MAV_SYS_STATUS_PREARM_CHECK,
        health,
        200,
        round(a.simulator.reported().battery_voltage * 1e3),
        round(battery.current * 100),
        round(battery.charge * 100),
        *(0, 0, 0, 0, 0, 0),
    )


def _battery_status(a: Autopilot) -> Any:
    battery = a.simulator.airframe.battery
    voltage = a.simulator.reported().battery_voltage
    cells = round(battery.cell.volts_per_cell_volt)
    each = round(voltage * 1e3 / cells)
    return mav.MAVLink_battery_status_message(
        *(0, mav.MAV_BATTERY_FUNCTION_ALL, mav.MAV_BATTERY_TYPE_LIPO, 2500),
        [each if i < cells else 65535 for i in range(10)],
        round(battery.current * 100),
        round(battery.consumed / 3.6),
        -1,
        round(battery.charge * 100),
        round(battery.charge * battery.cell.capacity / max(battery.current, 0.1)),
        mav.MAV_BATTERY_CHARGE_STATE_OK if battery.charge > 0.2 else mav.MAV_BATTERY_CHARGE_STATE_LOW,
    )


def _odometry(a: Autopilot) -> Any:
    e = a.simulator.reported()
    x, y, z = e.position
    vx, vy, vz = e.velocity
    p, q, r = e.angular_velocity
    # As PX4 does: pose and velocity both in local NED (child frame 1, not a body frame), body rates in FRD.
    return mav.MAVLink_odometry_message(
        e.time_us,
        mav.MAV_FRAME_LOCAL_NED,
        mav.MAV_FRAME_LOCAL_NED,
        *(y, x, -z),
        wire.attitude(e.quaternion),
        *(vy, vx, -vz),
        *(p, -q, -r),
        _UNKNOWN_COVARIANCE,
        _UNKNOWN_COVARIANCE,
        0,
        mav.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        100,
    )


def _highres_imu(a: Autopilot) -> Any:
    e = a.simulator.reported()
    fx, fy, fz = e.specific_force
    p, q, r = e.angular_velocity
    _, _, altitude = wire.geodetic(e.position)
    w, x, y, z = wire.attitude(e.quaternion)
    # The field of Zurich in gauss, NED, turned into the body.
    north, east, down = 0.21, 0.01, 0.43
    mx = (1 - 2 * (y * y + z * z)) * north + 2 * (x * y + w * z) * east + 2 * (x * z - w * y) * down
    my = 2 * (x * y - w * z) * north + (1 - 2 * (x * x + z * z)) * east + 2 * (y * z + w * x) * down
    mz = 2 * (x * z + w * y) * north + 2 * (y * z - w * x) * east + (1 - 2 * (x * x + y * y)) * down
    pressure = 1013.25 * (1 - 2.25577e-5 * altitude) ** 5.25588
    return mav.MAVLink_highres_imu_message(
        e.time_us, *(fx, -fy, -fz), *(p, -q, -r), *(mx, my, mz), pressure, 0.0, altitude, 25.0, 0x1FFF, 0
    )


def _attitude(a: Autopilot) -> Any:
    e = a.simulator.reported()
    p, q, r = e.angular_velocity
    roll, pitch, yaw = wire.euler(wire.attitude(e.quaternion))
    return mav.MAVLink_attitude_message(e.time_us // 1000, roll, pitch, yaw, p, -q, -r)


def _attitude_quaternion(a: Autopilot) -> Any:
    e = a.simulator.reported()
    p, q, r = e.angular_velocity
    return mav.MAVLink_attitude_quaternion_message(
        e.time_us // 1000, *wire.attitude(e.quaternion), p, -q, -r, (1.0, 0.0, 0.0, 0.0)
    )


def _attitude_target(a: Autopilot) -> Any:
    target = a.attitude
    q = (_NAN,) * 4 if target is None else wire.attitude(target.quaternion)
    p, q_rate, r = a.rates
    return mav.MAVLink_attitude_target_message(
        a.time_us // 1000, 0x80 if target is None else 0, q, p, -q_rate, -r, a.thrust
    )


def _local_position(a: Autopilot) -> Any:
    e = a.simulator.reported()
    return mav.MAVLink_local_position_ned_message(
        e.time_us // 1000, *wire.ned(e.position), *wire.ned(e.velocity)
    )


def _global_position(a: Autopilot) -> Any:
    e = a.simulator.reported()
    latitude, longitude, altitude = wire.geodetic(e.position)
    north, east, down = wire.ned(e.velocity)
    yaw = wire.euler(wire.attitude(e.quaternion))[2]
    return mav.MAVLink_global_position_int_message(
        e.time_us // 1000,
        *(round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3)),
        round((e.position[2] - a.home[2]) * 1e3),
        *(round(north * 100), round(east * 100), round(down * 100)),
        round(math.degrees(yaw) % 360.0 * 100) % 36000,
    )


def _gps_raw(a: Autopilot) -> Any:
    e = a.simulator.reported()
    latitude, longitude, altitude = wire.geodetic(e.position)
    vx, vy, _ = e.velocity
    course = math.degrees(math.atan2(vx, vy)) % 360.0
    return mav.MAVLink_gps_raw_int_message(
        e.time_us,
        mav.GPS_FIX_TYPE_RTK_FIXED,
        *(round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3)),
        *(70, 100, round(math.hypot(vx, vy) * 100), round(course * 100) % 36000, 18),
        *(round(altitude * 1e3), 20, 30, 50, 0, 0),
    )


def _altitude(a: Autopilot) -> Any:
    e = a.simulator.reported()
    z = e.position[2]
    amsl = wire.ORIGIN[2] + z
    return mav.MAVLink_altitude_message(e.time_us, amsl, amsl, z, z - a.home[2], 0.0, z)


def _vfr_hud(a: Autopilot) -> Any:
    e = a.simulator.reported()
    vx, vy, vz = e.velocity
    yaw = math.degrees(wire.euler(wire.attitude(e.quaternion))[2])
    speed = math.hypot(vx, vy)
    return mav.MAVLink_vfr_hud_message(
        speed, speed, round(yaw % 360.0) % 360, round(100 * a.thrust), wire.ORIGIN[2] + e.position[2], vz
    )


def _extended_state(a: Autopilot) -> Any:
    return mav.MAVLink_extended_sys_state_message(mav.MAV_VTOL_STATE_UNDEFINED, int(a.landed))


def _estimator_status(a: Autopilot) -> Any:
    flags = (
        mav.ESTIMATOR_ATTITUDE
        | mav.ESTIMATOR_VELOCITY_VERT
        | mav.ESTIMATOR_POS_VERT_ABS
        | mav.ESTIMATOR_POS_VERT_AGL
    )
    at_rest = a.landed is Landed.ON_GROUND
    if a.parameters["EKF2_GPS_CTRL"]:
        accuracy = 0.03
        flags |= (
            mav.ESTIMATOR_VELOCITY_HORIZ
            | mav.ESTIMATOR_POS_HORIZ_REL
            | mav.ESTIMATOR_POS_HORIZ_ABS
            | mav.ESTIMATOR_PRED_POS_HORIZ_REL
            | mav.ESTIMATOR_PRED_POS_HORIZ_ABS
        )
    else:
        # As PX4 1.17: without any source it makes a position up while it stands still, and tells it to be good.
        accuracy = 0.02 if at_rest else 100.0
    if at_rest:
        flags |= mav.ESTIMATOR_CONST_POS_MODE  # PX4 since 1.16, whatever the position is worth
    return mav.MAVLink_estimator_status_message(
        a.time_us, flags, 0.02, 0.02, 0.02, 0.02, 0.0, 0.0, accuracy, 0.03
    )


def _home(a: Autopilot) -> Any:
    latitude, longitude, altitude = wire.geodetic(a.home)
    return mav.MAVLink_home_position_message(
        *(round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3)),
        *wire.ned(a.home),
        (1.0, 0.0, 0.0, 0.0),
        *(0.0, 0.0, 0.0),
        a.time_us,
    )


def _esc_status(a: Autopilot) -> Any:
    e = a.simulator.reported()
    battery = a.simulator.airframe.battery
    turns = [round(speed * 60 / (2 * math.pi)) for speed in e.rotor_speed]
    return EscStatus(0, e.time_us, turns, [e.battery_voltage] * 4, [battery.current / 4] * 4)


def _servo_output(a: Autopilot) -> Any:
    pulses = [round(1000 + 1000 * motor) if a.armed else 900 for motor in a.simulator.motors]
    return mav.MAVLink_servo_output_raw_message(a.time_us % 2**32, 0, *pulses, 0, 0, 0, 0)


def _system_time(a: Autopilot) -> Any:
    return mav.MAVLink_system_time_message(time.time_ns() // 1000, a.time_us // 1000)


def _autopilot_version(a: Autopilot) -> Any:
    return mav.MAVLink_autopilot_version_message(
        CAPABILITIES, _VERSION, _VERSION, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0x7F11E, [0] * 18
    )


STREAMS: dict[int, tuple[Build, float]] = {
    # Sent in this order when due together: a companion that acts on the odometry has the IMU of the same
    # moment.
    mav.MAVLINK_MSG_ID_HIGHRES_IMU: (_highres_imu, 50.0),
    mav.MAVLINK_MSG_ID_ODOMETRY: (_odometry, 30.0),
    mav.MAVLINK_MSG_ID_HEARTBEAT: (_heartbeat, 1.0),
    mav.MAVLINK_MSG_ID_SYS_STATUS: (_sys_status, 2.0),
    mav.MAVLINK_MSG_ID_SYSTEM_TIME: (_system_time, 1.0),
    mav.MAVLINK_MSG_ID_GPS_RAW_INT: (_gps_raw, 5.0),
    mav.MAVLINK_MSG_ID_ATTITUDE: (_attitude, 100.0),
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: (_attitude_quaternion, 50.0),
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: (_local_position, 30.0),
    mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: (_global_position, 10.0),
    mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: (_servo_output, 10.0),
    mav.MAVLINK_MSG_ID_VFR_HUD: (_vfr_hud, 10.0),
    mav.MAVLINK_MSG_ID_ATTITUDE_TARGET: (_attitude_target, 10.0),
    mav.MAVLINK_MSG_ID_ALTITUDE: (_altitude, 10.0),
    mav.MAVLINK_MSG_ID_BATTERY_STATUS: (_battery_status, 0.5),
    mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION: (_autopilot_version, 0.0),
    mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS: (_estimator_status, 1.0),
    mav.MAVLINK_MSG_ID_HOME_POSITION: (_home, 0.5),
    mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: (_extended_state, 1.0),
    ESC_STATUS: (_esc_status, 10.0),
}
"""Message id to (its contents, default rate in Hz; 0: on request only)."""

ESTIMATOR_STREAMS = frozenset(
    {
        mav.MAVLINK_MSG_ID_ODOMETRY,
        mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
    }
)
"""Messages that come no faster than the estimator runs (EKF2_PREDICT_US)."""
