"""The other programs of this project, started and ended: a simulated vehicle and its companion on loopback."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from trueflight.models.errors import InputError

STARTING = 30.0
"""s that a process may take until it says ready."""


def program(name: str) -> str:
    """A program of this installation: beside the interpreter, or on the path."""
    beside = Path(sys.executable).parent / name
    return str(beside) if beside.exists() else name


def has_display() -> bool:
    """Whether a window can be shown here."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")) or sys.platform == "darwin"


def run_json(command: Sequence[object]) -> dict[str, Any]:
    """Run a program to its end and return what it printed as JSON; raises `InputError` with its last words."""
    words = [program(str(command[0])), *map(str, command[1:])]
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    except OSError as error:
        raise InputError(
            f"{command[0]}: cannot be started ({error.strerror}); pip install 'trueflight[all]'"
        ) from None
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise InputError(f"{' '.join(map(str, command[:2]))} failed: {last.removeprefix('error: ')}")
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


@contextmanager
def running_rig(
    folder: Path, vehicle: Path, truth: Sequence[str] = ()
) -> Iterator[tuple[str, tuple[int, int]]]:
    """Bridge and companion, ready, logging into `folder`; ended by their ids whatever happens.

    `truth` are further words for `sim-bridge run`. Yields the companion's Zenoh endpoint and both process ids.
    """
    companion_port, vehicle_port, pilot_port = (_free(socket.SOCK_DGRAM) for _ in range(3))
    endpoint = f"tcp/127.0.0.1:{_free(socket.SOCK_STREAM)}"
    bridge = _start(
        folder / "bridge.log",
        ["sim-bridge", "run", "--vehicle", vehicle, *truth]
        + ["--mavlink", f"udpout:127.0.0.1:{companion_port}", "--port", vehicle_port]
        + ["--pilot-port", pilot_port],
    )
    companion = None
    try:
        _wait_ready(bridge, folder / "bridge.log")
        companion = _start(
            folder / "companion.log",
            ["companion", "run", "--vehicle", vehicle, "--connect", f"udpin://127.0.0.1:{companion_port}"]
            + ["--listen", endpoint, "--records", folder / "on-board"]
            + ["--models", folder / "on-board-models"],
        )
        _wait_ready(companion, folder / "companion.log")
        yield endpoint, (bridge.pid, companion.pid)
    finally:
        for process in (companion, bridge):
            if process is not None:
                _end(process)


def _start(log: Path, command: list[object]) -> subprocess.Popen[bytes]:
    words = [program(str(command[0])), *map(str, command[1:])]
    try:
        with log.open("wb") as out:
            return subprocess.Popen(words, stdout=out, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
    except OSError as error:
        raise InputError(
            f"{command[0]}: cannot be started ({error.strerror}); pip install 'trueflight[all]'"
        ) from None


def _wait_ready(process: subprocess.Popen[bytes], log: Path) -> None:
    end = time.monotonic() + STARTING
    while time.monotonic() < end:
        text = log.read_text(errors="replace")
        if "ready:" in text:
            return
        if process.poll() is not None:
            last = (text.strip().splitlines() or ["it said nothing"])[-1]
            raise InputError(f"{log.stem} ended before it was ready: {last} (see {log})")
        time.sleep(0.05)
    raise InputError(f"{log.stem} was not ready within {STARTING:g} s; see {log}")


def _end(process: subprocess.Popen[bytes]) -> None:
    for ask, patience in ((signal.SIGINT, 10.0), (signal.SIGKILL, 5.0)):
        if process.poll() is not None:
            return
        process.send_signal(ask)
        try:
            process.wait(patience)
        except subprocess.TimeoutExpired:
            continue


def _free(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def told_to_end() -> Iterator[threading.Event]:
    """An event that is set once this process is told to end: by Ctrl-C, SIGTERM or the end of its terminal. A program
    in a shell's background, where Ctrl-C is ignored, is told by SIGINT too."""
    told = threading.Event()
    if threading.current_thread() is not threading.main_thread():  # only there may a handler be set
        yield told
        return
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, lambda *_: told.set()) for number in numbers}
    try:
        yield told
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
