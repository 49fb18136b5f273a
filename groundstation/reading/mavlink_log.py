"""What a ground station recorded of a vehicle's MAVLink (`.tlog`), brought to the topics of a PX4 log.

A telemetry log is each message with the time at which it came. Of several vehicles one is read, and of it what its
autopilot sent. Messages that tell the vehicle's time have it, the others are brought to it.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from trueflight.groundstation.reading import ardupilot_log
from trueflight.groundstation.reading.ardupilot_motors import frame_of, of_pulses
from trueflight.groundstation.reading.px4_airborne import MOTORS
from trueflight.groundstation.reading.px4_log import MODES, Fields, Frame, Log, collect
from trueflight.groundstation.reading.rows import as_us, possible
from trueflight.groundstation.reading.sources import Sources
from trueflight.models.errors import InputError
from trueflight.models.frames import quaternion_from_euler
from trueflight.models.outside import unreadable
from trueflight.models.vehicle import GRAVITY

STAMP, EARTH = 8, 6_371_000.0
"""Bytes of the time before each message, us since 1970, big-endian; m, the earth's radius."""
PARAMETER = 22
EARLIEST, LATEST = 946_684_800_000_000, 4_102_444_800_000_000
"""us since 1970, the years 2000 to 2100: what no message of a whole log is before or after."""
ARMED_FLAG, INVALID = 128, 8
ARDUPILOT, PX4 = 3, 12
APART = 0.5  # s; stamps further from the others' count another clock
ADVICE = (
    "raise the telemetry's rates (SRn_EXTRA1, SRn_POSITION, SRn_RC_CHAN, SRn_RAW_SENS to 10 Hz or more), or take the "
    "log of the vehicle itself (.bin, .ulg)"
)
FINER, OFTENER = ("actuator_motors", "actuator_outputs", "vehicle_rates_setpoint"), 1.5
"""What tells the thrust finer than whole percents, and how many times as often those must come to be read instead."""
NAMES = {
    "vehicle_attitude": "ATTITUDE",
    "vehicle_local_position": "LOCAL_POSITION_NED",
    "sensor_combined": "HIGHRES_IMU",
    "vehicle_acceleration": "RAW_IMU",
    "vehicle_angular_velocity": "ATTITUDE",
    "vehicle_rates_setpoint": "ATTITUDE_TARGET",
    "vehicle_thrust_setpoint": "ATTITUDE_TARGET",
    "vehicle_attitude_setpoint": "VFR_HUD",
    "actuator_controls_0": "VFR_HUD",
    "actuator_motors": "SERVO_OUTPUT_RAW",
    "actuator_outputs": "SERVO_OUTPUT_RAW",
    "esc_status": "ESC_TELEMETRY",
    "vehicle_land_detected": "EXTENDED_SYS_STATE",
}
PX4_MODES = {(1, 0): 0, (2, 0): 1, (3, 0): 2, (4, 2): 17, (4, 3): 4, (4, 4): 3, (4, 5): 5, (4, 6): 18, (4, 8): 19,
             (5, 0): 10, (6, 0): 14, (7, 0): 15}  # fmt: skip
"""`nav_state` of PX4's main and sub mode, as its heartbeat tells them."""


@dataclass
class Received:
    """Messages of one type: times of receipt (us), and the numbers of each."""

    received: list[int] = field(default_factory=list)
    rows: list[dict[str, Any]] = field(default_factory=list)

    def column(self, name: str) -> np.ndarray:
        """A field (M,) as floats."""
        return possible(np.array([float(row[name]) for row in self.rows]))

    def stack(self, *names: str) -> np.ndarray:
        """Fields as columns (M, k)."""
        return np.stack([self.column(name) for name in names], -1)


def load_tlog(path: Path, sources: Sources | None = None) -> Log:
    """Read a telemetry log, also one that is cut short or damaged: the vehicle with most messages, or that whose system
    number is `sources.namespace`. Raises `InputError` for a file that is none, or has no autopilot in it."""
    with unreadable(path, "the log", "save it from the ground station again", "not a whole telemetry log"):
        every, skipped = _messages(path)
        system, note = _system(path, every, (sources or Sources()).namespace)
        kinds = every[system]
        notes = [f"{skipped} bytes are no messages and were skipped"] if skipped else []
        return _log(path, kinds, [*notes, *note])


def _messages(path: Path) -> tuple[dict[int, dict[str, Received]], int]:
    """The messages that are used, by system and type; and how many bytes were none."""
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    numbers = {
        number for number, kind in dialect.mavlink_map.items() if kind.msgname in _READ or number == PARAMETER
    }
    reader = dialect.MAVLink(None)
    every: dict[int, dict[str, Received]] = {}
    data = path.read_bytes()
    skipped = 0
    for received, start, end in _framed(data):
        if start < 0:
            skipped += end
            continue
        second = data[start] == 0xFD
        number = int.from_bytes(data[start + 7 : start + 10], "little") if second else data[start + 5]
        if number not in numbers:
            continue
        try:
            message = reader.decode(bytearray(data[start:end]))
        except Exception:  # noqa: BLE001 - MAVError, or whatever its unpacking meets: a damaged message is left out
            skipped += end - start
            continue
        if message.get_srcComponent() == 1:
            kinds = every.setdefault(message.get_srcSystem(), {})
            one = kinds.setdefault(message.get_type(), Received())
            one.received.append(received)
            one.rows.append({name: getattr(message, name) for name in message.get_fieldnames()})
    return every, skipped


def _framed(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Time of receipt, beginning and end of each message; a beginning of -1 and a length for what is none."""
    at, size = 0, len(data)
    while at + STAMP + 8 <= size:
        stamp = int.from_bytes(data[at : at + STAMP], "big")
        start = at + STAMP
        length = {0xFE: 8, 0xFD: 12}.get(data[start], 0)
        if length == 12 and data[start + 2] & 1:
            length += 13  # signed
        end = start + length + data[start + 1]
        if not length or not EARLIEST < stamp < LATEST or end > size:
            yield 0, -1, 1
            at += 1
            continue
        yield stamp, start, end
        at = end


def _system(path: Path, every: dict[int, dict[str, Received]], asked: str | None) -> tuple[int, list[str]]:
    """The vehicle that is read, and what to say of the others."""
    pilots = {
        system: sum(len(one.rows) for one in kinds.values())
        for system, kinds in every.items()
        if "HEARTBEAT" in kinds and np.median(kinds["HEARTBEAT"].column("autopilot")) != INVALID
    }
    if not pilots:
        raise InputError(
            f"{path}: no MAVLink messages of an autopilot in it; save the telemetry as a .tlog again"
        )
    if asked is not None:
        number = int(asked.strip("/")) if asked.strip("/").isdigit() else -1
        if number not in pilots:
            has = ", ".join(map(str, sorted(pilots)))
            raise InputError(
                f"{path}: no vehicle '{asked}' in the log; --vehicle-namespace takes one of {has}"
            )
        return number, [f"vehicle {number} of {', '.join(map(str, sorted(pilots)))} is read, as chosen"]
    best = max(sorted(pilots), key=lambda system: pilots[system])
    if len(pilots) == 1:
        return best, []
    others = ", ".join(str(system) for system in sorted(pilots) if system != best)
    return best, [f"vehicle {best} is read, which sent most; --vehicle-namespace takes {others}"]


def _log(path: Path, kinds: dict[str, Received], notes: list[str]) -> Log:
    beats = kinds["HEARTBEAT"]
    ours = int(Counter(beats.column("autopilot").astype(int).tolist()).most_common(1)[0][0])
    parameters = {
        str(row["param_id"]).split("\0")[0]: float(row["param_value"])
        for row in kinds.get("PARAM_VALUE", Received()).rows
        if math.isfinite(row["param_value"])
    }
    system_type = int(np.median(beats.column("type")))
    frame: Frame | str | None = None
    if ours == ARDUPILOT and system_type in MOTORS:
        frame = (
            frame_of(parameters, [])
            if "FRAME_CLASS" in parameters
            else Frame(MOTORS[system_type], f"MAV_TYPE {system_type}")
        )
    clock, shift = _clock(kinds)
    parts: list[tuple[str, int, Fields]] = []
    for kind, made in _READ.items():
        if kind in kinds and len(kinds[kind].rows) > 1:
            t = _stamp(kinds[kind], clock, shift)
            parts += [
                (n, i, {"timestamp": t, **fields}) for n, i, fields in made(kinds[kind], ours == ARDUPILOT)
            ]
    if isinstance(frame, Frame) and (servos := kinds.get("SERVO_OUTPUT_RAW")) is not None:
        outputs = {
            i: servos.column(f"servo{i + 1}_raw") for i in range(16) if f"servo{i + 1}_raw" in servos.rows[0]
        }
        parts += of_pulses(_stamp(servos, clock, shift), outputs, parameters, frame.count)
    finer = [len(fields["timestamp"]) for name, _, fields in parts if name in FINER]
    parts = [
        part
        for part in parts
        if part[0] != "vehicle_attitude_setpoint"
        or len(part[2]["timestamp"]) > OFTENER * max(finer, default=0)
    ]
    told = {name for name, instance, _ in parts if instance == 0}
    parts = [part for part in parts if part[1] == 0 or part[0] not in told]
    version = _version(kinds)
    return Log(
        str(path),
        collect(parts),
        parameters,
        version=version,
        notes=tuple(notes),
        advice=ADVICE,
        faster=ADVICE,
        autopilot={ARDUPILOT: "ArduPilot", PX4: "PX4"}.get(ours, f"MAV_AUTOPILOT {ours}"),
        modes=ardupilot_log.MODES if ours == ARDUPILOT else MODES,
        names=NAMES,
        frame=frame if isinstance(frame, Frame) else None,
        filtered=ours == ARDUPILOT,
    )


def _version(kinds: dict[str, Received]) -> str:
    """The release that AUTOPILOT_VERSION tells, or a text of the vehicle."""
    told = kinds.get("AUTOPILOT_VERSION")
    if told is not None and (number := int(told.rows[-1]["flight_sw_version"])):
        return f"{number >> 24 & 255}.{number >> 16 & 255}.{number >> 8 & 255}"
    for row in kinds.get("STATUSTEXT", Received()).rows:
        if found := re.match(r"ArduCopter V(\d[\w.]*)", str(row["text"])):
            return found[1]
    return ""


def _own(one: Received) -> np.ndarray | None:
    """The vehicle's times (M,) in us, of messages that have them."""
    for name, unit in (("time_boot_ms", 1000.0), ("time_usec", 1.0)):
        if name in one.rows[0]:
            t = one.column(name) * unit
            return t if np.all(t > 0) else None
    return None


def _clock(kinds: dict[str, Received]) -> tuple[float, bool]:
    """By how much (us) times of receipt are later than those since boot; and whether any message tells those."""
    known = [
        np.array(one.received) - t
        for name in ("ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT")
        if (one := kinds.get(name)) is not None and (t := _own(one)) is not None
    ]
    return (float(np.median(np.concatenate(known))), True) if known else (0.0, False)


def _stamp(one: Received, clock: float, known: bool) -> np.ndarray:
    """Times (M,) in us of one clock."""
    received = np.array(one.received, dtype=float) - clock
    own = _own(one) if known else None
    if own is None:
        return as_us(received)
    apart = float(np.median(received - own))
    return as_us(own + (apart if abs(apart) > 1e6 * APART else 0.0))


Made = list[tuple[str, int, Fields]]


def _vector(name: str, columns: np.ndarray) -> Fields:
    return {f"{name}[{i}]": columns[:, i] for i in range(columns.shape[1])}


def _heartbeat(one: Received, ardupilot: bool) -> Made:
    armed = one.column("base_mode").astype(int) & ARMED_FLAG > 0
    mode = one.column("custom_mode").astype(np.int64)
    if not ardupilot:
        mode = np.array([PX4_MODES.get((int(m) >> 16 & 255, int(m) >> 24 & 255), -1) for m in mode])
    fields = {"arming_state": np.where(armed, 2.0, 1.0), "system_type": one.column("type"), "nav_state": mode}
    return [("vehicle_status", 0, fields)]


def _attitude(one: Received, _: bool) -> Made:
    q = quaternion_from_euler(one.stack("roll", "pitch", "yaw"))
    rates = one.stack("rollspeed", "pitchspeed", "yawspeed")
    return [("vehicle_attitude", 0, _vector("q", q)), ("vehicle_angular_velocity", 0, _vector("xyz", rates))]


def _quaternion(one: Received, _: bool) -> Made:
    return [("vehicle_attitude", 1, _vector("q", one.stack("q1", "q2", "q3", "q4")))]


def _local(one: Received, _: bool) -> Made:
    return [("vehicle_local_position", 0, {n: one.column(n) for n in ("x", "y", "z", "vx", "vy", "vz")})]


def _global(one: Received, _: bool) -> Made:
    latitude, longitude = (np.radians(1e-7 * one.column(n)) for n in ("lat", "lon"))
    x = EARTH * (latitude - latitude[0])
    y = EARTH * np.cos(latitude[0]) * (longitude - longitude[0])
    speeds = {n: 0.01 * one.column(n) for n in ("vx", "vy", "vz")}
    return [
        ("vehicle_local_position", 1, {"x": x, "y": y, "z": -1e-3 * one.column("relative_alt"), **speeds})
    ]


def _imu(one: Received, ardupilot: bool) -> Made:
    if not ardupilot:  # another autopilot's are counts of its own
        return []
    force = 1e-3 * GRAVITY * one.stack("xacc", "yacc", "zacc")
    return [("vehicle_acceleration", 0, _vector("xyz", force))]


def _highres(one: Received, _: bool) -> Made:
    fields = _vector("accelerometer_m_s2", one.stack("xacc", "yacc", "zacc"))
    return [("sensor_combined", 0, fields | _vector("gyro_rad", one.stack("xgyro", "ygyro", "zgyro")))]


def _target(one: Received, _: bool) -> Made:
    rates = dict(
        zip(
            ("roll", "pitch", "yaw"),
            one.stack("body_roll_rate", "body_pitch_rate", "body_yaw_rate").T,
            strict=True,
        )
    )
    return [("vehicle_rates_setpoint", 0, {**rates, "thrust_body[2]": -one.column("thrust")})]


def _throttle(one: Received, _: bool) -> Made:
    return [("vehicle_attitude_setpoint", 0, {"thrust_body[2]": -0.01 * one.column("throttle")})]


def _servos(one: Received, ardupilot: bool) -> Made:
    if ardupilot:
        return []
    found = [i for i in range(16) if f"servo{i + 1}_raw" in one.rows[0]]
    return [("actuator_outputs", 0, {f"output[{i}]": one.column(f"servo{i + 1}_raw") for i in found})]


def _battery(one: Received, _: bool) -> Made:
    cells = np.array([row["voltages"] for row in one.rows], dtype=float)
    cells[cells >= 65535] = 0.0
    current = 0.01 * one.column("current_battery")
    return [("battery_status", 0, {"voltage_v": 1e-3 * cells.sum(axis=1), "current_a": current})]


def _power(one: Received, _: bool) -> Made:
    return [
        (
            "battery_status",
            1,
            {
                "voltage_v": 1e-3 * one.column("voltage_battery"),
                "current_a": 0.01 * one.column("current_battery"),
            },
        )
    ]


def _landed(one: Received, _: bool) -> Made:
    state = one.column("landed_state")
    return [("vehicle_land_detected", 0, {"landed": (state == 1).astype(float)})] if np.any(state > 0) else []


def _reference(one: Received, _: bool) -> Made:
    return [("trajectory_setpoint", 0, _vector("position", one.stack("x", "y", "z")))]


def _speeds(one: Received, _: bool) -> Made:
    rpm = np.array([row["rpm"] for row in one.rows], dtype=float)
    return [("esc_status", 0, {f"esc[{i}].esc_rpm": rpm[:, i] for i in range(rpm.shape[1])})]


_READ: dict[str, Callable[[Received, bool], Made]] = {
    "HEARTBEAT": _heartbeat,
    "ATTITUDE": _attitude,
    "ATTITUDE_QUATERNION": _quaternion,
    "LOCAL_POSITION_NED": _local,
    "GLOBAL_POSITION_INT": _global,
    "RAW_IMU": _imu,
    "HIGHRES_IMU": _highres,
    "ATTITUDE_TARGET": _target,
    "VFR_HUD": _throttle,
    "SERVO_OUTPUT_RAW": _servos,
    "BATTERY_STATUS": _battery,
    "SYS_STATUS": _power,
    "EXTENDED_SYS_STATE": _landed,
    "POSITION_TARGET_LOCAL_NED": _reference,
    "ESC_TELEMETRY_1_TO_4": _speeds,
    "AUTOPILOT_VERSION": lambda one, ardupilot: [],
    "STATUSTEXT": lambda one, ardupilot: [],
}
"""What MAVLink's messages become."""
