"""Telemetry logs: what a vehicle sent is what it flew, whichever autopilot, and of one vehicle alone."""

import struct

import numpy as np
import pytest
from dataflash_writer import PARAMETERS, pulses
from px4_layouts import flown, frd, middle_of, motors, ned
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from trueflight.groundstation.measured.measurement import measure
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.versions.vehicle_draft import draft_of
from trueflight.models.errors import InputError
from trueflight.models.frames import enu_flu_from_ned_frd, euler_from_quaternion
from trueflight.models.vehicle import GRAVITY

QUAD5 = "models/vehicles/quad5/vehicle.toml"
SINCE_1970 = 1_780_000_000.0


def telemetry(
    one, *, ardupilot=True, system=1, rate=50, aside=0.0, kind=mavlink.MAV_TYPE_QUADROTOR
) -> list[tuple[float, bytes]]:
    """Every message (time, bytes) of a flight as a vehicle sends it, at a rate (Hz)."""
    out: list[tuple[float, bytes]] = []
    link = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)

    def send(t, message):
        out.append((t + 0.02, message.pack(link)))

    attitude = euler_from_quaternion(enu_flu_from_ned_frd(one.quaternion))
    rates, force = frd(one.angular_velocity), frd(one.specific_force)
    position, velocity, pilot = ned(one.position) + aside, ned(one.velocity), 3 if ardupilot else 12
    if ardupilot:
        for i, (name, value) in enumerate(PARAMETERS.items()):
            send(one.t[0], mavlink.MAVLink_param_value_message(name.encode(), value, 9, len(PARAMETERS), i))
    given = (
        pulses(motors(one, np.arange(len(one.t))))
        if ardupilot
        else 1000 + 1000 * motors(one, np.arange(len(one.t)))
    )
    for row in one.rows(2):
        mode = 5 if ardupilot else 6 << 16
        armed = 128 * bool(one.armed[row])
        send(one.t[row], mavlink.MAVLink_heartbeat_message(kind, pilot, 1 | armed, mode, 4, 3))
        send(
            one.t[row],
            mavlink.MAVLink_sys_status_message(
                0, 0, 0, 0, round(1e3 * one.voltage[row]), 1000, 80, 0, 0, 0, 0, 0, 0
            ),
        )
    for row in one.rows(rate):
        t, ms = one.t[row], round(1e3 * one.t[row])
        send(t, mavlink.MAVLink_attitude_message(ms, *attitude[row], *rates[row]))
        send(t, mavlink.MAVLink_local_position_ned_message(ms, *position[row], *velocity[row]))
        servos = [round(x) for x in given[row]] + [0] * 4
        send(t, mavlink.MAVLink_servo_output_raw_message(round(1e6 * t) & 0xFFFFFFFF, 0, *servos))
        if ardupilot:
            mg = [round(1e3 * x / GRAVITY) for x in force[row]]
            send(t, mavlink.MAVLink_raw_imu_message(round(1e6 * t), *mg, 0, 0, 0, 0, 0, 0))
            send(t, mavlink.MAVLink_vfr_hud_message(0, 0, 0, round(100 * one.thrust[row]), 0, 0))
        else:
            send(
                t,
                mavlink.MAVLink_highres_imu_message(
                    round(1e6 * t), *force[row], *rates[row], 0, 0, 0, 0, 0, 0, 0, 63
                ),
            )
            send(
                t,
                mavlink.MAVLink_attitude_target_message(
                    ms, 0, [1, 0, 0, 0], *frd(one.body_rate_command)[row], one.thrust[row]
                ),
            )
    return out


def save(path, *vehicles):
    rows = sorted((row for vehicle in vehicles for row in vehicle), key=lambda row: row[0])
    path.write_bytes(b"".join(struct.pack(">Q", round(1e6 * (SINCE_1970 + t))) + raw for t, raw in rows))
    return path


@pytest.mark.parametrize("ardupilot", [True, False])
def test_what_was_sent_is_what_was_flown(tmp_path, ardupilot):
    one = flown()
    flight = read_flight(save(tmp_path / "flight.tlog", telemetry(one, ardupilot=ardupilot)), QUAD5)
    rows, there = middle_of(flight, one)
    for name, tolerance in (
        ("position", 0.01),
        ("velocity", 0.02),
        ("specific_force", 0.2),
        ("angular_velocity", 0.1),
    ):
        error = np.median(np.abs(getattr(flight, name)[rows] - getattr(one, name)[there]), axis=0)
        assert np.all(error < tolerance), name
    np.testing.assert_allclose(flight.thrust_command[rows], one.thrust[there], atol=0.02)
    np.testing.assert_allclose(
        np.median(np.abs(flight.motor_command[rows] - motors(one, np.arange(len(one.t)))[there])),
        0,
        atol=0.01,
    )
    np.testing.assert_allclose(flight.battery_voltage[rows], one.voltage[there], atol=0.05)
    said = " ".join(flight.notes)
    assert ("flown in loiter" if ardupilot else "flown in offboard") in said
    assert ("SERVO_OUTPUT_RAW" if ardupilot else "ATTITUDE_TARGET") in said


def test_of_two_vehicles_one_is_read_and_the_other_can_be_chosen(tmp_path):
    one = flown()
    path = save(tmp_path / "two.tlog", telemetry(one), telemetry(one, system=7, rate=25, aside=50.0))
    flight = read_flight(path, QUAD5)
    assert any("vehicle 1 is read" in note and "7" in note for note in flight.notes)
    other = read_flight(path, QUAD5, "vehicle_namespace = '7'")
    assert abs(np.median(other.position[:, 0] - np.median(flight.position[:, 0]))) > 10
    with pytest.raises(InputError, match="takes one of 1, 7"):
        read_flight(path, QUAD5, "vehicle_namespace = '3'")


def test_slow_telemetry_is_refused_with_what_to_raise(tmp_path):
    path = save(tmp_path / "slow.tlog", telemetry(flown(), rate=2))
    with pytest.raises(InputError, match="SRn_") as error:
        read_flight(path, QUAD5)
    assert "\n" not in str(error.value)


def test_damage_and_foreign_bytes_cost_what_they_hit(tmp_path):
    path = save(tmp_path / "flight.tlog", telemetry(flown()))
    raw = bytearray(path.read_bytes())
    noise = np.random.default_rng(1)
    for start in noise.integers(2000, len(raw) - 100, 10):
        raw[start : start + 60] = noise.integers(0, 256, 60, dtype=np.uint8).tobytes()
    path.write_bytes(raw[: len(raw) - 33])
    assert any("skipped" in note for note in read_flight(path, QUAD5).notes)
    for name, broken in (("empty", b""), ("other", bytes(5000)), ("text", b"no telemetry " * 400)):
        (tmp_path / f"{name}.tlog").write_bytes(broken)
        with pytest.raises(InputError, match=f"{name}.tlog") as error:
            read_flight(tmp_path / f"{name}.tlog", QUAD5)
        assert "\n" not in str(error.value)


def test_another_kind_of_vehicle_is_named(tmp_path):
    path = save(tmp_path / "plane.tlog", telemetry(flown(), kind=mavlink.MAV_TYPE_FIXED_WING))
    with pytest.raises(InputError, match="fixed-wing"):
        read_flight(path, QUAD5)


def test_a_vehicle_is_drafted_from_the_parameters_that_were_sent(tmp_path):
    draft = draft_of(save(tmp_path / "flight.tlog", telemetry(flown())), tmp_path / "vehicle.toml")
    assert (
        draft.vehicle.hover_thrust == pytest.approx(0.38, rel=0.05) and "MOT_THST_HOVER is 0.36" in draft.text
    )


def seldom(one, kind: int, every: int) -> list[tuple[float, bytes]]:
    """The telemetry of a flight with one message of a kind in `every` only."""
    out, count = [], 0
    for t, message in telemetry(one, rate=20):
        if message[7] == kind:
            count += 1
            if count % every:
                continue
        out.append((t, message))
    return out


def test_thrust_that_is_told_too_seldom_is_said_to_be(tmp_path):
    """Pulses at 2 Hz: whole percents that come oftener are read instead; where those are missing, too, it is told."""
    one, pulses_, percents = flown(), mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW, mavlink.MAVLINK_MSG_ID_VFR_HUD
    flight = read_flight(save(tmp_path / "percents.tlog", seldom(one, pulses_, 10)), QUAD5)
    assert any("VFR_HUD" in note for note in flight.notes)
    rows, there = middle_of(flight, one)
    np.testing.assert_allclose(flight.thrust_command[rows], one.thrust[there], atol=0.02)
    left = [m for m in seldom(one, pulses_, 10) if m[1][7] != percents]
    with pytest.raises(
        InputError, match=r"SERVO_OUTPUT_RAW and was logged at 2 Hz; at least 3.5 Hz"
    ) as error:
        read_flight(save(tmp_path / "seldom.tlog", left), QUAD5)
    assert "\n" not in str(error.value)


def test_an_estimate_that_comes_four_times_a_second_tells_nothing_faster_and_has_noise(tmp_path):
    """Between its samples the log holds straight lines, which have none."""
    sent = [m for m in telemetry(flown(), rate=4) if m[1][7] != mavlink.MAVLINK_MSG_ID_RAW_IMU]
    flight = read_flight(save(tmp_path / "radio.tlog", sent), QUAD5)
    assert flight.sensor_rate == pytest.approx(4.0, rel=0.1) and not flight.has("specific_force")
    measured = measure(flight)
    assert measured.bandwidth < 2.0 and measured.noise.min() > 1e-4
