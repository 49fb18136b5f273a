"""Recordings of ROS 2 for tests: PX4's messages, MAVROS', a motion capture's."""

import sqlite3
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from mcap_ros2._dynamic import serialize_dynamic
from mcap_ros2.writer import Writer
from px4_layouts import Flown, flown
from ulog_writer import TYPES, Written

from trueflight.models.frames import rotate_inverse

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
    "sensor_msgs/msg/BatteryState": "std_msgs/Header header\nfloat32 voltage\nfloat32 temperature\nfloat32 current"
    + HEADER,
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


TABLES = (
    "topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT)",
    "messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)",
    "message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT, encoded_message_definition TEXT, "
    "type_description_hash TEXT)",
)


def as_db3(bag: Bag, path: Path, definitions: bool = True) -> Path:
    """The recording as rosbag2's SQLite storage keeps it, with the definitions of its messages or without."""
    store = sqlite3.connect(path)
    for table in TABLES[: 2 + definitions]:
        store.execute(f"CREATE TABLE {table}")
    told = {kind: definition for _, _, kind, definition, _ in bag.pending}
    if definitions:
        rows = [(number, kind, "ros2msg", text, "") for number, (kind, text) in enumerate(told.items())]
        store.executemany("INSERT INTO message_definitions VALUES (?, ?, ?, ?, ?)", rows)
    encode = {kind: serialize_dynamic(kind, definition)[kind] for kind, definition in told.items()}
    numbers: dict[str, int] = {}
    for t, topic, kind, _, message in sorted(bag.pending, key=lambda entry: entry[0]):
        if topic not in numbers:
            numbers[topic] = len(numbers) + 1
            store.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (numbers[topic], topic, kind))
        row = (numbers[topic], round(1e9 * (EPOCH + t)), bytes(encode[kind](message)))
        store.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    store.commit()
    store.close()
    return path


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


def ros_messages(
    bag: Bag, twist_in_world: bool = False, odometry: bool = True, space: str = "", one: Flown | None = None
) -> Bag:
    """What MAVROS or a motion capture sends of a flight: ENU and FLU; MAVROS in the namespace `space`."""
    one = one or flown()
    for row, t in enumerate(one.t):
        q = one.quaternion[row]
        pose = {"position": vector(one.position[row]), "orientation": turn(q)}
        if odometry and row % 2 == 0:
            velocity = one.velocity[row] if twist_in_world else rotate_inverse(q, one.velocity[row])
            twist = {"linear": vector(velocity), "angular": vector(np.zeros(3))}
            put(bag, t, f"{space}/mavros/local_position/odom", "nav_msgs/msg/Odometry", header=header(t),
                child_frame_id="base_link", pose={"pose": pose, "covariance": [0.0] * 36},
                twist={"twist": twist, "covariance": [0.0] * 36})  # fmt: skip
        if row % 2 == 0:
            put(bag, t, f"{space}/mocap/pose", "geometry_msgs/msg/PoseStamped", header=header(t), pose=pose)
            put(bag, t, f"{space}/mavros/setpoint_raw/target_attitude", "mavros_msgs/msg/AttitudeTarget",
                header=header(t), type_mask=0, orientation=turn(q), body_rate=vector(one.body_rate_command[row]),
                thrust=float(one.thrust[row]))  # fmt: skip
        put(bag, t, f"{space}/mavros/imu/data", "sensor_msgs/msg/Imu", header=header(t), orientation=turn(q),
            orientation_covariance=[0.0] * 9, angular_velocity=vector(one.angular_velocity[row]),
            angular_velocity_covariance=[0.0] * 9, linear_acceleration=vector(one.specific_force[row]),
            linear_acceleration_covariance=[0.0] * 9)  # fmt: skip
        if row % 50 == 0:
            put(bag, t, f"{space}/mavros/state", "mavros_msgs/msg/State", header=header(t), connected=True,
                armed=bool(one.armed[row]), mode="OFFBOARD")  # fmt: skip
            put(bag, t, f"{space}/mavros/battery", "sensor_msgs/msg/BatteryState", header=header(t),
                voltage=float(one.voltage[row]), temperature=0.0, current=-10.0)  # fmt: skip
    return bag


def put(bag, t, topic, kind, **fields):
    bag.put(t + 0.003, topic, kind, DEFINITIONS[kind], fields)


def imu(bag: Bag, topic: str, one: Flown, every: int = 1, unit: float = 1.0) -> None:
    """An IMU's topic, its accelerometer divided by `unit`."""
    nothing = {"w": 0.0, "x": 0.0, "y": 0.0, "z": 0.0}
    for row in range(0, len(one.t), every):
        put(bag, one.t[row], topic, "sensor_msgs/msg/Imu", header=header(one.t[row]), orientation=nothing,
            orientation_covariance=[0.0] * 9, angular_velocity=vector(one.angular_velocity[row]),
            angular_velocity_covariance=[0.0] * 9, linear_acceleration=vector(one.specific_force[row] / unit),
            linear_acceleration_covariance=[0.0] * 9)  # fmt: skip


def poses(bag: Bag, topic: str, one: Flown, every: int = 2) -> None:
    """A body's pose."""
    for row in range(0, len(one.t), every):
        pose = {"position": vector(one.position[row]), "orientation": turn(one.quaternion[row])}
        put(bag, one.t[row], topic, "geometry_msgs/msg/PoseStamped", header=header(one.t[row]), pose=pose)


def thrust(bag: Bag, topic: str, one: Flown, every: int = 2) -> None:
    """What MAVROS was asked for."""
    for row in range(0, len(one.t), every):
        put(bag, one.t[row], topic, "mavros_msgs/msg/AttitudeTarget", header=header(one.t[row]), type_mask=0,
            orientation=turn(one.quaternion[row]), body_rate=vector(one.body_rate_command[row]),
            thrust=float(one.thrust[row]))  # fmt: skip


def battery(bag: Bag, topic: str, t: np.ndarray, voltage: np.ndarray, current: float) -> None:
    """A battery that gives `current` (A; negative in the message, as its definition says)."""
    for when, volts in zip(t[::20], voltage[::20], strict=True):
        put(bag, when, topic, "sensor_msgs/msg/BatteryState", header=header(when), voltage=float(volts),
            temperature=0.0, current=-current)  # fmt: skip
