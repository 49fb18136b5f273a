"""Worker processes that end with their parent, however it ends, and leave interrupts to it."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process


@contextmanager
def worker_pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of `jobs` processes, each a fresh interpreter: forking a process that has threads (a progress bar's) may
    hang. At the end of the block work under way is finished and the rest is dropped. A request to end (SIGTERM) is a
    KeyboardInterrupt inside the block, so that it takes the same orderly way. Hand out the work inside
    `interrupts_held`, or a worker that still starts may be interrupted."""
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), serve_parent)
    with _ended_as_interrupted():
        try:
            yield pool
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Interrupts (Ctrl-C goes to every process of a terminal) and requests to end wait until the end of the block;
    processes that are started in it do not see them before they serve."""
    numbers, held = (signal.SIGINT, signal.SIGTERM), list[int]()
    # What this thread blocks the kernel gives to another one (OpenBLAS has some), and Python handles it here.
    in_main = threading.current_thread() is threading.main_thread()
    handlers = {n: signal.signal(n, lambda got, _: held.append(got)) for n in numbers} if in_main else {}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        for got in held[:1]:
            signal.raise_signal(got)


@contextmanager
def _ended_as_interrupted() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # only there may a handler be set
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def serve_parent() -> None:
    """In a worker: end when its parent does, and leave interrupts to it; what was half-written is removed by the next
    run."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    parent = parent_process()
    assert parent is not None

    def end_with_it() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_it, daemon=True).start()
