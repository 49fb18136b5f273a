"""The server started: where it listens, under which names it answers, and the link that opens it."""

from __future__ import annotations

import socket
import ssl
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from trueflight.groundstation.operate.keys import make_page_keys
from trueflight.groundstation.workbench.guard import Guard
from trueflight.groundstation.workbench.pages import Pages
from trueflight.groundstation.workbench.server import Workbench
from trueflight.groundstation.workbench.session import Session
from trueflight.groundstation.workbench.tasks import Source
from trueflight.groundstation.workbench.uploads import MOST_BYTES
from trueflight.groundstation.workbench.viewer import WebViewer
from trueflight.models import access
from trueflight.models.errors import InputError

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Serving:
    """What is opened and where: `port` 0 takes a free one; flights in `opened` are read at once, and the one that is
    `held_out` of every fit. Under a `host` other than loopback the page is served by the `keys` that
    `groundstation keys` made, to people who have some of them."""

    folder: Path
    store: Path
    opened: tuple[Source, ...] = ()
    held_out: Source | None = None
    port: int = 0
    most_bytes: int = MOST_BYTES
    host: str = LOOPBACK
    keys: Path | None = None


def serve(serving: Serving, ready: Callable[[str, bool], None]) -> None:
    """Serve the page until interrupted; `ready` is told the link to open, and whether it is the first.

    Raises `InputError` where the address is taken or none of this machine's, and for one that others reach without
    keys.
    """
    if serving.host != LOOPBACK and serving.keys is None:
        raise InputError(
            f"--host {serving.host}: other machines only with keys; make some (groundstation keys keys --engineer ME), "
            "and pass --keys keys"
        )
    listening = _listening(serving.host, serving.port)
    with TemporaryDirectory() as kept, listening:
        port = listening.getsockname()[1]
        names = (serving.host,) if serving.keys is not None else (LOOPBACK, "localhost")
        secure = {} if serving.keys is None else _secured(serving.keys, names, Path(kept) / "page")
        bench: Workbench | None = None
        session = Session(
            serving.folder, serving.store, lambda panels: bench.changed(panels) if bench else None
        )
        bench = Workbench(session, Pages(), WebViewer(), serving.most_bytes, serving.opened, serving.held_out)

        def link(token: str) -> str:
            return f"{'https' if secure else 'http'}://{_in_url(serving.host)}:{port}/?token={token}"

        hosts = frozenset(f"{_in_url(name)}:{port}" for name in names)
        guard = Guard(bench.app(), hosts, bool(secure), lambda token: ready(link(token), False))
        config = uvicorn.Config(
            guard,
            log_level="warning",
            access_log=False,
            timeout_graceful_shutdown=1,
            server_header=False,
            **secure,
        )
        ready(link(guard.token), True)
        uvicorn.Server(config).run(sockets=[listening])


def _listening(host: str, port: int) -> socket.socket:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        made = socket.socket(family, kind, protocol)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(address)
        made.listen()  # whoever opens the link at once waits for the first answer
    except OSError as error:
        raise InputError(
            f"{host}, port {port}: {error.strerror}; choose another --port, or a --host that is this machine's"
        ) from None
    return made


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _secured(keys: Path, names: tuple[str, ...], folder: Path) -> dict[str, Any]:
    """TLS both ways: a certificate of the authority for the page, and one of a person who is let in for the browser."""
    people = make_page_keys(keys, names, folder)

    class People(H11Protocol):
        """HTTP for those alone whose certificate names somebody who is let in."""

        def connection_made(self, transport: Any) -> None:
            subject = (transport.get_extra_info("peercert") or {}).get("subject", ())
            names = {value for pairs in subject for key, value in pairs if key == "commonName"}
            if names & people:
                super().connection_made(transport)
            else:
                transport.abort()

    return {
        "ssl_certfile": str(folder / access.CERTIFICATE),
        "ssl_keyfile": str(folder / access.PRIVATE_KEY),
        "ssl_ca_certs": str(folder / access.AUTHORITY),
        "ssl_cert_reqs": ssl.CERT_REQUIRED,
        "http": People,
    }
