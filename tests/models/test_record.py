"""A flight record survives what happens to computers in the air."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from processes import with_parent

from trueflight.models.design import Design
from trueflight.models.errors import InputError
from trueflight.models.flight import COLUMNS
from trueflight.models.record import FlightRecorder, read_record, vehicle_to_toml
from trueflight.models.record_pb2 import Event, Tick, Vector3
from trueflight.models.vehicle import Vehicle, load_vehicle

VEHICLE = Vehicle(
    name="quad5", mass=0.75, hover_thrust=0.38, rotor_positions=((0.1, 0.1, 0.0),), rotor_directions=(1,)
)
DESIGN = Design(
    "quad5",
    0.75,
    ((8.0, 0, 0), (0, 8.0, 0), (0, 0, 3.0)),
    ((0, -0.4, 0, 0, -0.35, 0), (0.4, 0, 0, 0.35, 0, 0), (0, 0, 3.75, 0, 0, 3.0)),
)


def make_tick(i: int) -> Tick:
    tick = Tick(vehicle_time_us=5_000_000 + 10_000 * i, host_time_ns=7_000_000_000 + 10_000_000 * i)
    tick.position.x, tick.position.y, tick.position.z = 0.01 * i, -1.0, 1.2
    noise = np.random.default_rng(i).normal(size=6)  # so that chunks do not compress to nothing
    tick.velocity.x, tick.velocity.y, tick.velocity.z = noise[:3]
    tick.angular_velocity.x, tick.angular_velocity.y, tick.angular_velocity.z = noise[3:]
    tick.quaternion.w = 1.0
    tick.specific_force.z = 9.81
    tick.thrust_command = 0.38
    tick.battery_voltage = 16.0
    tick.rotor_speed.extend([1.0, 2.0, 3.0, 4.0])
    tick.correction.CopyFrom(Vector3(x=0.5))
    tick.controller, tick.phase, tick.guard = "lqr", "mission", "off"
    tick.setpoint_sent = True
    return tick


def write(path: Path, count: int, close: bool = True) -> FlightRecorder:
    recorder = FlightRecorder(path, VEHICLE, DESIGN, {"trajectory": "hover"})
    for i in range(count):
        tick = make_tick(i)
        recorder.tick(tick, tick.vehicle_time_us, tick.host_time_ns)
    recorder.event(Event(vehicle_time_us=6_000_000, level="info", kind="takeoff", text="taking off"))
    if close:
        recorder.close()
    return recorder


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", 300)
    record = read_record(tmp_path / "a.mcap")
    assert not record.truncated
    assert record.notes == ()
    assert record.vehicle == VEHICLE
    assert record.design == DESIGN
    assert record.metadata["trajectory"] == "hover"
    assert record.metadata["ticks"] == "300"
    assert [event.kind for event in record.events] == ["takeoff"]
    ticks = record.ticks
    np.testing.assert_allclose(ticks["t"], 0.01 * np.arange(300), atol=1e-12)
    np.testing.assert_allclose(ticks["position"][:, 0], 0.01 * np.arange(300))
    np.testing.assert_allclose(ticks["rotor_speed"], np.tile([1.0, 2.0, 3.0, 4.0], (300, 1)))
    assert set(ticks["phase"]) == {"mission"}
    assert ticks["setpoint_sent"].all()
    # Columns of a flight that a record can hold are named as there; motor commands stay inside the autopilot.
    assert set(COLUMNS) - set(ticks) == {"motor_command", "position_reference"}


def test_several_threads_read_each_their_own(tmp_path: Path) -> None:
    for i in range(4):
        write(tmp_path / f"{i}.mcap", 1500 + 300 * i)
    paths = 6 * sorted(tmp_path.glob("*.mcap"))
    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(read_record, paths))
    for path, record in zip(paths, together, strict=True):
        alone = read_record(path)
        assert not record.truncated
        np.testing.assert_array_equal(record.ticks["position"], alone.ticks["position"])


def test_a_model_in_the_shadow_is_recorded_beside_the_live_one(tmp_path: Path) -> None:
    with FlightRecorder(tmp_path / "a.mcap", VEHICLE) as recorder:
        for i in range(4):
            tick = make_tick(i)
            tick.model = "0123456789ab"
            if i > 1:
                tick.shadow = "ba9876543210"
                tick.shadow_raw.CopyFrom(Vector3(z=-1.5))
            recorder.tick(tick, tick.vehicle_time_us, tick.host_time_ns)
    ticks = read_record(tmp_path / "a.mcap").ticks
    assert list(ticks["shadow"]) == ["", "", "ba9876543210", "ba9876543210"]
    assert set(ticks["model"]) == {"0123456789ab"}
    np.testing.assert_array_equal(ticks["shadow_raw"][:, 2], [np.nan, np.nan, -1.5, -1.5])
    write(tmp_path / "old.mcap", 3)
    assert "shadow_raw" not in read_record(tmp_path / "old.mcap").ticks, "as in records from before"


def test_what_was_never_measured_is_absent_and_gaps_are_nan(tmp_path: Path) -> None:
    with FlightRecorder(tmp_path / "a.mcap", VEHICLE) as recorder:
        for i in range(3):
            tick = make_tick(i)
            tick.ClearField("rotor_speed")
            if i == 0:
                tick.ClearField("specific_force")
            recorder.tick(tick.SerializeToString(), tick.vehicle_time_us, tick.host_time_ns)
    ticks = read_record(tmp_path / "a.mcap").ticks
    assert "rotor_speed" not in ticks
    assert np.isnan(ticks["specific_force"][0]).all()
    assert ticks["specific_force"][1, 2] == 9.81


@pytest.mark.parametrize("cut", [1, 8, 50, 400, 5000])
def test_a_file_cut_anywhere_keeps_everything_before_the_cut(tmp_path: Path, cut: int) -> None:
    write(tmp_path / "a.mcap", 600)
    whole = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "b.mcap").write_bytes(whole[:-cut])
    record = read_record(tmp_path / "b.mcap")
    assert record.truncated
    assert "recovered" in record.notes[0]
    np.testing.assert_allclose(np.diff(record.ticks["t"]), 0.01)
    assert len(record.ticks["t"]) > (550 if cut < 1000 else 100)


def test_damage_in_the_middle_keeps_what_stands_before_it(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", 600)
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2000] = bytes(2000)
    (tmp_path / "b.mcap").write_bytes(data)
    record = read_record(tmp_path / "b.mcap")
    assert record.truncated
    assert 50 < len(record.ticks["t"]) < 600


@pytest.mark.parametrize(
    "content", [b"", b"short", b"t,x,y,z\n0,1,2,3\n" * 10, b"\x89MCAP0\r\n", bytes(1000)]
)
def test_garbage_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_record(tmp_path / "a.mcap")
    assert "a.mcap" in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="cannot read"):
        read_record(tmp_path / "none.mcap")


def test_an_existing_record_is_never_overwritten(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", 3)
    with pytest.raises(InputError, match="cannot write"):
        FlightRecorder(tmp_path / "a.mcap", VEHICLE)


def test_drops_are_counted_and_told(tmp_path: Path) -> None:
    recorder = FlightRecorder(tmp_path / "a.mcap", VEHICLE, queue_limit=4)
    for i in range(5000):
        tick = make_tick(i)
        recorder.tick(tick, tick.vehicle_time_us, tick.host_time_ns)
    recorder.close()
    record = read_record(tmp_path / "a.mcap")
    assert recorder.dropped > 0
    assert int(record.metadata["dropped"]) == recorder.dropped
    assert len(record.ticks["t"]) + recorder.dropped == 5000
    assert "dropped" in record.notes[0]


def test_a_killed_recorder_loses_at_most_a_second(tmp_path: Path) -> None:
    program = f"""
        import sys, time
        sys.path[:0] = {[str(folder) for folder in Path(__file__).parents[:2]]!r}
        from test_record import VEHICLE, make_tick
        from trueflight.models.record import FlightRecorder
        recorder = FlightRecorder({str(tmp_path / "a.mcap")!r}, VEHICLE)
        for i in range(100000):
            tick = make_tick(i)
            recorder.tick(tick, tick.vehicle_time_us, tick.host_time_ns)
            print(i, flush=True)
            time.sleep(0.01)
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program)],
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=with_parent,
    )
    assert process.stdout is not None
    try:
        last = -1
        begin = time.monotonic()
        while time.monotonic() - begin < 60.0 and last < 300:
            last = int(process.stdout.readline())
    finally:
        os.kill(process.pid, signal.SIGKILL)
        rest = process.stdout.read().split()
        process.wait()
    last = int(rest[-1]) if rest else last
    record = read_record(tmp_path / "a.mcap")
    assert record.truncated
    recovered = len(record.ticks["t"])
    assert last + 1 - recovered <= 100, "more than one second at 100 Hz was lost"
    np.testing.assert_allclose(record.ticks["t"], 0.01 * np.arange(recovered), atol=1e-9)


def test_the_vehicle_survives_its_own_toml(tmp_path: Path) -> None:
    path = Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml"
    vehicle = load_vehicle(path)
    (tmp_path / "vehicle.toml").write_text(vehicle_to_toml(vehicle))
    assert load_vehicle(tmp_path / "vehicle.toml") == vehicle
    assert math.isclose(vehicle.mass, 0.75)
