"""A Kalman filter of a model's parameters: what a measured acceleration says of each, and how well each is known.

The truth is taken to drift as a random walk, the measurement to be linear in the parameters about the present ones,
with the model's own derivatives (an extended Kalman filter; Anderson and Moore, "Optimal Filtering", 1979, chapters 6
and 8).
What keeps it bounded whatever it is told (Ioannou and Sun, "Robust Adaptive Control", 1996, chapter 8):

* projection: a parameter never leaves its plausible range;
* dead zone: what is below the model's own error moves nothing;
* a measurement further off than its own uncertainty allows counts as one that is just so far off (Huber, "Robust
  Statistics", 1981), so that no parameter moves faster than its uncertainty;
* the uncertainty never exceeds the one at the beginning, so that what is not excited for long does not come to believe
  anything, and what is not known better than at the beginning does not move at all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from trueflight.models.learnable import Learnable

KNOWN = 0.5
"""Share of its first standard deviation below which a parameter is known well enough to move."""
FURTHEST = 3.0
"""Standard deviations beyond which a measurement counts as one that is just so far off."""


class ParameterFilter:
    """The parameters `values` with their `covariance` (P, P), in the order of `learnables`.

    `density` are the power spectral densities of the noise of the three accelerations, (m/s²)² s: noise that is alike
    for long weighs as much as it should. `dead` is the dead zone of each, `floor` their standard deviations, m/s².
    """

    def __init__(
        self,
        learnables: Sequence[Learnable],
        density: Sequence[float],
        dead: Sequence[float],
        floor: Sequence[float],
    ) -> None:
        self.learnables = tuple(learnables)
        self.values = [one.value for one in learnables]
        self._first = [one.spread**2 for one in learnables]
        self._drift = [one.drift**2 for one in learnables]
        count = len(self.values)
        self.covariance = [[self._first[i] if i == k else 0.0 for k in range(count)] for i in range(count)]
        self._density, self._dead, self._floor = list(density), list(dead), list(floor)

    @property
    def deviations(self) -> list[float]:
        """Standard deviation of each parameter; not a number where the filter has failed."""
        return [math.sqrt(row[i]) if row[i] >= 0.0 else math.nan for i, row in enumerate(self.covariance)]

    @property
    def moving(self) -> list[bool]:
        """Which parameters are known well enough to move."""
        most = KNOWN * KNOWN
        return [self.covariance[i][i] < most * first for i, first in enumerate(self._first)]

    @property
    def sound(self) -> bool:
        """Whether every number is finite and every variance positive."""
        return all(map(math.isfinite, self.values)) and all(
            0.0 < row[i] < math.inf for i, row in enumerate(self.covariance)
        )

    @property
    def at_bounds(self) -> list[str]:
        """Names of parameters that the projection holds at an end of their range, far from where they were deployed."""
        return [
            one.name
            for value, one in zip(self.values, self.learnables, strict=True)
            if not one.low < value < one.high and abs(value - one.value) > FURTHEST * one.spread
        ]

    def step(self, left: Sequence[float], slopes: Sequence[float], dt: float) -> None:
        """Take in three accelerations that the present parameters leave unexplained, m/s², with the model's derivatives
        along each parameter, three by three; `dt` s since the last step, above 0."""
        self._let_drift(dt)
        moving, before = self.moving, list(self.values)
        for axis in range(3):
            self._take(axis, left[axis], slopes[axis::3], dt, moving, before)
        for i, one in enumerate(self.learnables):
            if not one.low <= self.values[i] <= one.high:  # false for NaN as well: `sound` tells of it
                self.values[i] = min(one.high, max(one.low, self.values[i]))

    def _let_drift(self, dt: float) -> None:
        """The truth may have moved; but nobody knows less than at the beginning."""
        covariance = self.covariance
        for i, first in enumerate(self._first):
            row = covariance[i]
            row[i] += self._drift[i] * dt
            if row[i] > first:
                shrink = math.sqrt(first / row[i])
                for k, other in enumerate(covariance):
                    if k != i:
                        row[k] *= shrink
                        other[i] *= shrink
                row[i] = first

    def _take(
        self,
        axis: int,
        left: float,
        along: Sequence[float],
        dt: float,
        moving: Sequence[bool],
        before: Sequence[float],
    ) -> None:
        """One acceleration."""
        covariance = self.covariance
        spread = [sum(map(_product, row, along)) for row in covariance]
        known = sum(map(_product, spread, along))
        if known == 0.0:
            return
        total = known + self._density[axis] / dt
        left -= sum(h * (now - was) for h, now, was in zip(along, self.values, before, strict=True))
        most = FURTHEST * math.sqrt(max(0.0, known) + self._floor[axis] ** 2)
        dead = self._dead[axis]
        beyond = min(most, max(-most, left))
        beyond = beyond - dead if beyond > dead else beyond + dead if beyond < -dead else 0.0
        push = beyond / total
        for i, s in enumerate(spread):
            if moving[i]:
                self.values[i] += push * s
            row, gain = covariance[i], s / total
            for k, t in enumerate(spread):
                row[k] -= gain * t


def _product(a: float, b: float) -> float:
    return a * b
