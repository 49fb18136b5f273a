"""The flight record: one MCAP file per flight, appended while flying and readable after a power cut.

Messages are the protobuf `Tick` and `Event` of `record.proto`, with their schema in the file, so that Rerun
and Foxglove open it. The vehicle file and the design travel as attachments at its beginning. Format: MCAP
specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import contextlib
import io
import os
import queue
import struct
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, InvalidMagic
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from trueflight.models.design import Design, design_from_json, design_to_json
from trueflight.models.errors import InputError
from trueflight.models.mcap_records import mcap_records, parts
from trueflight.models.outside import toml_table, unreadable
from trueflight.models.record_columns import TickColumns
from trueflight.models.record_pb2 import DESCRIPTOR, Event, Tick
from trueflight.models.vehicle import Vehicle, vehicle_from_table

TICK_TOPIC, EVENT_TOPIC = "/tick", "/event"
CHUNK_BYTES = 16 * 1024
"""A chunk holds about 40 ticks, so that a cut loses 0.4 s at 100 Hz and less at higher rates."""
SYNC_PERIOD = 0.5
"""Seconds between two times that what was written is forced to the disk."""


class FlightRecorder:
    """Writes one flight record from a thread of its own; the caller never waits for the disk.

    `tick` and `event` only enqueue serialised messages. When the queue is full the message is dropped and
    counted; the count stands in the file's metadata `end` and in an event. A recorder that was never closed
    (a power cut, SIGKILL) leaves a readable file that misses at most the last chunk.

    `metadata` is free text by key, written at the beginning. `queue_limit` is the greatest number of messages
    that wait for the disk. A `simulated` flight has no wall clock: nothing in its file depends on when and how
    fast it was written. Raises `InputError` where the file cannot be made.
    """

    def __init__(
        self,
        path: str | Path,
        vehicle: Vehicle,
        design: Design | None = None,
        metadata: dict[str, str] | None = None,
        queue_limit: int = 4096,
        simulated: bool = False,
    ) -> None:
        self.path = Path(path)
        self.dropped = 0
        self.error = ""
        """Why nothing more is written, empty while all is well; whoever flies tells it at once."""
        self.rescued = False
        """Whether the file was taken away in flight and has been written anew."""
        self._queue: queue.Queue[tuple[int, int, int, bytes] | None] = queue.Queue(queue_limit)
        now = 0 if simulated else time.time_ns()
        self._epoch = 0 if simulated else now - time.monotonic_ns()
        self._sequence = [0, 0]
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._disk = _Disk(self.path)
        except OSError as error:
            raise InputError(f"{path}: cannot write the flight record ({error.strerror})") from None
        try:
            self._begin(vehicle, design, metadata or {}, now, simulated)
        except OSError as error:
            self._disk.give_up()
            with contextlib.suppress(OSError):
                self.path.unlink()  # a beginning without a flight is of no use to anybody
            raise InputError(f"{path}: cannot write the flight record ({error.strerror})") from None
        self._thread = threading.Thread(target=self._write, name="flight-recorder", daemon=True)
        self._thread.start()

    def _begin(
        self, vehicle: Vehicle, design: Design | None, metadata: dict[str, str], now: int, simulated: bool
    ) -> None:
        """What stands before the first tick; forced to the disk, so that a full one is seen before the flight."""
        created = {} if simulated else {"created_ns": str(now)}
        self._writer, self._channels = begin_record(self._disk, vehicle, design, {**created, **metadata}, now)
        self._disk.sync()

    def tick(self, tick: Tick | bytes, vehicle_time_us: int, host_time_ns: int) -> None:
        """Enqueue a `tick` (message, or its serialised bytes where the caller has them already), of `vehicle_time_us`
        on the vehicle's clock (us) and `host_time_ns` on the computer's (ns)."""
        self._put(
            0, vehicle_time_us, host_time_ns, tick if isinstance(tick, bytes) else tick.SerializeToString()
        )

    def event(self, event: Event) -> None:
        """Enqueue an event."""
        self._put(1, event.vehicle_time_us, event.host_time_ns, event.SerializeToString())

    def close(self, timeout: float = 10.0) -> None:
        """Write what is queued and the index, and close the file, within `timeout` s. Idempotent."""
        if self._thread.is_alive():
            with contextlib.suppress(queue.Full):  # its thread gave up in this moment
                self._queue.put(None, timeout=timeout)
            self._thread.join(timeout)

    def __enter__(self) -> FlightRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _put(self, channel: int, vehicle_time_us: int, host_time_ns: int, data: bytes) -> None:
        try:
            self._queue.put_nowait((channel, vehicle_time_us * 1000, host_time_ns, data))
        except queue.Full:
            self.dropped += 1

    def _write(self) -> None:
        synced, unsynced = time.monotonic(), False
        while True:
            try:
                item = self._queue.get(timeout=SYNC_PERIOD)
            except queue.Empty:
                item = ()  # type: ignore[assignment]
            try:
                if item is None:
                    self._finish()
                    return
                if item:
                    self._append(*item)
                    unsynced = True
                if time.monotonic() - synced >= SYNC_PERIOD:
                    self.rescued = self._disk.still_there() or self.rescued
                    if unsynced:
                        self._disk.sync()
                    synced, unsynced = time.monotonic(), False
            except OSError as error:  # a full disk must not stop a flight; it is told instead
                self._stop(error.strerror or str(error))
                return
            except Exception as error:  # noqa: BLE001 - nor may anything else end the record without a word
                self._stop(f"{type(error).__name__}: {error}")
                return

    def _stop(self, why: str) -> None:
        self.error = f"{self.path}: {why}"
        self._disk.give_up()

    def _append(self, channel: int, log_time: int, host_time: int, data: bytes) -> None:
        self._sequence[channel] += 1
        # log_time is the vehicle's clock (in simulation faster than the wall), publish_time the wall's.
        self._writer.add_message(
            self._channels[channel], log_time, data, host_time + self._epoch, self._sequence[channel]
        )

    def _finish(self) -> None:
        end_record(self._writer, self._sequence[0], self._sequence[1], self.dropped)
        self._disk.still_there()
        self._disk.sync()
        self._disk.give_up()


def begin_record(
    stream: Any, vehicle: Vehicle, design: Design | None, metadata: dict[str, str], now: int
) -> tuple[Writer, list[int]]:
    """What stands in a record before the first tick, written to a binary `stream`; `now` in ns since 1970, 0 for a
    simulated flight. Returns the writer, and its channels of ticks and of events."""
    writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
    writer.start(profile="trueflight", library="trueflight")
    schemas = FileDescriptorSet()
    DESCRIPTOR.CopyToProto(schemas.file.add())
    channels = []
    for topic, kind in ((TICK_TOPIC, Tick), (EVENT_TOPIC, Event)):
        name = kind.DESCRIPTOR.full_name
        schema = writer.register_schema(name, "protobuf", schemas.SerializeToString())
        channels.append(writer.register_channel(topic, "protobuf", schema))
    writer.add_metadata("flight", {"vehicle": vehicle.name, **metadata})
    attached = [("vehicle.toml", "application/toml", vehicle_to_toml(vehicle))]
    if design is not None:
        attached.append(("design.json", "application/json", design_to_json(design)))
    for name, kind_of_text, text in attached:
        writer.add_attachment(now, now, name, kind_of_text, text.encode())
    return writer, channels


def end_record(writer: Writer, ticks: int, events: int, dropped: int) -> None:
    """What stands in a record behind the last tick: how many `ticks` and `events` there are, how many were `dropped`,
    and the index."""
    counts = {"dropped": dropped, "ticks": ticks, "events": events}
    writer.add_metadata("end", {key: str(value) for key, value in counts.items()})
    writer.finish()


class _Disk:
    """The record's file: what is written is whole or not there, and comes back where somebody takes the file away.

    Raises `OSError` as the system does.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._size = 0

    def write(self, data: bytes) -> int:
        """All of `data`, or what was there before and an error: a reader finds no torn record."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self._size)
            raise
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Bytes written."""
        return self._size

    def flush(self) -> None:
        """Nothing is held back here."""

    def sync(self) -> None:
        """Force what was written to the disk."""
        os.fdatasync(self._descriptor)

    def still_there(self) -> bool:
        """Look whether the name still leads to this file; where not, write all of it anew. Whether that was so."""
        here = os.fstat(self._descriptor)
        try:
            there = os.stat(self._path)
            if (there.st_dev, there.st_ino) == (here.st_dev, here.st_ino):
                return False
        except OSError:
            pass
        self._path.parent.mkdir(parents=True, exist_ok=True)
        anew = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        old, self._descriptor = self._descriptor, anew
        size, self._size = self._size, 0
        try:
            while self._size < size:
                self.write(os.pread(old, min(1 << 20, size - self._size), self._size))
        finally:
            os.close(old)
        return True

    def give_up(self) -> None:
        """Close the file as it is."""
        with contextlib.suppress(OSError):
            os.close(self._descriptor)


def vehicle_to_toml(vehicle: Vehicle) -> str:
    """The text of a vehicle file that loads to an equal `Vehicle`."""
    lines = []
    for name in Vehicle.__dataclass_fields__:
        value = getattr(vehicle, name)
        if name == "source":
            continue
        if isinstance(value, str):
            lines.append(f'{name} = "{value}"')
        else:
            lines.append(f"{name} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(x) for x in value) + "]"
    return repr(value)


@dataclass(frozen=True)
class FlightRecord:
    """A flight record as read.

    `ticks` maps column names to arrays (N,) or (N, k): those of `models.flight.COLUMNS` plus `t` (s of the
    vehicle's clock since the first tick), `vehicle_time` and `host_time` (s), `feedback_thrust` (N),
    `feedback_body_rate` (rad/s), `correction`, `trim`, `correction_raw` (m/s², heading frame), `interval`, `latency`,
    `age`, `inference` (s), `overtaken` (odometry messages), `setpoint_sent`, `armed` (bool) and the words `model`,
    `controller`, `flight_mode`, `phase`, `guard`, `trajectory`, `shadow` (hash of a model evaluated but not applied),
    with `shadow_raw` (m/s², heading frame) for what that returned; of a model that learns in flight `learning` (what it
    does now), `learnt_names` (with blanks between) and `learnt`, `learnt_deviation`, `learnt_acting` (N, 8) in that
    order. What was never known is absent; what is missing in a
    tick is NaN.
    `truncated` tells that the file has no proper end, `notes` what that and any drops mean.
    """

    path: str
    ticks: dict[str, np.ndarray]
    events: tuple[Event, ...]
    metadata: dict[str, str] = field(default_factory=dict)
    vehicle: Vehicle | None = None
    design: Design | None = None
    truncated: bool = False
    notes: tuple[str, ...] = ()


def read_record(path: str | Path, ticks: bool = True) -> FlightRecord:
    """Read a flight record, also one that a power cut left without its end; without its `ticks` and events where only
    what stands before and behind them is asked for.

    Raises `InputError` for a file that cannot be read, is no MCAP, or holds no tick.
    """
    path = Path(path)
    with unreadable(path, "the flight record", _OURS), path.open("rb") as stream:
        into = TickColumns(os.fstat(stream.fileno()).st_size)
        raw = _Raw(into)
        end = _read_all(stream, raw, ticks)
    if end == _NO_MCAP:
        raise InputError(f"{path}: {end}; {_OURS}")
    if ticks and not raw.ticks.count:
        what = "other topics only" if raw.foreign else "no tick"
        raise InputError(f"{path}: holds {what}{'' if end is None else f' ({end})'}; nothing was flown in it")
    notes = []
    if end is not None:
        recovered = f"; {raw.ticks.count} ticks were recovered" if ticks else ""
        notes.append(f"the file is not whole ({end}){recovered}")
    if (dropped := raw.metadata.get("dropped", "0")) != "0":
        notes.append(f"{dropped[:20]} messages were dropped while recording: the disk was too slow")
    vehicle = design = None
    if "vehicle.toml" in raw.attachments:
        where = f"{path}:vehicle.toml"
        try:
            vehicle = vehicle_from_table(
                toml_table(_text(raw.attachments["vehicle.toml"], where), where), where
            )
        except InputError as error:
            notes.append(f"its vehicle file is damaged: {error}")
    if "design.json" in raw.attachments:
        where = f"{path}:design.json"
        try:
            design = design_from_json(_text(raw.attachments["design.json"], where), where)
        except InputError as error:
            notes.append(f"its design file is damaged: {error}")
    with unreadable(path, "the flight record", _OURS):
        columns = into.columns() if ticks else {}
    return FlightRecord(
        str(path), columns, tuple(raw.events), raw.metadata, vehicle, design, end is not None, tuple(notes)
    )  # fmt: skip


def read_messages(path: str | Path) -> tuple[list[Tick], list[Event]]:
    """Ticks and events of a flight record as they were sent, also of one that still grows or was cut short.

    Raises `InputError` for a file that cannot be read, is no MCAP, or holds no tick.
    """
    path = Path(path)
    with unreadable(path, "the flight record", _OURS), path.open("rb") as stream:
        kept = _Kept()
        raw = _Raw(kept)
        end = _read_all(stream, raw, True)
        ticks = [Tick.FromString(data) for data in kept.messages]
    if not ticks:
        raise InputError(f"{path}: holds no tick{'' if end is None else f' ({end})'}; {_OURS}")
    return ticks, raw.events


class _Kept:
    """Ticks as they stand in a record, in place of their columns."""

    def __init__(self) -> None:
        self.messages: list[bytes] = []

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.messages)

    def add(self, data: bytes, spans: list[tuple[int, int]]) -> None:
        """Take ticks, from a first to before a last byte of `data` each."""
        self.messages += [data[start:stop] for start, stop in spans]

    def settle(self) -> None:
        """Nothing waits here."""


_OURS = "give a record written by `companion`"
_NO_MCAP = "not an MCAP file"


def _text(attachment: bytes, where: str) -> str:
    try:
        return attachment.decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{where}: not text") from None


@dataclass
class _Raw:
    ticks: TickColumns | _Kept
    events: list[Event] = field(default_factory=list)
    metadata: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    foreign: bool = False


def _read_all(stream: BinaryIO, raw: _Raw, ticks: bool) -> str | None:
    """Collect every record; returns None for a proper end, otherwise how the file ended."""
    damaged: list[str] = []
    end = _collect(stream, raw, damaged, ticks)
    try:
        raw.ticks.settle()
    except Exception as error:  # noqa: BLE001 - of a damaged file every library raises its own kind
        return f"damaged after {raw.ticks.count} ticks: {error}"
    return end or (f"{len(damaged)} damaged chunks" if damaged else None)


def _collect(stream: BinaryIO, raw: _Raw, damaged: list[str], ticks: bool) -> str | None:
    kinds = _Kinds()
    begun = False
    try:
        for record in mcap_records(stream, damaged, "whole" if ticks else "not"):
            begun = True
            if isinstance(record, Metadata):
                raw.metadata.update(record.metadata)
            elif isinstance(record, Attachment):
                raw.attachments[record.name] = record.data
            elif isinstance(record, Schema | Channel):
                kinds.note(record)
            elif isinstance(record, Message):
                _take(record.data, kinds.of(record.channel_id), raw)
            elif isinstance(record, Chunk):
                try:
                    whole = parts(record)
                except ValueError as error:
                    damaged.append(str(error))
                    continue
                _take_chunk(record, whole, kinds, raw)
    except EndOfFile:
        return "cut off inside a chunk" if begun else _NO_MCAP
    except (InvalidMagic, struct.error):
        return "its last bytes are missing" if begun else _NO_MCAP
    except OSError:
        raise
    except Exception as error:  # noqa: BLE001 - of a damaged file every library raises its own kind
        return f"damaged after {raw.ticks.count} ticks: {error}"
    return None


@dataclass
class _Kinds:
    """What messages the channels of a file carry."""

    schemas: dict[int, str] = field(default_factory=dict)
    channels: dict[int, str] = field(default_factory=dict)

    def note(self, record: Schema | Channel) -> None:
        """Remember a schema or a channel."""
        if isinstance(record, Schema):
            self.schemas[record.id] = record.name
        else:
            self.channels[record.id] = self.schemas.get(record.schema_id, "")

    def of(self, channel: int) -> str:
        """Name of the messages of a channel; empty where it was never told."""
        return self.channels.get(channel, "")

    def channels_of(self, kind: str) -> set[int]:
        """The channels that carry messages of a kind."""
        return {number for number, carried in self.channels.items() if carried == kind}


def _take_chunk(chunk: Chunk, records: list[tuple[int, int, int, int]], kinds: _Kinds, raw: _Raw) -> None:
    """Collect what is in a chunk."""
    for opcode, _, start, stop in records:
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            content = ReadDataStream(io.BytesIO(chunk.data[start:stop]))
            kinds.note(Schema.read(content) if opcode == Opcode.SCHEMA else Channel.read(content))
    ticks = kinds.channels_of(Tick.DESCRIPTOR.full_name)
    message = int(Opcode.MESSAGE)
    raw.ticks.add(
        chunk.data, [(a, b) for opcode, channel, a, b in records if opcode == message and channel in ticks]
    )
    for opcode, channel, start, stop in records:
        if opcode == message and channel not in ticks:
            _take(chunk.data[start:stop], kinds.of(channel), raw)


def _take(message: bytes, kind: str, raw: _Raw) -> None:
    if kind == Tick.DESCRIPTOR.full_name:
        raw.ticks.add(message, [(0, len(message))])
    elif kind == Event.DESCRIPTOR.full_name:
        raw.events.append(Event.FromString(message))
    else:
        raw.foreign = True
