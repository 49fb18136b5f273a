"""A flight from what a PX4 vehicle logged: NED and FRD become ENU and FLU here, once, and every topic comes onto one
clock.

Whatever flew the vehicle, the command is the collective that PX4's control allocation received, so that any flight
mode can be analysed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trueflight.groundstation.reading.px4_log import Log, Topic
from trueflight.groundstation.reading.px4_thrust import commanded_thrust, motor_commands, rotor_speeds
from trueflight.groundstation.reading.uniform import continuous_quaternion
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.frames import enu_flu_from_ned_frd, enu_from_ned, flu_from_frd, rotate
from trueflight.models.vehicle import Vehicle

RATE = 100.0
"""Hz of the clock that all topics are brought to."""
ARMED = 2  # vehicle_status.arming_state
ROTARY_WING, FIXED_WING, ROVER, AIRSHIP = 1, 2, 3, 4  # vehicle_status.vehicle_type
MAV_TYPES = {1: "fixed-wing aircraft", 3: "coaxial helicopter", 4: "helicopter", 7: "airship", 10: "rover",
             11: "boat", 12: "submarine"} | {n: "VTOL aircraft" for n in range(19, 26)}  # fmt: skip
"""What else than a multirotor `vehicle_status.system_type` and `MAV_TYPE` may be (MAVLink, MAV_TYPE)."""
MOTORS = {2: 4, 13: 6, 14: 8, 15: 3, 29: 12, 35: 10}
"""Motors of the multirotors among them."""
MODES = {0: "manual", 1: "altitude", 2: "position", 3: "mission", 4: "hold", 5: "return", 6: "position slow",
         10: "acro", 12: "descend", 13: "termination", 14: "offboard", 15: "stabilized", 17: "takeoff", 18: "land",
         19: "follow", 20: "precision land", 21: "orbit"}  # fmt: skip
"""`vehicle_status.nav_state` by name."""
XYZ = ("xyz[0]", "xyz[1]", "xyz[2]")
ACCELEROMETER = tuple(f"accelerometer_m_s2[{i}]" for i in range(3))
GYROSCOPE = tuple(f"gyro_rad[{i}]" for i in range(3))
ATTITUDE = tuple(f"q[{i}]" for i in range(4))
BODY_FRAME = 3  # vehicle_odometry.velocity_frame
PAUSE = 0.25
"""s; a topic that is silent for longer, and for six of its periods, was not recorded: nothing is made up across."""
FAST = 0.4 * RATE
"""Hz; a sensor must be this fast."""
AROUND = 2.0  # s kept before arming and after disarming
AFFECTS_THRUST = ("THR_MDL_FAC", "MC_BAT_SCALE_EN", "MPC_THR_CURVE", "PWM_", "DSHOT_MIN", "UAVCAN_EC_M", "CA_ROTOR",
                  "SIH_", "MC_AIRMODE")  # fmt: skip


@dataclass(frozen=True)
class Airborne:
    """The clock (N,) in s of the log; where the vehicle was armed and where it was off the ground, both (N,) bool."""

    clock: np.ndarray
    armed: np.ndarray
    in_air: np.ndarray

    @property
    def span(self) -> tuple[float, float]:
        """First and last time in the air, s."""
        rows = np.flatnonzero(self.in_air)
        return float(self.clock[rows[0]]), float(self.clock[rows[-1]])


def flight_of(path: Path, log: Log, vehicle: Vehicle) -> Flight:
    """The flight of a PX4 log, on an even clock of 100 Hz.

    Accelerometer and gyroscope are averaged over each period, which is centred and keeps what is above 50 Hz from
    aliasing; estimates are interpolated; setpoints are interpolated too, for the logger writes a subset of them. Only
    what was armed and not landed counts as flying. Heights are above the ground at each takeoff. Raises `InputError`
    for a log of another kind of aircraft, without a flight, or without a topic that is needed.
    """
    from trueflight.groundstation.reading.flight_file import assemble

    check_multirotor(log)
    air, notes = airborne(log)
    notes = [*_heading(log, air), *log.notes, *notes]
    lost: list[Topic] = []
    columns: dict[str, np.ndarray] = {}
    attitude, said = _attitude(log, air)
    columns["quaternion"] = attitude
    notes += said
    motion, usable, said = _motion(log, air, attitude)
    columns |= motion
    notes += said
    inertial, sources, said = _inertial(log, air)
    columns |= inertial
    lost += sources
    notes += said
    if "specific_force" not in columns and not {"position", "velocity"} & set(columns):
        raise InputError(
            f"{log.origin}: neither an accelerometer of {FAST:.0f} Hz (sensor_combined) nor a valid estimate of the "
            f"velocity is in the log: nothing was measured that thrust could be compared with; {log.advice}"
        )
    commands, said = _commands(log, air, vehicle)
    columns |= commands
    notes += said
    if (battery := battery_in_use(log, air)) is not None:
        columns["battery_voltage"] = np.interp(air.clock, battery.t, battery.fields["voltage_v"])
    lost += [
        t for name in ("vehicle_attitude", "vehicle_local_position") if (t := log.topic(name)) is not None
    ]
    recorded = _recorded(air.clock, lost)
    if not np.all(recorded[air.armed]):
        notes.append(f"{(~recorded & air.armed).sum() / RATE:.1f} s of the armed time were not recorded")
    start = air.clock[0]
    clock = air.clock[recorded]
    return assemble(
        path,
        vehicle,
        clock - start,
        {name: column[recorded] for name, column in columns.items()},
        lambda row: f"{path}, t = {clock[min(row, len(clock) - 1)] - start:.2f} s",
        commanded=(air.in_air & usable)[recorded],
        notes=tuple(notes),
        most_lost=1.0,  # what was not recorded is told, and what is left is whole
    )


def check_multirotor(log: Log) -> None:
    """Raise `InputError`, in one line, for the log of anything but a multirotor."""
    status = log.topic("vehicle_status", "arming_state")
    kind = None
    if status is not None:
        armed = status.fields["arming_state"] == ARMED
        armed = armed if np.any(armed) else np.ones(len(status.t), dtype=bool)
        flown = {name: np.asarray(status.fields[name])[armed] for name in status.fields}
        system = int(np.median(flown["system_type"])) if "system_type" in flown else 0
        wing = flown.get("vehicle_type")
        if np.any(flown.get("is_vtol", np.zeros(1))):
            kind = "VTOL aircraft"
        elif system in MAV_TYPES:
            kind = MAV_TYPES[system]
        elif wing is not None and np.mean(wing == FIXED_WING) > 0.5:
            kind = "fixed-wing aircraft"
        elif wing is not None and np.mean(wing == ROVER) > 0.5:
            kind = "rover"
        elif wing is not None and np.mean(wing == AIRSHIP) > 0.5:
            kind = "airship"
    else:
        kind = MAV_TYPES.get(int(log.parameter("MAV_TYPE") or 0))
    if kind is not None:
        raise InputError(
            f"{log.origin}: the log of a {kind}; only multirotors can be analysed, take the log of one"
        )


def motor_count(log: Log) -> int:
    """How many motors the vehicle has, as far as the log tells; 4 otherwise."""
    if (count := log.parameter("CA_ROTOR_COUNT")) and count >= 3:
        return int(count)
    status = log.topic("vehicle_status", "system_type")
    kind = np.median(status.fields["system_type"]) if status is not None else log.parameter("MAV_TYPE") or 2
    return MOTORS.get(int(kind), 4)


def airborne(log: Log) -> tuple[Airborne, list[str]]:
    """The clock over what was armed plus 2 s on both sides, and what was flown on it. Raises `InputError` for a log
    without a flight."""
    origin = log.origin
    names = ("vehicle_attitude", "vehicle_odometry", "sensor_combined")
    needed = [topic for name in names if (topic := log.topic(name)) is not None]
    if not needed:
        raise InputError(
            f"{origin}: neither vehicle_attitude nor sensor_combined is in the log (cut short?); {log.advice}"
        )
    begin, end = max(t.t[0] for t in needed), min(t.t[-1] for t in needed)
    notes: list[str] = []
    choices = (("vehicle_status", "arming_state", ARMED), ("actuator_armed", "armed", 1))
    for name, field, value in choices:
        if (status := log.topic(name, field)) is not None:
            times, is_armed = status.t, np.asarray(status.fields[field]) == value
            break
    else:
        times, is_armed = np.array([begin, end]), np.array([True, True])
        notes.append("the log does not tell when the vehicle was armed: flight is told by thrust and height")
    if not np.any(is_armed):
        raise InputError(f"{origin}: the vehicle was never armed in this log; take the log of a flight")
    # The state holds until the next message: the last armed one may be half a second before disarming.
    until = np.append(times[1:], max(end, times[-1]))[is_armed][-1]
    first, last = max(begin, times[is_armed][0] - AROUND), min(end, until + AROUND)
    if last - first < 2.0:
        raise InputError(
            f"{origin}: only {max(last - first, 0):.1f} s are armed in this log (cut short?); take the log of "
            "a flight"
        )
    clock = np.arange(first, last, 1.0 / RATE)
    armed = _held(times, is_armed, clock)
    if not np.any(armed):
        raise InputError(f"{origin}: attitude and sensors were not recorded while armed; log from arming on")
    landed = np.zeros(len(clock), dtype=bool)
    land = log.topic("vehicle_land_detected", "landed")
    if land is not None:
        flags = [land.fields[f] for f in ("landed", "maybe_landed", "ground_contact") if land.has(f)]
        landed = _held(land.t, np.any(np.stack(flags, -1) > 0, axis=1), clock)
    in_air = armed & ~landed
    if not np.any(in_air):
        raise InputError(
            f"{origin}: armed for {armed.sum() / RATE:.0f} s but never off the ground (vehicle_land_detected); take "
            "the log of a flight"
        )
    if armed[-1]:
        notes.append("the log ends while armed: it may be cut short")
    flights = _runs(in_air, round(AROUND * RATE))
    if len(flights) > 1:
        notes.append(f"{len(flights)} flights in the log, {', '.join(_seconds(b - a) for a, b in flights)}")
    return Airborne(clock, armed, in_air), notes


def battery_in_use(log: Log, air: Airborne) -> Topic | None:
    """The battery that flew: connected, with a voltage, and of several the one that gave the most current."""
    best, most = None, -1.0
    first, last = air.span
    for battery in log.topics.get("battery_status", ()):
        flown = (battery.t >= first) & (battery.t <= last)
        if not battery.has("voltage_v") or flown.sum() < 2:
            continue
        voltage = np.asarray(battery.fields["voltage_v"], dtype=float)[flown]
        connected = np.asarray(battery.fields.get("connected", np.ones(len(battery.t))))[flown]
        if np.mean(connected > 0) < 0.5 or not np.median(voltage) > 0.5:
            continue
        current = np.asarray(battery.fields.get("current_a", np.zeros(len(battery.t))), dtype=float)[flown]
        drawn = max(float(np.nanmedian(current)) if np.any(np.isfinite(current)) else 0.0, 0.0)
        if drawn > most:
            best, most = battery, drawn
    return best


def _heading(log: Log, air: Airborne) -> list[str]:
    """What flew, how, and what was changed meanwhile."""
    notes = []
    if log.version or log.hardware:
        notes.append(
            " ".join(word for word in ("PX4", log.version, log.hardware and f"on {log.hardware}") if word)
        )
    status = log.topic("vehicle_status", "nav_state")
    if status is not None:
        modes = _held(status.t, np.asarray(status.fields["nav_state"]), air.clock)[air.in_air]
        seconds = {int(mode): np.sum(modes == mode) / RATE for mode in np.unique(modes)}
        said = [
            f"{MODES.get(mode, f'mode {mode}')} {_seconds(seconds[mode] * RATE)}"
            for mode in sorted(seconds, key=lambda mode: -seconds[mode])
            if seconds[mode] >= 1.0
        ]
        if said:
            notes.append(f"flown in {', '.join(said[:4])}")
    first, last = air.span
    before = dict(log.parameters)
    told = []
    for t, name, value in log.changes:
        if first <= t <= last and before.get(name) != value and name.startswith(AFFECTS_THRUST):
            told.append(f"{name} {before.get(name, float('nan')):g} to {value:g} at {t - air.clock[0]:.1f} s")
        before[name] = value
    if told:
        more = f" and {len(told) - 3} more" if len(told) > 3 else ""
        notes.append(f"parameters that act on thrust were changed in the air: {', '.join(told[:3])}{more}")
    return notes


def _attitude(log: Log, air: Airborne) -> tuple[np.ndarray, list[str]]:
    topic = log.topic("vehicle_attitude", *ATTITUDE) or log.topic("vehicle_odometry", *ATTITUDE)
    if topic is None:
        raise InputError(f"{log.origin}: vehicle_attitude is not in the log; {log.advice}")
    q = topic.stack(*ATTITUDE)
    good = np.abs(np.linalg.norm(q, axis=1) - 1.0) < 0.02
    if good.sum() < 2:
        raise InputError(f"{log.origin}: {topic.name} holds no attitude (the estimator did not start)")
    turned = continuous_quaternion(enu_flu_from_ned_frd(q[good]))
    at = np.stack([np.interp(air.clock, topic.t[good], c) for c in turned.T], -1)
    notes = [] if topic.name == "vehicle_attitude" else ["attitude is that of vehicle_odometry"]
    notes += _slow(log, topic, air, "attitude")
    return at / np.linalg.norm(at, axis=1, keepdims=True), notes


def _motion(
    log: Log, air: Airborne, attitude: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray, list[str]]:
    """Position, velocity and the position that was followed, ENU; heights above the ground at each takeoff. And where
    (N,) the estimate can be used."""
    clock = air.clock
    local = log.topic("vehicle_local_position", "x", "y", "z")
    usable = np.ones(len(clock), dtype=bool)
    notes: list[str] = []
    if local is not None and (notes_of := _invalid(local, air)) is not None:
        notes.append(notes_of)
        local = None
    if local is not None:
        topic, position = local, local.stack("x", "y", "z")
        velocity = local.first_of(("vx", "vy", "vz"))
        usable, notes = _valid(local, air)
    else:
        odometry = _odometry(log, air, attitude)
        if odometry is None:
            return {}, usable, notes or ["the log has no position"]
        topic, position, velocity = odometry
        notes.append("position and velocity are those of vehicle_odometry")
    notes += _slow(log, topic, air, "position")
    at = {
        name: enu_from_ned(np.stack([np.interp(clock, topic.t, c) for c in ned.T], -1))
        for name, ned in (("position", position), ("velocity", velocity))
        if ned is not None
    }
    at |= _references(log, air)
    ground, said = ground_level(at["position"][:, 2], air)
    at["position"][:, 2] -= ground
    if "position_reference" in at:
        at["position_reference"][:, 2] -= ground
    return at, usable, notes + said


def _invalid(local: Topic, air: Airborne) -> str | None:
    """Why the estimate of position and velocity cannot be used at all, if so."""
    flags = [name for name in ("v_xy_valid", "v_z_valid") if local.has(name)]
    if not flags:
        return None
    valid = np.all(local.stack(*flags) > 0, axis=1)
    share = float(np.mean(_held(local.t, valid, air.clock)[air.in_air]))
    return (
        None
        if share >= 0.5
        else "the estimator had no horizontal velocity: position and velocity are left out"
    )


def _valid(local: Topic, air: Airborne) -> tuple[np.ndarray, list[str]]:
    """Where (N,) the estimator vouches for its estimate and did not reset it."""
    notes: list[str] = []
    usable = np.ones(len(air.clock), dtype=bool)
    if flags := [name for name in ("v_xy_valid", "v_z_valid", "xy_valid", "z_valid") if local.has(name)]:
        valid = np.all(local.stack(*flags) > 0, axis=1)
        if local.has("xy_valid") and np.mean(local.fields["xy_valid"] > 0) < 0.5:
            # Optical flow: velocity without a position. What has drifted is still a motion.
            valid = np.all(local.stack(*(f for f in flags if f.startswith("v_"))) > 0, axis=1)
        usable = _held(local.t, valid, air.clock)
        if (bad := np.sum(air.in_air & ~usable) / RATE) > 0:
            notes.append(
                f"{bad:.1f} s in the air without a valid estimate of position or velocity are left out"
            )
    if counters := [
        n for n in local.fields if n.endswith("_reset_counter") and not n.startswith(("heading", "dist"))
    ]:
        jumped = np.flatnonzero(np.any(np.diff(local.stack(*counters), axis=0) != 0, axis=1))
        around = np.zeros(len(air.clock), dtype=bool)
        resets = 0
        for row in jumped:
            within = slice(*np.searchsorted(air.clock, [local.t[row], local.t[row + 1]]))
            around[max(within.start - 1, 0) : within.stop + 1] = True
            resets += bool(np.any(air.in_air[within]))
        usable &= ~around
        if resets:
            notes.append(f"the estimator reset its position or velocity {_times(resets)} in the air")
    return usable, notes


def _odometry(log: Log, air: Airborne, attitude: np.ndarray) -> tuple[Topic, np.ndarray, np.ndarray] | None:
    """Position and velocity (M, 3), NED, of `vehicle_odometry`: field names and frames changed with 1.14."""
    topic = log.topic("vehicle_odometry")
    if topic is None:
        return None
    position = topic.first_of(tuple(f"position[{i}]" for i in range(3)), ("x", "y", "z"))
    velocity = topic.first_of(tuple(f"velocity[{i}]" for i in range(3)), ("vx", "vy", "vz"))
    if position is None or velocity is None or not np.any(np.isfinite(position) & np.isfinite(velocity)):
        return None
    frame = topic.fields.get("velocity_frame")
    if frame is not None and np.median(frame) == BODY_FRAME:
        at = np.stack([np.interp(topic.t, air.clock, c) for c in continuous_quaternion(attitude).T], -1)
        at /= np.linalg.norm(at, axis=1, keepdims=True)
        velocity = enu_from_ned(rotate(at, flu_from_frd(velocity)))
    good = np.all(np.isfinite(position) & np.isfinite(velocity), axis=1)
    kept = Topic(topic.name, topic.t[good], {n: v[good] for n, v in topic.fields.items()}, topic.instance)
    return kept, position[good], velocity[good]


def ground_level(height: np.ndarray, air: Airborne) -> tuple[np.ndarray, list[str]]:
    """Height (N,) of the ground that the vehicle stood on before each takeoff, and what to say of it: an estimate
    drifts, and the next takeoff may be elsewhere."""
    ground = np.zeros(len(height))
    known: list[float] = []
    end = 0
    for a, b in _runs(air.in_air, round(AROUND * RATE)):
        if a > 0:
            known.append(float(np.median(height[max(end, a - round(0.5 * RATE)) : a])))
        ground[end:] = known[-1] if known else 0.0
        end = b
    if not known:
        return ground, ["the log starts in the air: heights are those of the estimator"]
    if max(abs(z) for z in known) <= 0.05:
        return ground, []
    levels = ", ".join(f"{z:.2f}" for z in known[:4])
    return ground, [f"heights are above the ground at takeoff ({levels} m in the log)"]


def _inertial(log: Log, air: Airborne) -> tuple[dict[str, np.ndarray], list[Topic], list[str]]:
    """Accelerometer and gyroscope, FLU, each the mean over a period of the clock; the topics they are from."""
    out: dict[str, np.ndarray] = {}
    used: list[Topic] = []
    notes: list[str] = []
    first, last = air.span

    def fast(name: str, *fields: str) -> Topic | None:
        topic = log.topic(name, *fields)
        return topic if topic is not None and topic.rate_within(first, last) >= FAST else None

    if (raw := fast("sensor_combined", *ACCELEROMETER)) is not None:
        out["specific_force"] = flu_from_frd(period_mean(raw.t, raw.stack(*ACCELEROMETER), air.clock))
        used.append(raw)
    elif (filtered := fast("vehicle_acceleration", *XYZ)) is not None:
        out["specific_force"] = flu_from_frd(period_mean(filtered.t, filtered.stack(*XYZ), air.clock))
        used.append(filtered)
        notes.append("the accelerometer is PX4's filtered vehicle_acceleration")
    else:
        notes.append(f"no accelerometer of {FAST:.0f} Hz or more in the log (sensor_combined)")
    if (rates := fast("vehicle_angular_velocity", *XYZ)) is not None:
        out["angular_velocity"] = flu_from_frd(period_mean(rates.t, rates.stack(*XYZ), air.clock))
    elif (gyro := fast("sensor_combined", *GYROSCOPE)) is not None:
        out["angular_velocity"] = flu_from_frd(period_mean(gyro.t, gyro.stack(*GYROSCOPE), air.clock))
    return out, used, notes


def _commands(log: Log, air: Airborne, vehicle: Vehicle) -> tuple[dict[str, np.ndarray], list[str]]:
    """Normalised collective (up is positive; 0 while disarmed), body rates, commands and speeds of four motors."""
    out: dict[str, np.ndarray] = {}
    clock, armed = air.clock, air.armed
    first, last = air.span
    count = motor_count(log)
    thrust = commanded_thrust(log, first, last, count)
    if thrust is None:
        raise InputError(
            f"{log.origin}: no thrust command in the log (vehicle_thrust_setpoint, actuator_controls_0, "
            f"vehicle_rates_setpoint, actuator_motors, actuator_outputs, esc_status); {log.advice}"
        )
    values = np.where(armed, np.nan_to_num(_interpolated(thrust.t, thrust.values, clock)), 0.0)
    notes = [f"thrust is {thrust.said}, logged at {thrust.rate:.0f} Hz"]
    if thrust.rate < 0.9 * RATE:
        notes[-1] += f": nothing faster than {thrust.rate / 2:.0f} Hz is known of it"
    if thrust.relative:
        values *= vehicle.hover_thrust / float(np.median(values[air.in_air]))
        notes.append(
            "it is scaled so that its median is hover_thrust: a wrong mass or thrust gain cannot show"
        )
    out["thrust_command"] = values
    if count != 4:
        notes.append(f"{count} motors: the collective is read, what single motors did is not")
    else:
        if (motors := motor_commands(log, first, last, 4)) is not None:
            commands = np.stack([_interpolated(motors.t, c, clock) for c in motors.commands.T], -1)
            out["motor_command"] = np.where(armed[:, None], np.nan_to_num(commands), 0.0)
        esc = rotor_speeds(log, first, last, 4)
        if esc is not None and esc[2] >= 10.0:
            out["rotor_speed"] = np.stack([np.interp(clock, esc[0], c) for c in esc[1].T], -1)
    rates = log.topic("vehicle_rates_setpoint", "roll", "pitch", "yaw")
    if rates is not None and rates.rate_within(first, last) >= 0.2 * RATE:
        wanted = flu_from_frd(rates.stack("roll", "pitch", "yaw"))
        out["body_rate_command"] = np.nan_to_num(
            np.stack([_interpolated(rates.t, c, clock) for c in wanted.T], -1)
        )
    return out, notes


def _references(log: Log, air: Airborne) -> dict[str, np.ndarray]:
    """Reference position, where one was followed for most of the flight (offboard by body rates has none)."""
    for name in ("trajectory_setpoint", "vehicle_local_position_setpoint"):
        topic = log.topic(name)
        if topic is None:
            continue
        found = topic.first_of(tuple(f"position[{i}]" for i in range(3)), ("x", "y", "z"))
        if found is None:
            continue
        known = np.all(np.isfinite(found), axis=1)
        if known.sum() > 2 and np.mean(_held(topic.t, known, air.clock)[air.in_air]) > 0.5:
            wanted, t = enu_from_ned(found[known]), topic.t[known]
            return {"position_reference": np.stack([np.interp(air.clock, t, c) for c in wanted.T], -1)}
    return {}


def _slow(log: Log, topic: Topic, air: Airborne, what: str) -> list[str]:
    """A note where a topic is logged more slowly than a manoeuvre lasts."""
    rate = topic.rate_within(*air.span)
    if rate >= 0.9 * RATE / 2:
        return []
    return [f"{what} is logged at {rate:.0f} Hz and interpolated; {log.faster}"]


def _recorded(clock: np.ndarray, topics: list[Topic]) -> np.ndarray:
    """Where (N,) all of these topics were being recorded."""
    recorded = np.ones(len(clock), dtype=bool)
    for topic in topics:
        longest = max(PAUSE, 6.0 / topic.rate)
        for row in np.flatnonzero(np.diff(topic.t) > longest):
            recorded[slice(*np.searchsorted(clock, [topic.t[row], topic.t[row + 1]], side="right"))] = False
        recorded &= (clock >= topic.t[0] - longest) & (clock <= topic.t[-1] + longest)
    return recorded


def _runs(where: np.ndarray, join: int) -> list[tuple[int, int]]:
    """Half-open runs of true samples; those less than `join` samples apart are one."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], where.astype(np.int8), [0]])))
    runs: list[tuple[int, int]] = []
    for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if runs and a - runs[-1][1] < join:
            runs[-1] = (runs[-1][0], b)
        else:
            runs.append((a, b))
    return runs


def _held(t: np.ndarray, values: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """The last value at or before each time; the first one before it."""
    return values[np.clip(np.searchsorted(t, clock, side="right") - 1, 0, len(t) - 1)]


def _interpolated(t: np.ndarray, values: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """Finite values, linear in between; nan where none is near (before the first, in a pause of the topic)."""
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


def period_mean(t: np.ndarray, values: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """Mean of samples (M, 3) over one period around each time, from their running integral."""
    good = np.all(np.isfinite(values), axis=1)
    t, values = t[good], values[good]
    integral = np.zeros_like(values)
    integral[1:] = np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t)[:, None], axis=0)
    half = 0.5 / RATE
    late, early = np.minimum(clock + half, t[-1]), np.maximum(clock - half, t[0])
    columns = [
        (np.interp(late, t, c) - np.interp(early, t, c)) / np.maximum(late - early, 1e-9) for c in integral.T
    ]
    return np.stack(columns, -1)


def _seconds(samples: float) -> str:
    return f"{samples / RATE:.0f} s"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
