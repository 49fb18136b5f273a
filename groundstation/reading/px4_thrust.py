"""The collective thrust that a PX4 vehicle commanded, from whichever topic of its log tells it best.

PX4 hands one normalised collective down: position control, attitude and rate setpoint, control allocation, motors,
outputs. All but the last are linear in the thrust PX4 wants; the outputs are what the ESCs received, after
`THR_MDL_FAC` bent the command: thrust = f s² + (1 - f) s for a signal s of 0 to 1 (PX4, `FunctionMotors`, and
`MultirotorMixer` before 1.13). Rotor speeds come last: they tell the thrust but for its scale.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from trueflight.groundstation.reading.px4_log import Log, Topic

ENOUGH = 40.0
"""Hz; the first source that is this fast is taken, otherwise the fastest: PX4's default profile logs setpoints at 50
Hz and motors at 10."""
SLOWEST = 3.5
"""Hz; below it a command tells nothing of a flight."""
SLOWEST_MOTORS = 20.0  # Hz; below it motor commands alias
MOTOR_1 = 101  # PX4's output function "Motor 1"
DSHOT_FULL = 1999.0
DSHOT_TIMERS = (-5, -4, -3)  # values of PWM_*_TIM that mean DShot
UAVCAN_FULL = 8191.0
PULSES = ("PWM_MAIN", "PWM_AUX", "PWM_EXTRA", "PWM")
DRIVERS = (*PULSES, "UAVCAN_EC", "SIM_GZ_EC", "HIL_ACT")


@dataclass(frozen=True)
class Thrust:
    """Commanded thrust (M,) at times `t` (M,) of the log's clock, up positive, 0 to 1; `said` tells where it is from
    and `rate` (Hz) how often it was logged. `relative` thrust is known but for its scale."""

    t: np.ndarray
    values: np.ndarray
    said: str
    rate: float
    relative: bool = False


@dataclass(frozen=True)
class Motors:
    """Commands of each motor (M, n), linear in thrust, 0 to 1, in PX4's order of motors."""

    t: np.ndarray
    commands: np.ndarray
    said: str
    rate: float


def commanded_thrust(log: Log, first: float, last: float, motors: int) -> Thrust | None:
    """The best collective command between two times of the flight (s), for a vehicle of so many motors; None where
    nothing tells it."""
    best: Thrust | None = None
    for source in _sources(log, first, last, motors):
        if source.rate >= ENOUGH:
            return source
        if source.rate >= SLOWEST and (best is None or source.rate > 1.5 * best.rate):
            best = source
    return best


def too_slow(log: Log, first: float, last: float, motors: int) -> str:
    """What to say where thrust is told, and too seldom for a flight to be compared with it; '' otherwise."""
    fastest = max(_sources(log, first, last, motors), key=lambda source: source.rate, default=None)
    if fastest is None:
        return ""
    return f"thrust is {fastest.said} and was logged at {fastest.rate:.2g} Hz; at least {SLOWEST:.2g} Hz are needed"


def motor_commands(log: Log, first: float, last: float, count: int) -> Motors | None:
    """What each motor was told between two times of the flight (s), at 20 Hz at least: `actuator_motors`, otherwise
    `actuator_outputs` through the range of its driver; None where neither tells it."""
    return next((m for m in _motors(log, first, last, count) if m.rate >= SLOWEST_MOTORS), None)


def _sources(log: Log, first: float, last: float, count: int) -> Iterator[Thrust]:
    setpoints = (
        ("vehicle_thrust_setpoint", "xyz[2]", -1.0),  # from 1.13 on
        ("actuator_controls_0", "control[3]", 1.0),  # to 1.13
        ("vehicle_rates_setpoint", "thrust_body[2]", -1.0),
        ("vehicle_attitude_setpoint", "thrust_body[2]", -1.0),
    )
    for name, field, sign in setpoints:
        topic = log.topic(name, field)
        if topic is None:
            continue
        values = sign * np.asarray(topic.fields[field], dtype=float)
        flown = (topic.t >= first) & (topic.t <= last) & np.isfinite(values)
        if not np.any(values[flown] > 0):
            continue
        values, said = _battery_scaled(log, topic, values)
        good = np.isfinite(values)
        yield Thrust(
            topic.t[good], values[good], f"{log.name_of(name)}{said}", topic.rate_within(first, last)
        )
    for motors in _motors(log, first, last, count):
        yield Thrust(motors.t, motors.commands.mean(axis=1), f"the mean of {motors.said}", motors.rate)
    if (esc := rotor_speeds(log, first, last, count)) is not None:
        t, speed, rate = esc
        yield Thrust(
            t,
            np.mean(speed**2, axis=1),
            f"the squared rotor speeds of {log.name_of('esc_status')}",
            rate,
            relative=True,
        )


def _battery_scaled(log: Log, topic: Topic, values: np.ndarray) -> tuple[np.ndarray, str]:
    """With `MC_BAT_SCALE_EN` PX4 multiplies the command as the voltage falls; where the topic is older than that
    step, it is made up for."""
    before = topic.name in ("vehicle_rates_setpoint", "vehicle_attitude_setpoint") or (
        topic.name == "vehicle_thrust_setpoint" and log.topic("actuator_controls_0") is not None
    )
    battery = log.topic("battery_status", "scale")
    if not before or battery is None or not log.parameter("MC_BAT_SCALE_EN"):
        return values, ""
    scale = np.asarray(battery.fields["scale"], dtype=float)
    scale = np.where(np.isfinite(scale) & (scale > 0), scale, 1.0)
    return values * np.interp(topic.t, battery.t, scale), " times the battery's scale (MC_BAT_SCALE_EN)"


def _motors(log: Log, first: float, last: float, count: int) -> Iterator[Motors]:
    fields = tuple(f"control[{i}]" for i in range(count))
    topic = log.topic("actuator_motors", *fields)
    if topic is not None:
        commands = topic.stack(*fields)
        known = np.all(np.isfinite(commands), axis=1)
        flown = known & (topic.t >= first) & (topic.t <= last)
        if np.any(commands[flown] > 0):
            # Motors that stand have no command (nan); they give no thrust.
            yield Motors(
                topic.t,
                np.nan_to_num(commands),
                log.name_of("actuator_motors"),
                topic.rate_within(first, last),
            )
    for topic in log.topics.get("actuator_outputs", ()):
        yield from _outputs(log, topic, first, last, count)


def _outputs(log: Log, topic: Topic, first: float, last: float, count: int) -> Iterator[Motors]:
    """Motor commands of one driver's outputs, if they are those of the motors."""
    parameters = log.parameters_at(first)
    flown = (topic.t >= first) & (topic.t <= last)
    if flown.sum() < 10:
        return
    for driver, channels in _layouts(parameters, count):
        names = tuple(f"output[{c}]" for c in channels)
        if not topic.has(*names):
            continue
        outputs = topic.stack(*names)
        moving = np.ptp(outputs[flown], axis=0) > 0.01 * np.abs(outputs[flown]).max(axis=0)
        if not np.all(moving):
            continue
        for low, high, kind in _ranges(parameters, driver, channels):
            inside = (outputs[flown] >= low - 2) & (outputs[flown] <= high + 2)
            # Stopped motors are below their range for a moment before takeoff and after landing.
            if inside.mean() < 0.95 or np.any(outputs[flown] > high + 2):
                continue
            signal = np.clip((outputs - low) / (high - low), 0.0, 1.0)
            factor = float(np.clip(parameters.get("THR_MDL_FAC", 0.0), 0.0, 1.0))
            bent = f", THR_MDL_FAC {factor:g}" if factor else ""
            said = f"actuator_outputs ({kind}, {np.min(low):g} to {np.max(high):g}{bent})"
            yield Motors(
                topic.t, factor * signal**2 + (1.0 - factor) * signal, said, topic.rate_within(first, last)
            )
            return


def _layouts(parameters: dict[str, float], count: int) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Which outputs of which driver are the motors: by output functions (from 1.13 on), or the first ones."""
    for driver in DRIVERS:
        by_function = {
            int(value): channel - 1
            for channel in range(1, 17)
            if (value := parameters.get(f"{driver}_FUNC{channel}")) is not None
        }
        wanted = [MOTOR_1 + motor for motor in range(count)]
        if all(function in by_function for function in wanted):
            yield driver, tuple(by_function[function] for function in wanted)
    if not any(name.startswith(DRIVERS) and "_FUNC" in name and value for name, value in parameters.items()):
        for driver in PULSES:
            yield driver, tuple(range(count))


def _ranges(
    parameters: dict[str, float], driver: str, channels: tuple[int, ...]
) -> Iterator[tuple[np.ndarray, np.ndarray, str]]:
    """Outputs (n,) of a driver that mean none and full, most likely first."""
    ones = np.ones(len(channels))
    timers = [value for name, value in parameters.items() if name.startswith(f"{driver}_TIM")]
    dshot = any(int(value) in DSHOT_TIMERS for value in timers) or parameters.get("DSHOT_CONFIG", 0) > 0
    least = max(1.0, round(parameters.get("DSHOT_MIN", 0.055) * DSHOT_FULL))
    if dshot:
        yield least * ones, DSHOT_FULL * ones, "DShot"
    low: list[float] = []
    high: list[float] = []
    for channel in channels:
        for ends, end in ((low, "MIN"), (high, "MAX")):
            one = parameters.get(f"{driver}_{end}{channel + 1}", -1.0)
            every = parameters.get(f"{driver}_{end}", parameters.get(f"PWM_{end}", -1.0))
            ends.append(one if one >= 0 else every)
    if min(low) >= 0 and all(b > a for a, b in zip(low, high, strict=True)):
        yield np.array(low), np.array(high), driver
    if not dshot:
        yield 1000.0 * ones, 2000.0 * ones, "pulses of 1 to 2 ms assumed"
        yield least * ones, DSHOT_FULL * ones, "DShot assumed"
        yield 0.0 * ones, UAVCAN_FULL * ones, "CAN assumed"


def rotor_speeds(
    log: Log, first: float, last: float, count: int
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Rotor speeds (M, count) in rad/s at times (M,), in the order of motors, and their rate (Hz) between two times;
    None where they are not measured. A speed that one report misses is filled in."""
    best: tuple[np.ndarray, np.ndarray, float] | None = None
    # Gazebo's interface writes rad/s into the field of revolutions per minute.
    unit = 1.0 if log.parameter("SIM_GZ_EC_FUNC1") else np.pi / 30
    for esc in log.topics.get("esc_status", ()):
        fields = tuple(f"esc[{i}].esc_rpm" for i in _escs(esc, count))
        if len(fields) < count or not esc.has(*fields):
            continue
        speed = np.abs(esc.stack(*fields)) * unit
        flown = (esc.t >= first) & (esc.t <= last)
        if flown.sum() < 10 or np.any(np.mean(speed[flown] > 0, axis=0) < 0.9):
            continue
        columns = []
        for one in speed.T:
            # A zero between two turning reports was not received.
            lost = (one == 0) & flown
            columns.append(np.where(lost, np.interp(esc.t, esc.t[~lost], one[~lost]), one))
        rate = esc.rate_within(first, last)
        if best is None or rate > best[2]:
            best = esc.t, np.stack(columns, -1), rate
    return best


def _escs(esc: Topic, count: int) -> list[int]:
    """Index in the report of each motor: by `actuator_function` (from 1.14 on), otherwise in order."""
    found: dict[int, int] = {}
    for index in range(16):
        functions = esc.fields.get(f"esc[{index}].actuator_function")
        if functions is not None and functions.max(initial=0) >= MOTOR_1:
            found[int(functions.max()) - MOTOR_1] = index
    if all(motor in found for motor in range(count)):
        return [found[motor] for motor in range(count)]
    return list(range(count))
