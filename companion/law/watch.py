"""A watch over one learned model: what it may say, how long it may take, and where it may be believed.

It believes nothing about the model. Whatever that returns (NaN, infinity, huge numbers), however long it
takes, or if it raises: what comes out is finite and within an authority per axis. Anything that cannot be
right trips. A trip latches: the model is not called again.

An answer is believed within its authority and its training range on the model's own word; beyond, as far as the
accelerometer bears it out. Borne out is what is nearer to the acceleration measured than nothing is: fast flight in
drag may need more than the authority, and then what is cut is right as far as it goes. Of an answer r beyond the
authority a and a measurement m, |m - r| < |m| gives m the sign of r and |m| > a / 2, so that what acts is nearer than
nothing as well: |m - a| < |m|. What is not borne out trips.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from trueflight.companion.law.actuation import ACTS_AT_ONCE, Actuation
from trueflight.companion.law.adaptation import Learning
from trueflight.companion.law.outer_loop import mixed

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)

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
    authority trips; one beyond the authority is cut, and trips after `patience` s in which the accelerometer
    does not bear it out. Outside the training range the correction is scaled down, to nothing at `margin` times the
    range's width or to the share that is borne out, and trips after `patience` s at nothing. `deadline` s of processor
    time for the inferences of one tick: `misses` late ones in a row trip, as does a single one of more than `stall` s.
    `fade` s from nothing to full effect and back, and from one model to another. Below `ground` m above the ground the
    thrust that models may take away runs down to nothing.
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
    ground: float = 0.5


SMOOTHING = 0.2
"""s, time constant of the low-pass of what is measured and of what a model says before they are compared, as in the
shadow; for the first two of it nothing is borne out."""


class Borne(NamedTuple):
    """How far the accelerometer bears a model's answer out: of each axis whether at all, and the `share` of the three,
    0 to 1, of the squares of what is measured that it explains."""

    axes: tuple[bool, bool, bool]
    share: float


_NOTHING = Borne((False, False, False), 0.0)


class Evidence:
    """What the accelerometer says of one model's answers."""

    def __init__(self) -> None:
        self._seen = 0.0
        self._measured, self._said = ZERO, ZERO

    def step(self, said: Vector, measured: Vector | None, dt: float) -> Borne:
        """Whether what is measured is nearer to what the model says than to nothing, both low-passed.

        Error accelerations of this moment in m/s², heading frame; `measured` is None where the accelerometer cannot be
        believed: then it begins anew. `dt` s since the last step.
        """
        if measured is None or not all(map(math.isfinite, measured)):
            self._seen = 0.0
            return _NOTHING
        if self._seen == 0.0:
            self._measured, self._said = measured, said
        self._seen += dt
        share = dt / (SMOOTHING + dt)
        self._measured = mixed(self._measured, measured, share)
        self._said = mixed(self._said, said, share)
        if self._seen < 2.0 * SMOOTHING:
            return _NOTHING
        (a, b, c), (x, y, z) = self._measured, self._said
        u, v, w = a - x, b - y, c - z
        axes = abs(u) < abs(a), abs(v) < abs(b), abs(w) < abs(c)
        all_ = a * a + b * b + c * c
        return Borne(axes, max(0.0, 1.0 - (u * u + v * v + w * w) / all_) if all_ > 0.0 else 0.0)


class Look(NamedTuple):
    """What a model says: `raw` as it returned it, `wanted` what of it may act (m/s²), `rate` of x and y (m/s³), and
    `now`, what it says of this moment (m/s²)."""

    raw: Vector
    wanted: Vector
    rate: tuple[float, float]
    now: Vector


class Watch:
    """One model during one flight.

    `model` maps features to three error accelerations (m/s², heading frame); one that has `rows` answers several rows
    of features in one go. `ranges` are the features'
    training ranges in the model's order. `name` is the model's hash, `actuation` what it knows of the path from
    command to motion. `clock` tells what an inference took: this thread's own processor time, for what others take
    from it says nothing of the model.
    """

    def __init__(
        self,
        model: Callable[[Sequence[float]], Sequence[float]],
        ranges: Sequence[Range],
        limits: GuardLimits | None = None,
        wants_yaw: bool = False,
        name: str = "",
        clock: Callable[[], float] = time.thread_time,
        actuation: Actuation = ACTS_AT_ONCE,
        learning: Learning | None = None,
    ) -> None:
        self.learning = learning
        """What learns while it flies, where the model does; then it is the model."""
        self.name, self.wants_yaw, self.actuation = name, wants_yaw, actuation
        self.limits = limits if limits is not None else GuardLimits()
        self.reason = ""
        """Why it tripped; empty while it has not."""
        self.trust = 0.0
        """Share of the last answer that was believed: 1 in the training range, 0 well outside."""
        self.inference_time = 0.0
        """Seconds that the last call of the model took."""
        self._rows = getattr(model, "rows", None) or partial(_one_by_one, model)
        self._ranges = [(r.name, r.low, r.high, margin(r, self.limits.margin)) for r in ranges]
        self._lows, self._highs = [r.low for r in ranges], [r.high for r in ranges]
        self._clock = clock
        self._late = 0
        self._outside = self._saturated = 0.0
        self._evidence = Evidence()

    @property
    def tripped(self) -> bool:
        """Whether it gave up on this model for the rest of the flight."""
        return self.reason != ""

    def learn(self, row: Sequence[float], measured: Vector | None, dt: float, waits: str) -> None:
        """Let the model learn, if it does: `companion.law.adaptation.Learning.step`; `row` may be longer than the
        model's."""
        if self.learning is not None:
            self.learning.step(row[: len(self._ranges)], measured, dt, waits)

    def evaluate(
        self, features: Sequence[float], dt: float, measured: Vector | None = None
    ) -> tuple[Vector, Vector]:
        """The model's raw answer, and what of it may act: finite and within the authority; m/s², heading frame.

        `features` may be longer than the model's: those come first. `dt` s since the last call, finite and not
        negative; `measured` is the error acceleration there, None where there is none to be believed. After a trip
        both are zero and the model is not called.
        """
        return self._judged((features,), dt, measured)[0]

    def look(
        self, rows: Sequence[Sequence[float]], ahead: float, dt: float, measured: Vector | None = None
    ) -> Look:
        """What the model says for four rows of features: where tilt acts, `ahead` s later, where thrust acts, now.

        x and y are taken from the first row, z from the third, the rate from the first two. The four count as
        one inference. `measured` as in `evaluate`, now.
        """
        (raw, now), (_, later), (lifting, lifted), (_, present) = self._judged(rows, dt, measured)
        rate = ((later[0] - now[0]) / ahead, (later[1] - now[1]) / ahead)
        return Look((raw[0], raw[1], lifting[2]), (now[0], now[1], lifted[2]), rate, present)

    def _judged(
        self, rows: Sequence[Sequence[float]], dt: float, measured: Vector | None
    ) -> list[tuple[Vector, Vector]]:
        """Raw answer and what of it may act for each row; where anything is wrong with one, nothing of all.

        The last row is that of the moment of `measured`.
        """
        self.inference_time = 0.0
        if self.reason:
            return [(ZERO, ZERO) for _ in rows]
        width = len(self._ranges)
        rows = [features if len(features) == width else features[:width] for features in rows]
        raws: list[Vector] = []
        begin = self._clock()
        try:
            for (x, y, z), _ in zip(self._rows(rows), rows, strict=True):
                raws.append((float(x), float(y), float(z)))
        except Exception as error:  # noqa: BLE001 - whatever a model raises, the flight goes on without it
            self.trip(f"the model raised {type(error).__name__}")
            return [(ZERO, ZERO) for _ in rows]
        self.inference_time = self._clock() - begin
        for x, y, z in raws:
            if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
                self.trip("the model returned a number that is not finite")
                return [(ZERO, ZERO) for _ in rows]
        borne = self._evidence.step(raws[-1], measured, dt)
        trusts = [(max(trust, borne.share), worst) for trust, worst in map(self._trusted, rows)]
        self.trust, worst = min(trusts)
        self._limit(raws, worst, dt, borne)
        if self.reason:
            return [(raw, ZERO) for raw in raws]
        a, b, c = self.limits.authority
        wanted = []
        for raw, (trust, _) in zip(raws, trusts, strict=True):
            x, y, z = raw
            wanted.append((raw, (trust * _within(x, a), trust * _within(y, b), trust * _within(z, c))))
        return wanted

    def _limit(self, raws: Sequence[Vector], worst: str, dt: float, borne: Borne) -> None:
        """Trip on finite answers that come late, are too large, or come from outside the training range, where they are
        not `borne` out."""
        limits = self.limits
        if not self._in_time(self.inference_time):
            self.trip(f"inference took {1e3 * self.inference_time:.1f} ms")
            return
        excesses = [
            max(map(abs, answers)) / most
            for answers, most in zip(zip(*raws, strict=True), limits.authority, strict=True)
        ]
        excess = max(excesses)
        alone = any(e > 1.0 and not out for e, out in zip(excesses, borne.axes, strict=True))
        self._saturated = self._saturated + dt if alone else 0.0
        self._outside = self._outside + dt if self.trust == 0.0 else 0.0
        if excess > limits.absurd:
            self.trip(f"a correction {excess:.0f} times its authority")
        elif self._saturated > limits.patience:
            self.trip(f"beyond its authority for {limits.patience:g} s")
        elif self._outside > limits.patience:
            self.trip(f"{worst} outside its training range for {limits.patience:g} s")

    def trip(self, reason: str) -> None:
        """Give up on the model for `reason`."""
        self.reason, self.trust = reason, 0.0

    def _in_time(self, seconds: float) -> bool:
        self._late = self._late + 1 if seconds > self.limits.deadline else 0
        return self._late < self.limits.misses and seconds <= self.limits.stall

    def _trusted(self, features: Sequence[float]) -> tuple[float, str]:
        """1 inside the training range, falling to 0 across the margin around it, and the feature that
        decides.
        """
        for value, low, high in zip(features, self._lows, self._highs, strict=True):
            if not low <= value <= high:  # true for NaN as well
                break
        else:
            return 1.0, ""
        trust, worst = 1.0, ""
        for value, (name, low, high, margin) in zip(features, self._ranges, strict=True):
            outside = low - value if value < low else value - high
            if not outside <= 0.0:  # true for NaN as well
                share = 1.0 - outside / margin
                if not share >= trust:
                    trust, worst = (share if share > 0.0 else 0.0), name
        return trust, worst


def _one_by_one(
    model: Callable[[Sequence[float]], Sequence[float]], rows: Sequence[Sequence[float]]
) -> list[Sequence[float]]:
    return [model(features) for features in rows]


def _within(value: float, authority: float) -> float:
    return value if -authority <= value <= authority else authority if value > authority else -authority


def margin(feature: Range, share: float) -> float:
    """How far beyond its training range a feature is believed a little: `share` of its width, in the feature's unit."""
    floor = _FLOORS.get(feature.unit, 0.1 * max(abs(feature.low), abs(feature.high), 1e-6))
    return max(share * (feature.high - feature.low), floor)
