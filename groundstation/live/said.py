"""What one look says, small enough to come from another process, and what has changed according to several."""

from __future__ import annotations

from dataclasses import dataclass, replace

from trueflight.groundstation.identify.steps import SHORTEST
from trueflight.groundstation.results import EffectVerdict

PERSISTS = 3
"""Looks, one after the other, that a change must be in before anybody is told."""
GONE = 5
"""Looks, one after the other, that a change must be missing from, with enough of the flight on both sides of it, before
it is taken back."""
NEAR = 1.0
"""s between two moments that are one: that is a bin of the engine's."""


@dataclass(frozen=True)
class Said:
    """What one look says of the flight number `flight` of the vehicle `name`.

    The window reaches from `start` to `stop`, s on the flight's clock; the look took `cost` s of processor time and was
    `thorough` or not. RMS in m/s². `widths` are the half-widths of the intervals of what is found, in parts of what is
    typical, by "effect/parameter". Where there could be none, `error` says why.
    """

    name: str
    flight: int
    start: float
    stop: float
    cost: float
    thorough: bool = False
    effects: tuple[EffectVerdict, ...] = ()
    rms_before: float = 0.0
    rms_after: float = 0.0
    noise_floor: float = 0.0
    widths: tuple[tuple[str, float], ...] = ()
    error: str = ""


@dataclass(frozen=True)
class Alert:
    """A change in flight at `time` [`low`, `high`], s on the flight's clock, first seen when the flight was `first` s
    long and told when it was `told` (None: not yet).

    `effect` is what changes, as the look that saw it last has it, `or_else` what the data cannot tell from it; `words`
    what it was and is. `seen` and `missed` count looks, one after the other.
    """

    effect: str
    or_else: tuple[str, ...]
    verdict: str
    time: float
    low: float
    high: float
    words: str
    first: float
    told: float | None = None
    seen: int = 1
    missed: int = 0
    taken_back: bool = False

    @property
    def text(self) -> str:
        """The change in one line."""
        others = f" (or {', '.join(self.or_else)})" if self.or_else else ""
        if self.taken_back:
            return f"taken back: {self.effect} at {self.time:.1f} s is not seen any more"
        return f"{self.effect}{others} changed at {self.time:.1f} s: {self.words}"


def follow(alerts: tuple[Alert, ...], said: Said) -> tuple[tuple[Alert, ...], tuple[Alert, ...]]:
    """The alerts after one more look, and those of them that are to be told now."""
    if said.error:
        return alerts, ()
    fresh = _changes(said)
    after, news = [], []
    for alert in alerts:
        same = next((c for c in fresh if _one(alert, c)), None)
        if same is not None:
            fresh = [c for c in fresh if not _one(alert, c)]
            now = replace(same, first=alert.first, told=alert.told, seen=alert.seen + 1)
            if now.told is None and now.seen >= PERSISTS:
                now = replace(now, told=said.stop)
                news.append(now)
            after.append(now)
        elif alert.told is None or alert.taken_back:
            after += [alert] if alert.taken_back else []
        else:
            # only a look that could have seen it speaks against it
            could = said.start + SHORTEST < alert.low and alert.high < said.stop - SHORTEST
            missed = alert.missed + 1 if could else alert.missed
            now = replace(alert, missed=missed, taken_back=missed >= GONE)
            news += [now] if now.taken_back else []
            after.append(now)
    return (*after, *fresh), tuple(news)


def _one(alert: Alert, change: Alert) -> bool:
    """Whether both are of one moment: what changes may be called by another name in the next look."""
    return change.low < alert.high + NEAR and alert.low - NEAR < change.high


def _changes(said: Said) -> list[Alert]:
    """What changes according to one look: the largest of each moment, beside which others are told."""
    found: list[Alert] = []
    for e in sorted(said.effects, key=lambda e: e.rank or 0):
        if e.rank is None or e.over_time is None:
            continue
        for change in e.over_time.changes:
            one = Alert(
                e.name, e.indistinguishable_from, e.verdict, change.time, change.low, change.high,
                "; ".join(e.over_time.lines), said.stop,
            )  # fmt: skip
            if not any(_one(other, one) for other in found):
                found.append(one)
    return found
