"""Where a number of a fit holds: everywhere, in one of several flights, or between two moments.

A payload that is dropped changes the mass at a moment; the wind belongs to the flight in which it blew. Such a number
is fitted once for each of its spans, in one fit with everything that is shared.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Span:
    """Samples of flight number `flight` (None: of every flight) from `start` on and before `stop`, s of its clock."""

    flight: int | None = None
    start: float = -np.inf
    stop: float = np.inf

    def holds(self, flight: int, t: float) -> bool:
        """Whether time `t` of flight number `flight` is in it."""
        return self.flight in (None, flight) and self.start <= t < self.stop


EVERYWHERE = Span()


@dataclass(frozen=True)
class Piecewise:
    """A number that differs between spans: `parts` are disjoint, outside of all of them it is `elsewhere`."""

    parts: tuple[tuple[Span, float], ...]
    elsewhere: float

    def at(self, flight: int, t: float) -> float:
        """The value at time `t` of flight number `flight`."""
        return next((value for span, value in self.parts if span.holds(flight, t)), self.elsewhere)


Value = float | Piecewise
Values = Mapping[str, Value] | Mapping[str, float]
"""Numbers of one effect by parameter."""


def number(parts: Sequence[tuple[Span, float]], elsewhere: float) -> Value:
    """The number with these values: a plain one where it is the same everywhere."""
    if len(parts) == 1 and parts[0][0] == EVERYWHERE:
        return parts[0][1]
    return Piecewise(tuple(parts), elsewhere)


def cut_at(values: Iterable[Values], flight: int, t: np.ndarray) -> list[slice]:
    """Rows of flight number `flight`, sampled at `t` (N,), in pieces within which no number changes."""
    moments = {
        moment
        for numbers in values
        for value in numbers.values()
        if isinstance(value, Piecewise)
        for span, _ in value.parts
        if span.flight in (None, flight)
        for moment in (span.start, span.stop)
    }
    edges = np.unique([0, *np.searchsorted(t, sorted(moments)), len(t)])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]


def held(values: Values, flight: int, t: float) -> dict[str, float]:
    """Plain numbers at time `t` of flight number `flight`."""
    return {k: v.at(flight, t) if isinstance(v, Piecewise) else v for k, v in values.items()}


def moments_of(values: Values) -> set[float]:
    """Moments at which numbers change, s."""
    parts = [v.parts for v in values.values() if isinstance(v, Piecewise)]
    return {t for one in parts for t in changes_of(span for span, _ in one)}


def changes_of(spans: Iterable[Span]) -> tuple[float, ...]:
    """Moments between spans of a flight, s, in order."""
    ends = {t for span in spans for t in (span.start, span.stop)}
    return tuple(sorted(t for t in ends if np.isfinite(t)))


def split_at(moments: Iterable[float]) -> tuple[Span, ...]:
    """The spans between moments of a flight; none where there is no moment: the number holds everywhere."""
    edges = [-np.inf, *sorted(moments), np.inf]
    return tuple(Span(None, a, b) for a, b in itertools.pairwise(edges)) if len(edges) > 2 else ()


def one_change_less(spans: Sequence[Span]) -> list[tuple[Span, ...]]:
    """The spans with each moment left out in turn, so that one number holds before and after it."""
    moments = changes_of(spans)
    return [_merged(spans, moment) for moment in moments]


def _merged(spans: Sequence[Span], moment: float) -> tuple[Span, ...]:
    before = next((s for s in spans if s.stop == moment), None)
    after = next((s for s in spans if s.start == moment), None)
    moments = changes_of(spans)
    earlier = max((t for t in moments if t < moment), default=-np.inf)
    later = min((t for t in moments if t > moment), default=np.inf)
    whole = Span(None, earlier if before is None else before.start, later if after is None else after.stop)
    rest = [s for s in spans if s not in (before, after)]
    merged = tuple(sorted((*rest, whole), key=lambda s: s.start))
    return () if merged == (EVERYWHERE,) else merged
