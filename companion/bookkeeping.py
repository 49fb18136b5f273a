"""What a tick leaves behind: its place in the record and on Zenoh, written by a thread of its own.

The control thread notes what was known and decided, and goes on; messages are made, recorded and published a few at a
time. That thread is woken right after a setpoint has left, when nothing is due for the rest of a period, and not for
every tick, because what wakes another thread costs the control thread more than the note.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from trueflight.companion.latest import Latest
from trueflight.companion.odometry import Odometry
from trueflight.companion.outcome import Outcome
from trueflight.companion.tick import Known, known_now, make_tick

TOGETHER = 4
"""Ticks that are written together: 40 ms at 100 Hz."""
_PERIOD = 0.05
"""s after which the rest is written where no ticks come any more."""
WAITING = 2000
"""Ticks that may wait; beyond that they are dropped, and counted."""

_Note = tuple[Odometry, Known, Outcome, float]
Write = Callable[[bytes, int, int], None]


class Bookkeeping:
    """Hands each tick to `write` (serialised, vehicle's clock in us, ours in ns), in order, on its own thread.

    `note` is the control thread's; `flush` any other's. What could not wait, or could not be written, is counted in
    `dropped` and told to `tell` in words; that must not block.
    """

    def __init__(self, write: Write, tell: Callable[[str], None]) -> None:
        self._refused = self._failed = self._told = 0  # each counted by one thread
        self._write_tick, self._tell = write, tell
        self._notes: deque[_Note] = deque()
        self._since = 0
        self._wake = threading.Event()
        self._writing = threading.Lock()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="bookkeeping", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Ticks that are lost."""
        return self._refused + self._failed

    def note(self, odometry: Odometry, latest: Latest, outcome: Outcome, latency: float) -> None:
        """Keep what is known now for the tick of this outcome, which must not change any more; never blocks."""
        if len(self._notes) >= WAITING:
            self._refused += 1
            return
        self._notes.append((odometry, known_now(latest), outcome, latency))
        self._since += 1
        if self._since >= TOGETHER:
            self._since = 0
            self._wake.set()

    def flush(self) -> None:
        """Write what waits, and return when it is written."""
        with self._writing:
            notes = self._notes
            while notes:
                odometry, known, outcome, latency = notes.popleft()
                try:
                    data = make_tick(odometry, known, outcome, latency).SerializeToString()
                    self._write_tick(data, odometry.vehicle_time_us, odometry.host_time_ns)
                except Exception:  # noqa: BLE001 - one tick that cannot be written must not end the book-keeping
                    self._failed += 1
            dropped = self.dropped
            if dropped != self._told:
                self._tell(f"{dropped - self._told} ticks are neither recorded nor published")
                self._told = dropped

    def close(self) -> None:
        """Write what waits and end the thread."""
        self._closing = True
        self._wake.set()
        self._thread.join(2.0)
        self.flush()

    def _work(self) -> None:
        while not self._closing:
            self._wake.wait(_PERIOD)
            self._wake.clear()
            self.flush()
