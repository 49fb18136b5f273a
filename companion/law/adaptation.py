"""Learning in flight: a deployed model whose numbers are estimated anew while it flies, and what keeps that safe.

`ParameterFilter` estimates, from what the accelerometer says beyond the model; this module decides what becomes of it.
It believes nothing of what was learnt until it has shown itself beside the flight: the learnt numbers predict the
measured acceleration of the last seconds better than the deployed ones. Then they are faded in, and out again where
that no longer holds. What cannot be right trips: numbers that are not finite, an uncertainty that is none, a number at
the end of its range, a prediction that stays worse than the deployed one. A trip latches for the flight, and the
deployed numbers fade back in. The guard and its watch stand behind all of it, as behind any model.

Measurement and derivatives pass the same low-pass filter, so that lag is the same in both, and what is left is compared
with the parameters of now (the filtered regression of Ioannou and Sun, "Robust Adaptive
Control", 1996, section 2.4).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

from trueflight.companion.law.parameter_filter import ParameterFilter
from trueflight.models.learnable import Learnable

if TYPE_CHECKING:
    from trueflight.models.record_pb2 import Tick

Vector = tuple[float, float, float]
LONGEST_STEP = 0.1
"""s between two measurements beyond which what was filtered is too old to go on with."""
OFF, WAITING, SHADOW, ACTING, TRIPPED = "off", "waiting", "shadow", "acting", "tripped"

_THREE = 3.0
"""The noise of three axes, in squares of its standard deviation."""


class Adjustable(Protocol):
    """A model whose parameters can be told: `companion.law.inference.Model`."""

    def rows(
        self, rows: Sequence[Sequence[float]], parameters: Sequence[float] | None = None
    ) -> Sequence[Sequence[float]]:
        """Error acceleration for each row of features, m/s², heading frame; with the deployed parameters or others."""
        ...

    def sensed(
        self, row: Sequence[float], parameters: Sequence[float]
    ) -> tuple[Sequence[float], Sequence[float]]:
        """Error acceleration of a row, and its derivative along each parameter, three by three."""
        ...


@dataclass(frozen=True)
class LearningLimits:
    """How learning goes about it.

    `smoothing` s is the time constant of the low-pass before anything is compared, half of a shadow's: motors' lag and
    vibration are gone. `alike` s is how long a model's own error stays what it is, about a turn or a stop: as much
    longer has to be measured. Predictions are compared over `judged` s. What was learnt acts where its squared error is
    below `better` times that of the deployed numbers, and that above the model's own error; it fades in or out within
    `fade` s. It trips where it is worse, or a number at the end of its range, for `patience` s. A residual beyond
    `absurd` m/s² is no flight (contact, an impact) and is not looked at.
    """

    smoothing: float = 0.1
    alike: float = 0.5
    judged: float = 1.0
    better: float = 0.8
    fade: float = 0.5
    patience: float = 3.0
    absurd: float = 6.0


class Told(NamedTuple):
    """Learning as a tick tells it: its status; then `names` (effect.parameter, with blanks between), and of each number
    as learnt, its standard deviation, and as it acts."""

    status: str
    names: str
    values: tuple[float, ...]
    deviations: tuple[float, ...]
    acting: tuple[float, ...]

    def write(self, tick: Tick) -> None:
        """Into a tick of the record."""
        tick.learning, tick.learnt_names = self.status, self.names
        tick.learnt[:], tick.learnt_deviation[:], tick.learnt_acting[:] = (
            self.values, self.deviations, self.acting,
        )  # fmt: skip


class Learning:
    """A model that learns, during one flight; for a `Watch` it is the model: `rows` answers with what acts.

    `noise` (m/s², three axes) is what the model leaves even of flights that it knows. It belongs to the control thread.
    """

    def __init__(
        self,
        model: Adjustable,
        learnables: Sequence[Learnable],
        noise: Vector,
        limits: LearningLimits | None = None,
    ) -> None:
        self.limits = limits = limits if limits is not None else LearningLimits()
        self.learnables = tuple(learnables)
        self.status = OFF
        """`off`, `waiting: WHY` (nothing is learnt now), `shadow` (learnt, but nothing acts), `acting`, or
        `tripped: WHY`, as in a tick."""
        self.share = 0.0
        """Share, 0 to 1, to which what was learnt acts."""
        self.acting = [one.value for one in learnables]
        """The parameters that act."""
        self._model, self._noise = model, noise
        self._names = " ".join(one.name for one in learnables)
        self._deployed = [one.value for one in learnables]
        self._wanted = list(self._deployed)
        density = [2.0 * limits.alike * n * n for n in noise]
        self._filter = ParameterFilter(learnables, density, noise, noise)
        self._reason = ""
        self._forget()
        self._worse = self._bound = 0.0
        self._learnt_error = self._deployed_error = 0.0

    @property
    def tripped(self) -> bool:
        """Whether it gave up learning for the rest of the flight."""
        return self._reason != ""

    @property
    def told(self) -> Told:
        """All of it, as of the last step."""
        found = self._filter
        return Told(
            self.status, self._names, tuple(found.values), tuple(found.deviations), tuple(self.acting)
        )

    def rows(self, rows: Sequence[Sequence[float]]) -> Sequence[Sequence[float]]:
        """Error acceleration for each row of features with the parameters that act, m/s², heading frame."""
        return self._model.rows(rows, self.acting)

    def __call__(self, features: Sequence[float]) -> Sequence[float]:
        """The same for one row."""
        return self.rows((features,))[0]

    def step(self, row: Sequence[float], measured: Vector | None, dt: float, waits: str = "") -> None:
        """One tick: `row` are the features of now with the thrust that acts, `measured` the error acceleration (m/s²,
        heading frame) that the accelerometer shows at that moment, None where it cannot be believed; `dt` s since the
        last tick. Nothing is learnt where it `waits` for something, in words."""
        if not self.tripped:
            try:
                self._learn(row, measured, dt, waits)
            except Exception as error:  # noqa: BLE001 - whatever a model raises, the flight goes on without learning
                self._trip(f"the model raised {type(error).__name__}")
        self._fade(dt)

    def _learn(self, row: Sequence[float], measured: Vector | None, dt: float, waits: str) -> None:
        if not waits and measured is None:
            waits = "no accelerometer"
        if not waits and not 0.0 < dt <= LONGEST_STEP:
            waits = "a gap"
        if waits or measured is None:
            self._forget()
            self.status = f"{WAITING}: {waits}"
            return
        estimate = self._filter.values
        answer, slopes = self._model.sensed(row, estimate)
        (plain,) = self._model.rows((row,), self._deployed)
        now = [m - a for m, a in zip(measured, answer, strict=True)]
        if not all(map(math.isfinite, (*now, *slopes, *plain))):
            self._trip("the model returned a number that is not finite")
            return
        # against the deployed numbers: what was learnt must not decide what it looks at
        before = [m - a for m, a in zip(measured, plain, strict=True)]
        if max(map(abs, before)) > self.limits.absurd:
            self.status = f"{WAITING}: pushed by more than any flight"
            return
        left = self._low_passed(now, before, slopes, estimate, dt)
        self._seen += dt
        if self._seen < 2.0 * self.limits.smoothing:
            self.status = f"{WAITING}: the first moments"
            return
        self.status = SHADOW
        self._judge(left, dt)
        self._filter.step(left, self._slopes, dt)
        if not self._filter.sound:
            self._trip("the filter's numbers are no longer sound")

    def _forget(self) -> None:
        """Begin the low-pass filters anew."""
        self._seen = 0.0
        self._regressed = [0.0] * 3
        self._before = [0.0] * 3
        self._slopes = [0.0] * (3 * len(self.learnables))

    def _low_passed(
        self,
        now: Sequence[float],
        before: Sequence[float],
        slopes: Sequence[float],
        estimate: Sequence[float],
        dt: float,
    ) -> list[float]:
        """What the present parameters leave, low-passed: what they would have left all the time, and not what the
        earlier ones did."""
        share = dt / (self.limits.smoothing + dt) if self._seen else 1.0
        self._slopes = filtered = [s + share * (n - s) for s, n in zip(self._slopes, slopes, strict=True)]
        self._before = [s + share * (n - s) for s, n in zip(self._before, before, strict=True)]
        left = []
        for axis in range(3):
            linear = sum(map(_product, slopes[axis::3], estimate))
            self._regressed[axis] += share * (now[axis] + linear - self._regressed[axis])
            left.append(self._regressed[axis] - sum(map(_product, filtered[axis::3], estimate)))
        return left

    def _judge(self, left: Sequence[float], dt: float) -> None:
        """Whether what was learnt before this tick predicts better than what was deployed, over the last seconds."""
        learnt = sum((x / n) ** 2 for x, n in zip(left, self._noise, strict=True))
        deployed = sum((x / n) ** 2 for x, n in zip(self._before, self._noise, strict=True))
        share = dt / (self.limits.judged + dt)
        self._learnt_error += share * (learnt - self._learnt_error)
        self._deployed_error += share * (deployed - self._deployed_error)
        worse = self._learnt_error > self._deployed_error + _THREE
        self._worse = self._worse + dt if worse else 0.0
        ends = self._filter.at_bounds
        self._bound = self._bound + dt if ends else 0.0
        if self._worse > self.limits.patience:
            self._trip(f"its prediction was worse than the deployed one's for {self.limits.patience:g} s")
        elif self._bound > self.limits.patience:
            self._trip(f"{ends[0]} was at the end of its range for {self.limits.patience:g} s")

    def _trip(self, reason: str) -> None:
        self._reason = reason
        self.status = f"{TRIPPED}: {reason}"

    def _fade(self, dt: float) -> None:
        """Move the share of what was learnt, and with it the parameters that act."""
        change = min(LONGEST_STEP, dt) / self.limits.fade if dt > 0.0 else 0.0
        learns = not self.tripped and not self.status.startswith(WAITING)
        if self.tripped or (learns and self._learnt_error > self._deployed_error):
            self.share = max(0.0, self.share - change)
        elif learns and max(_THREE, self._learnt_error / self.limits.better) < self._deployed_error:
            self.share = min(1.0, self.share + change)
        if learns:
            self.status = ACTING if self.share > 0.0 else SHADOW
        if not self.tripped:
            self._wanted = list(self._filter.values)
        share = self.share
        self.acting = [d + share * (w - d) for d, w in zip(self._deployed, self._wanted, strict=True)]


def _product(a: float, b: float) -> float:
    return a * b
