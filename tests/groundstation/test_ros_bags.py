"""Recordings of ROS 2: PX4's messages make the same flight as its ULog; ROS' own stand in where they are missing."""

import json
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from px4_layouts import BOOT, flown, log_of, middle_of
from ros_bag_writer import EPOCH, HEADER, Bag, as_db3, poses, px4_topics, ros_messages

from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.ros_bag import load_ros_bag
from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle

VEHICLE = Vehicle("quad5", mass=0.75, hover_thrust=0.38)
BIN = Path(sys.executable).parent


def agrees(flight, names=("position", "velocity", "specific_force", "angular_velocity"), loose=1.0):
    rows, same = middle_of(flight, flown())
    tolerance = {"position": 0.01, "velocity": 0.02, "specific_force": 0.2, "angular_velocity": 0.06}
    for name in names:
        error = getattr(flight, name)[rows] - getattr(flown(), name)[same]
        assert np.sqrt(np.mean(error**2)) < loose * tolerance[name], name
    assert np.sqrt(np.mean((flight.thrust_command[rows] - flown().thrust[same]) ** 2)) < 0.01
    assert flight.flying[rows].all()


@pytest.mark.parametrize(
    ("clock", "space", "version"), [(EPOCH, "/fmu/out", ""), (0.0, "/px4_1/fmu/out", "_v1")]
)
def test_px4_messages_make_the_flight_of_the_ulog(clock, space, version, tmp_path):
    flight = read_flight(
        px4_topics(Bag(tmp_path / "bag.mcap"), log_of("1.16"), clock, space, version).save(), VEHICLE
    )
    ulog = read_flight(log_of("1.16").save(tmp_path / "log.ulg"), VEHICLE)
    agrees(flight)
    assert abs(len(flight) - len(ulog)) <= 1
    np.testing.assert_allclose(flight.position[:1800], ulog.position[:1800], atol=0.02)
    np.testing.assert_array_equal(flight.flying.sum(), ulog.flying.sum())


@pytest.mark.parametrize("twist_in_world", [False, True])
def test_odometry_and_imu_of_ros_stand_in(twist_in_world, tmp_path):
    flight = read_flight(ros_messages(Bag(tmp_path / "bag.mcap"), twist_in_world).save(), VEHICLE)
    agrees(flight)
    assert flight.battery_voltage is not None
    rows, same = middle_of(flight, flown())
    np.testing.assert_allclose(flight.body_rate_command[rows], flown().body_rate_command[same], atol=0.2)


@pytest.mark.parametrize("definitions", [True, False])
def test_a_bag_in_sqlite_is_the_same_flight(definitions, tmp_path):
    """Without definitions, as bags from before Iron are, ROS' own messages are known, and others are told."""
    made = ros_messages(Bag(tmp_path / "bag.mcap"))
    path = as_db3(made, tmp_path / "bag_0.db3", definitions)
    if not definitions:
        with pytest.raises(InputError, match=r"no thrust command") as error:
            read_flight(path, VEHICLE)
        assert "\n" not in str(error.value)
        return
    flight, same = read_flight(path, VEHICLE), read_flight(made.save(), VEHICLE)
    agrees(flight)
    np.testing.assert_array_equal(flight.specific_force, same.specific_force)


def test_nothing_is_left_beside_a_bag_and_one_that_is_still_written_is_read_as_far_as_it_is(tmp_path):
    path = as_db3(ros_messages(Bag(tmp_path / "bag.mcap")), tmp_path / "bag_0.db3")
    whole = read_flight(path, VEHICLE)
    with closing(sqlite3.connect(path)) as writer:
        assert writer.execute("PRAGMA journal_mode=WAL").fetchone() == ("wal",)
    before = sorted(tmp_path.iterdir())
    read_flight(path, VEHICLE)
    assert sorted(tmp_path.iterdir()) == before
    with closing(sqlite3.connect(path)) as writer:
        writer.execute("PRAGMA wal_autocheckpoint=0")
        writer.execute("DELETE FROM messages WHERE timestamp > (SELECT avg(timestamp) FROM messages)")
        writer.commit()
        assert len(read_flight(path, VEHICLE)) < 0.7 * len(whole)


def test_ros_own_messages_are_read_from_a_bag_without_definitions(tmp_path):
    path = as_db3(ros_messages(Bag(tmp_path / "bag.mcap")), tmp_path / "bag_0.db3", definitions=False)
    log = load_ros_bag(path)
    assert {"vehicle_local_position", "sensor_combined"} <= set(log.topics)
    assert any("no readable definition" in note and "ros2 bag convert" in note for note in log.notes)


def test_a_bag_that_is_damaged_is_read_as_far_as_it_goes_or_told(tmp_path):
    path = as_db3(ros_messages(Bag(tmp_path / "bag.mcap")), tmp_path / "bag_0.db3")
    raw = path.read_bytes()
    for name, broken in (("half", raw[: len(raw) // 2]), ("none", b"no database"), ("empty", b"")):
        cut = tmp_path / f"{name}.db3"
        cut.write_bytes(broken)
        try:
            read_flight(cut, VEHICLE)
        except InputError as error:
            assert str(cut) in str(error) and "\n" not in str(error)


def test_a_definition_that_does_not_parse_is_told_in_a_note_and_nowhere_else(tmp_path, capfd):
    path = as_db3(ros_messages(Bag(tmp_path / "bag.mcap")), tmp_path / "bag_0.db3")
    with closing(sqlite3.connect(path)) as bag, bag:
        bag.execute(
            "UPDATE message_definitions SET encoded_message_definition = 'float64 x' || char(10) || 'int32[ n' "
            "WHERE topic_type = 'sensor_msgs/msg/Imu'"
        )
    log = load_ros_bag(path)
    assert "vehicle_local_position" in log.topics
    assert any("no readable definition" in note for note in log.notes)
    assert capfd.readouterr() == ("", "")


def test_a_pose_alone_gives_a_flight_whose_velocity_is_differentiated(tmp_path):
    flight = read_flight(ros_messages(Bag(tmp_path / "bag.mcap"), odometry=False).save(), VEHICLE)
    agrees(flight, ("position", "specific_force", "angular_velocity"))
    assert flight.velocity is not None
    assert any("/mocap/pose" in note for note in flight.notes)
    assert any("differentiated from the position" in note for note in flight.notes)


def test_setpoints_on_another_clock_are_shifted_to_the_vehicles(tmp_path):
    """PX4 counts from boot, the node that commands it from 1970."""
    log, setpoints = log_of("1.16"), log_of("1.16")
    commanded = ("vehicle_thrust_setpoint", "vehicle_rates_setpoint")
    log.topics = [topic for topic in log.topics if topic[0] not in (*commanded, "actuator_motors")]
    setpoints.topics = [topic for topic in setpoints.topics if topic[0] in commanded]
    bag = px4_topics(Bag(tmp_path / "bag.mcap"), log, clock=0.0)
    flight = read_flight(px4_topics(bag, setpoints, clock=EPOCH, space="/fmu/in").save(), VEHICLE)
    agrees(flight)
    assert any("another clock" in note for note in flight.notes)


def test_of_two_vehicles_one_is_read(tmp_path):
    bag = px4_topics(Bag(tmp_path / "bag.mcap"), log_of("1.16"), space="/px4_1/fmu/out")
    other = log_of("1.16")
    other.topics = [(n, i, t[: len(t) // 2], {k: (c, np.asarray(v)[: len(t) // 2]) for k, (c, v) in f.items()})
                    for n, i, t, f in other.topics]  # fmt: skip
    flight = read_flight(px4_topics(bag, other, space="/px4_2/fmu/out").save(), VEHICLE)
    agrees(flight)
    assert any("2 vehicles" in note and "/px4_1" in note for note in flight.notes)


def test_a_recording_cut_off_or_damaged_keeps_what_is_whole(tmp_path):
    bag = px4_topics(Bag(tmp_path / "bag.mcap"), log_of("1.16"))
    bag.chunk = 20_000
    content = bag.save().read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(content[: int(0.7 * len(content))])
    flight = read_flight(path, VEHICLE)
    assert any("not whole" in note for note in flight.notes) and flight.duration > 10.0
    path.write_bytes(content[: len(content) // 2] + bytes(200) + content[len(content) // 2 + 200 :])
    flight = read_flight(path, VEHICLE)
    assert any("damaged parts" in note for note in flight.notes)
    path.write_bytes(content[:3000])
    with pytest.raises(InputError, match="PX4 flight"):
        read_flight(path, VEHICLE)


def test_a_recording_of_something_else_says_what_it_has(tmp_path):
    bag = Bag(tmp_path / "bag.mcap")
    for i in range(100):
        bag.put(0.1 * i, "/camera/info", "std_msgs/msg/Header", "builtin_interfaces/Time stamp\nstring frame_id"
                + HEADER, {"stamp": {"sec": i, "nanosec": 0}, "frame_id": "x"})  # fmt: skip
    with pytest.raises(InputError, match="/camera/info"):
        read_flight(bag.save(), VEHICLE)


def test_a_recording_without_thrust_says_so(tmp_path):
    bag = ros_messages(Bag(tmp_path / "bag.mcap"))
    bag.pending = [entry for entry in bag.pending if "target_attitude" not in entry[1]]
    with pytest.raises(InputError, match="no thrust command"):
        read_flight(bag.save(), VEHICLE)


def test_flights_lists_recordings_of_ros(tmp_path):
    px4_topics(Bag(tmp_path / "bag.mcap"), log_of("1.16")).save()
    (tmp_path / "vehicle.toml").write_text('name = "quad5"\nmass = 0.75\nhover_thrust = 0.38\n')
    done = subprocess.run(
        [BIN / "groundstation", "flights", tmp_path, "--json"], capture_output=True, check=True
    )
    (row,) = json.loads(done.stdout)
    assert row["error"] == "" and row["flying"] > 10.0
    assert BOOT > 0


@pytest.mark.parametrize(
    ("clock", "said"), [(lambda t: 3.0 + 0 * t, "by 3 s"), (lambda t: 0.02 * (t - BOOT), "drifts")]
)
def test_a_topic_of_a_computer_that_is_not_synchronised_is_brought_to_the_others(clock, said, tmp_path):
    one, bag = flown(), ros_messages(Bag(tmp_path / "bag.mcap"), odometry=False)
    bag.pending = [entry for entry in bag.pending if "/mocap/" not in entry[1]]
    other = Bag(tmp_path / "none.mcap")
    poses(other, "/mocap/pose", replace(one, t=one.t - clock(one.t)))
    received = one.t[::2] + 0.003
    bag.pending += [(when, *entry[1:]) for when, entry in zip(received, other.pending, strict=True)]
    flight = read_flight(bag.save(), VEHICLE)
    agrees(flight, ("position", "specific_force", "angular_velocity"), 4.0)
    assert any(said in note and "/mocap/pose" in note for note in flight.notes)
