"""What an ArduCopter vehicle logged, brought to the topics of a PX4 log, so that one reader makes a flight of both.

Messages and fields: ArduPilot's `LogStructure.h` and `ArduCopter/Log.cpp`, Copter 3.3 to today. Its frames are PX4's,
NED and FRD; angles are in degrees. `ardupilot_motors` tells what the motors were told.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from trueflight.groundstation.reading.ardupilot_motors import (
    frame_of,
    motor_commands,
    rotor_speeds,
    thrust_topics,
)
from trueflight.groundstation.reading.dataflash import Dataflash, Messages
from trueflight.groundstation.reading.px4_log import Fields, Log, collect
from trueflight.models.errors import InputError
from trueflight.models.frames import quaternion_from_euler
from trueflight.models.outside import unreadable

ADVICE = "log attitude, rates, IMU, CTUN and battery (LOG_BITMASK; its bit 0 is fast attitude, bit 18 the fast IMU)"
FASTER = "LOG_BITMASK bits 0 (fast attitude) and 18 (fast IMU) log manoeuvres faster"
MODES = {0: "stabilize", 1: "acro", 2: "alt hold", 3: "auto", 4: "guided", 5: "loiter", 6: "RTL", 7: "circle",
         9: "land", 11: "drift", 13: "sport", 14: "flip", 15: "autotune", 16: "poshold", 17: "brake", 18: "throw",
         20: "guided without GPS", 21: "smart RTL", 22: "flow hold", 23: "follow", 24: "zigzag", 25: "system id",
         26: "autorotate", 27: "auto RTL"}  # fmt: skip
"""Copter's flight modes by number."""
ARMED, DISARMED, LANDED_MAYBE, LANDED, NOT_LANDED = 10, 11, 17, 18, 28
HEIGHT_RESET, HEADING_RESET = 60, 62
"""`EV.Id` of what is used here (`AP_Logger/LogEvent`)."""
VELOCITY_XY, VELOCITY_Z, POSITION_REL, POSITION_ABS, HEIGHT, CONSTANT = 1, 2, 3, 4, 5, 7
"""Bits of the estimator's status (`nav_filter_status`)."""
PADDING = 528
"""Bytes at the end of a healthy log that may be no messages: its last pages."""
ESTIMATORS = {3: "XK", 2: "NK", 1: "EK"}
"""How the messages of the third, second and first extended Kalman filter begin."""
OTHERS = {
    "ArduPlane": "fixed-wing or VTOL aircraft", "ArduRover": "rover", "Rover": "rover", "APMrover2": "rover",
    "ArduSub": "submarine", "AntennaTracker": "antenna tracker", "Blimp": "airship", "APM:Plane": "fixed-wing or VTOL "
    "aircraft", "APM:Rover": "rover",
}  # fmt: skip
NAMES = {
    "vehicle_attitude": "ATT",
    "vehicle_local_position": "the estimator's position (XKF1, NKF1, EKF1)",
    "sensor_combined": "the fast accelerometer (ACC)",
    "vehicle_acceleration": "IMU",
    "vehicle_angular_velocity": "IMU",
    "vehicle_thrust_setpoint": "RATE.AOut",
    "vehicle_rates_setpoint": "RATE",
    "vehicle_attitude_setpoint": "CTUN.ThO",
    "actuator_controls_0": "CTUN.ThO",
    "actuator_outputs": "RCOU (MOT_PWM_*, MOT_SPIN_*)",
    "actuator_motors": "RCOU (MOT_PWM_*, MOT_SPIN_*)",
    "esc_status": "ESC",
    "battery_status": "BAT",
    "vehicle_land_detected": "EV",
}
"""What PX4's topics are in these logs."""


def load_dataflash(path: Path) -> Log:
    """Read an ArduPilot dataflash log, also one that is cut short or damaged. Raises `InputError` for a file that is
    none, and for the log of anything but a copter."""
    with unreadable(path, "the log", "download it from the vehicle again", "not a whole dataflash log"):
        if path.stat().st_size == 0:
            raise InputError(f"{path}: the file is empty; download the log again")
        with Dataflash(path) as log:
            return _log(path, log)


def _log(path: Path, log: Dataflash) -> Log:
    said = _said(log)
    version, kind = _release(said)
    if kind is not None:
        raise InputError(
            f"{path}: the log of a {kind}; only multirotors can be analysed, take the log of one"
        )
    parameters, changes = _parameters(log)
    frame = frame_of(parameters, said)
    if isinstance(frame, str):
        raise InputError(
            f"{path}: the log of a {frame}; only multirotors can be analysed, take the log of one"
        )
    parts: list[tuple[str, int, Fields]] = []
    notes: list[str] = []
    for found, words in (
        _attitude(log, parameters),
        _position(log, parameters),
        _inertial(log),
        _state(log),
        thrust_topics(log, parameters),
    ):
        parts += found
        notes += words
    parts += [*_rates(log), *_references(log), *_batteries(log)]
    parts += [*motor_commands(log, parameters, frame.count), *rotor_speeds(log, parameters, frame.count)]
    return Log(
        str(path),
        collect(parts),
        parameters,
        changes,
        version,
        notes=(*_lost(log), *notes),
        advice=ADVICE,
        faster=FASTER,
        autopilot="ArduCopter",
        modes=MODES,
        names=NAMES,
        frame=frame,
        filtered=True,
    )


def _said(log: Dataflash) -> list[str]:
    """The texts that the vehicle wrote."""
    texts = log.messages("MSG")
    if texts is None or not texts.has("Message"):
        return []
    return [bytes(t).split(b"\0")[0].decode("ascii", "replace") for t in texts.fields["Message"].tolist()]


def _release(said: list[str]) -> tuple[str, str | None]:
    """Version of the firmware, and what it flies where that is no copter."""
    for text in said:
        found = re.match(r"(?:APM:)?(\w+) [Vv]?(\d[\w.\-]*)", text)
        if found is None:
            continue
        if found[1] in ("ArduCopter", "Copter"):
            return found[2], None
        if (other := OTHERS.get(found[1])) is not None:
            return found[2], other
    return "", None


def _parameters(log: Dataflash) -> tuple[dict[str, float], tuple[tuple[float, str, float], ...]]:
    """The parameters at the beginning, and what was changed later: time in s, name, value."""
    table = log.messages("PARM")
    if table is None or not table.has("Name", "Value"):
        return {}, ()
    first: dict[str, float] = {}
    changes = []
    for t, raw, value in zip(
        table.t.tolist(), table.fields["Name"].tolist(), table.fields["Value"].tolist(), strict=True
    ):
        name = bytes(raw).split(b"\0")[0].decode("ascii", "replace")
        if not np.isfinite(value):
            continue
        if name in first:
            changes.append((1e-6 * t, name, float(value)))
        first.setdefault(name, float(value))
    return first, tuple(changes)


def _attitude(
    log: Dataflash, parameters: dict[str, float]
) -> tuple[list[tuple[str, int, Fields]], list[str]]:
    """Attitude as quaternions, NED and FRD: that of ATT, or the estimator's where that is logged faster."""
    given = log.messages("ATT")
    estimate = _estimate(log, parameters)
    angles = ("Roll", "Pitch", "Yaw")
    usable = [one for one in (given, estimate) if one is not None and len(one) > 2 and one.has(*angles)]
    if not usable:
        return [], []
    best = usable[0]
    if len(usable) > 1 and len(usable[1]) > 1.5 * len(best):
        best = usable[1]
    q = quaternion_from_euler(np.radians(best.stack(*angles)))
    turns = _counted(_events(log, HEADING_RESET), best.t)
    fields: Fields = {
        "timestamp": best.t,
        **{f"q[{i}]": q[:, i] for i in range(4)},
        "quat_reset_counter": turns,
    }
    return [("vehicle_attitude", 0, fields)], [] if best is given else [f"attitude is that of {best.name}"]


def _estimate(log: Dataflash, parameters: dict[str, float]) -> Messages | None:
    """The estimate of the filter that flew the vehicle, of its core in use at each time."""
    used = int(parameters.get("AHRS_EKF_TYPE", parameters.get("AHRS_EKF_USE", -1)))
    if used == 0:  # it flew without one, and what one told beside it may have run away
        return None
    order = [*([used] if used in ESTIMATORS else []), *ESTIMATORS]
    for prefix in dict.fromkeys(ESTIMATORS[kind] for kind in order):
        found = log.messages(f"{prefix}F1")
        if found is None or not found.has("VN", "VE", "VD", "PN", "PE", "PD"):
            continue
        cores = found.by_instance("C")
        second = log.messages(f"{prefix}F6")  # the second core, until 4.1
        if len(cores) == 1 and second is not None and second.has("VN", "VE", "VD", "PN", "PE", "PD"):
            cores[1] = second
        core = _core(log, prefix)
        if core is None or len(cores) == 1:
            return cores.get(0, next(iter(cores.values())))
        picked = []
        for number, one in cores.items():
            rows = np.clip(np.searchsorted(core.t, one.t, side="right") - 1, 0, len(core) - 1)
            primary = core.field("PI")
            if primary is not None and np.any(mine := primary[rows] == number):
                picked.append(one.at(mine))
        return _joined(picked) if picked else cores.get(0)
    return None


def _core(log: Dataflash, prefix: str) -> Messages | None:
    """The filter's status messages that tell its core in use."""
    status = log.messages(f"{prefix}F4")
    if status is None or not status.has("PI") or not len(status):
        return None
    return status.by_instance("C").get(0, status)


def _joined(parts: list[Messages]) -> Messages:
    """Messages of several cores in order of time."""
    t = np.concatenate([p.t for p in parts])
    order = np.argsort(t, kind="stable")
    shared = set.intersection(*(set(p.fields) for p in parts))
    fields = {n: np.concatenate([p.fields[n] for p in parts])[order] for n in shared}
    return Messages(parts[0].name, t[order], fields, parts[0].whole)


def _position(
    log: Dataflash, parameters: dict[str, float]
) -> tuple[list[tuple[str, int, Fields]], list[str]]:
    """Position and velocity of the estimator in use, with what it vouches for and what it reset."""
    found = _estimate(log, parameters)
    if found is None or len(found) < 3:
        return [], [
            f"{name} 0: flown without an extended Kalman filter, whose position and velocity are left out"
            for name in ("AHRS_EKF_TYPE", "AHRS_EKF_USE")
            if parameters.get(name) == 0
        ]
    names = {"x": "PN", "y": "PE", "z": "PD", "vx": "VN", "vy": "VE", "vz": "VD"}
    fields: Fields = {"timestamp": found.t}
    fields |= {ours: np.asarray(found.fields[theirs], dtype=float) for ours, theirs in names.items()}
    status = _core(log, found.name[:2]) or log.messages(f"{found.name[:2]}F4")
    if status is not None and status.has("SS"):
        rows = np.clip(np.searchsorted(status.t, found.t, side="right") - 1, 0, len(status) - 1)
        flags = np.asarray(status.fields["SS"])[rows].astype(np.int64)

        def told(bit: int) -> np.ndarray:
            return flags >> bit & 1 == 1

        moving = ~told(CONSTANT)
        fields |= {
            "v_xy_valid": (told(VELOCITY_XY) & moving).astype(float),
            "v_z_valid": told(VELOCITY_Z).astype(float),
            "xy_valid": ((told(POSITION_REL) | told(POSITION_ABS)) & moving).astype(float),
            "z_valid": told(HEIGHT).astype(float),
        }
    fields["z_reset_counter"] = _counted(_events(log, HEIGHT_RESET), found.t)
    core = _core(log, found.name[:2])
    if core is not None and (primary := core.field("PI")) is not None:
        fields["xy_reset_counter"] = _counted(core.t[1:][np.diff(primary) != 0], found.t)
    return [("vehicle_local_position", 0, fields)], [f"position and velocity are those of {found.name}"]


def _inertial(log: Dataflash) -> tuple[list[tuple[str, int, Fields]], list[str]]:
    """Accelerometer and gyroscope, FRD: the raw ones where they were logged, otherwise the filtered ones of IMU."""
    parts: list[tuple[str, int, Fields]] = []
    raw = log.messages("ACC")
    if raw is not None and raw.has("AccX", "AccY", "AccZ"):
        one = raw.by_instance("I", "Inst").get(0, raw)
        at = one.field("SampleUS")
        t = one.t if at is None else at.astype(np.int64)
        force = one.stack("AccX", "AccY", "AccZ")
        parts.append(
            (
                "sensor_combined",
                0,
                {"timestamp": t} | {f"accelerometer_m_s2[{i}]": force[:, i] for i in range(3)},
            )
        )
    imu = log.messages("IMU")
    if imu is None or not imu.has("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"):
        return parts, []
    for number, one in sorted(imu.by_instance("I").items()):
        force, rates = one.stack("AccX", "AccY", "AccZ"), one.stack("GyrX", "GyrY", "GyrZ")
        for name, columns in (("vehicle_acceleration", force), ("vehicle_angular_velocity", rates)):
            parts.append(
                (name, number, {"timestamp": one.t} | {f"xyz[{i}]": columns[:, i] for i in range(3)})
            )
    return parts, []


def _state(log: Dataflash) -> tuple[list[tuple[str, int, Fields]], list[str]]:
    """Armed, landed and the flight mode, each held from its event on."""
    clock = log.first_of("IMU", "ATT", "RCOU")
    if clock is None:
        return [], []
    begin, end = int(clock.t.min()), int(clock.t.max())
    parts: list[tuple[str, int, Fields]] = []
    armed = [(t, 1.0) for t in _events(log, ARMED)] + [(t, 0.0) for t in _events(log, DISARMED)]
    switch = log.messages("ARM")
    if switch is not None and (state := switch.field("ArmState")) is not None:
        armed += list(zip(switch.t.tolist(), state.tolist(), strict=True))
    landed = [(t, 1.0) for t in (*_events(log, LANDED), *_events(log, LANDED_MAYBE))]
    landed += [(t, 0.0) for t in _events(log, NOT_LANDED)]
    landed += [(t, 1.0) for t in _events(log, ARMED)]  # it arms on the ground, and tells when it leaves it
    for topic, name, changes in (
        ("actuator_armed", "armed", armed),
        ("vehicle_land_detected", "landed", landed),
    ):
        if changes:
            parts.append((topic, 0, _held(name, sorted(changes), begin, end)))
    mode = log.messages("MODE")
    if mode is not None and (number := mode.field("ModeNum", "Mode")) is not None and len(mode):
        changes = list(zip(mode.t.tolist(), number.tolist(), strict=True))
        parts.append(("vehicle_status", 0, _held("nav_state", changes, begin, end)))
    return parts, []


def _held(name: str, changes: list[tuple[int, float]], begin: int, end: int) -> Fields:
    """A state from its changes: before the first one, what that one changed (it is told when it changes)."""
    before = 1.0 - changes[0][1] if name != "nav_state" else changes[0][1]
    rows = {min(begin, changes[0][0] - 1): before, **dict(changes)}
    rows.setdefault(max(end, changes[-1][0] + 1), changes[-1][1])
    times = sorted(rows)
    return {"timestamp": np.array(times, dtype=np.int64), name: np.array([rows[t] for t in times])}


def _events(log: Dataflash, number: int) -> list[int]:
    """Times, us, of an event."""
    events = log.messages("EV")
    if events is None or not events.has("Id"):
        return []
    return [int(t) for t in events.t[events.fields["Id"] == number]]


def _counted(times: list[int] | np.ndarray, t: np.ndarray) -> np.ndarray:
    """How many of `times` have passed at each of `t`."""
    return np.searchsorted(np.sort(np.asarray(times, dtype=np.int64)), t, side="right").astype(float)


def _rates(log: Dataflash) -> list[tuple[str, int, Fields]]:
    """Commanded body rates, FRD, rad/s. The log has degrees, to 3.3 hundredths of one: the gyroscope tells which."""
    rate = log.messages("RATE")
    if rate is None:
        return []
    wanted = [rate.field(*names) for names in (("RDes", "RllDes"), ("PDes", "PitDes"), ("YDes", "YawDes"))]
    if any(one is None for one in wanted):
        return []
    felt, imu = rate.field("R", "Rll"), log.messages("IMU")
    unit = 1.0
    if felt is not None and imu is not None and (gyro := imu.field("GyrX")) is not None:
        turned = np.degrees(np.interp(rate.t, imu.t, gyro))
        unit = 0.01 if np.std(felt) > 10.0 * np.std(turned) > 0.0 else 1.0
    columns = {
        n: np.radians(v * unit)
        for n, v in zip(("roll", "pitch", "yaw"), wanted, strict=True)
        if v is not None
    }
    return [("vehicle_rates_setpoint", 0, {"timestamp": rate.t, **columns})]


def _references(log: Dataflash) -> list[tuple[str, int, Fields]]:
    """The position that was followed, NED, where the position controller flew (from 4.1 on)."""
    axes = [log.messages(name) for name in ("PSCN", "PSCE", "PSCD")]
    north = axes[0]
    if north is None:
        return []
    fields: Fields = {"timestamp": north.t}
    for index, (one, names) in enumerate(zip(axes, (("TPN",), ("TPE",), ("TPD",)), strict=True)):
        wanted = one.field(*names) if one is not None else None
        if one is None or wanted is None or not len(one):
            return []
        fields[f"position[{index}]"] = np.interp(north.t, one.t, wanted)
    return [("trajectory_setpoint", 0, fields)]


def _batteries(log: Dataflash) -> list[tuple[str, int, Fields]]:
    """Every battery; where it is told in hundredths (CURR, before 3.4) in volts and amperes."""
    parts: list[tuple[str, int, Fields]] = []
    for found in (log.first_of("BAT", "CURR"), log.messages("BAT2")):
        for number, one in sorted(found.by_instance("Inst", "Instance").items()) if found is not None else ():
            voltage, current = one.field("Volt"), one.field("Curr")
            if voltage is None:
                continue
            unit = 0.01 if "Volt" in one.whole else 1.0
            fields: Fields = {"timestamp": one.t, "voltage_v": voltage * unit}
            if current is not None:
                fields["current_a"] = current * (0.01 if "Curr" in one.whole else 1.0)
            parts.append(("battery_status", number + (found is not None and found.name == "BAT2"), fields))
    return parts


def _lost(log: Dataflash) -> list[str]:
    """What is damaged, and what the logger says that it lost."""
    notes = [f"{log.skipped} bytes are damaged and were skipped"] if log.skipped > PADDING else []
    drops = log.messages("DSF")
    lost = drops.field("Dp") if drops is not None else None
    if lost is None or not len(lost) or not lost[-1] > 0:
        return notes
    return [*notes, f"the logger dropped {lost[-1]:.0f} messages"]
