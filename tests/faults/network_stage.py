"""A vehicle with real Zenoh sessions, certificates and ports on loopback, and no autopilot, to be attacked."""

from __future__ import annotations

import json
import socket
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import zenoh

from trueflight.companion.signature import Signatures
from trueflight.companion.telemetry import ATTACHED, Telemetry, read_json
from trueflight.companion.zenoh_session import ZenohSettings, open_session
from trueflight.groundstation.operate.keys import make_keys
from trueflight.groundstation.operate.link import Link
from trueflight.groundstation.operate.settings import Settings
from trueflight.models import access
from trueflight.models.access import Keys, read_keys

PEOPLE = [("eve", "observer"), ("anna", "operator"), ("bob", "engineer"), ("carl", "engineer")]
ORDER = {
    "mission": b'{"trajectory": "hover"}',
    "model": b"\x08\x0a a network",
    "status": b"",
    "record": b"{}",
}
HEARD = 0.4
"""s in which whatever arrives on loopback has arrived."""


def free_port() -> int:
    """A port on the loopback interface that nobody uses now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Stage:
    """A vehicle `quad5` with keys, another `quad6` of the same authority (keys only), and four people."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = free_port()
        self.endpoint = f"tls/127.0.0.1:{self.port}"
        self.root = folder / "keys"
        make_keys(self.root, ["quad5", "quad6"], PEOPLE)
        self.asked: list[tuple[str, bytes]] = []
        self.heard: list[str] = []
        self.models = folder / "models"
        self.models.mkdir()
        (folder / "records").mkdir()
        own = self.keys("vehicle-quad5")
        self.signatures = Signatures(self.models, "quad5", own, "local", False)
        session = open_session(ZenohSettings(listen=(self.endpoint,)), own, "quad5")
        # Whatever gets past access control is heard here.
        self._ears = [
            session.declare_subscriber(pattern, lambda sample: self.heard.append(str(sample.key_expr)))
            for pattern in ("trueflight/*/*", "trueflight/quad5/tick/@adv/**")
        ]
        self.telemetry = vehicle(session, "quad5", self.asked, folder / "records", self.signatures)
        self.telemetry.subscribe("pose", lambda payload: None, lambda reason: None)

    def __enter__(self) -> Stage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.telemetry.close()

    def keys(self, who: str) -> Keys:
        """The keys of a person, or of `vehicle-NAME`."""
        return read_keys(self.root / who)

    def open(self, config: dict[str, Any], endpoint: str = "") -> zenoh.Session:
        """A session to the vehicle with these settings; raises `zenoh.ZError` where it is not let in."""
        whole = {
            "mode": "peer",
            "listen/endpoints": [],
            "connect/endpoints": [endpoint or self.endpoint],
            "connect/timeout_ms": 1500,
            "connect/exit_on_failure": True,
            "scouting/multicast/enabled": False,
            **config,
        }
        made = zenoh.Config()
        for path, value in whole.items():
            made.insert_json5(path, json.dumps(value))
        return zenoh.open(made)

    def intruder(self, who: str) -> zenoh.Session:
        """A session with somebody's keys that obeys no rules of its own."""
        return self.open({**tls(self.keys(who))})

    def link(self, who: str, **changes: Any) -> Link:
        """The ground station of somebody."""
        return Link(Settings(connect=(self.endpoint,), timeout=3.0, keys=str(self.root / who), **changes))


def vehicle(
    session: zenoh.Session,
    name: str,
    asked: list[tuple[str, bytes]],
    records: Path,
    signatures: Signatures | None = None,
) -> Telemetry:
    """The companion's telemetry, noting what is asked of it; models go through `signatures` as on board."""

    def mission(payload: bytes, parameters: dict[str, str]) -> dict[str, Any]:
        asked.append(("mission", payload))
        read_json(payload)
        return {"accepted": True, "reason": "", "mission": "m1", "duration": 1.0}

    def model(payload: bytes, parameters: dict[str, str]) -> dict[str, Any]:
        reason = signatures.admit(payload, parameters.get(ATTACHED, "").encode()) if signatures else ""
        asked.append(("model", payload))
        return {"accepted": not reason, "reason": reason}

    def status(payload: bytes, parameters: dict[str, str]) -> dict[str, Any]:
        asked.append(("status", payload))
        return {"accepted": True, "reason": "", "phase": "idle", "vehicle": name, "missions": []}

    return Telemetry(session, name, {"status": status, "mission": mission, "model": model}, records)


def tls(keys: Keys) -> dict[str, Any]:
    """Somebody's certificate, without the rules that a decent ground station sets itself."""
    return {
        "transport/link/tls/root_ca_certificate": str(keys.path(access.AUTHORITY)),
        "transport/link/tls/enable_mtls": True,
        "transport/link/tls/verify_name_on_connect": False,
        "transport/link/tls/connect_certificate": str(keys.path(access.CERTIFICATE)),
        "transport/link/tls/connect_private_key": str(keys.path(access.PRIVATE_KEY)),
        "transport/link/tls/listen_certificate": str(keys.path(access.CERTIFICATE)),
        "transport/link/tls/listen_private_key": str(keys.path(access.PRIVATE_KEY)),
    }


@dataclass
class Open:
    """Companions without keys, each on its own port."""

    stage: Stage
    names: tuple[str, ...]
    ports: list[int] = field(default_factory=list)
    asked: list[list[tuple[str, bytes]]] = field(default_factory=list)
    running: list[Telemetry] = field(default_factory=list)

    def __enter__(self) -> Open:
        for name in self.names:
            self.ports.append(free_port())
            self.asked.append([])
            session = open_session(ZenohSettings(listen=(f"tcp/127.0.0.1:{self.ports[-1]}",)))
            self.running.append(vehicle(session, name, self.asked[-1], self.stage.folder / "records"))
        return self

    def __exit__(self, *why: object) -> None:
        for one in self.running:
            one.close()

    def settings(self, **changes: Any) -> Settings:
        """Of a ground station that is connected to all of them."""
        ends = tuple(f"tcp/127.0.0.1:{port}" for port in self.ports)
        return Settings(connect=ends, timeout=3.0, **changes)

    def missions(self) -> list[int]:
        """How many each was asked for."""
        return [sum(leaf == "mission" for leaf, _ in asked) for asked in self.asked]
