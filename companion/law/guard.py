"""The guard: it lets learned corrections act on the vehicle only as far as they can be trusted.

Each model has a `Watch`. Of those one is live; another may take over while flying. Old and new are then faded
into each other with weights that sum to what they summed to before, so that the applied correction has no
step, and the previous model stays loaded as the last good one. When the live model trips, the last good one
fades in again; without one, the correction runs down to zero and the flight goes on with the plain cascade.
A model that tripped never acts again in this flight.

Whatever the models do, the applied correction stays finite, within the authority and the slew per axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple
from typing import NamedTuple

from trueflight.companion.law.actuation import ACTS_AT_ONCE, Actuation
from trueflight.companion.law.adaptation import Learning
from trueflight.companion.law.outer_loop import mixed
from trueflight.companion.law.watch import ZERO, GuardLimits, Vector, Watch

OFF, FADING_IN, ACTIVE, FADING_OVER, FADING_OUT, TRIPPED = (
    "off",
    "fading_in",
    "active",
    "fading_over",
    "fading_out",
    "tripped",
)

LONGEST_STEP = 0.1
"""Seconds of slew and fading that one tick may use at most, so that a gap in the odometry gives no jump."""


class Correction(NamedTuple):
    """Error acceleration to cancel, m/s², heading frame: as applied, and as the live model returned it.

    `rate` (m/s³, x and y) is how fast the applied one is about to change. `now` is what the models that act say of this
    moment, whatever of it is applied yet.
    """

    applied: Vector
    rate: tuple[float, float]
    raw: Vector
    now: Vector = ZERO


class Guard:
    """Stands between models and command during one flight; begins with one model, live and not yet faded in, or none.

    `watch` is the first model's; its limits are the guard's, or `limits` where no model is live yet. `on_trip` is told
    the name of a model and the reason once, from the thread that calls `step`, and must not block. All methods belong
    to that thread.
    """

    def __init__(
        self,
        watch: Watch | None,
        on_trip: Callable[[str, str], None] | None = None,
        limits: GuardLimits | None = None,
    ) -> None:
        self.limits = watch.limits if watch is not None else limits or GuardLimits()
        self.wants_yaw = watch is not None and watch.wants_yaw
        self.inference_time = 0.0
        self._on_trip = on_trip
        self._live: Watch | None = watch
        self._last_good: Watch | None = None
        self._weights: dict[Watch, float] = {} if watch is None else {watch: 0.0}
        self._tripped: dict[str, Watch] = {}
        self._running = False
        self._applied = ZERO

    @property
    def status(self) -> str:
        """`off`, `fading_in`, `active`, `fading_over` (from one model to another), `fading_out`, or
        `tripped: REASON`, as in a tick.
        """
        live = self._live
        if live is not None and live.tripped:
            return f"{TRIPPED}: {live.reason}"
        if not self._running or live is None:
            return FADING_OUT if any(self._weights.values()) else OFF
        if any(weight for watch, weight in self._weights.items() if watch is not live):
            return FADING_OVER
        return ACTIVE if self._weights[live] == 1.0 else FADING_IN

    @property
    def tripped(self) -> bool:
        """Whether the live model tripped and no other took over: the plain cascade flies on."""
        return self._live is not None and self._live.tripped

    @property
    def live(self) -> str:
        """Name of the live model; empty after the last one was rolled back."""
        return self._live.name if self._live is not None else ""

    @property
    def last_good(self) -> str:
        """Name of the model that takes over where the live one trips; empty without one."""
        return self._last_good.name if self._last_good is not None else ""

    @property
    def settled(self) -> bool:
        """Whether no model is being faded into another."""
        return all(watch is self._live or weight == 0.0 for watch, weight in self._weights.items())

    @property
    def applied(self) -> Vector:
        """The correction of the last step, m/s², heading frame."""
        return self._applied

    def why_tripped(self, name: str) -> str:
        """Why this model tripped in this flight; empty where it did not."""
        return self._tripped[name].reason if name in self._tripped else ""

    def start(self) -> None:
        """Fade the correction in. No effect on a model that tripped: that latches."""
        self._running = True

    def stop(self) -> None:
        """Fade the correction out."""
        self._running = False

    def succeed(self, watch: Watch) -> None:
        """Make another model the live one, and the present one the last good one; they fade over."""
        if self._live is not None and not self._live.tripped:
            self._last_good = self._live
        self._enter(watch)

    def roll_back(self, earlier: Watch | None = None) -> None:
        """Make the last good model live again; without one `earlier`, and without that the plain cascade."""
        target = self._last_good if self._last_good is not None else earlier
        self._last_good = None
        if target is None:
            self._live = None
        else:
            self._enter(target)

    @property
    def learning(self) -> Learning | None:
        """What the live model learns; None where it learns nothing."""
        return self._live.learning if self._live is not None else None

    def learn(self, row: Sequence[float], measured: Vector | None, dt: float, waits: str) -> None:
        """Let the live model learn from what the accelerometer shows at features `row`, where it acts wholly: see
        `companion.law.adaptation.Learning.step`."""
        live = self._live
        if live is not None and live.learning is not None:
            acts = not live.tripped and self._weights[live] == 1.0
            live.learn(row, measured, dt, waits or ("" if acts else "the correction does not act"))

    @property
    def engaged(self) -> float:
        """Share, 0 to 1, to which models act now."""
        return min(1.0, sum(self._weights.values()))

    @property
    def actuation(self) -> Actuation:
        """What the models that act know of the path from command to motion, by their weights."""
        acting = [(weight, watch.actuation) for watch, weight in self._weights.items() if weight > 0.0]
        if len(acting) < 2:
            return acting[0][1] if acting else ACTS_AT_ONCE
        weights = [weight for weight, _ in acting]
        columns = zip(*(astuple(one) for _, one in acting), strict=True)
        return Actuation(*(_mean(weights, numbers) for numbers in columns))

    def step(
        self,
        rows: Sequence[Sequence[float]],
        ahead: float,
        dt: float,
        height: float = math.inf,
        measured: Vector | None = None,
    ) -> Correction:
        """The correction for four rows of features: where tilt acts, `ahead` s later, where thrust acts, and now; `dt`
        s since the last step, `height` in m as measured above the ground, `measured` the error acceleration that the
        accelerometer shows now (m/s², heading frame), None where it cannot be believed.

        The applied one is finite, within `authority`, and within `slew * dt` of the previous one, always; its rate
        within `slew`.
        """
        dt = min(LONGEST_STEP, dt) if dt > 0.0 else 0.0  # false for NaN as well
        self.inference_time = 0.0
        self._fade(dt)
        x, y, z = raw = ZERO
        rx = ry = 0.0
        all_weights, now = 0.0, ZERO
        for watch, weight in list(self._weights.items()):
            if weight == 0.0 and not (self._running and watch is self._live):
                continue
            look = watch.look(rows, ahead, dt, measured)
            self.inference_time += watch.inference_time
            if watch is self._live:
                raw = look.raw
            if watch.tripped:
                self._drop(watch)
                continue
            x, y, z = x + weight * look.wanted[0], y + weight * look.wanted[1], z + weight * look.wanted[2]
            rx, ry = rx + weight * look.rate[0], ry + weight * look.rate[1]
            all_weights += weight
            if all_weights > 0.0:
                now = mixed(now, look.now, weight / all_weights)
        self._applied = self._slewed((x, y, min(z, self._most_lift_taken(height))), dt)
        a, b, _ = self.limits.slew
        return Correction(self._applied, (min(a, max(-a, rx)), min(b, max(-b, ry))), raw, now)

    def _most_lift_taken(self, height: float) -> float:
        """The greatest loss of thrust (m/s²) that models may ask for at this height above the ground, m.

        A model that expects too much of the ground effect takes thrust away, and down there is no room for that.
        """
        share = height / self.limits.ground  # above 1 the authority itself is the limit
        return self.limits.authority[2] * share if share > 0.0 else 0.0  # false for NaN as well

    def _enter(self, watch: Watch) -> None:
        self._live = watch = self._tripped.get(watch.name, watch) if watch.name else watch
        if not watch.tripped:
            self._weights.setdefault(watch, 0.0)
        self.wants_yaw = any(one.wants_yaw for one in self._weights)

    def _fade(self, dt: float) -> None:
        """Move the weights: what leaves gives up as much, all together, as the live one may take."""
        change = dt / self.limits.fade
        live = self._live if self._running else None
        leaving = sum(weight for watch, weight in self._weights.items() if watch is not live)
        keep = 1.0 - change / leaving if leaving > change else 0.0
        for watch, weight in list(self._weights.items()):
            if watch is live:
                continue
            if keep * weight > 0.0 or watch is self._live:
                self._weights[watch] = keep * weight
            else:
                del self._weights[watch]
        if live is not None and not live.tripped:
            self._weights[live] = min(1.0 - keep * leaving, self._weights[live] + change)

    def _drop(self, watch: Watch) -> None:
        """A model tripped: it is out, and where it was the live one, the last good one takes over."""
        del self._weights[watch]
        self._tripped[watch.name] = watch
        if self._on_trip is not None:
            self._on_trip(watch.name, watch.reason)
        if watch is self._last_good:
            self._last_good = None
        elif watch is self._live and self._last_good is not None:
            self.roll_back()

    def _slewed(self, wanted: Vector, dt: float) -> Vector:
        (x, y, z), (a, b, c) = self._applied, self.limits.slew
        u, v, w = self.limits.authority
        return (
            _toward(x, wanted[0], a * dt, u),
            _toward(y, wanted[1], b * dt, v),
            _toward(z, wanted[2], c * dt, w),
        )


def _mean(weights: Sequence[float], numbers: Sequence[float]) -> float:
    """The weighted mean, between the numbers to the last bit: beyond a limit `Actuation` would refuse it."""
    mean = sum(w * n for w, n in zip(weights, numbers, strict=True)) / sum(weights)
    return min(max(numbers), max(min(numbers), mean))


def _toward(now: float, wanted: float, step: float, authority: float) -> float:
    wanted = min(authority, max(-authority, wanted))
    return min(now + step, max(now - step, wanted))
