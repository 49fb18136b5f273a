"""MCAP of ROS 2: PX4's messages make the same flight as its ULog; ROS' own stand in where they are missing."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap_ros2.writer import Writer
from px4_layouts import BOOT, flown, log_of, middle_of
from ulog_writer import TYPES, Written

from trueflight.groundstation.reading import read_flight
from trueflight.models.errors import InputError
from trueflight.models.frames import rotate_inverse
from trueflight.models.vehicle import Vehicle

VEHICLE = Vehicle("quad5", mass=0.75, hover_thrust=0.38)
BIN = Path(sys.executable).parent
EPOCH = 1_780_000_000.0  # s since 1970 when PX4's clock was 0
ROS_TYPES = {"float": "float32", "double": "float64", "bool": "bool"} | {
    name: name.removesuffix("_t") for name in TYPES.values() if name.endswith("_t")
}
HEADER = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec"""
XYZ = "float64 x\nfloat64 y\nfloat64 z"
GEOMETRY = f"""
================================================================================
MSG: geometry_msgs/Point
{XYZ}
================================================================================
MSG: geometry_msgs/Vector3
{XYZ}
================================================================================
MSG: geometry_msgs/Quaternion
{XYZ}
float64 w
================================================================================
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Twist
geometry_msgs/Vector3 linear
geometry_msgs/Vector3 angular
================================================================================
MSG: geometry_msgs/PoseWithCovariance
geometry_msgs/Pose pose
float64[36] covariance
================================================================================
MSG: geometry_msgs/TwistWithCovariance
geometry_msgs/Twist twist
float64[36] covariance"""
DEFINITIONS = {
    "nav_msgs/msg/Odometry": "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
    "geometry_msgs/TwistWithCovariance twist" + HEADER + GEOMETRY,
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose" + HEADER + GEOMETRY,
    "sensor_msgs/msg/Imu": "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
    "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
    "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
    "float64[9] linear_acceleration_covariance" + HEADER + GEOMETRY,
    "sensor_msgs/msg/BatteryState": "std_msgs/Header header\nfloat32 voltage\nfloat32 temperature" + HEADER,
    "mavros_msgs/msg/AttitudeTarget": "std_msgs/Header header\nuint8 type_mask\ngeometry_msgs/Quaternion orientation\n"
    "geometry_msgs/Vector3 body_rate\nfloat32 thrust" + HEADER + GEOMETRY,
    "mavros_msgs/msg/State": "std_msgs/Header header\nbool connected\nbool armed\nstring mode" + HEADER,
}


class Bag:
    """A recording that is being written; messages go in by time."""

    def __init__(self, path):
        self.path, self.pending, self.chunk = path, [], 1 << 20

    def put(self, t, topic, kind, definition, message, stamp=None):
        self.pending.append((t, topic, kind, definition, message))

    def save(self):
        with self.path.open("wb") as stream:
            writer = Writer(stream, chunk_size=self.chunk)
            schemas = {}
            for t, topic, kind, definition, message in sorted(self.pending, key=lambda entry: entry[0]):
                if kind not in schemas:
                    schemas[kind] = writer.register_msgdef(kind, definition)
                writer.write_message(topic, schemas[kind], message, log_time=round(1e9 * (EPOCH + t)))
            writer.finish()
        return self.path


def px4_topics(
    bag: Bag, log: Written, clock: float = EPOCH, space: str = "/fmu/out", version: str = ""
) -> Bag:
    """Every topic of a log as PX4 sends it to ROS; its stamps count from 1970 (`EPOCH`) or from boot (0)."""
    for name, _, t, fields in log.topics:
        kind = "px4_msgs/msg/" + "".join(word.capitalize() for word in name.split("_"))
        sizes = {k: np.asarray(v).shape[1] if np.asarray(v).ndim > 1 else 0 for k, (_, v) in fields.items()}
        lines = ["uint64 timestamp"]
        lines += [
            f"{ROS_TYPES[TYPES[c]]}{f'[{sizes[k]}]' if sizes[k] else ''} {k}" for k, (c, _) in fields.items()
        ]
        for row, when in enumerate(t):
            values = {k: np.asarray(v)[row].tolist() for k, (_, v) in fields.items()}
            if "timestamp_sample" in values:
                values["timestamp_sample"] += round(1e6 * clock)
            message = SimpleNamespace(timestamp=round(1e6 * (clock + when)), **values)
            bag.put(when + 0.003, f"{space}/{name}{version}", kind, "\n".join(lines), message)
    return bag


def vector(values):
    return dict(zip("xyz", map(float, values), strict=True))


def turn(q):
    return {"w": float(q[0]), "x": float(q[1]), "y": float(q[2]), "z": float(q[3])}


def header(t, frame="map"):
    whole = int(EPOCH + t)
    return {"stamp": {"sec": whole, "nanosec": round(1e9 * (EPOCH + t - whole))}, "frame_id": frame}


def ros_messages(bag: Bag, twist_in_world: bool = False, odometry: bool = True) -> Bag:
    """What MAVROS or a motion capture sends of the flight: ENU and FLU."""
    one = flown()
    for row, t in enumerate(one.t):
        q = one.quaternion[row]
        pose = {"position": vector(one.position[row]), "orientation": turn(q)}
        if odometry and row % 2 == 0:
            velocity = one.velocity[row] if twist_in_world else rotate_inverse(q, one.velocity[row])
            twist = {"linear": vector(velocity), "angular": vector(np.zeros(3))}
            put(bag, t, "/mavros/local_position/odom", "nav_msgs/msg/Odometry", header=header(t),
                child_frame_id="base_link", pose={"pose": pose, "covariance": [0.0] * 36},
                twist={"twist": twist, "covariance": [0.0] * 36})  # fmt: skip
        if row % 2 == 0:
            put(bag, t, "/mocap/pose", "geometry_msgs/msg/PoseStamped", header=header(t), pose=pose)
            put(bag, t, "/mavros/setpoint_raw/target_attitude", "mavros_msgs/msg/AttitudeTarget", header=header(t),
                type_mask=0, orientation=turn(q), body_rate=vector(one.body_rate_command[row]),
                thrust=float(one.thrust[row]))  # fmt: skip
        put(bag, t, "/mavros/imu/data", "sensor_msgs/msg/Imu", header=header(t), orientation=turn(q),
            orientation_covariance=[0.0] * 9, angular_velocity=vector(one.angular_velocity[row]),
            angular_velocity_covariance=[0.0] * 9, linear_acceleration=vector(one.specific_force[row]),
            linear_acceleration_covariance=[0.0] * 9)  # fmt: skip
        if row % 50 == 0:
            put(bag, t, "/mavros/state", "mavros_msgs/msg/State", header=header(t), connected=True,
                armed=bool(one.armed[row]), mode="OFFBOARD")  # fmt: skip
            put(bag, t, "/mavros/battery", "sensor_msgs/msg/BatteryState", header=header(t),
                voltage=float(one.voltage[row]), temperature=0.0)  # fmt: skip
    return bag


def put(bag, t, topic, kind, **fields):
    bag.put(t + 0.003, topic, kind, DEFINITIONS[kind], fields)


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
