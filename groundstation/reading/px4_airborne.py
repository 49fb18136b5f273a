"""When a PX4 vehicle flew, and what it was: the clock that every topic of its log is brought to, where it was armed
and in the air, and on which battery."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trueflight.groundstation.reading.px4_log import Log, Topic
from trueflight.models.errors import InputError

RATE = 100.0
"""Hz of the clock that all topics are brought to."""
ARMED = 2  # vehicle_status.arming_state
ROTARY_WING, FIXED_WING, ROVER, AIRSHIP = 1, 2, 3, 4  # vehicle_status.vehicle_type
MAV_TYPES = {1: "fixed-wing aircraft", 3: "coaxial helicopter", 4: "helicopter", 7: "airship", 10: "rover",
             11: "boat", 12: "submarine"} | {n: "VTOL aircraft" for n in range(19, 26)}  # fmt: skip
"""What else than a multirotor `vehicle_status.system_type` and `MAV_TYPE` may be (MAVLink, MAV_TYPE)."""
MOTORS = {2: 4, 13: 6, 14: 8, 15: 3, 29: 12, 35: 10}
"""Motors of the multirotors among them."""
AROUND = 2.0  # s kept before arming and after disarming


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


def airborne(log: Log) -> tuple[Airborne, list[str]]:
    """The clock over what was armed plus 2 s on both sides, and what was flown on it. Raises `InputError` for a log
    without a flight."""
    origin = log.origin
    names = (
        ("quaternion", "vehicle_attitude"),
        ("quaternion", "vehicle_odometry"),
        ("specific_force", "sensor_combined"),
        *([("specific_force", "vehicle_acceleration")] if log.filtered else []),
    )
    needed = [topic for what, name in names if (topic := log.of(what).topic(name)) is not None]
    if not needed:
        raise InputError(
            f"{origin}: neither {log.name_of('vehicle_attitude')} nor {log.name_of('sensor_combined')} is in the log "
            f"(cut short?); {log.advice}"
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
    armed = held(times, is_armed, clock)
    if not np.any(armed):
        raise InputError(f"{origin}: attitude and sensors were not recorded while armed; log from arming on")
    landed = np.zeros(len(clock), dtype=bool)
    land = log.topic("vehicle_land_detected", "landed")
    if land is not None:
        flags = [land.fields[f] for f in ("landed", "maybe_landed", "ground_contact") if land.has(f)]
        landed = held(land.t, np.any(np.stack(flags, -1) > 0, axis=1), clock)
    in_air = armed & ~landed
    if not np.any(in_air):
        raise InputError(
            f"{origin}: armed for {armed.sum() / RATE:.0f} s but never off the ground "
            f"({log.name_of('vehicle_land_detected')}); take "
            "the log of a flight"
        )
    if armed[-1] and is_armed[-1]:  # a logger that stops when it disarms ends a moment before
        notes.append("the log ends while armed: it may be cut short")
    flights = runs(in_air, round(AROUND * RATE))
    if len(flights) > 1:
        notes.append(
            f"{len(flights)} flights in the log, {', '.join(whole_seconds(b - a) for a, b in flights)}"
        )
    return Airborne(clock, armed, in_air), notes


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
    if log.frame is not None:
        return log.frame.count
    if (count := log.parameter("CA_ROTOR_COUNT")) and count >= 3:
        return int(count)
    status = log.topic("vehicle_status", "system_type")
    kind = np.median(status.fields["system_type"]) if status is not None else log.parameter("MAV_TYPE") or 2
    return MOTORS.get(int(kind), 4)


DRAWN, AGREE = 1.5, 0.03
"""Times the current of the next battery from which on one is the flight battery; share by which voltages of one may
differ."""


def battery_in_use(log: Log, air: Airborne) -> tuple[Topic | None, list[str]]:
    """The battery that flew: connected, with a voltage, and of several the one that gave the most current; and what to
    say of the others. None where nothing tells which of several it was."""
    found: list[tuple[float, float, Topic]] = []
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
        found.append((drawn, float(np.median(voltage)), battery))
    if len(found) < 2:
        return (found[0][2] if found else None), []
    found.sort(key=lambda one: (-one[0], one[2].instance))
    (most, volts, best), (less, _, next_) = found[:2]
    named = [f"battery_status:{battery.instance}" for _, _, battery in found]
    told = ", ".join(f"{name} {v:.3g} V" for name, (_, v, _) in zip(named, found, strict=True))
    if most > max(DRAWN * less, 0.1):
        why = "it gives the most current"
    elif max(abs(v - volts) for _, v, _ in found) <= AGREE * volts:
        why = "their voltages agree"
    else:
        line = f"--topic battery_voltage={named[0]} takes one"
        return None, [
            f"{len(found)} batteries, and no current tells which of them flies ({told}): voltage is left out; {line}"
        ]
    return best, [
        f"{len(found)} batteries ({told}): {named[0]} is read, {why}; --topic battery_voltage="
        f"battery_status:{next_.instance} reads another"
    ]


def ground_level(height: np.ndarray, air: Airborne) -> tuple[np.ndarray, list[str]]:
    """Height (N,) of the ground that the vehicle stood on before each takeoff, and what to say of it: an estimate
    drifts, and the next takeoff may be elsewhere."""
    ground = np.zeros(len(height))
    known: list[float] = []
    end = 0
    for a, b in runs(air.in_air, round(AROUND * RATE)):
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


def runs(where: np.ndarray, join: int) -> list[tuple[int, int]]:
    """Half-open runs of true samples; those less than `join` samples apart are one."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], where.astype(np.int8), [0]])))
    runs: list[tuple[int, int]] = []
    for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if runs and a - runs[-1][1] < join:
            runs[-1] = (runs[-1][0], b)
        else:
            runs.append((a, b))
    return runs


def held(t: np.ndarray, values: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """The last value at or before each time; the first one before it."""
    return values[np.clip(np.searchsorted(t, clock, side="right") - 1, 0, len(t) - 1)]


def whole_seconds(samples: float) -> str:
    """The time of so many samples of the clock, in words."""
    return f"{samples / RATE:.0f} s"


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
