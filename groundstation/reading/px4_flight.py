"""A flight from what a PX4 vehicle logged: NED and FRD become ENU and FLU here, once, and every topic comes onto one
clock.

Whatever flew the vehicle, the command is the collective that PX4's control allocation received, so that any flight
mode can be analysed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trueflight.groundstation.reading.assemble import assemble
from trueflight.groundstation.reading.mapping import Mapping
from trueflight.groundstation.reading.px4_airborne import (
    RATE,
    Airborne,
    airborne,
    battery_in_use,
    check_multirotor,
    held,
    motor_count,
    period_mean,
    whole_seconds,
)
from trueflight.groundstation.reading.px4_log import Log, Topic
from trueflight.groundstation.reading.px4_motion import attitude_of, motion_of
from trueflight.groundstation.reading.px4_resets import without_resets
from trueflight.groundstation.reading.px4_thrust import (
    commanded_thrust,
    motor_commands,
    rotor_speeds,
    too_slow,
)
from trueflight.groundstation.reading.sources import COLLECTIVE
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.frames import flu_from_frd
from trueflight.models.vehicle import Vehicle

XYZ = ("xyz[0]", "xyz[1]", "xyz[2]")
ACCELEROMETER = tuple(f"accelerometer_m_s2[{i}]" for i in range(3))
GYROSCOPE = tuple(f"gyro_rad[{i}]" for i in range(3))
PAUSE = 0.25
"""s; a topic that is silent for longer, and for six of its periods, was not recorded: nothing is made up across."""
FAST, FILTERED = 0.4 * RATE, 0.2 * RATE
"""Hz; a sensor must be this fast, and half of it will do for one that was filtered before it was logged: what is above
is not in it (ArduPilot's `INS_ACCEL_FILTER`, 10 or 20 Hz)."""
AFFECTS_THRUST = ("THR_MDL_FAC", "MC_BAT_SCALE_EN", "MPC_THR_CURVE", "PWM_", "DSHOT_MIN", "UAVCAN_EC_M", "CA_ROTOR",
                  "SIH_", "MC_AIRMODE", "MOT_PWM_M", "MOT_SPIN_M", "MOT_THST_EXPO", "MOT_BAT_VOLT")  # fmt: skip


def flight_of(path: Path, log: Log, vehicle: Vehicle, mapping: Mapping | None = None) -> Flight:
    """The flight of a PX4 log, on an even clock of 100 Hz.

    Accelerometer and gyroscope are averaged over each period, which is centred and keeps what is above 50 Hz from
    aliasing; estimates are interpolated; setpoints are interpolated too, for the logger writes a subset of them. Only
    what was armed and not landed counts as flying. Heights are above the ground at each takeoff. Raises `InputError`
    for a log of another kind of aircraft, without a flight, or without a topic that is needed.
    """
    check_multirotor(log)
    air, notes = airborne(log)
    notes = [*_heading(log, air), *log.notes, *notes]
    lost: list[Topic] = []
    columns: dict[str, np.ndarray] = {}
    attitude, said = attitude_of(log.of("quaternion"), air)
    columns["quaternion"] = attitude
    notes += said
    motion, usable, said = motion_of(log, air, attitude)
    columns |= motion
    notes += said
    clean, said = without_resets(log, air)
    usable &= clean
    notes += said
    inertial, sources, said = _inertial(log, air)
    columns |= inertial
    lost += sources
    notes += said
    slow = min((rate for t in sources if (rate := t.rate_within(*air.span)) < FAST), default=None)
    if slow is not None:
        notes[-1] += f", logged at {slow:.0f} Hz and interpolated; {log.faster}"
    if "specific_force" not in columns and not {"position", "velocity"} & set(columns):
        raise InputError(
            f"{log.origin}: neither an accelerometer of {_least(log):.0f} Hz ({log.name_of('sensor_combined')}) nor a "
            "valid estimate of the velocity is in the log: nothing was measured that thrust could be compared with; "
            f"{log.advice}"
        )
    commands, said = _commands(log, air, vehicle)
    columns |= commands
    notes += said
    battery, said = battery_in_use(log.of("battery_voltage"), air)
    notes += said
    if battery is not None:
        columns["battery_voltage"] = np.interp(air.clock, battery.t, battery.fields["voltage_v"])
    estimates = (("quaternion", "vehicle_attitude"), ("position", "vehicle_local_position"))
    lost += [t for quantity, name in estimates if (t := log.of(quantity).topic(name)) is not None]
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
        mapping=mapping,
        rates=_rates_of(log, air, columns, slow),
    )


def _heading(log: Log, air: Airborne) -> list[str]:
    """What flew, how, and what was changed meanwhile."""
    notes = []
    if log.version or log.hardware:
        notes.append(
            " ".join(
                word for word in (log.autopilot, log.version, log.hardware and f"on {log.hardware}") if word
            )
        )
    status = log.topic("vehicle_status", "nav_state")
    if status is not None:
        modes = held(status.t, np.asarray(status.fields["nav_state"]), air.clock)[air.in_air]
        seconds = {int(mode): np.sum(modes == mode) / RATE for mode in np.unique(modes)}
        said = [
            f"{log.modes.get(mode, f'mode {mode}')} {whole_seconds(seconds[mode] * RATE)}"
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


def _inertial(log: Log, air: Airborne) -> tuple[dict[str, np.ndarray], list[Topic], list[str]]:
    """Accelerometer and gyroscope, FLU, each the mean over a period of the clock; the topics they are from."""
    out: dict[str, np.ndarray] = {}
    used: list[Topic] = []
    notes: list[str] = []

    def fast(quantity: str, name: str, *fields: str) -> Topic | None:
        topic = log.of(quantity).topic(name, *fields)
        if topic is None or (rate := topic.rate_within(*air.span)) >= _least(log):
            return topic
        if quantity in log.chosen:
            raise InputError(
                f"{log.origin}: {topic.name}, chosen for {quantity}, was logged at {rate:.0f} Hz, and "
                f"{_least(log):.0f} Hz are needed; choose another topic (--topic)"
            )
        return None

    if (raw := fast("specific_force", "sensor_combined", *ACCELEROMETER)) is not None:
        out["specific_force"] = _sensed(log, raw, ACCELEROMETER, air)
        used.append(raw)
    elif (filtered := fast("specific_force", "vehicle_acceleration", *XYZ)) is not None:
        out["specific_force"] = _sensed(log, filtered, XYZ, air)
        used.append(filtered)
        if "specific_force" not in log.chosen:
            notes.append(
                f"the accelerometer is {log.autopilot}'s filtered {log.name_of('vehicle_acceleration')}"
            )
    else:
        notes.append(
            f"no accelerometer of {_least(log):.0f} Hz or more in the log ({log.name_of('sensor_combined')})"
        )
    if (rates := fast("angular_velocity", "vehicle_angular_velocity", *XYZ)) is not None:
        out["angular_velocity"] = _sensed(log, rates, XYZ, air)
    elif (gyro := fast("angular_velocity", "sensor_combined", *GYROSCOPE)) is not None:
        out["angular_velocity"] = _sensed(log, gyro, GYROSCOPE, air)
    return out, used, notes


def _tellers(log: Log) -> list[str]:
    """What could tell the thrust, as the log would call it."""
    return list(dict.fromkeys(log.name_of(topic) for topic in COLLECTIVE))


def _rates_of(
    log: Log, air: Airborne, columns: dict[str, np.ndarray], slow: float | None
) -> dict[str, float]:
    """The true rates (Hz) of what was interpolated and is compared with the thrust: the accelerometer's, or, without
    one, the velocity's."""
    if slow is not None:
        return {"specific_force": slow}
    estimate = log.of("velocity").topic("vehicle_local_position")
    if "specific_force" in columns or "velocity" not in columns or estimate is None:
        return {}
    rate = estimate.rate_within(*air.span)
    return {"velocity": rate} if rate < FAST else {}


def _least(log: Log) -> float:
    """Hz that a sensor of this log must have."""
    return FILTERED if log.filtered else FAST


def _sensed(log: Log, topic: Topic, fields: tuple[str, ...], air: Airborne) -> np.ndarray:
    """A sensor's columns (N, 3) on the clock, FLU: means over its periods, or, where those are longer, in between."""
    values = topic.stack(*fields)
    if topic.rate_within(*air.span) >= FAST:
        return flu_from_frd(period_mean(topic.t, values, air.clock))
    return flu_from_frd(np.stack([np.interp(air.clock, topic.t, c) for c in values.T], -1))


def _commands(log: Log, air: Airborne, vehicle: Vehicle) -> tuple[dict[str, np.ndarray], list[str]]:
    """Normalised collective (up is positive; 0 while disarmed), body rates, commands and speeds of four motors."""
    out: dict[str, np.ndarray] = {}
    clock, armed = air.clock, air.armed
    first, last = air.span
    count = motor_count(log)
    thrust = commanded_thrust(log.of("thrust_command"), first, last, count)
    if thrust is None:
        none = f"no thrust command in the log ({', '.join(_tellers(log))})"
        said = too_slow(log.of("thrust_command"), first, last, count)
        raise InputError(f"{log.origin}: {said or none}; {log.advice}")
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
    if (motors := motor_commands(log.of("motor_command"), first, last, count)) is not None:
        commands = np.stack([_interpolated(motors.t, c, clock) for c in motors.commands.T], -1)
        out["motor_command"] = np.where(armed[:, None], np.nan_to_num(commands), 0.0)
    esc = rotor_speeds(log.of("rotor_speed"), first, last, count)
    if esc is not None and esc[2] >= 10.0:
        out["rotor_speed"] = np.stack([np.interp(clock, esc[0], c) for c in esc[1].T], -1)
    if count != 4:
        notes.append(f"{count} motors: effects of single rotors are looked for with four only")
    if vehicle.rotor_positions and len(vehicle.rotor_positions) != count:
        notes.append(
            f"{count} motors flew, and the vehicle file has {len(vehicle.rotor_positions)} rotor_positions: correct "
            "them (--draft-vehicle writes what the log tells of them)"
        )
    rates = log.of("body_rate_command").topic("vehicle_rates_setpoint", "roll", "pitch", "yaw")
    if rates is not None and rates.rate_within(first, last) >= 0.2 * RATE:
        wanted = flu_from_frd(rates.stack("roll", "pitch", "yaw"))
        out["body_rate_command"] = np.nan_to_num(
            np.stack([_interpolated(rates.t, c, clock) for c in wanted.T], -1)
        )
    return out, notes


def _recorded(clock: np.ndarray, topics: list[Topic]) -> np.ndarray:
    """Where (N,) all of these topics were being recorded."""
    recorded = np.ones(len(clock), dtype=bool)
    for topic in topics:
        longest = max(PAUSE, 6.0 / topic.rate)
        for row in np.flatnonzero(np.diff(topic.t) > longest):
            recorded[slice(*np.searchsorted(clock, [topic.t[row], topic.t[row + 1]], side="right"))] = False
        recorded &= (clock >= topic.t[0] - longest) & (clock <= topic.t[-1] + longest)
    return recorded


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
