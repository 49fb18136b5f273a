"""PX4 ULog files: NED and FRD become ENU and FLU here, once, and every topic comes onto one clock.

Topics and fields: PX4 user guide, "uORB Message Reference" (releases 1.11 to 1.16). The thrust command is the
collective that the control allocation received, `vehicle_thrust_setpoint`, so that any flight mode can be
analysed.
"""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from groundstation.reading.uniform import continuous_quaternion
from models.errors import InputError
from models.flight import Flight
from models.frames import enu_flu_from_ned_frd, enu_from_ned, flu_from_frd
from models.vehicle import Vehicle

RATE = 100.0
"""Hz of the clock that all topics are brought to."""
ARMED = 2  # vehicle_status.arming_state
SLOWEST_MOTORS = 20.0  # Hz; below it motor commands alias
XYZ = ("xyz[0]", "xyz[1]", "xyz[2]")
TOPICS = (
    "vehicle_local_position",
    "vehicle_odometry",
    "vehicle_attitude",
    "vehicle_angular_velocity",
    "sensor_combined",
    "vehicle_acceleration",
    "vehicle_thrust_setpoint",
    "vehicle_rates_setpoint",
    "vehicle_attitude_setpoint",
    "actuator_motors",
    "battery_status",
    "trajectory_setpoint",
    "vehicle_local_position_setpoint",
    "vehicle_status",
    "actuator_armed",
    "vehicle_land_detected",
    "esc_status",
)


@dataclass(frozen=True)
class Topic:
    """One topic of a log: `t` (M,) in s of the log's clock, and its fields by name."""

    name: str
    t: np.ndarray
    fields: dict[str, np.ndarray]

    @property
    def rate(self) -> float:
        """Mean rate, Hz."""
        return (len(self.t) - 1) / max(float(self.t[-1] - self.t[0]), 1e-9)

    def stack(self, *names: str) -> np.ndarray:
        """Fields as columns (M, k)."""
        return np.stack([np.asarray(self.fields[name], dtype=float) for name in names], -1)

    def has(self, *names: str) -> bool:
        """Whether the topic has all of these fields."""
        return all(name in self.fields for name in names)


def read_ulog(path: Path, vehicle: Vehicle) -> Flight:
    """The flight of a PX4 ULog, on an even clock of 100 Hz.

    Accelerometer and gyroscope are averaged over each period, which is centred and keeps what is above 50 Hz
    from aliasing; estimates are interpolated; setpoints are interpolated too, for the logger writes a subset
    of them. Only what was armed and not landed counts as flying. Heights are above the ground at takeoff.
    Raises `InputError` for a file that is no ULog, is cut short before the flight, or lacks a needed topic.
    """
    from groundstation.reading.flight_file import assemble

    topics, notes = _load(path)
    clock, armed, landed = _clock(path, topics)
    if armed[-1]:
        notes.append("the log ends while armed: it may be cut short")
    columns: dict[str, np.ndarray] = {}
    quaternion, said = _attitude(path, topics, clock)
    columns["quaternion"] = quaternion
    notes += said
    motion, said = _motion(topics, clock, armed & ~landed)
    columns |= motion
    notes += said
    inertial, said = _inertial(topics, clock)
    columns |= inertial
    notes += said
    commands, said = _commands(path, topics, clock, armed)
    columns |= commands
    notes += said
    columns |= _references(topics, clock, armed & ~landed)
    if (battery := topics.get("battery_status")) is not None and battery.has("voltage_v"):
        voltage = battery.fields["voltage_v"]
        if np.median(voltage) > 0.5:
            columns["battery_voltage"] = np.interp(clock, battery.t, voltage)
    if (columns_of_speed := _rotor_speed(topics, clock)) is not None:
        columns["rotor_speed"] = columns_of_speed
    return assemble(
        path,
        vehicle,
        clock - clock[0],
        columns,
        lambda row: f"{path}, t = {clock[min(row, len(clock) - 1)] - clock[0]:.2f} s",
        commanded=armed & ~landed,
        notes=tuple(notes),
    )


def _load(path: Path) -> tuple[dict[str, Topic], list[str]]:
    from pyulog import ULog

    try:
        # pyulog prints what it meets in a damaged file; we tell it ourselves.
        with contextlib.redirect_stdout(io.StringIO()):
            log = ULog(str(path), message_name_filter_list=list(TOPICS))
    except OSError as error:
        raise InputError(f"{path}: cannot read the log ({error.strerror or error}); check the path") from None
    except Exception as error:  # noqa: BLE001 - pyulog lets through whatever its parser meets
        raise InputError(
            f"{path}: not a whole ULog ({error}); copy it from the vehicle's card again"
        ) from None
    topics: dict[str, Topic] = {}
    for data in sorted(log.data_list, key=lambda d: d.multi_id, reverse=True):  # instance 0 last: it wins
        topic = _topic(data)
        if topic is not None:
            topics[data.name] = topic
    notes = []
    if log.dropouts:
        lost = sum(d.duration for d in log.dropouts) / 1000
        notes.append(f"the logger dropped data {len(log.dropouts)} times, {lost:.1f} s in all")
    if log.file_corruption:
        notes.append("parts of the log are damaged and were skipped")
    if not topics:
        raise InputError(
            f"{path}: the log holds none of the topics of a flight (cut short?); log with PX4's default "
            "profile"
        )
    return topics, notes


def _topic(data: Any) -> Topic | None:
    fields = dict(data.data)
    stamp = np.asarray(fields["timestamp"], dtype=np.int64)
    sample = fields.get("timestamp_sample")
    # The time of measurement, where it is known and sane; the time of publication otherwise.
    if (
        sample is not None
        and np.all(sample > 0)
        and np.max(np.abs(stamp - sample.astype(np.int64))) < 1_000_000
    ):
        stamp = np.asarray(sample, dtype=np.int64)
    keep = np.concatenate([[True], np.diff(np.maximum.accumulate(stamp)) > 0])
    if keep.sum() < 2:
        return None
    return Topic(data.name, stamp[keep] * 1e-6, {name: np.asarray(v)[keep] for name, v in fields.items()})


def _clock(path: Path, topics: dict[str, Topic]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The clock (N,) in s over what was armed plus 2 s on both sides, and where armed and landed (N,)
    bool."""
    for name, field, value in (("vehicle_status", "arming_state", ARMED), ("actuator_armed", "armed", 1)):
        if (status := topics.get(name)) is not None and status.has(field):
            armed_topic, is_armed = status, status.fields[field] == value
            break
    else:
        raise InputError(f"{path}: vehicle_status is not in the log, so what was armed is unknown; log it")
    if not np.any(is_armed):
        raise InputError(f"{path}: the vehicle was never armed in this log; take the log of a flight")
    needed = [
        t for n, t in topics.items() if n in ("vehicle_attitude", "vehicle_odometry", "sensor_combined")
    ]
    if not needed:
        raise InputError(
            f"{path}: neither vehicle_attitude nor sensor_combined is in the log; log with PX4's default "
            "profile"
        )
    begin = max(t.t[0] for t in needed)
    end = min(t.t[-1] for t in needed)
    armed_times = armed_topic.t[is_armed]
    first, last = max(begin, armed_times[0] - 2.0), min(end, armed_times[-1] + 2.0)
    if last - first < 2.0:
        raise InputError(
            f"{path}: only {max(last - first, 0):.1f} s are armed in this log (cut short?); take the log of "
            "a flight"
        )
    clock = np.arange(first, last, 1.0 / RATE)
    armed = _held(armed_topic.t, is_armed, clock)
    land = topics.get("vehicle_land_detected")
    landed = (
        _held(land.t, land.fields["landed"] > 0, clock) if land is not None else np.zeros(len(clock), bool)
    )
    return clock, armed, landed


def _attitude(path: Path, topics: dict[str, Topic], clock: np.ndarray) -> tuple[np.ndarray, list[str]]:
    fields = tuple(f"q[{i}]" for i in range(4))
    topic = topics.get("vehicle_attitude") or topics.get("vehicle_odometry")
    if topic is None or not topic.has(*fields):
        raise InputError(f"{path}: vehicle_attitude is not in the log; log it (PX4's default profile does)")
    turned = continuous_quaternion(enu_flu_from_ned_frd(topic.stack(*fields)))
    at = np.stack([np.interp(clock, topic.t, c) for c in turned.T], -1)
    notes = [] if topic.name == "vehicle_attitude" else ["attitude is that of vehicle_odometry"]
    return at / np.linalg.norm(at, axis=1, keepdims=True), notes


def _motion(
    topics: dict[str, Topic], clock: np.ndarray, in_air: np.ndarray
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Position and velocity, ENU; heights above the ground at takeoff."""
    local, odometry = topics.get("vehicle_local_position"), topics.get("vehicle_odometry")
    notes: list[str] = []
    if local is not None and local.has("x", "y", "z", "vx", "vy", "vz"):
        position, velocity, t = local.stack("x", "y", "z"), local.stack("vx", "vy", "vz"), local.t
        if local.has("xy_reset_counter", "z_reset_counter"):
            counters = local.stack("xy_reset_counter", "z_reset_counter")
            during = np.interp(t, clock, in_air.astype(float)) > 0.5
            resets = int(np.sum(np.any(np.diff(counters, axis=0) != 0, axis=1) & during[1:]))
            if resets:
                notes.append(f"the estimator reset its position {resets} times in the air")
    elif odometry is not None and odometry.has("position[0]", "velocity[0]"):
        position = odometry.stack(*(f"position[{i}]" for i in range(3)))
        velocity, t = odometry.stack(*(f"velocity[{i}]" for i in range(3))), odometry.t
        notes.append("position and velocity are those of vehicle_odometry")
    else:
        return {}, ["the log has no position"]
    at = [np.stack([np.interp(clock, t, c) for c in enu_from_ned(v).T], -1) for v in (position, velocity)]
    before = np.flatnonzero(in_air)
    if before.size and before[0] > 0:
        ground = float(np.median(at[0][max(0, before[0] - 50) : before[0], 2]))
        at[0][:, 2] -= ground
        if abs(ground) > 0.05:
            notes.append(f"heights are above the ground at takeoff ({ground:.2f} m in the log)")
    return {"position": at[0], "velocity": at[1]}, notes


def _inertial(topics: dict[str, Topic], clock: np.ndarray) -> tuple[dict[str, np.ndarray], list[str]]:
    """Accelerometer and gyroscope, FLU, each the mean over a period of the clock."""
    out: dict[str, np.ndarray] = {}
    notes: list[str] = []
    combined = topics.get("sensor_combined")
    accelerometer = tuple(f"accelerometer_m_s2[{i}]" for i in range(3))
    gyro = tuple(f"gyro_rad[{i}]" for i in range(3))
    filtered, rates = topics.get("vehicle_acceleration"), topics.get("vehicle_angular_velocity")
    if combined is not None and combined.has(*accelerometer):
        out["specific_force"] = flu_from_frd(_mean(combined.t, combined.stack(*accelerometer), clock))
    elif filtered is not None and filtered.rate > 0.4 * RATE:
        out["specific_force"] = flu_from_frd(_mean(filtered.t, filtered.stack(*XYZ), clock))
        notes.append("the accelerometer is PX4's filtered vehicle_acceleration")
    else:
        notes.append("no accelerometer fast enough in the log (sensor_combined is not logged)")
    if rates is not None and rates.rate > 0.4 * RATE:
        out["angular_velocity"] = flu_from_frd(_mean(rates.t, rates.stack(*XYZ), clock))
    elif combined is not None and combined.has(*gyro):
        out["angular_velocity"] = flu_from_frd(_mean(combined.t, combined.stack(*gyro), clock))
    return out, notes


def _commands(
    path: Path, topics: dict[str, Topic], clock: np.ndarray, armed: np.ndarray
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Normalised collective (up is positive; 0 while disarmed), body rates, motor commands."""
    out: dict[str, np.ndarray] = {}
    notes: list[str] = []
    for name, field in (
        ("vehicle_thrust_setpoint", "xyz[2]"),
        ("vehicle_rates_setpoint", "thrust_body[2]"),
        ("vehicle_attitude_setpoint", "thrust_body[2]"),
    ):
        topic = topics.get(name)
        if topic is None or not topic.has(field) or topic.rate < 10.0:
            continue
        thrust = _interpolated(topic.t, -topic.fields[field].astype(float), clock)
        out["thrust_command"] = np.where(armed, np.nan_to_num(thrust), 0.0)
        if topic.rate < 0.9 * RATE:
            notes.append(
                f"thrust is {name}, logged at {topic.rate:.0f} Hz: nothing faster than half of that is known"
            )
        break
    motors = topics.get("actuator_motors")
    fields = tuple(f"control[{i}]" for i in range(4))
    if motors is not None and motors.has(*fields) and motors.rate >= SLOWEST_MOTORS:
        commands = np.stack([_interpolated(motors.t, c, clock) for c in motors.stack(*fields).T], -1)
        out["motor_command"] = np.where(armed[:, None], np.nan_to_num(commands), 0.0)
    if "thrust_command" not in out and "motor_command" not in out:
        raise InputError(
            f"{path}: no thrust command in the log (vehicle_thrust_setpoint, vehicle_rates_setpoint or "
            "actuator_motors at 20 Hz); log with PX4's default or high-rate profile"
        )
    rates = topics.get("vehicle_rates_setpoint")
    if rates is not None and rates.rate >= 0.2 * RATE:
        wanted = flu_from_frd(rates.stack("roll", "pitch", "yaw"))
        out["body_rate_command"] = np.nan_to_num(
            np.stack([_interpolated(rates.t, c, clock) for c in wanted.T], -1)
        )
    return out, notes


def _references(topics: dict[str, Topic], clock: np.ndarray, in_air: np.ndarray) -> dict[str, np.ndarray]:
    """Reference position, where one was followed for most of the flight (offboard by body rates has none)."""
    candidates = (
        ("trajectory_setpoint", tuple(f"position[{i}]" for i in range(3))),
        ("vehicle_local_position_setpoint", ("x", "y", "z")),
    )
    for name, fields in candidates:
        topic = topics.get(name)
        if topic is None or not topic.has(*fields):
            continue
        wanted = enu_from_ned(topic.stack(*fields))
        known = np.all(np.isfinite(wanted), axis=1)
        if known.sum() > 2 and np.mean(_held(topic.t, known, clock)[in_air]) > 0.5:
            t = topic.t[known]
            return {"position_reference": np.stack([np.interp(clock, t, c) for c in wanted[known].T], -1)}
    return {}


def _rotor_speed(topics: dict[str, Topic], clock: np.ndarray) -> np.ndarray | None:
    esc = topics.get("esc_status")
    fields = tuple(f"esc[{i}].esc_rpm" for i in range(4))
    if esc is None or not esc.has(*fields) or esc.rate < 10.0:
        return None
    speed = np.abs(esc.stack(*fields)) * np.pi / 30
    return np.stack([np.interp(clock, esc.t, c) for c in speed.T], -1) if np.any(speed > 0) else None


def _held(t: np.ndarray, values: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """The last value at or before each time; the first one before it."""
    return values[np.clip(np.searchsorted(t, clock, side="right") - 1, 0, len(t) - 1)]


def _interpolated(t: np.ndarray, values: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """Finite values, linear in between; nan where none is near (before the first, in a pause of the
    topic)."""
    good = np.isfinite(values)
    if good.sum() < 2:
        return np.full(len(clock), np.nan)
    t, values = t[good], values[good]
    out = np.interp(clock, t, values)
    after = np.clip(np.searchsorted(t, clock), 1, len(t) - 1)
    pause = t[after] - t[after - 1] > 0.5
    held = values[after - 1]
    out = np.where(pause, held, out)
    return np.where((clock < t[0]) | (clock > t[-1] + 0.5), np.nan, out)


def _mean(t: np.ndarray, values: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """Mean of samples (M, 3) over one period around each time, from their running integral."""
    integral = np.zeros_like(values)
    integral[1:] = np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t)[:, None], axis=0)
    half = 0.5 / RATE
    late, early = np.minimum(clock + half, t[-1]), np.maximum(clock - half, t[0])
    columns = [
        (np.interp(late, t, c) - np.interp(early, t, c)) / np.maximum(late - early, 1e-9) for c in integral.T
    ]
    return np.stack(columns, -1)
