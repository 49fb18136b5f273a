"""Of several vehicles, bodies, IMUs and batteries one is read, told with the others; setpoints never are."""

import json
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import typer.main
from px4_layouts import Flown, _battery, flown, log_of, middle_of
from ros_bag_writer import Bag, battery, imu, poses, ros_messages, thrust

from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.mapping import load_mapping
from trueflight.groundstation.reading.px4_log import Log
from trueflight.groundstation.reading.ros_bag import load_ros_bag
from trueflight.groundstation.reading.sources import as_lines
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.shipped import QUAD5
from trueflight.models.vehicle import Vehicle

VEHICLE = Vehicle("quad5", mass=0.75, hover_thrust=0.38)
BIN = Path(sys.executable).parent


@cache
def stranger() -> Flown:
    """Another vehicle, in the air at the same times."""
    other = flown(7, "lemniscate")
    count = min(len(other.t), len(flown().t))
    return replace(
        other,
        **{n: v[:count] for n, v in vars(other).items() if isinstance(v, np.ndarray)},
        middle=other.middle,
    )


def is_flight(flight: Flight, one: Flown) -> bool:
    """Whether every column that was read is of `one`."""
    rows, same = middle_of(flight, one)
    apart = [
        np.sqrt(np.mean((getattr(flight, name)[rows] - getattr(one, name)[same]) ** 2))
        for name in ("position", "specific_force", "angular_velocity")
        if getattr(flight, name) is not None
    ]
    apart.append(10 * np.sqrt(np.mean((flight.thrust_command[rows] - one.thrust[same]) ** 2)))
    return max(apart) < 0.3


def told(flight: Flight, *words: str) -> bool:
    return any(all(word in note for word in words) for note in flight.notes)


def test_of_two_vehicles_in_one_recording_nothing_is_mixed(tmp_path: Path) -> None:
    bag = ros_messages(Bag(tmp_path / "bag.mcap"), space="/uav1")
    ros_messages(bag, space="/uav2", one=stranger())
    thrust(bag, "/uav2/mavros/setpoint_raw/attitude", stranger(), every=1)  # the fastest of all is another's
    path = bag.save()
    flight = read_flight(path, VEHICLE)
    assert is_flight(flight, flown())
    assert told(flight, "2 vehicles", "namespace /uav1", "--vehicle-namespace /uav2")
    assert is_flight(read_flight(path, VEHICLE, 'vehicle_namespace = "uav2"'), stranger())
    with pytest.raises(InputError, match=r"no vehicle with the namespace '/uav3'.* it has /uav1, /uav2"):
        read_flight(path, VEHICLE, 'vehicle_namespace = "/uav3"')


def test_another_vehicles_imu_stands_in_for_nothing(tmp_path: Path) -> None:
    bag = ros_messages(Bag(tmp_path / "bag.mcap"), space="/uav1")
    bag.pending = [entry for entry in bag.pending if "/imu/" not in entry[1]]
    imu(bag, "/uav2/mavros/imu/data", stranger())
    log = load_ros_bag(bag.save())
    assert "vehicle_attitude" in log.topics and "sensor_combined" not in log.topics


def test_without_a_bridge_names_tell_vehicles_apart(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "bag.mcap")
    for space, one, every in (("cf1", flown(), 2), ("cf2", stranger(), 1)):
        poses(bag, f"/vrpn/{space}/pose", one, every)
        imu(bag, f"/{space}/imu", one, every)
    thrust(bag, "/cf1/cmd_attitude", flown())
    log = load_ros_bag(bag.save())
    assert is_pose(log, flown())
    assert any("/cf2/imu" in note and "left out" in note for note in log.notes)


def mocap(path: Path, other: Flown, imus: bool = True) -> Path:
    bag = Bag(path)
    poses(bag, "/vrpn_mocap/drone/pose", flown())
    poses(bag, "/vrpn_mocap/another/pose", other, every=1)
    thrust(bag, "/mavros/setpoint_raw/target_attitude", flown())
    if imus:
        imu(bag, "/mavros/imu/data", flown())
    return bag.save()


def test_the_body_that_turns_as_the_gyroscope_says_is_the_vehicle(tmp_path: Path) -> None:
    path = mocap(tmp_path / "bag.mcap", stranger())
    flight = read_flight(path, VEHICLE)
    assert is_flight(flight, flown())
    assert told(flight, "2 poses", "/vrpn_mocap/drone/pose is read", "gyroscope", "/vrpn_mocap/another/pose")
    chosen = 'topics.position = "/vrpn_mocap/another/pose"'
    with pytest.raises(InputError, match=r"contradict each other|in the air"):  # asked for, and refused
        read_flight(path, VEHICLE, chosen)


def test_a_body_that_stands_is_not_the_vehicle(tmp_path: Path) -> None:
    one = flown()
    stands = replace(one, position=0.0 * one.position, quaternion=one.quaternion[:1].repeat(len(one.t), 0))
    log = load_ros_bag(mocap(tmp_path / "bag.mcap", stands, imus=False))
    assert is_pose(log, one)
    assert any("/vrpn_mocap/drone/pose is read, the only one that moves" in note for note in log.notes)


def is_pose(log: Log, one: Flown) -> bool:
    topic = log.of("position").topics["vehicle_local_position"][0]
    assert len(topic.t) == len(one.t[::2])
    return bool(np.allclose(topic.stack("y", "x", "z") * [1, 1, -1], one.position[::2], atol=1e-6))


def test_where_nothing_tells_which_body_flies_the_list_is_given(tmp_path: Path) -> None:
    path = mocap(tmp_path / "bag.mcap", stranger(), imus=False)
    with pytest.raises(InputError, match=r"2 poses .*another/pose.*drone/pose.*--topic position=/vrpn_mocap"):
        read_flight(path, VEHICLE)
    (tmp_path / "mine.toml").write_text('[topics]\nposition = "/vrpn_mocap/drone/pose"\n')
    assert is_pose(load_ros_bag(path, load_mapping(tmp_path / "mine.toml").sources), flown())
    with pytest.raises(
        InputError, match="no topic '/no/pose' for position in the recording; it has /vrpn_mocap/an"
    ):
        read_flight(path, VEHICLE, 'topics.position = "/no/pose"')


def test_setpoints_another_imu_and_another_battery_are_not_the_vehicles(tmp_path: Path) -> None:
    bag = ros_messages(Bag(tmp_path / "bag.mcap"), odometry=False)
    bag.pending = [entry for entry in bag.pending if "/mocap/" not in entry[1] and "battery" not in entry[1]]
    poses(bag, "/mavros/local_position/pose", flown(), every=4)
    for wanted in ("/mavros/setpoint_position/local", "/planner/desired_pose", "/goal"):
        poses(bag, wanted, stranger(), every=2)
    imu(bag, "/lidar/imu", flown(), unit=9.81)
    imu(bag, "/lidar/imu", replace(flown(), t=flown().t + 0.005), unit=9.81)
    one = flown()
    battery(bag, "/mavros/battery", one.t, one.voltage - 4.0, 0.2)
    battery(bag, "/mavros/battery2", one.t, one.voltage, 12.0)
    flight = read_flight(bag.save(), VEHICLE)
    assert is_flight(flight, one)
    rows, same = middle_of(flight, one)
    np.testing.assert_allclose(flight.battery_voltage[rows], one.voltage[same], atol=0.1)
    assert told(flight, "/goal", "/planner/desired_pose", "setpoints are no measurements")
    assert told(flight, "2 IMUs", "/mavros/imu/data is read", "--topic specific_force=/lidar/imu")
    assert told(flight, "2 batteries", "/mavros/battery2 is read", "current")


def test_a_ulogs_instances_are_chosen_by_number(tmp_path: Path) -> None:
    log, one = log_of("1.16"), flown()
    for instance, bias in ((0, 0.0), (1, 0.5)):
        x, y, z = ((one.specific_force + bias) * [1.0, -1.0, -1.0]).T
        log.add("sensor_accel", one.t, instance, x=("f", x), y=("f", y), z=("f", z))
    _battery(log, replace(one, voltage=one.voltage - 3.0), (1, 16), 1, current=0.3)
    path = log.save(tmp_path / "log.ulg")
    plain = read_flight(path, VEHICLE)
    assert told(plain, "2 batteries", "battery_status:0", "--topic battery_voltage=battery_status:1")
    how = as_lines(None, ["battery_voltage=battery_status:1", "specific_force=sensor_accel:1"])
    flight = read_flight(path, VEHICLE, how)
    rows, same = middle_of(flight, one)
    np.testing.assert_allclose(flight.battery_voltage[rows], one.voltage[same] - 3.0, atol=0.1)
    biased = np.mean(flight.specific_force[rows] - plain.specific_force[rows], axis=0)
    np.testing.assert_allclose(biased, 0.5, atol=0.05)
    with pytest.raises(
        InputError, match=r"no topic 'battery_status:7' .* it has battery_status, battery_status:1$"
    ):
        read_flight(path, VEHICLE, 'topics.battery_voltage = "battery_status:7"')
    with pytest.raises(InputError, match="a ULog holds one vehicle"):
        read_flight(path, VEHICLE, 'vehicle_namespace = "/uav1"')


def test_batteries_that_nothing_tells_apart_are_left_out(tmp_path: Path) -> None:
    log, one = log_of("1.16", leave_out=("battery_status",)), flown()
    for instance, less in ((0, 0.0), (1, 4.0)):
        log.add("battery_status", one.t[::20], instance, voltage_v=("f", one.voltage[::20] - less))
    flight = read_flight(log.save(tmp_path / "log.ulg"), VEHICLE)
    assert flight.battery_voltage is None
    assert told(flight, "2 batteries", "left out", "--topic battery_voltage=battery_status:0")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["position"], "QUANTITY=NAME"),
        (["positon=/a"], "did you mean 'position'"),
        (["position=/a", "position=/b"], "/a and from /b; choose one"),
    ],
)
def test_a_choice_that_cannot_be_read_is_told(given: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        as_lines(None, given)


def test_every_command_that_reads_flights_can_choose() -> None:
    from trueflight.groundstation.commands.app import app

    def commands(group):
        for command in group.commands.values():
            yield from commands(command) if hasattr(command, "commands") else [command]

    reading = [c for c in commands(typer.main.get_command(app)) if any(p.name == "vehicle" for p in c.params)]
    mapped = {c.name for c in reading if any("--mapping" in p.opts for p in c.params)}
    chosen = {c.name for c in reading if any("--topic" in p.opts for p in c.params)}
    assert (
        mapped == chosen and {"diagnose", "compare", "where", "track", "import", "survey", "train"} <= chosen
    )


def test_the_options_reach_the_reader(tmp_path: Path) -> None:
    path = mocap(tmp_path / "bag.mcap", stranger())
    command = [BIN / "groundstation", "import", path, "--check", "--vehicle", QUAD5, "--json"]
    done = subprocess.run(
        [*command, "--topic", "attitude=/vrpn_mocap/drone/pose", "--topic", "position=/vrpn_mocap/drone/pose"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert any("as chosen" in note for note in json.loads(done.stdout)["notes"])
    done = subprocess.run([*command, "--vehicle-namespace", "/uav9"], capture_output=True, text=True)
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1
