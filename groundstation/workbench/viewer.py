"""Rerun's web viewer, served by us: its files are in `rerun-sdk`, which hands them out over HTTP alone."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from importlib.metadata import version
from pathlib import Path

from trueflight.models.errors import InputError
from trueflight.models.whole_file import write_whole

FILES = {"re_viewer.js": "text/javascript", "re_viewer_bg.wasm": "application/wasm"}
STARTING = 30.0
"""s that the viewer's own server may take."""
_SERVE = (
    "import sys, time, rerun as rr; rr.init('trueflight'); "
    "rr.serve_web_viewer(web_port=int(sys.argv[1]), open_browser=False); sys.stdin.read()"
)


class WebViewer:
    """The files of the web viewer, taken out of the installed package once for each of its versions."""

    def __init__(self, cache: Path | None = None) -> None:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        self._folder = (cache or home / "trueflight") / f"rerun-web-viewer-{version('rerun-sdk')}"

    def media_type(self, name: str) -> str:
        """What a file is."""
        return FILES[name]

    def file(self, name: str) -> Path:
        """A file of the viewer. Raises `InputError` for one that is none, and where the viewer hands none out."""
        if name not in FILES:
            raise InputError("the viewer has no such file")
        if not all((self._folder / known).is_file() for known in FILES):
            self._take_out()
        return self._folder / name

    def _take_out(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        process = subprocess.Popen(
            [sys.executable, "-c", _SERVE, str(port)],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            for name in FILES:
                content = _fetched(f"http://127.0.0.1:{port}/{name}", process)
                write_whole(
                    self._folder / name, content, "the viewer's files", "set XDG_CACHE_HOME to a folder"
                )
        finally:
            process.kill()
            process.wait()


def _fetched(url: str, process: subprocess.Popen[bytes]) -> bytes:
    deadline = time.monotonic() + STARTING
    while True:
        try:
            with urllib.request.urlopen(url, timeout=STARTING) as answer:
                content: bytes = answer.read()
                return content
        except (urllib.error.URLError, OSError) as error:
            if process.poll() is not None or time.monotonic() > deadline:
                raise InputError(
                    f"the Rerun web viewer does not start ({error}); pip install rerun-sdk again"
                ) from None
            time.sleep(0.1)
