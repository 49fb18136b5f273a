"""ArduPilot's dataflash logs: what was flown comes out as flown, whatever was logged; damage is told in one line."""

import json
import struct
from dataclasses import replace

import numpy as np
import programs
import pytest
from dataflash_writer import copter, pulses
from px4_layouts import flown, middle_of, motors

from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.ardupilot_log import load_dataflash
from trueflight.groundstation.versions.vehicle_draft import draft_of, draft_vehicle
from trueflight.models.errors import InputError
from trueflight.models.vehicle import load_vehicle

QUAD5 = "models/vehicles/quad5/vehicle.toml"


def test_a_copters_log_is_what_it_flew(tmp_path):
    one = flown()
    flight = read_flight(copter(one).save(tmp_path / "flight.bin"), QUAD5)
    rows, there = middle_of(flight, one)
    for name, tolerance in (
        ("position", 0.01),
        ("velocity", 0.02),
        ("specific_force", 0.6),
        ("angular_velocity", 0.1),
    ):
        np.testing.assert_allclose(
            np.median(np.abs(getattr(flight, name)[rows] - getattr(one, name)[there]), axis=0),
            0,
            atol=tolerance,
        )
    turned = np.abs(np.sum(flight.quaternion[rows] * one.quaternion[there], axis=1))
    assert turned.min() > 1 - 1e-5
    np.testing.assert_allclose(flight.thrust_command[rows], one.thrust[there], atol=1e-6)
    np.testing.assert_allclose(
        flight.motor_command[rows], motors(one, np.arange(len(one.t)))[there], atol=2e-3
    )
    np.testing.assert_allclose(flight.rotor_speed[rows], one.rotor_speed[there], rtol=0.05)
    np.testing.assert_allclose(flight.body_rate_command[rows], one.body_rate_command[there], atol=0.02)
    np.testing.assert_allclose(flight.battery_voltage[rows], one.voltage[there], atol=0.05)
    assert not flight.flying[flight.t < 2.0].any() and flight.flying[rows].mean() > 0.95
    said = " ".join(flight.notes)
    assert "ArduCopter 4.5.7" in said and "flown in loiter" in said and "thrust is RATE.AOut" in said


def test_slow_sensors_are_read_for_what_they_are(tmp_path):
    log = copter(flown(), imu=25, attitude=10, rate=10)
    flight = read_flight(log.save(tmp_path / "default.bin"), QUAD5)
    assert flight.sensor_rate == pytest.approx(25, rel=0.05)
    assert flight.has("specific_force") and not flight.has("motor_command")  # motors at 10 Hz alias
    assert any("25 Hz" in note for note in flight.notes)


def test_a_missing_command_is_made_up_from_the_motors(tmp_path):
    one = flown()
    log = copter(one, leave_out=("RATE", "CTUN"), parameters={"MOT_PWM_TYPE": 6})
    flight = read_flight(log.save(tmp_path / "motors.bin"), QUAD5)
    rows, there = middle_of(flight, one)
    np.testing.assert_allclose(flight.thrust_command[rows], one.thrust[there], atol=3e-3)
    assert any("the mean of RCOU" in note for note in flight.notes)


def test_a_voltage_that_is_made_up_for_is_told_in_the_command(tmp_path):
    one = flown()
    log = copter(one, parameters={"MOT_BAT_VOLT_MAX": 16.8}, leave_out=("RCOU",))
    rows = one.rows(10)
    log.add("MOTB", "Qff", "TimeUS,LiftMax,BatVolt", one.t[rows], 0.9, 0.9)
    flight = read_flight(log.save(tmp_path / "made_up.bin"), QUAD5)
    rows, there = middle_of(flight, one)
    share = (pulses(one.thrust[there]) - 1150) / 800 / 0.9  # of the motors' range, raised
    np.testing.assert_allclose(flight.thrust_command[rows], 0.35 * share + 0.65 * share**2, atol=2e-3)


def test_older_messages_are_read_as_they_were(tmp_path):
    """Thousandths, hundredths, milliseconds, and events without a time: Copter 3.3."""
    one = flown()
    log = copter(
        one,
        firmware="APM:Copter V3.3.1",
        leave_out=("RATE", "XKF1", "XKF4", "IMU", "BAT", "RCOU", "ESC", "EV"),
    )
    rows = one.rows(50)
    full = copter(one, imu=50)
    number, code, columns = full.kinds["IMU"]
    log.kinds["IMU"] = (number, code, columns)
    log.rows += [row for row in full.rows if row[1][2] == number]
    log.add("CTUN", "Qhh", "TimeUS,ThrIn,ThrOut", one.t[rows], 0, one.thrust[rows] * 1000)
    log.add("CURR", "Qhh", "TimeUS,Volt,Curr", one.t[rows], one.voltage[rows] * 100, 2000)
    flight = read_flight(log.save(tmp_path / "old.bin"), QUAD5)
    at, there = middle_of(flight, one)
    np.testing.assert_allclose(flight.thrust_command[at], one.thrust[there], atol=0.01)
    np.testing.assert_allclose(flight.battery_voltage[at], one.voltage[there], atol=0.1)


def test_armed_and_never_said_to_have_left_the_ground_is_no_flight(tmp_path):
    """A copter tells when it takes off; motors that turn on a bench are armed all the same."""
    log = copter(flown())
    number = log.kinds["EV"][0]
    log.rows = [row for row in log.rows if not (row[1][2] == number and row[1][-1] in (28, 18))]
    with pytest.raises(InputError, match="never off the ground") as error:
        read_flight(log.save(tmp_path / "bench.bin"), QUAD5)
    assert "\n" not in str(error.value)


def test_a_draft_that_cannot_be_names_its_log(tmp_path):
    one = flown()
    log = copter(replace(one, thrust=2.0 * one.thrust, specific_force=0.7 * one.specific_force))
    with pytest.raises(InputError, match=r"fast\.bin: .*hover_thrust") as error:
        draft_of(log.save(tmp_path / "fast.bin"), tmp_path / "vehicle.toml")
    assert "\n" not in str(error.value)


def test_numbers_that_damage_makes_bring_no_warning(tmp_path, recwarn):
    """Signalling NaN, infinity and what no sensor reads, anywhere in the log; times that go back and repeat."""
    one = flown()
    force = one.specific_force.copy()
    rows = np.arange(900, 1500, 60)
    force[rows, 2] = 7.0 + 0.001 * np.arange(len(rows))
    raw = copter(replace(one, specific_force=force)).bytes()
    worst = [struct.pack("<I", bits) for bits in (0x7FA00000, 0x7FC00000, 0x7F800000, 0xFF7FFFFF, 0xFFA00001)]
    for k, value in enumerate(force[rows, 2]):
        before = struct.pack("<f", -value)
        assert before in raw
        raw = raw.replace(before, worst[k % len(worst)])
    times = [struct.pack("<Q", round(1e6 * one.t[row])) for row in (1000, 1001, 1002, 1203)]
    raw = (
        raw.replace(times[1], times[0])
        .replace(times[2], times[3])
        .replace(times[3], struct.pack("<Q", 2**64 - 1))
    )
    path = tmp_path / "damaged.bin"
    path.write_bytes(raw)
    assert read_flight(path, QUAD5).flying.sum() > 1000
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]


def test_the_core_that_flew_is_read_and_nothing_across_a_change_of_it(tmp_path):
    one = flown()
    log = copter(one, leave_out=("XKF4",))
    rows = one.rows(100)
    changed = one.t[rows] > one.t[one.middle][500]
    log.add("XKF4", "QBBH", "TimeUS,C,PI,SS", one.t[rows], 0, changed.astype(int), 0b0011_0111_1111)
    flight = read_flight(log.save(tmp_path / "cores.bin"), QUAD5)
    assert any("reset its position" in note for note in flight.notes)


def test_a_vehicle_is_drafted_from_the_frame_and_the_flight(tmp_path):
    draft = draft_of(copter(flown()).save(tmp_path / "flight.bin"), tmp_path / "vehicle.toml")
    assert draft.vehicle.hover_thrust == pytest.approx(0.38, rel=0.03)
    assert "rotor_positions" in draft.to_complete and "MOT_THST_HOVER is 0.36" in draft.text
    assert (
        "[[0.7071, -0.7071, 0.0]" in draft.text and "ATC_RAT_RLL_P" in draft.text and "PX4" not in draft.text
    )
    hexa = draft_vehicle(
        load_dataflash(
            copter(flown(), parameters={"FRAME_CLASS": 2}, leave_out=("ESC",)).save(tmp_path / "6.bin")
        )
    )
    assert "[-1, 1, -1, 1, 1, -1]" in hexa.text


@pytest.mark.parametrize(
    "broken, words",
    [
        (lambda raw: b"", "empty"),
        (lambda raw: b"\x00" * 4000, "no ArduPilot dataflash log"),
        (lambda raw: raw[:3000], "log"),
        (lambda raw: raw.replace(b"ArduCopter V4", b"ArduPlane V4.", 1), "fixed-wing or VTOL"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_told_in_one_line(tmp_path, broken, words):
    path = tmp_path / "broken.bin"
    path.write_bytes(broken(copter(flown()).bytes()))
    with pytest.raises(InputError, match=words) as error:
        read_flight(path, QUAD5)
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def test_damage_in_the_middle_costs_what_is_damaged(tmp_path):
    raw = bytearray(copter(flown()).bytes())
    noise = np.random.default_rng(0)
    for start in noise.integers(5000, len(raw) - 200, 20):
        raw[start : start + 100] = noise.integers(0, 256, 100, dtype=np.uint8).tobytes()
    path = tmp_path / "damaged.bin"
    path.write_bytes(bytes(raw))
    flight = read_flight(path, QUAD5)
    assert len(flight) > 0.8 * len(flown().t)


def test_the_commands_read_it_as_any_other_flight(tmp_path):
    path = copter(flown()).save(tmp_path / "flight.bin")
    drafted = programs.run(
        "groundstation", "import", path, "--draft-vehicle", tmp_path / "vehicle.toml", "--mass", 0.75
    )
    assert drafted.returncode == 0, drafted.stderr
    assert load_vehicle(tmp_path / "vehicle.toml").mass == 0.75
    checked = programs.run("groundstation", "import", path, "--check", "--json")
    assert checked.returncode == 0 and json.loads(checked.stdout)["consistency"]
