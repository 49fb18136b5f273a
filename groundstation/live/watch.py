"""Vehicles watched: ticks to whoever shows them at once, and a look at one of them after the other as the engine is
free. Nothing here waits for the engine."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from trueflight.groundstation.live.engine import Engine
from trueflight.groundstation.live.learnt import Followed, Learnt
from trueflight.groundstation.live.said import Alert, Said, follow
from trueflight.groundstation.live.sources import Source
from trueflight.groundstation.live.window import Window
from trueflight.models.errors import InputError
from trueflight.models.model import Model
from trueflight.models.record_pb2 import Event, Tick
from trueflight.models.vehicle import Vehicle

PERIOD = 0.1
"""s between two rounds."""
EACH = 1.0
"""s from the beginning of a look at a vehicle to the next, at least."""
LEAST = 10.0
"""s of flight in the window before it is looked at."""
SILENCE = 2.0
"""s without a tick that everybody is told of."""


class Shown(Protocol):
    """Whoever shows what happens; vehicles by their name."""

    def ticks(self, name: str, ticks: Sequence[Tick]) -> None:
        """Ticks of now."""

    def past(self, name: str, ticks: Sequence[Tick]) -> None:
        """Ticks that had been missing."""

    def event(self, name: str, event: Event) -> None:
        """What the companion told."""

    def state(self, name: str, silent: float, status: dict[str, Any]) -> None:
        """How long a vehicle has been silent, s (0: it is not), and its companion's status."""

    def learnt(self, name: str, flight: int, news: Sequence[Learnt]) -> None:
        """What its companion learnt in flight number `flight` and flies with now."""

    def said(self, name: str, said: Said, alerts: Sequence[Alert], news: Sequence[Alert], age: float) -> None:
        """What the newest look says, `age` s of flight ago; `news` are those of the `alerts` that are told now."""


@dataclass
class _Watched:
    source: Source
    window: Window
    heard: float
    begun: float = float("-inf")
    looked: float = 0.0
    said: Said | None = None
    alerts: tuple[Alert, ...] = ()
    flight: int = 0
    base: Model | None = None
    followed: Followed = field(default_factory=Followed)
    wrong: str = field(default="")


class Watch:
    """`sources` looked at over the last `seconds` s by the `engine`, against the model that `model_of` chooses for a
    vehicle; without an engine they are only shown."""

    def __init__(
        self,
        sources: Sequence[Source],
        shown: Sequence[Shown],
        engine: Engine | None,
        model_of: Callable[[Vehicle], Model],
        seconds: float,
    ) -> None:
        now = time.monotonic()
        self._watched = [_Watched(source, Window(seconds), now) for source in sources]
        self._shown, self._engine, self._model_of = tuple(shown), engine, model_of
        self.seen = 0

    def run(self, told: threading.Event, seconds: float | None = None) -> int:
        """Watch until `told` to end, for `seconds`, or until nothing more comes; returns how many ticks were seen."""
        end = time.monotonic() + seconds if seconds is not None else float("inf")
        while time.monotonic() < end and not told.wait(PERIOD):
            self.round()
            if all(w.source.ended for w in self._watched):
                break
        self.round()
        self._answer(60.0 if not told.is_set() else 0.0)
        return self.seen

    def run_in_step(self, told: threading.Event) -> int:
        """Watch records, each second of them looked at before the next comes: the same every time."""
        while not told.is_set() and not all(w.source.ended for w in self._watched):
            for w in self._watched:
                self._take(w)
                while self._look_at(w) and not self._answer(PERIOD) and not told.is_set():
                    pass
        return self.seen

    def round(self) -> None:
        """Take what has come, show it, and let the engine go on."""
        for w in self._watched:
            self._take(w)
        self._answer()
        waiting = [w for w in self._watched if time.monotonic() - w.begun >= EACH]
        for w in sorted(waiting, key=lambda w: w.begun):
            if self._look_at(w):
                break

    def _take(self, w: _Watched) -> None:
        name, ticks, filled = w.source.name, w.source.ticks(), w.source.filled()
        if ticks:
            w.heard = time.monotonic()
            w.window.take(ticks)
            learnt = w.followed.take(ticks, w.window.flight, w.window.zero)
            self.seen += len(ticks)
        if filled:
            w.window.fill(filled)
        w.source.missing(w.window.holes())
        silent = time.monotonic() - w.heard
        for one in self._shown:
            if ticks:
                one.ticks(name, ticks)
                if learnt:
                    one.learnt(name, w.window.flight, learnt)
            if filled:
                one.past(name, filled)
        for event in w.source.events():
            for one in self._shown:
                one.event(name, event)
        for one in self._shown:
            one.state(name, silent if silent > SILENCE and not w.source.ended else 0.0, w.source.status)

    def _look_at(self, w: _Watched) -> bool:
        """Begin to look at a vehicle; whether the engine looks now."""
        if self._engine is None or w.source.vehicle is None:
            return False
        if not self._engine.idle:
            return True
        if w.window.covered < LEAST or w.wrong or (w.flight, w.looked) == (w.window.flight, w.window.now):
            return False
        if w.base is None:
            try:
                w.base = self._model_of(w.source.vehicle)
            except InputError as error:
                w.wrong = str(error)
                self._heed(w, Said(w.source.name, w.window.flight, 0.0, 0.0, 0.0, error=w.wrong))
                return False
        w.begun, w.looked, w.flight = time.monotonic(), w.window.now, w.window.flight
        self._engine.look(w.window.snapshot(w.source.name, w.source.vehicle, w.base))
        return True

    def _answer(self, patience: float = 0.0) -> bool:
        """Heed what the engine has to say; whether it said something."""
        said = self._engine.answer(patience) if self._engine is not None else None
        if said is None:
            return False
        w = next(w for w in self._watched if w.source.name == said.name)
        if said.flight == w.window.flight:  # otherwise it is of a flight that is over
            self._heed(w, said)
        return True

    def _heed(self, w: _Watched, said: Said) -> None:
        if w.said is not None and w.said.flight != said.flight:
            w.alerts = ()
        w.said = said
        w.alerts, news = follow(w.alerts, said)
        age = max(0.0, w.window.now - said.stop) if not said.error else 0.0
        for one in self._shown:
            one.said(w.source.name, said, w.alerts, news, age)
