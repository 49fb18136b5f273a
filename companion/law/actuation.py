"""What is known of the path from command to motion, and how much of it can be undone by looking ahead.

The autopilot's rate loop is a PI controller behind a pure delay: `w' = (c - w) / lag + i`, `i' = integral (c - w) /
lag`, with the command c as it was `delay` ago. The delay is met by prediction from the commands that are on
their way (O. J. M. Smith, "Closer control of loops with dead time", Chemical Engineering Progress 53, 1957),
the lag by commanding its inverse, which needs the derivative of the wanted rate.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from trueflight.models.contract import ACTUATION_LIMITS

Pair = tuple[float, float]

_LONGEST_GAP = 0.1
"""s between two ticks after which the model of the rate loop starts anew."""
STEP = 0.0025  # s, of the integration: a tenth of the shortest lag met


@dataclass(frozen=True)
class Actuation:
    """Delay (s), lag (s) and integral rate (1/s) of the roll and pitch rate loop; delay and lag (s) of thrust.

    All zero: commands act at once, and there is nothing to undo.
    """

    rate_delay: float = 0.0
    rate_lag: float = 0.0
    rate_integral: float = 0.0
    thrust_delay: float = 0.0
    thrust_lag: float = 0.0

    def __post_init__(self) -> None:
        for name, most in ACTUATION_LIMITS.items():
            value = getattr(self, name)
            if not 0.0 <= value <= most:  # true for NaN as well
                raise ValueError(f"{name} is {value!r}; it must lie between 0 and {most:g}")

    def scaled(self, share: float) -> Actuation:
        """Delays and lags times `share`: how much of them is to be undone."""
        return Actuation(
            share * self.rate_delay,
            share * self.rate_lag,
            self.rate_integral,
            share * self.thrust_delay,
            share * self.thrust_lag,
        )


ACTS_AT_ONCE = Actuation()
"""Nothing known, so nothing to undo."""


class RateModel:
    """The roll and pitch rate loop beside the real one: what the commands on their way will still do."""

    def __init__(self, actuation: Actuation) -> None:
        self.actuation = actuation
        self._past: deque[tuple[float, Pair, Pair]] = deque()  # time, angle, rate
        self.reset()

    def reset(self) -> None:
        """Forget everything: nothing is on its way."""
        self._time = 0.0
        self._angle: Pair = (0.0, 0.0)
        self._rate: Pair = (0.0, 0.0)
        self._integral: Pair = (0.0, 0.0)
        self._past.clear()
        self._past.append((0.0, self._angle, self._rate))

    def advance(self, command: Pair, dt: float) -> None:
        """Let the last command (rad/s, body) have acted, without delay, for `dt` s."""
        if not 0.0 <= dt <= _LONGEST_GAP:
            self.reset()
            return
        lag, integral = self.actuation.rate_lag, self.actuation.rate_integral
        (x, y), (p, q), (i, j), (a, b) = self._angle, self._rate, self._integral, command
        if lag > 0.0:
            steps = max(1, math.ceil(dt / STEP))
            h = dt / steps
            follow = 1.0 - math.exp(-h / lag)
            for _ in range(steps):
                dp, dq = follow * (a - p + lag * i), follow * (b - q + lag * j)
                i += h * integral / lag * (a - p - 0.5 * dp)
                j += h * integral / lag * (b - q - 0.5 * dq)
                x += h * (p + 0.5 * dp)
                y += h * (q + 0.5 * dq)
                p, q = p + dp, q + dq
        else:
            x, y, p, q = x + dt * a, y + dt * b, a, b
        self._time += dt
        self._angle, self._rate, self._integral = (x, y), (p, q), (i, j)
        self._past.append((self._time, self._angle, self._rate))
        while len(self._past) > 2 and self._past[1][0] <= self._time - self.actuation.rate_delay:
            self._past.popleft()

    def on_its_way(self, share: float = 1.0) -> tuple[Pair, Pair]:
        """By how much angle (rad) and rate (rad/s) about body x and y will have changed one delay from now.

        `share` of the delay, 0 to 1.
        """
        then = self._time - share * self.actuation.rate_delay
        moments = iter(self._past)
        before = after = next(moments)
        while after[0] < then:  # ends: the newest is now
            before, after = after, next(moments)
        part = (then - before[0]) / (after[0] - before[0]) if after[0] > before[0] else 1.0
        angle, rate = _between(before[1], after[1], part), _between(before[2], after[2], part)
        (x, y), (p, q) = self._angle, self._rate
        return (x - angle[0], y - angle[1]), (p - rate[0], q - rate[1])


class LagInverse:
    """What must be added to a wanted body rate so that the rate loop's lag gives the wanted one.

    `lag s / (s + integral)` of the wanted rate's derivative: the loop's own integral does the rest.
    """

    def __init__(self) -> None:
        self._added: Pair = (0.0, 0.0)
        self._slope: Pair | None = None

    def reset(self) -> None:
        """Start anew at the next step."""
        self._added, self._slope = (0.0, 0.0), None

    def step(self, slope: Pair, lag: float, integral: float, dt: float) -> Pair:
        """Rates to add (rad/s) for the wanted rates' derivatives `slope` (rad/s²); `dt` s since the last step."""
        before, self._slope = self._slope, slope
        if before is None or not 0.0 <= dt <= _LONGEST_GAP:
            self._added = (0.0, 0.0)
        elif integral == 0.0:
            self._added = (lag * slope[0], lag * slope[1])
        else:
            keep = math.exp(-integral * dt)
            x, y = self._added
            self._added = (
                keep * (x + lag * (slope[0] - before[0])),
                keep * (y + lag * (slope[1] - before[1])),
            )
        return self._added


def _between(a: Pair, b: Pair, part: float) -> Pair:
    return a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1])
