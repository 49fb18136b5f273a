"""Worker processes that end with their parent, however it ends, and leave interrupts to it."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process


def worker_pool(jobs: int) -> ProcessPoolExecutor:
    """A pool of `jobs` processes, each a fresh interpreter: forking a process that has threads (a progress bar's) may
    hang. Hand out the work inside `interrupts_held`, or a worker that still starts may be interrupted."""
    return ProcessPoolExecutor(jobs, get_context("spawn"), _serve_parent)


@contextmanager
def interrupts_held() -> Iterator[None]:
    """An interrupt (Ctrl-C goes to every process of a terminal) waits until the end of the block; processes that are
    started in it never see one."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve_parent() -> None:
    """In the worker: end when the parent does; what was half-written is removed by the next run."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    assert parent is not None

    def end_with_it() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_it, daemon=True).start()
