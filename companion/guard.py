"""The guard: it lets a learned correction act on the vehicle only as far as it can be trusted.

It believes nothing about the model. Whatever that returns (NaN, infinity, huge numbers), however long it
takes, or if it raises: the applied correction stays finite, within an authority per axis and a slew per axis.
Anything that cannot be right trips the guard. A trip latches: the correction runs down to zero at the slew
limit, the model is not called again, and the flight goes on with the plain cascade until somebody on the
ground starts another one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)

OFF, FADING_IN, ACTIVE, FADING_OUT, TRIPPED = "off", "fading_in", "active", "fading_out", "tripped"

LONGEST_STEP = 0.1
"""Seconds of slew and fading that one tick may use at most, so that a gap in the odometry gives no jump."""

_FLOORS = {"m": 0.2, "m/s": 0.5, "V": 0.5, "1": 0.1}
"""Least margin around the training range, by unit: noise and trim, where training hardly moved a feature."""


@dataclass(frozen=True)
class Range:
    """The range of one feature seen in training, in `unit`."""

    name: str
    unit: str
    low: float
    high: float


@dataclass(frozen=True)
class GuardLimits:
    """How far a correction is trusted.

    `authority` m/s² and `slew` m/s³ per axis of the heading frame. A raw value beyond `absurd` times the
    authority trips; one beyond the authority is cut and trips after `patience` s without a pause. Outside the
    training range the correction is scaled down, to nothing at `margin` times the range's width, and trips
    after `patience` s beyond. `deadline` s for one inference: `misses` late ones in a row trip, as does a single
    one of more than `stall` s. One late inference alone says more of the operating system than of the model.
    `fade` s from nothing to full effect and back.
    """

    authority: Vector = (3.0, 3.0, 4.0)
    slew: Vector = (30.0, 30.0, 40.0)
    absurd: float = 5.0
    margin: float = 0.25
    patience: float = 1.0
    deadline: float = 0.002
    misses: int = 5
    stall: float = 0.05
    fade: float = 1.0


class Guard:
    """Watches one model during one flight.

    `model` maps features to three error accelerations (m/s², heading frame). `ranges` are the features'
    training ranges in the model's order. `on_trip` is told the reason once, from the thread that calls
    `step`, and must not block. `clock` is for tests.
    """

    def __init__(
        self,
        model: Callable[[Sequence[float]], Sequence[float]],
        ranges: Sequence[Range],
        limits: GuardLimits | None = None,
        wants_yaw: bool = False,
        on_trip: Callable[[str], None] | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.wants_yaw = wants_yaw
        self.limits = limits if limits is not None else GuardLimits()
        self.inference_time = 0.0
        self._model = model
        self._ranges = [(r.name, r.low, r.high, _margin(r, self.limits.margin)) for r in ranges]
        self._on_trip = on_trip
        self._clock = clock
        self._mode, self._reason = OFF, ""
        self._weight = 0.0
        self._applied = ZERO
        self._late = 0
        self._outside = self._saturated = 0.0

    @property
    def status(self) -> str:
        """`off`, `fading_in`, `active`, `fading_out`, or `tripped: REASON`, as in a tick."""
        return f"{TRIPPED}: {self._reason}" if self._mode == TRIPPED else self._mode

    @property
    def tripped(self) -> bool:
        """Whether it gave up on this model for the rest of the flight."""
        return self._mode == TRIPPED

    @property
    def applied(self) -> Vector:
        """The correction of the last step, m/s², heading frame."""
        return self._applied

    def start(self) -> None:
        """Fade the correction in. No effect after a trip: that latches."""
        if self._mode in (OFF, FADING_OUT):
            self._mode = FADING_IN

    def stop(self) -> None:
        """Fade the correction out."""
        if self._mode in (FADING_IN, ACTIVE):
            self._mode = FADING_OUT

    def step(self, features: Sequence[float], dt: float) -> tuple[Vector, Vector]:
        """The correction to apply now and the model's raw answer, m/s², heading frame; `dt` s since the last
        step.

        The applied one is finite, within `authority`, and within `slew * dt` of the previous one, always.
        """
        dt = min(LONGEST_STEP, dt) if dt > 0.0 else 0.0  # false for NaN as well
        raw = ZERO
        self.inference_time = 0.0
        if self._mode in (FADING_IN, ACTIVE, FADING_OUT):
            self._fade(dt)
            raw, wanted = self._evaluate(features, dt)
        else:
            wanted = ZERO
        self._applied = self._slewed(wanted, dt)
        return self._applied, raw

    def _fade(self, dt: float) -> None:
        change = dt / self.limits.fade
        if self._mode == FADING_OUT:
            self._weight = max(0.0, self._weight - change)
            if self._weight == 0.0:
                self._mode = OFF
        else:
            self._weight = min(1.0, self._weight + change)
            self._mode = ACTIVE if self._weight == 1.0 else FADING_IN

    def _evaluate(self, features: Sequence[float], dt: float) -> tuple[Vector, Vector]:
        begin = self._clock()
        try:
            x, y, z = self._model(features)
            raw = (float(x), float(y), float(z))
        except Exception as error:  # noqa: BLE001 - whatever a model raises, the flight goes on without it
            return ZERO, self._trip(f"the model raised {type(error).__name__}")
        self.inference_time = self._clock() - begin
        if not (math.isfinite(raw[0]) and math.isfinite(raw[1]) and math.isfinite(raw[2])):
            return ZERO, self._trip("the model returned a number that is not finite")
        if not self._in_time(self.inference_time):
            return raw, self._trip(f"inference took {1e3 * self.inference_time:.1f} ms")
        excess = max(abs(raw[i]) / self.limits.authority[i] for i in range(3))
        if excess > self.limits.absurd:
            return raw, self._trip(f"a correction {excess:.0f} times its authority")
        self._saturated = self._saturated + dt if excess > 1.0 else 0.0
        if self._saturated > self.limits.patience:
            return raw, self._trip(f"beyond its authority for {self.limits.patience:g} s")
        trust, name = self._trust(features)
        self._outside = self._outside + dt if trust == 0.0 else 0.0
        if self._outside > self.limits.patience:
            return raw, self._trip(f"{name} outside its training range for {self.limits.patience:g} s")
        scale = self._weight * trust
        return raw, (scale * raw[0], scale * raw[1], scale * raw[2])

    def _in_time(self, seconds: float) -> bool:
        self._late = self._late + 1 if seconds > self.limits.deadline else 0
        return self._late < self.limits.misses and seconds <= self.limits.stall

    def _trust(self, features: Sequence[float]) -> tuple[float, str]:
        """1 inside the training range, falling to 0 across the margin around it, and the feature that
        decides.
        """
        trust, worst = 1.0, ""
        for value, (name, low, high, margin) in zip(features, self._ranges, strict=True):
            outside = low - value if value < low else value - high
            if not outside <= 0.0:  # true for NaN as well
                share = 1.0 - outside / margin
                if not share >= trust:
                    trust, worst = (share if share > 0.0 else 0.0), name
        return trust, worst

    def _trip(self, reason: str) -> Vector:
        self._mode, self._reason, self._weight = TRIPPED, reason, 0.0
        if self._on_trip is not None:
            self._on_trip(reason)
        return ZERO

    def _slewed(self, wanted: Vector, dt: float) -> Vector:
        (x, y, z), (a, b, c) = self._applied, self.limits.slew
        u, v, w = self.limits.authority
        return (
            _toward(x, wanted[0], a * dt, u),
            _toward(y, wanted[1], b * dt, v),
            _toward(z, wanted[2], c * dt, w),
        )


def _toward(now: float, wanted: float, step: float, authority: float) -> float:
    wanted = min(authority, max(-authority, wanted))
    return min(now + step, max(now - step, wanted))


def _margin(feature: Range, share: float) -> float:
    floor = _FLOORS.get(feature.unit, 0.1 * max(abs(feature.low), abs(feature.high), 1e-6))
    return max(share * (feature.high - feature.low), floor)
