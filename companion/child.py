"""A child process that reads what came from outside, so that nothing it does to the reader happens to the companion.

It runs when nothing else wants the processor, gets its bytes through a pipe and never by a path, and is
confined before it looks at them (`companion.confined`).
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence

_QUIET = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
"""One thread for the linear algebra: every other would ask for memory of its own."""
_PASSED = ("PATH", "PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "LD_LIBRARY_PATH", "LANG", "LC_ALL")
"""What a child needs to know of the environment; the rest may be secret, or set a runtime up."""


def ask_child(
    command: Sequence[str], request: bytes, patience: float, processor_time: int
) -> tuple[bytes, str]:
    """What a child answers to a request, and how it ended where it ended badly; `patience` in s of the wall's clock."""
    environment = {name: os.environ[name] for name in _PASSED if name in os.environ} | _QUIET
    child = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=environment,
    )
    try:
        out, _ = child.communicate(request, patience)
        return out, _how_it_ended(child.returncode, processor_time)
    except subprocess.TimeoutExpired:
        child.kill()
        out, _ = child.communicate()
        return out, f"its check did not end within {patience:g} s"


def begin_child() -> tuple[int, bytes]:
    """In the child: step back, and take the whole request; the descriptor for the answer, and the request."""
    os.nice(19)
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    answers = os.dup(1)
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)  # what a library prints is no answer
    os.close(nothing)
    return answers, sys.stdin.buffer.read()


def _how_it_ended(code: int, processor_time: int) -> str:
    if code == -signal.SIGXCPU or code == -signal.SIGKILL:
        return f"its check took more than {processor_time} s of the processor, or was killed"
    if code < 0:
        return f"its check crashed ({signal.Signals(-code).name}): the file is hostile or damaged"
    return f"its check ended with code {code}: the file is hostile or damaged"
