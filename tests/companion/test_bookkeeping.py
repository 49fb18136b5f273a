"""Ticks are written by a thread of their own: all of them, in order, as they were when they were decided."""

from __future__ import annotations

import threading

from rig import wait_for

from trueflight.companion.bookkeeping import TOGETHER, WAITING, Bookkeeping
from trueflight.companion.latest import Latest
from trueflight.companion.odometry import Odometry
from trueflight.companion.outcome import Outcome
from trueflight.models.record_pb2 import Tick


def odometry(number: int) -> Odometry:
    zero = (0.0, 0.0, 0.0)
    return Odometry(1000 * number, number, zero, zero, (1.0, 0.0, 0.0, 0.0), zero, 0)


class Shelf:
    """Keeps what is written; `open` lets it through."""

    def __init__(self) -> None:
        self.ticks: list[Tick] = []
        self.told: list[str] = []
        self.open = threading.Event()
        self.open.set()
        self.threads: set[str] = set()

    def write(self, data: bytes, vehicle_time_us: int, host_time_ns: int) -> None:
        self.open.wait(60.0)
        self.threads.add(threading.current_thread().name)
        self.ticks.append(Tick.FromString(data))
        assert self.ticks[-1].vehicle_time_us == vehicle_time_us == 1000 * host_time_ns


def note(books: Bookkeeping, number: int, latest: Latest) -> None:
    books.note(odometry(number), latest, Outcome("mission", 0.01, (0.0, 0.0, 0.0)), 0.0)


def test_every_tick_is_written_in_order_and_without_more_of_them_coming() -> None:
    shelf = Shelf()
    books = Bookkeeping(shelf.write, shelf.told.append)
    latest = Latest()
    count = 3 * TOGETHER + 1  # the last one waits for no other
    for number in range(count):
        note(books, number, latest)
    wait_for(lambda: len(shelf.ticks) == count, "the last tick")
    assert [tick.host_time_ns for tick in shelf.ticks] == list(range(count))
    assert shelf.threads == {"bookkeeping"} and not books.dropped and not shelf.told
    books.close()


def test_a_tick_tells_what_was_known_when_it_was_decided() -> None:
    shelf = Shelf()
    shelf.open.clear()
    books, latest = Bookkeeping(shelf.write, shelf.told.append), Latest(flight_mode="OFFBOARD")
    note(books, 0, latest)
    latest.flight_mode = "HOLD"
    note(books, 1, latest)
    shelf.open.set()
    books.flush()
    assert [tick.flight_mode for tick in shelf.ticks] == ["OFFBOARD", "HOLD"]
    books.close()


def test_after_a_flush_and_after_the_end_nothing_waits_any_more() -> None:
    shelf = Shelf()
    books = Bookkeeping(shelf.write, shelf.told.append)
    for number in range(3):
        note(books, number, Latest())
        books.flush()
        assert len(shelf.ticks) == number + 1
    note(books, 3, Latest())
    books.close()
    assert len(shelf.ticks) == 4


def test_what_cannot_wait_is_dropped_counted_and_told_and_the_thread_that_notes_never_waits() -> None:
    shelf = Shelf()
    shelf.open.clear()
    books = Bookkeeping(shelf.write, shelf.told.append)
    for number in range(WAITING + 60):
        note(books, number, Latest())
    assert books.dropped >= 59  # one may be in the hands of the other thread
    shelf.open.set()
    books.flush()
    assert len(shelf.ticks) + books.dropped == WAITING + 60
    wait_for(lambda: shelf.told, "the word about it")
    assert f"{books.dropped} ticks" in shelf.told[0]
    books.close()


def test_a_tick_that_cannot_be_written_is_told_and_the_next_one_is_written() -> None:
    shelf = Shelf()

    def write(data: bytes, vehicle_time_us: int, host_time_ns: int) -> None:
        if host_time_ns == 1:
            raise MemoryError
        shelf.write(data, vehicle_time_us, host_time_ns)

    books = Bookkeeping(write, shelf.told.append)
    for number in range(3):
        note(books, number, Latest())
    books.flush()
    books.close()
    assert (
        [tick.host_time_ns for tick in shelf.ticks] == [0, 2] and books.dropped == 1 and len(shelf.told) == 1
    )
