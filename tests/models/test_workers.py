"""Workers are started whole: what interrupts the parent waits until they are."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from trueflight.models.workers import interrupts_held


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_another_thread_receives_waits_all_the_same(number: signal.Signals) -> None:
    """OpenBLAS's threads block no signal; the kernel gives them what the main thread blocks."""
    done = threading.Event()
    other = threading.Thread(target=done.wait)
    other.start()
    before = signal.signal(number, signal.default_int_handler)
    seen = []
    try:
        with pytest.raises(KeyboardInterrupt), interrupts_held():
            os.kill(os.getpid(), number)
            for step in range(200_000):  # long enough for Python to look for signals
                seen.append(step)
        assert len(seen) == 200_000
        assert signal.getsignal(number) is signal.default_int_handler
        assert number not in signal.pthread_sigmask(signal.SIG_BLOCK, set())
    finally:
        signal.signal(number, before)
        done.set()
        other.join()
