"""Whether the odometry is of the vehicle that flies: does it change, and move as gyroscope and accelerometer say?

An estimate that stands still, is repeated, or belongs to another body has valid numbers and stamps that advance; a
cascade that believes it flies away. Accelerometer and gyroscope come by another message (HIGHRES_IMU), straight from
the sensors, and cannot be wrong in the same way. Over a short window three sums are kept: rotation of the attitude
minus the integral of the gyroscope, change of the velocity minus the integral of the acceleration, change of the
position minus the integral of the velocity. Noise, bias and vibration add little to them in so short a time.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from trueflight.companion.odometry import ImuSample, Odometry
from trueflight.models.vehicle import GRAVITY

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class AgreementLimits:
    """Section `[agreement]`: how far the odometry may be from the sensors before a flight ends.

    Over `window` s the attitude may turn by `turn` rad more or less than the gyroscope did, the velocity change by
    `velocity` m/s otherwise than the accelerometer says, and the position by `position` m otherwise than the velocity
    says; over `drift_window` s the tilt may change by `drift` rad more or less than the gyroscope, whose own bias is
    learned before, did. A position, velocity or attitude that does not change at all for `frozen` s, and
    an accelerometer that is silent for so long, end a flight as well.

    The defaults are twice and more of what flights without such a fault showed: simulated ones with every hidden effect
    (turn 0.02, velocity 0.6, position 0.07, drift 0.02), with an estimator that lags by 80 ms (velocity 1.0, position
    0.5), and PX4 1.17 in its own simulator, whose GPS pulls the position (turn 0.04, velocity 0.7, position 1.1,
    drift 0.08).
    """

    window: float = 1.0
    turn: float = 0.3
    velocity: float = 2.0
    position: float = 2.5
    drift_window: float = 10.0
    drift: float = 0.2
    frozen: float = 0.25


class Difference(NamedTuple):
    """Odometry minus sensors: rad, m/s and m over the window, and rad of tilt over the longer one."""

    turn: float
    velocity: float
    position: float
    drift: float


_GAP = 0.1
"""s between two samples over which what the sensors say is not known: the windows begin anew."""
_LEARNING = 60.0
"""s over which the bias of the gyroscope is learned."""
_SMOOTHING = 0.5
"""s over which the drift is smoothed: the noise of a single attitude is none."""


class _Window:
    """Sums of the rows of the last `seconds`; a row begins with its own duration."""

    def __init__(self, seconds: float, width: int) -> None:
        self._seconds, self._width = seconds, width
        self.clear()

    def clear(self) -> None:
        self._rows: deque[tuple[float, ...]] = deque()
        self.sums = [0.0] * self._width

    def add(self, row: tuple[float, ...]) -> list[float]:
        rows, sums = self._rows, self.sums
        rows.append(row)
        sums = [a + b for a, b in zip(sums, row, strict=True)]
        while sums[0] > self._seconds and len(rows) > 1:
            sums = [a - b for a, b in zip(sums, rows.popleft(), strict=True)]
        self.sums = sums
        return sums


class Agreement:
    """Compares tick by tick; belongs to the control thread. `reason` is what the last sample made of it."""

    def __init__(self, limits: AgreementLimits) -> None:
        self.limits = limits
        self.reason = ""
        self.greatest = Difference(0.0, 0.0, 0.0, 0.0)
        self._short = _Window(limits.window, 10)
        self._long = _Window(limits.drift_window, 3)
        self._bias, self._learned = (0.0, 0.0), 0.0
        self._drift = (0.0, 0.0)
        self._still = 0.0
        self._silent = 0.0
        self._before: tuple[Odometry, ImuSample | None] | None = None

    def step(self, odometry: Odometry, imu: ImuSample | None) -> str:
        """'' or what does not agree, in words. `imu` is the newest sample, None before the first."""
        before, self._before = self._before, (odometry, imu)
        if before is not None:
            dt = 1e-6 * (odometry.vehicle_time_us - before[0].vehicle_time_us)
            if dt > 0.0:
                self.reason = self._judge(odometry, before[0], imu, before[1], dt)
        return self.reason

    def begin(self) -> None:
        """A flight begins: what was different on the ground, carried about by hand, is forgotten; the bias is not."""
        self._short.clear()
        self._long.clear()
        self._drift = (0.0, 0.0)

    @property
    def standing(self) -> str:
        """'' or why nothing of it can be believed even at rest: it stands still, or nothing is heard of the sensors."""
        return self.reason if max(self._still, self._silent) > self.limits.frozen else ""

    def _judge(
        self,
        odometry: Odometry,
        last: Odometry,
        imu: ImuSample | None,
        last_imu: ImuSample | None,
        dt: float,
    ) -> str:
        # An estimate in use changes with every sample of the gyroscope and the accelerometer, at rest as well.
        if (
            odometry.position == last.position
            or odometry.velocity == last.velocity
            or odometry.quaternion == last.quaternion
        ):
            self._still += dt
        else:
            self._still = 0.0
        if self._still > self.limits.frozen:
            names = ("position", "velocity", "quaternion")
            same = [name for name in names if getattr(odometry, name) == getattr(last, name)]
            return f"the odometry's {' and '.join(same)} did not change for {self._still:.2f} s"
        if imu is None or last_imu is None:
            return ""
        self._silent = self._silent + dt if imu.time_us == last_imu.time_us else 0.0
        if self._silent > self.limits.frozen:
            return f"nothing was heard of the accelerometer for {self._silent:.2f} s: nothing confirms the odometry"
        if dt > _GAP or odometry.reset_counter != last.reset_counter:
            self.begin()
            return ""
        return self._compare(odometry, last, imu, last_imu, dt)

    def _compare(
        self, odometry: Odometry, last: Odometry, imu: ImuSample, last_imu: ImuSample, dt: float
    ) -> str:
        turned = _less(_turned(last.quaternion, odometry.quaternion), _mean(last_imu.gyro, imu.gyro), dt)
        felt = _mean(_acceleration(last, last_imu), _acceleration(odometry, imu))
        changed = _less(_minus(odometry.velocity, last.velocity), felt, dt)
        moved = _less(_minus(odometry.position, last.position), _mean(last.velocity, odometry.velocity), dt)
        sums = self._short.add((dt, *turned, *changed, *moved))
        roll, pitch = self._bias
        tilt = self._long.add((dt, turned[0] - roll * dt, turned[1] - pitch * dt))
        # A mean at first, then one that forgets.
        self._learned = min(self._learned + dt, _LEARNING)
        share = dt / self._learned
        self._bias = roll + share * (turned[0] / dt - roll), pitch + share * (turned[1] / dt - pitch)
        share = min(dt / _SMOOTHING, 1.0)
        (x, y), (_, now_x, now_y) = self._drift, tilt
        self._drift = x + share * (now_x - x), y + share * (now_y - y)
        _, a, b, c, d, e, f, g, h, i = sums
        found = Difference(
            math.hypot(a, b, c), math.hypot(d, e, f), math.hypot(g, h, i), math.hypot(*self._drift)
        )
        turn, velocity, position, drift = self.greatest
        self.greatest = Difference(
            max(turn, found.turn),
            max(velocity, found.velocity),
            max(position, found.position),
            max(drift, found.drift),
        )
        return self._told(found)

    def _told(self, found: Difference) -> str:
        limits = self.limits
        if (
            found.turn <= limits.turn
            and found.velocity <= limits.velocity
            and found.position <= limits.position
            and found.drift <= limits.drift
        ):
            return ""
        over = f"within {self._short.sums[0]:.1f} s"
        if found.turn > limits.turn:
            return f"the odometry turned {math.degrees(found.turn):.0f} degrees otherwise than the gyroscope {over}"
        if found.velocity > limits.velocity:
            what = f"the odometry's velocity changed by {found.velocity:.1f} m/s"
            return f"{what} otherwise than the accelerometer says {over}"
        if found.position > limits.position:
            return f"the odometry's position moved {found.position:.2f} m otherwise than its velocity says {over}"
        if found.drift > limits.drift:
            what = f"the odometry tilted {math.degrees(found.drift):.0f} degrees otherwise than the gyroscope"
            return f"{what} within {self._long.sums[0]:.1f} s"
        return ""


def _acceleration(odometry: Odometry, imu: ImuSample) -> Vector:
    """m/s², world ENU: specific force turned by the odometry's attitude, and gravity."""
    x, y, z = rotated(odometry.quaternion, imu.specific_force)
    return x, y, z - GRAVITY


def rotated(quaternion: tuple[float, float, float, float], vector: Vector) -> Vector:
    """A vector in body axes turned to the world by a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    a, b, c = vector
    # v + 2 q x (q x v + w v)
    p, q, r = y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c
    return a + 2.0 * (y * r - z * q), b + 2.0 * (z * p - x * r), c + 2.0 * (x * q - y * p)


def _turned(last: tuple[float, float, float, float], now: tuple[float, float, float, float]) -> Vector:
    """The rotation from one attitude to the next as a vector in body axes, rad; right for the small ones of a tick."""
    w0, x0, y0, z0 = last
    w1, x1, y1, z1 = now
    w = w0 * w1 + x0 * x1 + y0 * y1 + z0 * z1
    x = w0 * x1 - x0 * w1 - y0 * z1 + z0 * y1
    y = w0 * y1 + x0 * z1 - y0 * w1 - z0 * x1
    z = w0 * z1 - x0 * y1 + y0 * x1 - z0 * w1
    twice = 2.0 if w >= 0.0 else -2.0
    return twice * x, twice * y, twice * z


def _minus(one: Vector, other: Vector) -> Vector:
    return one[0] - other[0], one[1] - other[1], one[2] - other[2]


def _mean(one: Vector, other: Vector) -> Vector:
    return 0.5 * (one[0] + other[0]), 0.5 * (one[1] + other[1]), 0.5 * (one[2] + other[2])


def _less(change: Vector, rate: Vector, dt: float) -> Vector:
    return change[0] - rate[0] * dt, change[1] - rate[1] * dt, change[2] - rate[2] * dt
