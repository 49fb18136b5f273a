"""Looks in a process of their own, one at a time: whoever receives and draws never waits for one."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from trueflight.groundstation.live.said import Said
from trueflight.groundstation.live.window import Snapshot, flight_of
from trueflight.groundstation.results import EffectVerdict
from trueflight.models.errors import InputError
from trueflight.models.model import Model
from trueflight.models.workers import interrupts_held, worker_pool

NICENESS = 10
THOROUGH = 5
"""Of so many looks at a flight one is thorough."""
ENDED = "the process that looks at the flight was ended; start the monitor again to have it back"


class Engine:
    """Looks at snapshots, one at a time."""

    def __init__(self, pool: ProcessPoolExecutor) -> None:
        self._pool = pool
        self._looking: Future[Said] | None = None
        self._at: Snapshot | None = None

    @property
    def idle(self) -> bool:
        """Whether the next look can begin."""
        return self._looking is None

    def look(self, snapshot: Snapshot) -> None:
        """Begin to look at a snapshot."""
        self._at = snapshot
        try:
            with interrupts_held():
                self._looking = self._pool.submit(_look, snapshot)
        except BrokenProcessPool:
            self._looking = Future()
            self._looking.set_exception(InputError(ENDED))

    def answer(self, patience: float = 0.0) -> Said | None:
        """What the look says, once it is at its end; waits for `patience` s at most."""
        if self._looking is None or self._at is None:
            return None
        try:
            said = self._looking.result(patience)
        except TimeoutError:
            return None
        except BrokenProcessPool:
            said = Said(self._at.name, self._at.flight, 0.0, 0.0, 0.0, error=ENDED)
        except InputError as error:
            said = Said(self._at.name, self._at.flight, 0.0, 0.0, 0.0, error=str(error))
        self._looking = None
        return said


@contextmanager
def engine() -> Iterator[Engine]:
    """An engine whose process ends with the block."""
    with worker_pool(1) as pool:
        yield Engine(pool)


# --- in the process ---------------------------------------------------------------------------------------

_past: dict[str, tuple[int, int, object]] = {}
"""By vehicle: which flight, how many looks it had, and the last of them."""


def _look(snapshot: Snapshot) -> Said:
    """Look at a snapshot, beginning at what the last look at the same flight found; whatever goes wrong is said."""
    from trueflight.groundstation.identify.live import Look, look

    os.nice(max(0, NICENESS - os.nice(0)))
    begun = time.process_time()
    flight, count, before = _past.get(snapshot.name, (snapshot.flight, 0, None))
    if flight != snapshot.flight:
        count, before = 0, None
    start = stop = 0.0
    try:
        window = flight_of(snapshot)
        start, stop = float(window.t[0]), float(window.t[-1])
        assert before is None or isinstance(before, Look)
        seen = look(window, snapshot.base, before, count % THOROUGH == 0)
    except Exception as error:  # noqa: BLE001 - one window that cannot be judged must not end the monitor
        _past[snapshot.name] = (snapshot.flight, count, before)
        told = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        return Said(snapshot.name, snapshot.flight, start, stop, time.process_time() - begun, error=told)
    _past[snapshot.name] = (snapshot.flight, count + 1, seen)
    d = seen.diagnosis
    return Said(
        snapshot.name, snapshot.flight, start, stop, time.process_time() - begun, seen.thorough, d.effects,
        d.rms_before, d.rms_after, d.noise_floor, _widths(d.effects, snapshot.base),
    )  # fmt: skip


def _widths(effects: Sequence[EffectVerdict], base: Model) -> tuple[tuple[str, float], ...]:
    """Half-widths of intervals, in parts of what is typical beyond "no effect", by "effect/parameter", of what is
    found."""
    from trueflight.models.effects import catalogue

    known, found = catalogue(base.effects_directory), []
    for e in effects:
        if e.rank is None or e.name not in known:
            continue
        neutral = known[e.name].neutral(base.vehicle)
        for p in known[e.name].parameters:
            size = abs(p.typical - neutral.get(p.name, 0.0))
            widths = [
                0.5 * (told.high - told.low) / size for told in e.parameters if told.name == p.name and size
            ]
            found += [(f"{e.name}/{p.name}", width) for width in widths]
    return tuple(found)
