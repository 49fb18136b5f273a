"""Is a flight what its columns say? Clock, missing values, units, and signs that physics does not allow.

Each check raises one `InputError` that says what is wrong, where, and what to do. The thresholds are far
outside what a quadrotor can do, so that a real flight, however odd, passes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from trueflight.groundstation.reading.uniform import segments
from trueflight.models.errors import InputError
from trueflight.models.flight import COLUMNS
from trueflight.models.frames import rotate
from trueflight.models.vehicle import GRAVITY, Vehicle

LOWEST_RATE = 10.0  # Hz; below it neither rates nor drag can be told from noise
SHORTEST = 2.0  # s

HIGHEST_RATE = 60.0  # rad/s; a racing quadrotor reaches 35
HIGHEST_VOLTAGE = 1000.0


def check_clock(t: np.ndarray, place: Callable[[int], str]) -> None:
    """The clock (N,): finite, never backwards, and in seconds. `place(row)` names a row in a message."""
    if len(t) < 20:
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
                    f'(a mapping converts it: [time] unit = "{unit}")'
                )
        raise InputError(
            f"{place(0)}: sampled at {1 / dt:.3g} Hz; at least {LOWEST_RATE:g} Hz are needed, 100 Hz is good"
        )


def check_units(columns: dict[str, np.ndarray], vehicle: Vehicle, origin: str) -> None:
    """Magnitudes that tell a wrong unit: degrees, g, millivolts, raw 16-bit commands."""
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
            raise InputError(
                f"{origin}: {COLUMNS[name][2]} reaches {peak:.0f} rad/s; is it in deg/s? Convert it to "
                "rad/s, "
                'or map it with unit = "deg/s"'
            )
    if (u := columns.get("thrust_command")) is not None:
        _check_thrust(u, origin)
    if (volts := columns.get("battery_voltage")) is not None:
        level = float(np.median(volts))
        if level > 20 * vehicle.nominal_voltage:
            raise InputError(
                f"{origin}: battery_voltage is {level:.0f} V, the vehicle's nominal voltage "
                f"{vehicle.nominal_voltage:g} V; "
                'is it in mV? Map it with unit = "mV"'
            )
    if (
        (yaw := columns.get("yaw_reference")) is not None
        and np.ptp(np.diff(yaw)) > 0
        and _high(yaw[:, None]) > 60
    ):
        raise InputError(
            f'{origin}: yaw_reference reaches {_high(yaw[:, None]):.0f} rad; in degrees? Use unit = "deg"'
        )


def check_specific_force(columns: dict[str, np.ndarray], flying: np.ndarray, origin: str) -> None:
    """In flight the accelerometer feels the thrust: about +9.8 m/s² along body z (FLU) on average."""
    f = columns.get("specific_force")
    if f is None:
        return
    x, y, z = np.median(f[flying], axis=0)
    norm = float(np.median(np.linalg.norm(f[flying], axis=1)))
    spread = float(np.subtract(*np.quantile(f[flying, 2], [0.75, 0.25])))
    if 0.5 < norm < 2.0 and abs(z) > 0.8 * norm and spread < 0.5 * norm:
        raise InputError(
            f"{origin}: specific_force is {norm:.2f} m/s^2 in flight, which looks like g; convert it to "
            "m/s^2, "
            'or map it with unit = "g"'
        )
    if norm > 0.5 * GRAVITY and z < -0.5 * norm:
        raise InputError(
            f"{origin}: specific_force_z is {z:.1f} m/s^2 in flight, but up is positive (body FLU); if the "
            "log is in "
            'NED and FRD, map it with frame = "ned_frd"'
        )
    if norm < 0.3 * GRAVITY:
        raise InputError(
            f"{origin}: specific_force is only {norm:.2f} m/s^2 in flight: gravity was taken out of it; "
            "give the raw "
            "accelerometer, or map the columns as [world_acceleration] if they are in the world frame"
        )
    if max(abs(x), abs(y)) > 0.7 * norm:
        axis = "x" if abs(x) > abs(y) else "y"
        raise InputError(
            f"{origin}: specific_force points along body {axis} in flight ({x:.1f}, {y:.1f}, {z:.1f} "
            "m/s^2), thrust acts "
            "along z; map the axes in the order forward, left, up"
        )


def check_attitude(t: np.ndarray, columns: dict[str, np.ndarray], flying: np.ndarray, origin: str) -> None:
    """The attitude must turn as the gyroscope says: tells the order w, x, y, z from x, y, z, w, body-to-world
    from world-to-body, and radians from degrees. Silent where the flight turns too little to tell."""
    q, w = columns.get("quaternion"), columns.get("angular_velocity")
    if q is None or w is None:
        return
    dt = float(np.median(np.diff(t)))
    stride = max(1, round(0.04 / dt))  # 40 ms: above the noise of an attitude estimate, below its manoeuvres
    rows = np.concatenate([np.arange(s.start, s.stop - stride) for s in segments(t)])
    rows = rows[flying[rows] & flying[rows + stride]]
    if len(rows) < 100:
        return
    mean = np.concatenate([np.zeros((1, 3)), np.cumsum(w, axis=0)])
    gyro = (mean[rows + stride] - mean[rows]) / stride
    if np.sqrt(np.mean(gyro**2)) < 0.05:
        return
    seconds = stride * dt

    def score(quaternion: np.ndarray) -> tuple[float, float]:
        turned = body_rate(quaternion[rows], quaternion[rows + stride], seconds)
        slope = float(np.sum(turned * gyro) / np.sum(gyro**2))
        return float(np.sum(turned * gyro) / np.sqrt(np.sum(turned**2) * np.sum(gyro**2) + 1e-30)), slope

    agreement, slope = score(q)
    if agreement > 0.5:
        if slope < 0.1:
            raise InputError(
                f"{origin}: angular_velocity is {1 / slope:.0f} times what the attitude turns; is it in "
                "deg/s? "
                'Convert it to rad/s, or map it with unit = "deg/s"'
            )
        return
    others = {
        'the columns look like x, y, z, w; name them so, or map them with order = "xyzw"': q[:, [3, 0, 1, 2]],
        "it looks like world to body; take its conjugate (or map it with inverse = true)": q
        * [1, -1, -1, -1],
        'it looks like FRD axes (map attitude and rates with frame = "ned_frd")': q * [1, 1, -1, -1],
    }
    hint, best = max(((text, score(other)[0]) for text, other in others.items()), key=lambda pair: pair[1])
    if best > 0.8 and best > agreement + 0.4:
        raise InputError(f"{origin}: the quaternion does not turn as angular_velocity says; {hint}")


def check_motion(t: np.ndarray, columns: dict[str, np.ndarray], flying: np.ndarray, origin: str) -> None:
    """Velocity must be the derivative of position, and its own derivative must be the rotated specific
    force."""
    p, v = columns.get("position"), columns.get("velocity")
    half_second = max(1, round(0.5 / float(np.median(np.diff(t)))))
    rows = np.concatenate(
        [np.arange(s.start, s.stop - half_second) for s in segments(t)] or [np.array([], int)]
    )
    rows = rows[flying[rows] & flying[rows + half_second]]
    if v is None or len(rows) < 2 * half_second:
        return
    seconds = (t[rows + half_second] - t[rows])[:, None]
    if p is not None:
        moved = p[rows + half_second] - p[rows]
        integral = np.concatenate([np.zeros((1, 3)), np.cumsum(v, axis=0)])
        expected = (integral[rows + half_second] - integral[rows]) / half_second * seconds
        if np.sqrt(np.mean(expected**2)) > 0.02:
            scale, agreement = _slope(expected, moved)
            if agreement > 0.9 and not 0.5 < scale < 2:
                raise InputError(
                    f"{origin}: position moves {scale:.3g} times as far as velocity says; check the units "
                    "of both "
                    "(m and m/s)"
                )
            for axis, name in enumerate("xyz"):
                _one, agree = _slope(expected[:, axis], moved[:, axis])
                if agree < -0.8 and np.std(expected[:, axis]) > 0.05:
                    raise InputError(
                        f"{origin}: velocity_{name} has the opposite sign of position_{name}'s motion; "
                        "give both in "
                        'world ENU, or map them with frame = "ned_frd"'
                    )
    q, f = columns.get("quaternion"), columns.get("specific_force")
    if q is None or f is None:
        return
    gained = (v[rows + half_second] - v[rows]) / seconds
    world = rotate(q, f) - np.array([0, 0, GRAVITY])
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(world, axis=0)])
    felt = (integral[rows + half_second] - integral[rows]) / half_second
    for axes, names in (((0, 1), "horizontal"), ((2,), "vertical")):
        a, b = gained[:, axes] - gained[:, axes].mean(0), felt[:, axes] - felt[:, axes].mean(0)
        _, agreement = _slope(a, b)
        if agreement < -0.7 and min(np.std(a), np.std(b)) > 0.3:
            raise InputError(
                f"{origin}: the {names} velocity gains the opposite of what accelerometer and attitude "
                "say; the frames "
                'disagree: world ENU, body FLU are needed (map a NED log with frame = "ned_frd")'
            )


def body_rate(start: np.ndarray, end: np.ndarray, seconds: float) -> np.ndarray:
    """Mean body rates (N, 3) in rad/s that turn attitudes `start` (N, 4) into `end` (N, 4)."""
    w0, v0 = start[:, :1], -start[:, 1:]
    w1, v1 = end[:, :1], end[:, 1:]
    scalar = w0 * w1 - np.sum(v0 * v1, axis=1, keepdims=True)
    vector = w0 * v1 + w1 * v0 + np.cross(v0, v1)
    return 2.0 * np.sign(np.where(scalar == 0, 1.0, scalar)) * vector / seconds


def _check_thrust(u: np.ndarray, origin: str) -> None:
    low, high = float(np.quantile(u, 0.001)), float(np.quantile(u, 0.999))
    if low < -0.05:
        raise InputError(
            f"{origin}: thrust_command goes down to {low:.3g}; up is positive (0 to 1). If the log is in "
            "FRD, map it "
            "with sign = -1"
        )
    if high <= 1.5:
        return
    if high > 2500:
        guess = 'a 16-bit command? Map it with unit = "u16"'
    elif high > 900:
        guess = 'a pulse width? Map it with unit = "pwm"'
    elif high <= 105:
        guess = 'in percent, or in newtons? Map it with unit = "percent" or "N"'
    else:
        guess = "divide it by full collective"
    raise InputError(f"{origin}: thrust_command reaches {high:.4g}, it is 0 to 1 of full collective; {guess}")


def _slope(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope of y over x without intercept, and their correlation without centring."""
    xy, xx, yy = float(np.sum(x * y)), float(np.sum(x * x)), float(np.sum(y * y))
    return xy / (xx + 1e-30), xy / (np.sqrt(xx * yy) + 1e-30)


def _high(column: np.ndarray) -> float:
    return float(np.quantile(np.max(np.abs(column), axis=-1), 0.99))
