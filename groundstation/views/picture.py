"""A recording as a picture: drawn by a Rerun viewer that has no window, which ends with it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from trueflight.models.errors import InputError
from trueflight.models.whole_file import whole_file

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

SIZE = (1600, 900)
"""Pixels."""
STARTED_WITHIN, STILL_WITHIN = 60.0, 60.0  # s
PACE = 0.5  # s between two looks
NOTICES = 7.0  # s for which the viewer tells of itself over what it draws


def draw(recording: Path, picture: Path, rerun: str, size: tuple[int, int] = SIZE) -> None:
    """Draw what `recording` opens on as the PNG file `picture`; `rerun` is the viewer's program.

    Raises `InputError` where this machine cannot draw, or the picture cannot be written.
    """
    with (
        whole_file(picture, "the picture", "choose another --png") as partial,
        _viewer(recording, rerun, size) as viewer,
    ):
        viewer.open(str(recording.resolve()))
        viewer.set_time(play_state="paused")
        before, opened = b"", time.monotonic()
        while (since := time.monotonic() - opened) < STILL_WITHIN:
            time.sleep(PACE)
            seen = viewer.take_screenshot()
            if seen == before and since > NOTICES:
                break
            before = seen
        partial.write_bytes(seen)


@contextmanager
def _viewer(recording: Path, rerun: str, size: tuple[int, int]) -> Iterator[ViewerClient]:
    """A viewer without a window, on a port of its own."""
    from rerun.experimental import ViewerClient

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [
        "--headless",
        "--hide-welcome-screen",
        "--port",
        str(port),
        "--window-size",
        f"{size[0]}x{size[1]}",
    ]
    process = subprocess.Popen(
        [rerun, *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        client, end = None, time.monotonic() + STARTED_WITHIN
        while client is None:
            try:
                client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
                client.get_state()
            except (ConnectionError, RuntimeError):
                client = None
                if process.poll() is not None or time.monotonic() > end:
                    raise InputError(
                        f"{recording} is written, but this machine cannot draw it: its Rerun viewer finds nothing to "
                        "draw with; install mesa-vulkan-drivers (Debian), or open the recording elsewhere"
                    ) from None
                time.sleep(0.1)
        yield client
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGTERM)
        process.wait()
