"""A process that a test starts can be interrupted and does not outlive it."""

from __future__ import annotations

import ctypes
import signal

_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1


def with_parent() -> None:
    """`preexec_fn` of Popen: Linux kills the child when the tests end in whatever way, also by SIGKILL.

    A shell that runs the tests in the background may have told us to ignore SIGINT; the child does not.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
