"""The ground's end of Zenoh: ask a companion, follow what it tells, fetch its records.

Keys and payloads are those of `models.contract` and of the companion's telemetry. Callbacks of subscriptions
run on Zenoh's threads and must only enqueue.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import zenoh
import zenoh.ext

from groundstation.settings import Settings
from models.contract import key
from models.errors import InputError
from models.record_pb2 import Event, Tick
from models.whole_file import whole_file

PIECE_TRIES = 3
ENDED = ("finished", "failed", "aborted")
"""States of a mission that is over."""
POLL, SILENCE = 0.3, 30.0
"""s between two looks at a mission, and that a link may be down meanwhile."""
CHECK_PATIENCE = 40.0
"""Seconds for the answer to a model: its check may take longer than any other request."""


class Link:
    """A session with one companion. Use as a context manager.

    Opening it connects and finds the vehicle: the one named in the settings, otherwise the only one there.
    Raises `InputError` where nothing answers, or more than one does.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._where = ", ".join(settings.connect) or settings.zenoh_config or "Zenoh"
        self._subscribers: list[Any] = []
        self.session = _open(settings, self._where)
        try:
            self.vehicle = self._find(settings.name)
        except InputError:
            self.session.close()
            raise

    def __enter__(self) -> Link:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End subscriptions and the session."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._subscribers.clear()
        self.session.close()

    def ask(
        self,
        leaf: str,
        request: dict[str, Any] | bytes | None = None,
        timeout: float | None = None,
        parameters: str = "",
    ) -> dict[str, Any]:
        """The companion's JSON answer; `parameters` are those of a Zenoh selector. Raises `InputError` where it is
        silent or does not answer with JSON."""
        data, _ = self._reply(leaf, request, timeout, parameters)
        try:
            answer = json.loads(data)
        except ValueError:
            answer = None
        if not isinstance(answer, dict):
            raise InputError(
                f"companion '{self.vehicle}': its answer to '{leaf}' is no JSON; do both run one version?"
            )
        return answer

    def request(
        self,
        leaf: str,
        request: dict[str, Any] | bytes,
        timeout: float | None = None,
        parameters: str = "",
    ) -> dict[str, Any]:
        """As `ask`, but a refusal raises `InputError` with the companion's reason."""
        answer = self.ask(leaf, request, timeout, parameters)
        if not answer.get("accepted", False):
            raise InputError(f"companion '{self.vehicle}' refused: {answer.get('reason', 'no reason given')}")
        return answer

    def status(self) -> dict[str, Any]:
        """What the companion is doing."""
        return self.ask("status")

    def end_of(
        self,
        mission: str,
        tell: Callable[[dict[str, Any], dict[str, Any]], None] = lambda status, entry: None,
        idle: bool = False,
    ) -> dict[str, Any]:
        """The companion's entry of a mission once it has ended (and, with `idle`, once the next one can follow).

        `tell` gets status and entry at every look before that. The link may drop for a while in flight: the flight
        goes on without it. Raises `InputError` where it stays down, or the companion forgot the mission.
        """
        silent_since: float | None = None
        while True:
            try:
                status = self.status()
                silent_since = None
            except InputError:
                silent_since = silent_since or time.monotonic()
                if time.monotonic() - silent_since > SILENCE:
                    raise
                continue
            entry = next((m for m in status["missions"] if m["mission"] == mission), None)
            if entry is None:
                raise InputError(
                    f"companion '{self.vehicle}' knows nothing of mission {mission} any more; did it restart? Its "
                    "records are still on board"
                )
            if entry["state"] in ENDED and not (idle and status["phase"] != "idle"):
                return dict(entry)
            tell(status, entry)
            time.sleep(POLL)

    def deploy(self, onnx: bytes, shadow: float | None = None) -> dict[str, Any]:
        """Send a model; the answer's `state` is `live`, or `shadow` in flight, there for `shadow` s.

        Raises `InputError` where the companion refuses it.
        """
        parameters = f"shadow={shadow:g}" if shadow is not None else ""
        return self.request("model", onnx, max(self.settings.timeout, CHECK_PATIENCE), parameters)

    def roll_back(self) -> dict[str, Any]:
        """Withdraw the model in the shadow; without one, go back to the model before the live one."""
        return self.request("model", {"command": "rollback"}, max(self.settings.timeout, CHECK_PATIENCE))

    def records(self) -> list[dict[str, Any]]:
        """Flight records on board, oldest first: name, size in bytes, time."""
        return list(self.request("record", {})["records"])

    def fetch_record(
        self, name: str, folder: Path, progress: Callable[[int, int], None] = lambda done, size: None
    ) -> Path:
        """Copy a record into `folder`, piece by piece; it appears there only when whole.

        Raises `InputError` where the companion does not have it or the copy does not arrive.
        """
        if Path(name).name != name:
            raise InputError(f"record name '{name}' is not a file name; take one of the list")
        target = folder / name
        offset, size = 0, 1
        with whole_file(target, "the record", "choose another folder") as partial, partial.open("wb") as file:
            while offset < size:
                piece, size = self._piece(name, offset)
                file.write(piece)
                offset += len(piece)
                progress(offset, size)
                if not piece and offset < size:
                    raise InputError(
                        f"record '{name}': the companion sends nothing after {offset} bytes; ask again"
                    )
            file.flush()
        return target

    def follow(
        self,
        on_tick: Callable[[Tick], None] | None = None,
        on_event: Callable[[Event], None] | None = None,
        history: int = 0,
    ) -> None:
        """Subscribe: ticks, with the last `history` of them that the companion keeps, and events from now
        on."""
        if on_tick is not None:
            self._subscribe("tick", lambda data: on_tick(Tick.FromString(data)), history)
        if on_event is not None:
            self._subscribe("event", lambda data: on_event(Event.FromString(data)), 0)

    def alive(self) -> bool:
        """Whether the companion is there now."""
        return self.vehicle in _alive(self.session, 1.0)

    def _subscribe(self, leaf: str, on_data: Callable[[bytes], None], history: int) -> None:
        kept = zenoh.ext.HistoryConfig(max_samples=history, detect_late_publishers=True) if history else None
        self._subscribers.append(
            zenoh.ext.declare_advanced_subscriber(
                self.session,
                key(self.vehicle, leaf),
                lambda sample: on_data(sample.payload.to_bytes()),
                history=kept,
                recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
            )
        )

    def _find(self, name: str) -> str:
        end = time.monotonic() + self.settings.timeout
        while True:
            there = _alive(self.session, 0.5)
            if name in there:
                return name
            if not name and len(there) == 1:
                return there[0]
            if not name and len(there) > 1:
                raise InputError(
                    f"{len(there)} companions answer ({', '.join(there)}); choose one with --name"
                )
            if time.monotonic() > end:
                break
            time.sleep(0.05)
        what = f"companion '{name}'" if name else "companion"
        others = f"; there are: {', '.join(there)}" if there else "; is it running, and listening there?"
        raise InputError(f"no {what} answers on {self._where}{others} (other endpoint: -e tcp/HOST:PORT)")

    def _reply(
        self,
        leaf: str,
        request: dict[str, Any] | bytes | None,
        timeout: float | None,
        parameters: str = "",
    ) -> tuple[bytes, dict[str, Any]]:
        payload = json.dumps(request) if isinstance(request, dict) else request
        seconds = timeout if timeout is not None else self.settings.timeout
        selector = key(self.vehicle, leaf) + (f"?{parameters}" if parameters else "")
        replies = self.session.get(selector, payload=payload, timeout=seconds)
        for reply in replies:
            if reply.ok is not None:
                attached = reply.ok.attachment
                return reply.ok.payload.to_bytes(), json.loads(
                    attached.to_bytes()
                ) if attached is not None else {}
        raise InputError(
            f"companion '{self.vehicle}' does not answer '{leaf}' within {seconds:g} s; is the link up? "
            "(`groundstation status`)"
        )

    def _piece(self, name: str, offset: int) -> tuple[bytes, int]:
        for attempt in range(PIECE_TRIES):
            try:
                data, about = self._reply("record", {"name": name, "offset": offset}, None)
            except InputError:
                if attempt == PIECE_TRIES - 1:
                    raise
                continue
            if "size" in about:
                return data, int(about["size"])
            answer = json.loads(data)
            raise InputError(f"companion '{self.vehicle}' refused: {answer.get('reason', 'no reason given')}")
        raise AssertionError("unreachable")


def companions(settings: Settings) -> list[str]:
    """Names of the vehicles whose companions are reachable."""
    session = _open(settings, ", ".join(settings.connect))
    try:
        return _alive(session, settings.timeout)
    finally:
        session.close()


def _alive(session: zenoh.Session, timeout: float) -> list[str]:
    found = set()
    for reply in session.liveliness().get(key("*", "status"), timeout=timeout):
        if reply.ok is not None:
            found.add(str(reply.ok.key_expr).split("/")[1])
    return sorted(found)


def _open(settings: Settings, where: str) -> zenoh.Session:
    if settings.zenoh_config:
        try:
            config = zenoh.Config.from_file(settings.zenoh_config)
        except zenoh.ZError as error:
            raise InputError(
                f"{settings.zenoh_config}: not a Zenoh configuration ({_short(error)})"
            ) from None
    else:
        config = zenoh.Config()
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("connect/timeout_ms", str(round(1000 * settings.timeout)))
        config.insert_json5("connect/exit_on_failure", "true")
    pairs = [("mode", json.dumps(settings.mode))] if not settings.zenoh_config else []
    if settings.connect and not settings.zenoh_config:
        pairs.append(("connect/endpoints", json.dumps(list(settings.connect))))
    if settings.listen or not settings.zenoh_config:
        pairs.append(("listen/endpoints", json.dumps(list(settings.listen))))
    for pair in settings.cfg:
        name, colon, value = pair.partition(":")
        if not colon:
            raise InputError(f"--cfg '{pair}': write KEY:VALUE, such as transport/link/tx/queue/size/data:4")
        pairs.append((name.strip(), value.strip()))
    for name, value in pairs:
        try:
            config.insert_json5(name, value)
        except zenoh.ZError as error:
            raise InputError(
                f"Zenoh does not take {name} = {value} ({_short(error)}); correct the flag"
            ) from None
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise InputError(
            f"nobody answers on {where} ({_short(error)}); start the companion, or pass its endpoint with -e"
        ) from None


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:160]
