"""The flight records of many flights, written while they fly: the same messages as `sim_bridge.in_process.record`.

Ticks are gathered for all flights and turned into messages block by block: what is the same in a message of a flight is
a pattern of bytes, into which the numbers of many ticks are laid at once.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from trueflight.models.record import begin_record, end_record
from trueflight.models.record_pb2 import Event
from trueflight.models.whole_file import whole_file
from trueflight.sim_bridge.in_process import OUTCOME_LEVELS, Flown, constant_tick, record_metadata
from trueflight.sim_bridge.many.flight import Samples, fly_many
from trueflight.sim_bridge.plan import Plan

_AT_A_TIME = 100  # ticks that are turned into messages together
_VECTORS = ("x", "y", "z")
_FIELDS: tuple[tuple[str, tuple[str, ...], Callable[[Samples], np.ndarray]], ...] = (
    ("position", _VECTORS, lambda s: s.position),
    ("velocity", _VECTORS, lambda s: s.estimates.velocity),
    ("quaternion", ("w", "x", "y", "z"), lambda s: s.estimates.quaternion),
    ("angular_velocity", _VECTORS, lambda s: s.estimates.angular_velocity),
    ("specific_force", _VECTORS, lambda s: s.estimates.specific_force),
    ("position_reference", _VECTORS, lambda s: s.references.position),
    ("velocity_reference", _VECTORS, lambda s: s.references.velocity),
    ("acceleration_reference", _VECTORS, lambda s: s.references.acceleration),
    ("yaw_reference", (), lambda s: s.references.yaw),
    ("feedback", ("thrust",), lambda s: s.steps.feedback_thrust),
    ("feedback.body_rate", _VECTORS, lambda s: s.steps.feedback_rate),
    ("correction", _VECTORS, lambda s: s.steps.correction),
    ("correction_raw", _VECTORS, lambda s: s.steps.correction_raw),
    ("trim", _VECTORS, lambda s: s.steps.trim),
    ("thrust_command", (), lambda s: s.steps.thrust_command),
    ("body_rate_command", _VECTORS, lambda s: s.steps.body_rate),
    ("battery_voltage", (), lambda s: s.estimates.battery_voltage),
    ("inference", (), lambda s: s.inference),
    ("rotor_speed", ("1", "2", "3", "4"), lambda s: s.estimates.rotor_speed),
)
"""Fields of a tick, their parts, and where they come from."""
_WIDTHS = [max(len(parts), 1) for _, parts, _ in _FIELDS]
_BEGINS = np.cumsum([0, *_WIDTHS]).tolist()
_COLUMNS = _BEGINS[-1]


def record_many(
    plans: Sequence[Plan],
    paths: Sequence[Path],
    on_end: Callable[[int, Flown], None] | None = None,
    on_tick: Callable[[int], None] | None = None,
) -> list[Flown]:
    """Fly plans of one control rate together, each into its own flight record (MCAP), which has its name once the
    flight has ended.

    `on_end` is told each flight by its index as it ends, `on_tick` after each control tick how many flights are under
    way. Raises `InputError` where a record cannot be written, or one of that name is there.
    """
    with ExitStack() as stack:
        written = _Records(plans, paths, stack)

        def each(samples: Samples) -> None:
            written.take(samples)
            if on_tick is not None:
                on_tick(int(samples.under_way.sum()))

        def ended(index: int, flown: Flown) -> None:
            written.end(index, flown)
            if on_end is not None:
                on_end(index, flown)

        return fly_many(plans, each, ended)


class _Records:
    """The records of flights under way, and the ticks of all that are not written yet."""

    def __init__(self, plans: Sequence[Plan], paths: Sequence[Path], stack: ExitStack) -> None:
        self._records = [_Record(plan, path, stack) for plan, path in zip(plans, paths, strict=True)]
        self._block = np.empty((_AT_A_TIME, _COLUMNS, len(plans)))
        self._times: list[int] = []
        self._guards: list[tuple[str, ...]] = []
        self._missions: list[np.ndarray] = []

    def take(self, samples: Samples) -> None:
        """Take down one tick of all."""
        if len(self._times) == _AT_A_TIME:
            for i in np.flatnonzero(samples.under_way).tolist():
                self._write(i)
            self._times.clear()
            self._guards.clear()
            self._missions.clear()
        row = self._block[len(self._times)]
        for begin, width, (_, _, get) in zip(_BEGINS, _WIDTHS, _FIELDS, strict=False):
            row[begin : begin + width] = get(samples)
        self._times.append(samples.estimates.time_us)
        self._guards.append(tuple(samples.guard))
        self._missions.append(samples.mission)

    def end(self, index: int, flown: Flown) -> None:
        """A flight has ended with the last tick taken: its record is whole."""
        self._write(index)
        self._records[index].end(flown, self._times[-1])

    def _write(self, index: int) -> None:
        count = len(self._times)
        phases = [(g[index], bool(m[index])) for g, m in zip(self._guards, self._missions, strict=True)]
        self._records[index].write(self._block[:count, :, index], self._times, phases)


class _Record:
    """One flight's record."""

    def __init__(self, plan: Plan, path: Path, stack: ExitStack) -> None:
        self._plan = plan
        self._whole = stack.enter_context(ExitStack())
        self._path = self._whole.enter_context(
            whole_file(path, "the flight record", "choose another -o", new=True)
        )
        self._stream = _Appended(self._path)
        self._writer, self._channels = begin_record(
            self._stream, plan.vehicle, plan.design, record_metadata(plan), 0
        )
        self._patterns: dict[tuple[str, bool, int, int], _Pattern] = {}
        self._ticks = 0

    def write(self, rows: np.ndarray, times: Sequence[int], phases: Sequence[tuple[str, bool]]) -> None:
        """Write ticks: their numbers (K, columns), times (us), guards and whether the trajectory has begun."""
        keys = [
            (*phase, _varint_size(time), _varint_size(1000 * time))
            for phase, time in zip(phases, times, strict=True)
        ]
        at = 0
        for key, run in groupby(keys):
            count = len(list(run))
            pattern = self._patterns.get(key)
            if pattern is None:
                pattern = self._patterns[key] = _Pattern(self._plan, *key)
            some = times[at : at + count]
            for time, message in zip(some, pattern.messages(rows[at : at + count], some), strict=True):
                self._ticks += 1
                self._writer.add_message(self._channels[0], 1000 * time, message, 1000 * time, self._ticks)
            at += count
        self._stream.flush()

    def end(self, flown: Flown, time_us: int) -> None:
        """Tell how it ended; the file gets its name."""
        level = OUTCOME_LEVELS[flown.outcome]
        event = Event(vehicle_time_us=time_us, level=level, kind=flown.outcome, text=flown.outcome)
        self._writer.add_message(self._channels[1], 1000 * time_us, event.SerializeToString(), 0, 1)
        end_record(self._writer, self._ticks, 1, 0)
        self._stream.flush(everything=True)
        self._whole.close()


class _Appended:
    """A file that is opened only to append to it: hundreds of records are under way at once."""

    def __init__(self, path: Path) -> None:
        self._path, self._waiting, self._size = path, bytearray(), 0
        path.touch()

    def write(self, data: bytes) -> int:
        """Keep for later."""
        self._waiting += data
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Bytes written so far."""
        return self._size

    def flush(self, everything: bool = False) -> None:
        """Append what waits, if it is much or `everything` is asked for."""
        if everything or len(self._waiting) > 1 << 18:
            with self._path.open("ab") as stream:
                stream.write(self._waiting)
            self._waiting.clear()


class _Pattern:
    """A tick as bytes, with room for its numbers: of one flight, phase and guard, and of times of so many bytes."""

    def __init__(self, plan: Plan, guard: str, mission: bool, time_size: int, host_size: int) -> None:
        tick = constant_tick(plan)
        tick.guard, tick.phase = guard, "mission" if mission else "takeoff"
        # Numbers that stand nowhere else in the message show where it has room for them.
        marks = [1.0 + (1 + i) * 1e-9 for i in range(_COLUMNS)]
        columns = 0
        for begin, (name, parts, _) in zip(_BEGINS, _FIELDS, strict=False):
            if name == "rotor_speed":
                if not plan.rotor_speeds:
                    break
                tick.rotor_speed[:] = marks[begin : begin + len(parts)]
            elif parts:
                holder: Any = tick
                for word in name.split("."):
                    holder = getattr(holder, word)
                for part, mark in zip(parts, marks[begin:], strict=False):
                    setattr(holder, part, mark)
            else:
                setattr(tick, name, marks[begin])
            columns = begin + max(len(parts), 1)
        rest = tick.SerializeToString()
        head = b"\x08" + bytes(time_size) + b"\x10" + bytes(host_size)
        self._bytes = np.frombuffer(head + rest, dtype=np.uint8)
        self._times = (1, time_size, 1), (2 + time_size, host_size, 1000)
        self._places = [len(head) + _only(rest, struct.pack("<d", mark)) for mark in marks[:columns]]

    def messages(self, rows: np.ndarray, times: Sequence[int]) -> list[bytes]:
        """The ticks with these numbers (K, columns) and times (us), serialised."""
        out = np.repeat(self._bytes[None], len(times), axis=0)
        for begin, size, factor in self._times:
            values = np.array(times, dtype=np.int64) * factor
            for byte in range(size):
                more = 0x80 if byte < size - 1 else 0
                out[:, begin + byte] = ((values >> (7 * byte)) & 0x7F) | more
        numbers = np.ascontiguousarray(rows, dtype="<f8").view(np.uint8).reshape(len(times), -1, 8)
        for column, place in enumerate(self._places):
            out[:, place : place + 8] = numbers[:, column]
        return [row.tobytes() for row in out]


def _only(text: bytes, part: bytes) -> int:
    """Where a part stands that stands there once."""
    assert text.count(part) == 1
    return text.index(part)


def _varint_size(value: int) -> int:
    """Bytes of a number as protobuf writes it."""
    return max(1, -(-value.bit_length() // 7))
