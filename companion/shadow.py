"""A model in the shadow: evaluated beside a flight, compared with what the accelerometer says, never applied.

What a model predicts can be measured: the error acceleration (10) of the paper, `delta = v_dot - A_zeta (phi,
theta, T - m g)` with `v_dot = R f - g e3`. The plain linear model predicts zero. A model that is further from
the measurement than zero is, on any axis and by more than a tolerance, makes the flight worse than no
model would; it is refused. Both distances are taken after the same low-pass filter, so that vibration and the
motors' lag, which no model here predicts, count for neither.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from trueflight.companion.law.control import euler, world_from_body
from trueflight.companion.law.watch import ZERO, Vector, Watch
from trueflight.models.vehicle import GRAVITY


@dataclass(frozen=True)
class ShadowLimits:
    """How a model proves itself before it takes over in flight.

    `seconds` of flown trajectory in the shadow. `tolerance` m/s²: by how much the RMS of its error may exceed
    that of the plain linear model, per axis; the position loop holds a constant error of that size within a few
    centimetres. `smoothing` s, time constant of the low-pass filter. `trust` is the least mean share of
    training range (1 inside, 0 well outside) in which it must have been.
    """

    seconds: float = 3.0
    tolerance: float = 0.15
    smoothing: float = 0.2
    trust: float = 0.5


def error_acceleration(
    quaternion: tuple[float, float, float, float], specific_force: Vector, thrust: float, mass: float
) -> Vector:
    """Measured error acceleration (10), m/s², heading frame.

    `quaternion` w, x, y, z body to world, `specific_force` m/s² body FLU, `thrust` N as commanded, `mass` kg.
    """
    ax, ay, az = world_from_body(quaternion, specific_force)
    roll, pitch, yaw = euler(quaternion)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return (
        cosine * ax + sine * ay - GRAVITY * pitch,
        cosine * ay - sine * ax + GRAVITY * roll,
        az - thrust / mass,  # both with gravity: az - g - (T - m g) / m
    )


class Shadow:
    """One model's time in the shadow, in one flight.

    `title` is what people call the model. `seconds` replaces that of the limits.
    """

    def __init__(self, watch: Watch, limits: ShadowLimits, title: str = "", seconds: float = 0.0) -> None:
        self.watch, self.limits, self.title = watch, limits, title
        self.seconds = seconds if seconds > 0.0 else limits.seconds
        self.refused = ""
        """Why it may not take over; empty while there is no reason against it."""
        self._flown = self._trusted = self._measured = 0.0
        self._error, self._plain = [0.0] * 3, [0.0] * 3
        self._error_squares, self._plain_squares = [0.0] * 3, [0.0] * 3

    @property
    def name(self) -> str:
        """The model's hash."""
        return self.watch.name

    @property
    def remaining(self) -> float:
        """Seconds of flown trajectory that are still needed."""
        return max(0.0, self.seconds - self._flown)

    @property
    def passed(self) -> bool:
        """Whether it has proved itself."""
        return not self.refused and self.remaining == 0.0

    def describe(self) -> dict[str, str | float]:
        """For the status."""
        return {
            "hash": self.name,
            "title": self.title,
            "remaining": round(self.remaining, 2),
            "refused": self.refused,
        }

    @property
    def errors(self) -> tuple[Vector, Vector]:
        """RMS of measured error acceleration minus prediction, of this model and of the plain linear one (which
        predicts zero), m/s², heading frame, low-passed.
        """
        return self._rms(self._error_squares), self._rms(self._plain_squares)

    def step(self, features: Sequence[float], measured: Vector | None, dt: float) -> Vector:
        """What the model returns for the features of the measured state; m/s², heading frame.

        `measured` is the error acceleration at that state, None without an accelerometer. `dt` s of flown
        trajectory since the last step, 0 where the flight is elsewhere (takeoff, landing).
        """
        dt = min(self.limits.smoothing, dt) if dt > 0.0 else 0.0
        raw, _ = self.watch.evaluate(features, dt, measured)
        if self.watch.tripped:
            self.refused = self.refused or self.watch.reason
            return raw
        if dt == 0.0 or self.refused or self.remaining == 0.0:
            return raw
        self._flown += dt
        self._trusted += dt * self.watch.trust
        if measured is not None:
            self._measured += dt
            share = dt / (self.limits.smoothing + dt)
            for i in range(3):
                self._error[i] += share * (measured[i] - raw[i] - self._error[i])
                self._plain[i] += share * (measured[i] - self._plain[i])
                self._error_squares[i] += dt * self._error[i] ** 2
                self._plain_squares[i] += dt * self._plain[i] ** 2
        if self.remaining == 0.0:
            self.refused = self._judge()
        return raw

    def _judge(self) -> str:
        if self._measured < 0.5 * self._flown:
            return "no accelerometer to measure it by"
        trusted = self._trusted / self._flown
        if trusted < self.limits.trust:
            return f"this flight is mostly outside its training range (trusted {100 * trusted:.0f} %)"
        error, plain = self.errors
        worst = max(range(3), key=lambda i: error[i] - plain[i])
        if not error[worst] <= plain[worst] + self.limits.tolerance:
            return (
                f"its prediction is worse than none: along {'xyz'[worst]} it is {error[worst]:.2f} m/s^2 from "
                f"the accelerometer, the plain linear model {plain[worst]:.2f}"
            )
        return ""

    def _rms(self, squares: Sequence[float]) -> Vector:
        if self._measured == 0.0:
            return ZERO
        x, y, z = (math.sqrt(square / self._measured) for square in squares)
        return (x, y, z)
