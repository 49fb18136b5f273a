"""The process that computes for the page: it can be ended at any moment, and the page stays alive meanwhile."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection

from trueflight.groundstation.workbench.tasks import Ended, Message, Task
from trueflight.models.workers import interrupts_held, serve_parent

ENDED_BY_SYSTEM = (
    "the process that computes was ended by the system, most likely for want of memory; give a shorter flight"
)


class Worker:
    """One process that does one task at a time; what it says is handed to `told`, on a thread of its own.

    It is started before there is a task, so that what it has to load is there when one comes.
    """

    def __init__(self, told: Callable[[int, Message], None]) -> None:
        self._told = told
        self._number = 0
        self._ours: Connection | None = None
        self._busy = False
        self._start()

    def ask(self, task: Task) -> int:
        """Hand over a task; its number, which comes with every message about it."""
        if not self._process.is_alive():
            self.cancel()
        self._number += 1
        self._busy = True
        assert self._ours is not None
        self._ours.send((self._number, task))
        return self._number

    def cancel(self) -> None:
        """End whatever is being done. What it would have written is not there, or whole."""
        self.close()
        self._start()

    def close(self) -> None:
        """End the process."""
        ours, self._ours = self._ours, None  # so that whoever listens knows that it was us
        self._process.kill()
        self._process.join()
        if ours is not None:
            ours.close()

    def _start(self) -> None:
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        self._ours, self._busy = ours, False
        with interrupts_held():
            self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
            self._process.start()
        theirs.close()
        threading.Thread(target=self._listen, args=(ours,), daemon=True).start()

    def _listen(self, ours: Connection) -> None:
        try:
            while True:
                number, message = ours.recv()
                self._busy = self._busy and not isinstance(message, Ended)
                self._told(number, message)
        except (EOFError, OSError):
            if ours is self._ours and self._busy:  # not ended by us: the system did
                self._start()
                self._told(self._number, Ended(ENDED_BY_SYSTEM))


def _serve(ours: Connection) -> None:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is loaded
    serve_parent()
    from trueflight.groundstation.workbench.work import do

    while True:
        try:
            number, task = ours.recv()
        except EOFError:
            return

        def tell(message: Message, number: int = number) -> None:
            ours.send((number, message))

        do(task, tell)
