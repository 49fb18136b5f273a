"""A flight record on a disk that is full, fills up, or loses the folder: told, and what was written stays readable."""

from __future__ import annotations

import errno
import os
import shutil
import time
from pathlib import Path

import pytest

from trueflight.models import record
from trueflight.models.errors import InputError
from trueflight.models.record import FlightRecorder, read_record
from trueflight.models.record_pb2 import Tick
from trueflight.models.vehicle import load_vehicle

VEHICLE = load_vehicle(Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml")


def fill(recorder: FlightRecorder, begin: int, count: int) -> None:
    for i in range(begin, begin + count):
        while recorder._queue.qsize() > 2000 and not recorder.error:
            time.sleep(0.001)
        tick = Tick(vehicle_time_us=10_000 * i, phase="mission", flight_mode=os.urandom(150).hex())
        recorder.tick(tick, tick.vehicle_time_us, 0)


def until(condition: object, what: str) -> None:
    end = time.monotonic() + 30.0
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end, what
        time.sleep(0.01)


def full_after(monkeypatch: pytest.MonkeyPatch, room: int) -> None:
    """A disk with `room` bytes left, as the system calls see it: the last write is done in part, as on a real one."""
    left, write = [room], os.write

    def limited(descriptor: int, data: bytes) -> int:
        if not left[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        done = write(descriptor, bytes(data)[: left[0]])
        left[0] -= done
        return done

    monkeypatch.setattr(record.os, "write", limited)


@pytest.mark.parametrize("room", [0, 1, 200, 500])
def test_on_a_full_disk_no_record_begins_and_none_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    full_after(monkeypatch, room)
    with pytest.raises(InputError, match="cannot write the flight record"):
        FlightRecorder(tmp_path / "a.mcap", VEHICLE)
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_fills_up_ends_the_record_at_once_and_leaves_it_readable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full_after(monkeypatch, 200_000)
    recorder = FlightRecorder(tmp_path / "a.mcap", VEHICLE)
    fill(recorder, 0, 3000)
    until(lambda: recorder.error, "the error")
    assert "No space left" in recorder.error
    recorder.close()
    read = read_record(tmp_path / "a.mcap")
    assert read.truncated
    assert len(read.ticks["t"]) > 400
    assert (tmp_path / "a.mcap").stat().st_size <= 200_000


def _fill_up(path: Path) -> None:
    """Take what is left of a disk, for a record ends where a whole chunk no longer fits."""
    with path.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(512))
        except OSError:
            pass


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small disk needs root")
def test_on_a_real_disk_that_is_too_small(tmp_path: Path) -> None:
    if os.system(f"mount -t tmpfs -o size=256k tmpfs {tmp_path} 2>/dev/null"):
        pytest.skip("this machine does not let us mount a small disk")
    try:
        recorder = FlightRecorder(tmp_path / "a.mcap", VEHICLE)
        fill(recorder, 0, 3000)
        until(lambda: recorder.error, "the error")
        recorder.close()
        assert len(read_record(tmp_path / "a.mcap").ticks["t"]) > 400
        _fill_up(tmp_path / "rest")
        with pytest.raises(InputError, match="No space left"):
            FlightRecorder(tmp_path / "b.mcap", VEHICLE)
    finally:
        os.system(f"umount {tmp_path}")


def test_a_folder_taken_away_in_flight_is_made_again_with_all_of_the_record(tmp_path: Path) -> None:
    folder = tmp_path / "records"
    recorder = FlightRecorder(folder / "a.mcap", VEHICLE)
    fill(recorder, 0, 500)
    shutil.rmtree(folder)
    until(lambda: recorder.rescued, "the record to be written anew")
    fill(recorder, 500, 500)
    recorder.close()
    read = read_record(folder / "a.mcap")
    assert not read.truncated
    assert len(read.ticks["t"]) == 1000
    assert recorder.error == ""


def test_a_folder_that_cannot_be_made_again_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "records"
    recorder = FlightRecorder(folder / "a.mcap", VEHICLE)
    shutil.rmtree(folder)
    folder.write_text("in the way")
    until(lambda: recorder.error, "the error")
    recorder.close()


def test_a_message_that_cannot_be_written_ends_the_record_and_not_its_thread_alone(tmp_path: Path) -> None:
    recorder = FlightRecorder(tmp_path / "a.mcap", VEHICLE)
    recorder.tick(b"", -5, 0)  # a time before the vehicle's clock began
    until(lambda: recorder.error, "the error")
    recorder.close()
