"""The companion on Zenoh: ticks and events out, missions, models and records on request.

Keys are `models.contract.key(vehicle, leaf)`:

* `tick`: serialised `Tick`, every control tick; dropped rather than waited for, the last ones kept for late
joiners. * `event`: serialised `Event`; reliable, the last ones kept. * `status`: a liveliness token, and a
query answered with JSON. * `mission`: query with JSON `{"trajectory", "parameters", "controller", "repeat"}`
or `{"setpoints": CSV, ...}` or `{"command": "abort" | "land"}`. * `model`: query with the bytes of an ONNX
file (`model?shadow=SECONDS`: how long to evaluate it in flight before it is applied), or JSON `{"command": "list"
| "rollback"}`. * `record`: query with JSON `{}` for the list, or `{"name",
"offset", "length"}` for a piece of one record: its bytes as `application/octet-stream`, with JSON `{"size",
"offset"}` attached; ask on until `offset` reaches `size`. * `pose`: subscribed, see `models.pose`.

A request may name whom it is for (`?instance=ZENOH_ID`, as the answer to `status` comes from): another companion of the
same name then stays silent. A model's signature (`models.signature`) is the attachment of its query.

Every other answer is JSON with `accepted` and `reason`. Zenoh's callbacks only look at sizes and enqueue: what
is larger than `models.contract.REQUEST_BYTES` is refused without being copied or parsed, and so is what would
make too many bytes wait; beyond `zenoh_session.MOST_BYTES` Zenoh itself lets it fall. Nothing that arrives ends
a thread. The control thread never calls Zenoh: it hands serialised ticks to a publishing thread through a
bounded queue and goes on. What takes long (the check of a model, long missions, pieces of a record) has a
thread of its own, so that an order to land never waits for it.
"""

from __future__ import annotations

import contextlib
import json
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh
import zenoh.ext

from trueflight.companion.mission_request import SMALL, read_json
from trueflight.models import contract
from trueflight.models.errors import InputError, shown
from trueflight.models.record_pb2 import Event

TICKS_KEPT, EVENTS_KEPT = 1000, 200
REQUESTS_WAITING = 64
BYTES_WAITING = 8 << 20
"""Bytes of all requests that wait, together."""
PIECE = 1 << 20
"""Greatest number of bytes of a record in one answer."""

_SLOW = ("model", "record")
INSTANCE = "instance"
"""Parameter of a selector: the Zenoh identity of the one companion that is meant."""
ATTACHED = "attachment"
"""The parameter that a handler finds what was attached to the query in, as text."""
_FAR = 1 << 53

Handler = Callable[[bytes, dict[str, str]], dict[str, Any]]
"""From a request's payload and the parameters of its selector to the answer."""

_JSON, _BYTES, _PROTOBUF = "application/json", "application/octet-stream", "application/protobuf"


class Telemetry:
    """Publishes and answers for one vehicle; handlers run on two service threads, quick ones and slow ones.

    `handlers` maps the leaves `status`, `mission` and `model` to their handlers. `records` is the folder that
    `record` serves from.
    """

    def __init__(
        self,
        session: zenoh.Session,
        vehicle: str,
        handlers: dict[str, Handler],
        records: Path,
    ) -> None:
        self.ticks_dropped = 0
        self.refused = 0
        """Requests and messages refused by their size, or because too many were waiting."""
        self.troubles = 0
        """Times that a thread here met what it did not expect, and went on."""
        self._session, self._records, self._vehicle = session, records, vehicle
        self._subscribers: list[zenoh.Subscriber[Any]] = []
        self._handlers = {"record": self._record, **handlers}
        self._instance = str(session.info.zid())
        self._quick: queue.Queue[_Waiting | None] = queue.Queue(REQUESTS_WAITING)
        self._slow: queue.Queue[_Waiting | None] = queue.Queue(REQUESTS_WAITING)
        self._bytes_waiting = 0
        self._counting = threading.Lock()
        self._ticks: deque[bytes] = deque()
        self._events: deque[bytes] = deque()
        self._wake = threading.Event()
        self._closing = False
        self._tick_publisher = zenoh.ext.declare_advanced_publisher(
            session,
            contract.key(vehicle, "tick"),
            encoding=_PROTOBUF,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_LOW,
            cache=zenoh.ext.CacheConfig(max_samples=TICKS_KEPT),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            publisher_detection=True,
        )
        self._event_publisher = zenoh.ext.declare_advanced_publisher(
            session,
            contract.key(vehicle, "event"),
            encoding=_PROTOBUF,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            cache=zenoh.ext.CacheConfig(max_samples=EVENTS_KEPT),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            publisher_detection=True,
        )
        self._queryables = [
            session.declare_queryable(contract.key(vehicle, leaf), self._enqueuer(leaf), complete=True)
            for leaf in self._handlers
        ]
        self._token = session.liveliness().declare_token(contract.key(vehicle, "status"))
        self._threads = [
            threading.Thread(target=self._publish, name="zenoh-publisher", daemon=True),
            threading.Thread(target=self._serve, args=(self._quick,), name="zenoh-service", daemon=True),
            threading.Thread(target=self._serve, args=(self._slow,), name="zenoh-slow-service", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def tick(self, data: bytes) -> None:
        """Hand over a serialised tick; the control thread's only touch with this class."""
        if len(self._ticks) < TICKS_KEPT:
            self._ticks.append(data)
        else:
            self.ticks_dropped += 1
        self._wake.set()

    def event(self, event: Event) -> None:
        """Hand over an event; any thread."""
        self._events.append(event.SerializeToString())
        self._wake.set()

    def subscribe(self, leaf: str, take: Callable[[bytes], None], refuse: Callable[[str], None]) -> None:
        """Call `take` with each payload published on `leaf`, or `refuse` with the reason where it is too large.

        Both are called on Zenoh's thread, so they must only enqueue.
        """

        def arrived(sample: zenoh.Sample) -> None:
            reason = contract.too_large(leaf, len(sample.payload))
            if reason:
                self.refused += 1
                refuse(reason)
            else:
                take(sample.payload.to_bytes())

        self._subscribers.append(self._session.declare_subscriber(contract.key(self._vehicle, leaf), arrived))

    def close(self) -> None:
        """Publish what waits, say good-bye and close the session."""
        self._closing = True
        self._wake.set()
        for requests in (self._quick, self._slow):
            with contextlib.suppress(queue.Full):
                requests.put(None, timeout=1.0)
        for thread in self._threads:
            thread.join(2.0)
        self._token.undeclare()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        for queryable in self._queryables:
            queryable.undeclare()
        self._session.close()

    def _publish(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            for waiting, publisher in (
                (self._events, self._event_publisher),
                (self._ticks, self._tick_publisher),
            ):
                while waiting:
                    data = waiting.popleft()
                    try:
                        publisher.put(data)
                    except Exception:  # noqa: BLE001 - a link that breaks in this moment must not end the telemetry
                        self.troubles += 1
            if self._closing:
                return

    def _enqueuer(self, leaf: str) -> Callable[[zenoh.Query], None]:
        def enqueue(query: zenoh.Query) -> None:
            size = len(query.payload) if query.payload is not None else 0
            attached = len(query.attachment) if query.attachment is not None else 0
            reason = contract.too_large(leaf, size)
            if attached > contract.ATTACHED_BYTES:
                reason = f"{attached} bytes attached; at most {contract.ATTACHED_BYTES} are accepted"
            if len(str(query.parameters)) > contract.SELECTOR_CHARACTERS:
                reason = f"a selector of more than {contract.SELECTOR_CHARACTERS} characters"
            elif _parameters(query).get(INSTANCE, self._instance) != self._instance:
                query.drop()  # for another companion of this name
                return
            reason = reason or self._wait_for_turn(_Waiting(leaf, query, size + attached))
            if reason:
                self.refused += 1
                with contextlib.suppress(Exception):  # the one who asked may be gone
                    self._answer(leaf, query, {"accepted": False, "reason": reason})
                query.drop()

        return enqueue

    def _wait_for_turn(self, request: _Waiting) -> str:
        """'' where the request waits now, otherwise why it may not."""
        long = request.leaf in _SLOW or request.size > SMALL
        full = "too many requests are waiting; ask again"
        with self._counting:
            if self._bytes_waiting + request.size > BYTES_WAITING:
                return full
            self._bytes_waiting += request.size
        try:
            (self._slow if long else self._quick).put_nowait(request)
        except queue.Full:
            self._done_waiting(request)
            return full
        return ""

    def _done_waiting(self, request: _Waiting) -> None:
        with self._counting:
            self._bytes_waiting -= request.size

    def _serve(self, requests: queue.Queue[_Waiting | None]) -> None:
        while (request := requests.get()) is not None:
            try:
                with request.query as query:
                    self._answer(request.leaf, query, self._answer_to(request.leaf, query))
            except Exception:  # noqa: BLE001 - who asked is gone, or cannot be answered: the next one can
                self.troubles += 1
            finally:
                self._done_waiting(request)
                del request  # its payload need not wait for the next one

    def _answer_to(self, leaf: str, query: zenoh.Query) -> dict[str, Any]:
        try:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            parameters = _parameters(query)
            parameters.pop(INSTANCE, None)
            parameters.pop(ATTACHED, None)
            if query.attachment is not None:
                parameters[ATTACHED] = query.attachment.to_bytes().decode("utf-8", "replace")
            return self._handlers[leaf](payload, parameters)
        except InputError as error:
            return {"accepted": False, "reason": str(error)}
        except Exception as error:  # noqa: BLE001 - one bad request must not end the service
            self.troubles += 1
            text = f"internal error: {type(error).__name__}: {str(error)[:200]}"
            return {"accepted": False, "reason": text}

    def _answer(self, leaf: str, query: zenoh.Query, answer: dict[str, Any]) -> None:
        """Reply under the own key: whoever asked `trueflight/*/status` wants to know who answers."""
        key = contract.key(self._vehicle, leaf)
        if "bytes" in answer:
            attached = json.dumps({"size": answer["size"], "offset": answer["offset"]})
            query.reply(key, answer["bytes"], encoding=_BYTES, attachment=attached)
        else:
            query.reply(key, json.dumps(answer), encoding=_JSON)

    def _record(self, payload: bytes, parameters: dict[str, str]) -> dict[str, Any]:
        request = read_json(payload)
        if "name" not in request:
            return {"accepted": True, "reason": "", "records": list_records(self._records)}
        name, offset, length = request["name"], request.get("offset", 0), request.get("length", PIECE)
        if (
            type(offset) is not int
            or type(length) is not int
            or not 0 <= offset < _FAR
            or not 1 <= length < _FAR
        ):
            return {"accepted": False, "reason": "'offset' and 'length' must be whole numbers"}
        if name not in [entry["name"] for entry in list_records(self._records)]:
            return {"accepted": False, "reason": f"no record {shown(name)}; ask for the list"}
        try:
            with (self._records / name).open("rb") as file:
                size = file.seek(0, 2)
                file.seek(min(offset, size))
                return {"bytes": file.read(min(length, PIECE)), "size": size, "offset": offset}
        except OSError as error:
            return {"accepted": False, "reason": f"cannot read record '{name}' ({error.strerror})"}


@dataclass(frozen=True)
class _Waiting:
    """A request that waits for its turn; `size` bytes of payload."""

    leaf: str
    query: zenoh.Query
    size: int


def list_records(folder: Path) -> list[dict[str, Any]]:
    """Records on board, oldest first: name, size in bytes, time of the last write (s since 1970)."""
    found = []
    for path in sorted(folder.glob("*.mcap")):
        try:
            stat = path.stat()
        except OSError:  # taken away in this moment
            continue
        found.append({"name": path.name, "size": stat.st_size, "time": round(stat.st_mtime, 3)})
    return found


def make_event(level: str, kind: str, text: str, vehicle_time_us: int = 0) -> Event:
    """An event of now; `level` is info, warning or error."""
    return Event(
        vehicle_time_us=vehicle_time_us, host_time_ns=time.monotonic_ns(), level=level, kind=kind, text=text
    )


def _parameters(query: zenoh.Query) -> dict[str, str]:
    return dict(query.parameters)  # type: ignore[call-overload]
