"""The ground's end of Zenoh: ask a companion, follow what it tells, fetch its records.

Keys and payloads are those of `models.contract` and of the companion's telemetry. Callbacks of subscriptions
run on Zenoh's threads and must only enqueue.

Who is there is who answers `status`, not who shows a liveliness token: anybody may show one. Each companion is known by
its Zenoh identity, and a request names the one it is for, so that no other of the same name obeys it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import zenoh
import zenoh.ext

from trueflight.groundstation.operate.settings import Settings
from trueflight.models.access import NEEDS, SIGNING_KEY, VEHICLE, Keys, read_keys, transport
from trueflight.models.contract import key
from trueflight.models.errors import InputError
from trueflight.models.record_pb2 import Event, Tick
from trueflight.models.session import (
    CONNECT,
    ENCRYPTED,
    LISTEN,
    claim,
    claims_of_settings,
    configuration,
    endpoints,
    exposed,
    protocol,
    short,
)
from trueflight.models.signature import sign
from trueflight.models.whole_file import whole_file

PIECE_TRIES = 3
ENDED = ("finished", "failed", "aborted")
"""States of a mission that is over."""
POLL, SILENCE = 0.3, 30.0
"""s between two looks at a mission, and that a link may be down meanwhile."""
_LOOK = 0.5
"""Seconds for those who are there to say so."""
CHECK_PATIENCE = 40.0
"""Seconds for the answer to a model: its check may take longer than any other request."""


class Link:
    """A session with one companion. Use as a context manager.

    Opening it connects and finds the vehicle: the one named in the settings, otherwise the only one there.
    Raises `InputError` where nothing answers, or more than one does.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._subscribers: list[Any] = []
        self.keys = read_keys(settings.keys) if settings.keys else None
        self.session, where, self.exposed = _open(settings, self.keys)
        try:
            self.vehicle, self.instance, access = _find(self.session, settings, self.keys, where)
        except InputError:
            self.session.close()
            raise
        self.warning = _warning(access, self.exposed)
        """What is open to anybody, in words; '' where nothing is."""

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
        attached: bytes | None = None,
    ) -> dict[str, Any]:
        """The companion's JSON answer; `parameters` are those of a Zenoh selector. Raises `InputError` where it is
        silent or does not answer with JSON."""
        data, _ = self._reply(leaf, request, timeout, parameters, attached)
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
        attached: bytes | None = None,
    ) -> dict[str, Any]:
        """As `ask`, but a refusal raises `InputError` with the companion's reason."""
        answer = self.ask(leaf, request, timeout, parameters, attached)
        if not answer.get("accepted", False):
            raise InputError(f"companion '{self.vehicle}' refused: {answer.get('reason', 'no reason given')}")
        return answer

    def status(self) -> dict[str, Any]:
        """What the companion is doing; one that has been started again since is taken for the same.

        Raises `InputError` where it is silent, or where several have its name by now.
        """
        there = _answers(self.session, self.vehicle, self.settings.timeout, self.instance)
        own = [one for one in there if one.instance == self.instance] or there
        if len(own) > 1:
            raise InputError(_several(self.session, self.vehicle, own))
        if not own:
            raise InputError(self._silent("status", self.settings.timeout))
        self.instance = own[0].instance
        return own[0].status

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
        """Send a model, signed with an engineer's keys; the answer's `state` is `shadow` in flight, for `shadow` s,
        `staged` on the ground, or `live` where it has proved itself in an earlier flight.

        Raises `InputError` where the companion refuses it.
        """
        parameters = f"shadow={shadow:g}" if shadow is not None else ""
        return self.request(
            "model", onnx, max(self.settings.timeout, CHECK_PATIENCE), parameters, self._signed(onnx)
        )

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

    def head_of_record(self, name: str) -> bytes:
        """The first piece of a record: what stands before its ticks is in it. Raises `InputError` as `fetch_record`."""
        return self._piece(name, 0)[0]

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
        return any(
            one.instance == self.instance for one in _answers(self.session, self.vehicle, 1.0, self.instance)
        )

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

    def _signed(self, onnx: bytes) -> bytes | None:
        """The signature that goes with a model; None without an engineer's keys."""
        if self.keys is None or not self.keys.path(SIGNING_KEY).exists():
            return None
        return sign(onnx, self.vehicle, self.keys.name, self.keys.path(SIGNING_KEY)).to_json()

    def _reply(
        self,
        leaf: str,
        request: dict[str, Any] | bytes | None,
        timeout: float | None,
        parameters: str = "",
        attached: bytes | None = None,
    ) -> tuple[bytes, dict[str, Any]]:
        if self.keys is not None and not self.keys.may(leaf):
            raise InputError(
                f"these keys ({self.keys.folder}) are {self.keys.name}'s, {self.keys.role}: '{leaf}' needs "
                f"{NEEDS.get(leaf, 'another role')}"
            )
        payload = json.dumps(request) if isinstance(request, dict) else request
        seconds = timeout if timeout is not None else self.settings.timeout
        asked = ";".join(part for part in (parameters, f"instance={self.instance}") if part)
        replies = self.session.get(
            f"{key(self.vehicle, leaf)}?{asked}",
            payload=payload,
            attachment=attached,
            timeout=seconds,
            # All are asked, the one that is meant answers; otherwise the nearest alone would be.
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        for reply in replies:
            if reply.ok is not None and _instance(reply) == self.instance:
                about = reply.ok.attachment
                return reply.ok.payload.to_bytes(), json.loads(about.to_bytes()) if about is not None else {}
        raise InputError(self._silent(leaf, seconds))

    def _silent(self, leaf: str, seconds: float) -> str:
        return (
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


@dataclass(frozen=True)
class Answer:
    """A companion that answered: its vehicle's name, its Zenoh identity, what it said."""

    vehicle: str
    instance: str
    status: dict[str, Any]


def companions(settings: Settings) -> list[str]:
    """Names of the vehicles whose companions are reachable."""
    session, _, _ = _open(settings, read_keys(settings.keys) if settings.keys else None)
    try:
        return sorted({one.vehicle for one in _answers(session, "*", settings.timeout)})
    finally:
        session.close()


def _answers(session: zenoh.Session, vehicle: str, timeout: float, until: str = "") -> list[Answer]:
    """Who answers `status`, each once; with `until` only so far as that instance."""
    found: dict[tuple[str, str], Answer] = {}
    replies = session.get(
        key(vehicle, "status"),
        timeout=timeout,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
    )
    for reply in replies:
        answer = _answer(reply)
        if answer is not None:
            found[answer.vehicle, answer.instance] = answer
            if answer.instance == until:
                break
    return sorted(found.values(), key=lambda one: (one.vehicle, one.instance))


def _answer(reply: zenoh.Reply) -> Answer | None:
    """A reply to `status` that a companion may have given; None for anything else."""
    if reply.ok is None:
        return None
    parts = str(reply.ok.key_expr).split("/")
    try:
        status = json.loads(reply.ok.payload.to_bytes())
    except (ValueError, RecursionError):
        return None
    if len(parts) != 3 or not isinstance(status, dict) or "accepted" not in status:
        return None
    return Answer(parts[1], _instance(reply), status)


def _find(
    session: zenoh.Session, settings: Settings, keys: Keys | None, where: str
) -> tuple[str, str, dict[str, Any]]:
    """Name and identity of the vehicle that is meant, and what it says of who may reach it."""
    name = settings.name
    end = time.monotonic() + settings.timeout
    while True:
        there = _answers(session, name or "*", min(_LOOK, settings.timeout))
        names = sorted({one.vehicle for one in there})
        if len(names) > 1:
            raise InputError(f"{len(names)} companions answer ({', '.join(names)}); choose one with --name")
        if len(there) > 1:
            raise InputError(_several(session, names[0], there))
        if there:
            access = there[0].status.get("access")
            return there[0].vehicle, there[0].instance, access if isinstance(access, dict) else {}
        if time.monotonic() > end:
            break
        time.sleep(0.05)
    what = f"companion '{name}'" if name else "companion"
    names = sorted({one.vehicle for one in _answers(session, "*", _LOOK)})
    others = f"; there are: {', '.join(names)}" if names else "; is it running, and listening there?"
    if keys is not None and not names:
        others = f"; is '{keys.certificate}' on its list (access.toml in the vehicle's keys)?"
    raise InputError(f"no {what} answers on {where}{others} (other endpoint: -e tcp/HOST:PORT)")


def _warning(access: dict[str, Any], exposed: Sequence[str]) -> str:
    """What is open to anybody, at the companion's end or at this one, in words; '' where nothing is."""
    ways = [f"it {way}" for way in _words(access, "exposed")] + [f"this end {way}" for way in exposed]
    if ways:
        return f"insecure, anybody on the network can fly it: {', '.join(ways)}"
    return access["loose"] if isinstance(access.get("loose"), str) else ""


def _words(table: dict[str, Any], key: str) -> list[str]:
    value = table.get(key)
    return [str(one)[:100] for one in value[:5]] if isinstance(value, list) else []


def _instance(reply: zenoh.Reply) -> str:
    return str(reply.replier_id.zid) if reply.replier_id is not None else ""


def _several(session: zenoh.Session, vehicle: str, there: Sequence[Answer]) -> str:
    """Why nothing is sent to one of several companions with one name, and what to do."""
    links = {str(link.zid): link.dst for link in session.info.links()}
    ends = [f"{links.get(one.instance, 'through a router')} (instance {one.instance[:8]})" for one in there]
    return (
        f"{len(there)} companions are named '{vehicle}': {' and '.join(ends)}; nothing is sent, for it could be "
        "the wrong one: give each its own name in its vehicle.toml, or connect to one of them alone with -e"
    )


def _open(settings: Settings, keys: Keys | None) -> tuple[zenoh.Session, str, list[str]]:
    """The session, the endpoints it is for, and how others could reach it without keys."""
    given = claims_of_settings("the setting", settings.mode, settings.connect, settings.listen, settings.cfg)
    if keys is not None:
        if keys.role == VEHICLE:
            raise InputError(f"{keys.folder}: keys of the vehicle '{keys.name}'; pass a person's folder")
        given += [claim(path, value, f"keys '{keys.folder}'") for path, value in transport(keys).items()]
    otherwise = [
        claim("scouting/multicast/enabled", False, ""),
        claim(LISTEN, [], ""),
        claim("connect/timeout_ms", round(1000 * settings.timeout), ""),
        claim("connect/exit_on_failure", True, ""),
    ]
    if not settings.listen:
        otherwise.append(claim(CONNECT, [settings.default_connect], ""))
    config = configuration(settings.zenoh_config, given, otherwise)
    ends = [*endpoints(config, CONNECT), *endpoints(config, LISTEN)]
    where = ", ".join(ends) or "Zenoh"
    if keys is not None:
        if endpoints(config, LISTEN):
            raise InputError(
                f"listening on {endpoints(config, LISTEN)[0]} contradicts the keys in {keys.folder}: with keys the "
                "companion listens, and the ground connects (-e tls/VEHICLE:7447)"
            )
        for end in ends:
            if protocol(end) not in ENCRYPTED:
                raise InputError(
                    f"{end} is not encrypted, which contradicts the keys in {keys.folder}: write "
                    f"tls/{end.partition('/')[2]}, or leave the keys out"
                )
    try:
        return zenoh.open(config), where, exposed(config) if keys is None else []
    except zenoh.ZError as error:
        raise InputError(_nobody(where, error, keys)) from None


def _nobody(where: str, error: Exception, keys: Keys | None) -> str:
    told = short(error)
    if keys is not None:
        advice = (
            "start the companion there with the keys of one authority, and see that neither's have run out "
            f"({keys.path('cert.pem')})"
        )
    else:
        advice = "start the companion, or pass its endpoint with -e (one that has keys wants --keys FOLDER and tls/...)"
    if ", " in where:  # all must be there: the one that is missing may be the one that is meant
        return f"not all of {where} answer ({told}); leave out what is switched off, or {advice}"
    return f"nobody answers on {where} ({told}); {advice}"
