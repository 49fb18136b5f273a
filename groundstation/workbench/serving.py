"""The server started: where it listens, under which names it answers, and the link that opens it."""

from __future__ import annotations

import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import uvicorn

from trueflight.groundstation.workbench.guard import Guard
from trueflight.groundstation.workbench.pages import Pages
from trueflight.groundstation.workbench.server import Workbench
from trueflight.groundstation.workbench.session import Session
from trueflight.groundstation.workbench.tasks import Source
from trueflight.groundstation.workbench.uploads import MOST_BYTES
from trueflight.groundstation.workbench.viewer import WebViewer
from trueflight.models.errors import InputError

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Serving:
    """What is opened and where: `port` 0 takes a free one; flights in `opened` are read at once, and the one that is
    `held_out` of every fit."""

    folder: Path
    store: Path
    opened: tuple[Source, ...] = ()
    held_out: Source | None = None
    port: int = 0
    most_bytes: int = MOST_BYTES


def serve(serving: Serving, ready: Callable[[str, bool], None]) -> None:
    """Serve the page until interrupted; `ready` is told the link to open, and whether it is the first.

    Raises `InputError` where the port is taken.
    """
    listening = socket.socket()
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((LOOPBACK, serving.port))
        listening.listen()  # whoever opens the link at once waits for the first answer
    except OSError as error:
        raise InputError(
            f"port {serving.port}: {error.strerror}; choose another --port, or leave it out"
        ) from None
    port = listening.getsockname()[1]
    bench: Workbench | None = None
    session = Session(serving.folder, serving.store, lambda panels: bench.changed(panels) if bench else None)
    bench = Workbench(session, Pages(), WebViewer(), serving.most_bytes, serving.opened, serving.held_out)

    def link(token: str) -> str:
        return f"http://{LOOPBACK}:{port}/?token={token}"

    hosts = frozenset(f"{name}:{port}" for name in (LOOPBACK, "localhost"))
    guard = Guard(bench.app(), hosts, False, lambda token: ready(link(token), False))
    config = uvicorn.Config(
        guard,
        log_level="warning",
        access_log=False,
        lifespan="on",
        timeout_graceful_shutdown=1,
        server_header=False,
    )
    ready(link(guard.token), True)
    uvicorn.Server(config).run(sockets=[listening])
