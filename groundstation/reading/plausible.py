"""Is a flight what its columns say? Clock, missing values, units, and signs that physics does not allow.

Each check raises one `InputError` that says what is wrong, where, and what to do. The thresholds are far
outside what a quadrotor can do, so that a real flight, however odd, passes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from trueflight.models.errors import InputError
from trueflight.models.flight import COLUMNS
from trueflight.models.frames import BLOCK
from trueflight.models.vehicle import GRAVITY, Vehicle

LOWEST_RATE = 10.0  # Hz; below it neither rates nor drag can be told from noise
SHORTEST = 2.0  # s
LEAST = 20  # samples
FULL = 1.5  # of full throttle, with some room: what reaches further is in another unit, or ran away

HIGHEST_RATE = 60.0  # rad/s; a racing quadrotor reaches 35
HIGHEST_FORCE = 16.0 * GRAVITY  # m/s²; the range of most accelerometers on flight controllers
AT_ITS_END = 0.995  # of the range, for a sensor that tells no more than its greatest number
MOST_BEYOND = 0.01  # share of the flight; an impact takes some samples
STAYS = 0.8  # share of the rest of a flight that what ran away is beyond
CELL = 3.7  # V nominal, lithium polymer
PACK = (0.6, 1.4)
"""Voltage over nominal: 2.8 V a cell where nominal was said of full cells, to 4.35 V where of empty ones."""
MILLIVOLTS = (600.0, 1400.0)
COEFFICIENT = (5e-4, 0.15)
"""Thrust over air density, disk area and squared tip speed; propellers have 0.004 to 0.03, in rpm 91 times less."""
AIR_DENSITY = 1.2  # kg/m³


def check_clock(t: np.ndarray, place: Callable[[int], str]) -> None:
    """The clock (N,): finite, never backwards, and in seconds. `place(row)` names a row in a message."""
    if len(t) < LEAST:
        raise InputError(f"{place(0)}: only {len(t)} samples; at least {SHORTEST:g} s of flight are needed")
    bad = np.flatnonzero(~np.isfinite(t))
    if bad.size:
        raise InputError(f"{place(int(bad[0]))}: the time is not a number; correct or remove that row")
    steps = np.diff(t)
    back = np.flatnonzero(steps < 0)
    if back.size:
        row = int(back[0]) + 1
        raise InputError(
            f"{place(row)}: time goes back from {t[row - 1]:.6g} to {t[row]:.6g} s; "
            "sort the rows, or split the file where the logger started again"
        )
    positive = steps[steps > 0]
    if positive.size < 0.5 * steps.size:
        raise InputError(
            f"{place(0)}: {100 * (1 - positive.size / steps.size):.0f} % of the times are duplicates; "
            "log the time with more digits"
        )
    dt = float(np.median(positive))
    if dt > 1.0 / LOWEST_RATE:
        for unit, factor in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
            if 5e-4 <= dt * factor <= 1.0 / LOWEST_RATE:
                raise InputError(
                    f"{place(0)}: the time steps by {dt:g} from row to row; is it in {unit}? It must be in s "
                    f"(--mapping 'time.unit = \"{unit}\"' converts it)"
                )
        raise InputError(
            f"{place(0)}: sampled at {1 / dt:.3g} Hz; at least {LOWEST_RATE:g} Hz are needed, 100 Hz is good"
        )


def check_units(
    t: np.ndarray, columns: dict[str, np.ndarray], vehicle: Vehicle, origin: str, units: dict[str, str]
) -> None:
    """Magnitudes that tell a wrong unit: degrees, g, millivolts, raw 16-bit commands; `units` were named."""
    if (q := columns.get("quaternion")) is not None:
        norm = np.linalg.norm(q, axis=1)
        wrong = np.abs(norm - 1) > 0.02
        if np.mean(wrong) > 0.001:
            row = int(np.argmax(wrong))
            hint = (
                "angles in degrees? A mapping reads roll, pitch and yaw"
                if np.median(norm) > 2
                else "quaternion_w, x, y, z must hold one whole unit quaternion, body to world"
            )
            raise InputError(
                f"{origin}: the quaternion is not unit (norm {norm[row]:.3g} in sample {row + 1}); {hint}"
            )
    for name in ("angular_velocity", "body_rate_command"):
        if (w := columns.get(name)) is not None and (peak := _high(w)) > HIGHEST_RATE:
            beyond = np.max(np.abs(w), axis=1) > HIGHEST_RATE
            first = int(np.argmax(beyond))
            if first > LEAST and np.mean(beyond[first:]) > STAYS:  # degrees come back
                raise InputError(_ran_away(t, w, beyond, name, f"beyond {HIGHEST_RATE:.0f} rad/s", origin))
            raise InputError(
                f"{origin}: {COLUMNS[name][2]} reaches {peak:.0f} rad/s; is it in deg/s? Convert it to "
                "rad/s, "
                f"or read it with --mapping '{name}.unit = \"deg/s\"'"
            )
    if (u := columns.get("thrust_command")) is not None:
        _check_runaway(t, u, "thrust_command", origin, units)
        _check_thrust(u, vehicle.hover_thrust, origin)
    if (volts := columns.get("battery_voltage")) is not None:
        level = float(np.nanmedian(volts))
        if MILLIVOLTS[0] < level / vehicle.nominal_voltage < MILLIVOLTS[1] and abs(level - 65535.0) > 1.0:
            raise InputError(
                f"{origin}: battery_voltage is {level:.0f} V, the vehicle's nominal voltage "
                f"{vehicle.nominal_voltage:g} V; "
                "is it in mV? Read it with --mapping 'battery_voltage.unit = \"mV\"'"
            )
    if (motors := columns.get("motor_command")) is not None:
        _check_runaway(t, motors, "motor_command", origin, units)
        _check_motors(motors, vehicle.hover_thrust, origin)
    if (speed := columns.get("rotor_speed")) is not None:
        _check_rotor_speed(speed, vehicle, origin)
    if (
        (yaw := columns.get("yaw_reference")) is not None
        and np.ptp(np.diff(yaw)) > 0
        and _high(yaw[:, None]) > 60
    ):
        raise InputError(
            f"{origin}: yaw_reference reaches {_high(yaw[:, None]):.0f} rad; in degrees? Read it with "
            "--mapping 'yaw_reference.unit = \"deg\"'"
        )


def without_wrong_voltage(
    columns: dict[str, np.ndarray], vehicle: Vehicle
) -> tuple[dict[str, np.ndarray], list[str]]:
    """A voltage that no pack of the vehicle's nominal voltage has is left out, with the likely unit in a note: what a
    battery does cannot be judged from it, and a flight needs no voltage."""
    volts = columns.get("battery_voltage")
    if volts is None:
        return columns, []
    level, nominal = float(np.nanmedian(volts)), vehicle.nominal_voltage
    if PACK[0] <= level / nominal <= PACK[1] or MILLIVOLTS[0] < level / nominal < MILLIVOLTS[1]:
        return columns, []
    cells = round(nominal / CELL)
    if abs(level - 65.535) < 0.01 or abs(level - 65535.0) < 1.0:
        guess = "65535 is what drivers write that have no reading"
    elif cells > 1 and PACK[0] <= level / CELL <= PACK[1]:
        guess = f"per cell of {cells}? Multiply it by {cells}"
    elif np.nanmin(volts) >= 0.0 and np.nanmax(volts) <= 1.001:
        guess = "a share of the charge? It must be in volts"
    elif np.nanmax(volts) <= 100.5 and level > PACK[1] * nominal:
        guess = "in percent? It must be in volts"
    elif PACK[0] <= 1e-3 * level / nominal <= PACK[1]:
        guess = "in mV? Read it with --mapping 'battery_voltage.unit = \"mV\"'"
    else:
        guess = "correct nominal_voltage of the vehicle file, or the unit"
    note = f"the battery voltage, {level:.3g} V, is implausible for {nominal:g} V nominal and was left out ({guess})"
    return {name: column for name, column in columns.items() if name != "battery_voltage"}, [note]


def check_sensors(t: np.ndarray, columns: dict[str, np.ndarray], flying: np.ndarray, origin: str) -> None:
    """Readings beyond what sensors of a flight controller can tell: a column that runs away, or another quantity."""
    for name, limit, unit, more in (
        ("specific_force", HIGHEST_FORCE, "m/s^2", " (16 g)"),
        ("angular_velocity", HIGHEST_RATE, "rad/s", ""),
    ):
        if (column := columns.get(name)) is None:
            continue
        beyond = flying & (np.max(np.abs(column), axis=1) > AT_ITS_END * limit)
        if np.sum(beyond) > MOST_BEYOND * np.sum(flying):
            raise InputError(_ran_away(t, column, beyond, name, f"beyond {limit:.0f} {unit}{more}", origin))


def implausible_force(columns: dict[str, np.ndarray], flying: np.ndarray) -> str:
    """What is wrong with an accelerometer that does not feel the thrust in flight, about +9.8 m/s² along body z (FLU)
    on average; '' where it does, or where there is none."""
    f = columns.get("specific_force")
    if f is None:
        return ""
    x, y, z = np.median(f[flying], axis=0)
    norm = float(np.median(np.linalg.norm(f[flying], axis=1)))
    spread = float(np.subtract(*np.quantile(f[flying, 2], [0.75, 0.25])))
    if 0.5 < norm < 2.0 and abs(z) > 0.8 * norm and spread < 0.5 * norm:
        return (
            f"specific_force is {norm:.2f} m/s^2 in flight, which looks like g; convert it to "
            "m/s^2, "
            "or read it with --mapping 'specific_force.unit = \"g\"'"
        )
    if norm > 0.5 * GRAVITY and z < -0.5 * norm:
        return (
            f"specific_force_z is {z:.1f} m/s^2 in flight, but up is positive (body FLU); if the "
            "log is in "
            "NED and FRD, read it with --mapping 'frame = \"ned_frd\"'"
        )
    if norm < 0.3 * GRAVITY:
        return (
            f"specific_force is only {norm:.2f} m/s^2 in flight: gravity was taken out of it; "
            "give the raw "
            "accelerometer, or map the columns as [world_acceleration] if they are in the world frame"
        )
    if max(abs(x), abs(y)) > 0.7 * norm:
        axis = "x" if abs(x) > abs(y) else "y"
        return (
            f"specific_force points along body {axis} in flight ({x:.1f}, {y:.1f}, {z:.1f} "
            "m/s^2), thrust acts "
            "along z; map the axes in the order forward, left, up"
        )
    return ""


def body_rate(start: np.ndarray, end: np.ndarray, seconds: float) -> np.ndarray:
    """Mean body rates (N, 3) in rad/s that turn attitudes `start` (N, 4) into `end` (N, 4)."""
    out = np.empty((len(start), 3))
    for first in range(0, len(out), BLOCK):
        rows = slice(first, first + BLOCK)
        (w0, x0, y0, z0), (w, x, y, z) = start[rows].T, end[rows].T
        scalar = w0 * w + x0 * x + y0 * y + z0 * z
        between = (
            w0 * x - w * x0 - y0 * z + z0 * y,
            w0 * y - w * y0 - z0 * x + x0 * z,
            w0 * z - w * z0 - x0 * y + y0 * x,
        )
        sine = np.sqrt(between[0] ** 2 + between[1] ** 2 + between[2] ** 2)
        angle = 2.0 * np.arctan2(sine, np.abs(scalar))
        rate = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 2.0) / seconds
        rate = np.where(scalar < 0, -rate, rate)
        for k in range(3):
            out[rows, k] = between[k] * rate
    return out


def _ran_away(
    t: np.ndarray, column: np.ndarray, beyond: np.ndarray, name: str, what: str, origin: str
) -> str:
    """What to say of a `column` (N,) or (N, k), of the quantity `name`, that is `what` in the samples `beyond` (N,):
    which column, since when, how long, how far, and the line of a mapping that reads the rest."""
    flat = np.abs(column.reshape(len(t), -1))
    worst, first = int(np.argmax(flat.max(axis=0))), int(np.argmax(beyond))
    cut = f"'time.until = {np.floor(10 * t[first]) / 10:g}'" if t[first] - t[0] > SHORTEST else ""
    leave = f"'{name}.leave_out = true'"
    return (
        f"{origin}: {COLUMNS[name][0][worst]} is {what} from t = {t[first]:.1f} s on, in {100 * np.mean(beyond):.0f} % "
        f"of the flight, up to {flat.max():.4g}: the sensor, logger or export ran away or is at its end; export it "
        f"again, or read what is good with --mapping {f'{cut} (or earlier), or {leave}' if cut else leave}"
    )


def _check_runaway(t: np.ndarray, column: np.ndarray, name: str, origin: str, units: dict[str, str]) -> None:
    """Commands that were 0 to 1 of full throttle first and are not any more, or are not in the unit that was named."""
    highest = np.max(np.abs(column.reshape(len(t), -1)), axis=1)
    beyond = highest > FULL
    if np.mean(beyond) < 0.001:
        return
    before = highest[: int(np.argmax(beyond))]
    throttle = len(before) > LEAST and 0.1 < np.median(before) < 1.0 and np.ptp(before) > 0.01
    if not throttle and name not in units:  # in another unit throughout
        return
    named = f' in unit "{units[name]}"' if name in units else ""
    raise InputError(_ran_away(t, column, beyond, name, f"beyond full throttle, 1,{named}", origin))


def _command_unit(command: np.ndarray, high: float, hover: float) -> str:
    """The unit of commands that reach `high`; '' for none that is known. Of pulse widths and DShot, whose ranges
    overlap, the one in which the median is nearer to the `hover` thrust of the vehicle file."""
    if high <= 105:
        return "percent"
    middle = float(np.median(command[command > 0]))
    nearness = {}
    if high <= 2500 and middle > 1000:
        nearness["pwm"] = abs(np.log(1e-3 * (middle - 1000) / hover))
    if high <= 2100 and middle > 48:
        nearness["dshot"] = abs(np.log((middle - 48) / 1999 / hover))
    return min(nearness, key=lambda unit: nearness[unit]) if nearness else "u16" if high <= 66000 else ""


def _check_motors(motors: np.ndarray, hover: float, origin: str) -> None:
    high, low = float(np.nanquantile(motors, 0.999)), float(np.nanquantile(motors, 0.001))
    if high <= FULL and low >= -1.05:
        return
    unit = _command_unit(motors, high, hover) if low >= 0 else ""
    guess = {
        "pwm": "microseconds of PWM? ",
        "dshot": "DShot (48 to 2047)? ",
        "percent": "in percent? ",
        "u16": "a 16-bit command? ",
    }.get(unit, "give them as 0 to 1 of full throttle")
    guess += f"Read them with --mapping 'motor_command.unit = \"{unit}\"'" if unit else ""
    raise InputError(
        f"{origin}: motor commands reach from {low:.4g} to {high:.4g}, but their unit is 0 to 1 of full throttle; "
        f"{guess}"
    )


def _check_rotor_speed(speed: np.ndarray, vehicle: Vehicle, origin: str) -> None:
    """The thrust coefficient that carries the vehicle's weight at the median speed must be a propeller's."""
    radius, places = vehicle.rotor_radius, np.array(vehicle.rotor_positions)
    if len(places) < 2 or not np.any(speed > 0.0):
        return
    apart = min(float(np.linalg.norm(places[0] - other)) for other in places[1:])
    if not 0.1 * apart < radius < 0.6 * apart:  # the radius was not measured
        return
    median = float(np.median(speed[speed > 0.0]))
    thrust = vehicle.weight / max(len(vehicle.rotor_positions), 1)
    coefficient = thrust / (AIR_DENSITY * np.pi * radius**2 * (median * radius) ** 2)
    if COEFFICIENT[0] <= coefficient <= COEFFICIENT[1]:
        return
    for unit, factor in (("rpm", np.pi / 30), ("rev/s", 2 * np.pi)):
        if COEFFICIENT[0] <= coefficient / factor**2 <= COEFFICIENT[1]:
            raise InputError(
                f"{origin}: rotor speeds of {median:.0f} rad/s do not fit rotors of {radius:.3g} m that carry "
                f"{vehicle.mass:.3g} kg; are they in {unit}? Read them with --mapping "
                f"'rotor_speed.unit = \"{unit}\"'"
            )
    raise InputError(
        f"{origin}: rotor speeds of {median:.0f} rad/s do not fit rotors of {radius:.3g} m that carry "
        f"{vehicle.mass:.3g} kg; check their unit (rad/s), and mass and rotor_radius of the vehicle file"
    )


def _check_thrust(u: np.ndarray, hover: float, origin: str) -> None:
    low, high = float(np.quantile(u, 0.001)), float(np.quantile(u, 0.999))
    if low < -0.05:
        raise InputError(
            f"{origin}: thrust_command goes down to {low:.3g}; up is positive (0 to 1). If the log is in "
            "FRD, read it with --mapping 'thrust_command.sign = -1'"
        )
    if high <= FULL:
        return
    unit = _command_unit(u, high, hover)
    guess = {
        "pwm": "a pulse width? Read it with --mapping 'thrust_command.unit = \"pwm\"'",
        "dshot": "DShot (48 to 2047)? Read it with --mapping 'thrust_command.unit = \"dshot\"'",
        "percent": 'in percent, or in newtons? Read it with --mapping \'thrust_command.unit = "percent"\', or "N"',
        "u16": "a 16-bit command? Read it with --mapping 'thrust_command.unit = \"u16\"'",
    }.get(unit, "divide it by full collective")
    raise InputError(f"{origin}: thrust_command reaches {high:.4g}, it is 0 to 1 of full collective; {guess}")


def _high(column: np.ndarray) -> float:
    return float(np.quantile(np.max(np.abs(column), axis=-1), 0.99))
