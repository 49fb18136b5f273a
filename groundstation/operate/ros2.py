"""A vehicle as a ROS 2 node that publishes: for RViz, Foxglove, PlotJuggler and `ros2 topic echo`, without ROS here.

Messages are ROS' own, in CDR by rosbags' definitions; keys, liveliness tokens and attachments are those of `rmw_zenoh`
(its `docs/design.md`, `liveliness_utils.cpp` and `attachment_helpers.cpp`, 0.6 and later), so that its nodes see an
ordinary publisher. World ENU is the frame `map`, body FLU `NAME/base_link` (REP 103, REP 105).
"""

from __future__ import annotations

import hashlib
import struct
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import zenoh

from trueflight.models.frames import quaternion_from_euler, rotate_inverse
from trueflight.models.record_pb2 import Event, Tick, Vector3

DISTRIBUTIONS = ("humble", "jazzy", "kilted")
"""ROS 2 releases that `rmw_zenoh` is made for. Humble knows no hashes of types."""
DEPTH = 10
QUALITY = f"::,{DEPTH}:,:,:,,"
"""Quality of service in a token: reliable, volatile, the last ten, as rclcpp's own; what is empty is the default."""
LEVELS = {"info": 0, "warning": 1, "error": 2}
OK, WARN = 0, 1
MAP = "map"


@dataclass(frozen=True)
class RosTopic:
    """A topic: its whole name, and the type of its messages."""

    name: str
    kind: str


def topics_of(vehicle: str) -> dict[str, RosTopic]:
    """What is published of a vehicle, by what it tells."""
    space = f"/{ros_name(vehicle)}"
    return {
        "tf": RosTopic("/tf", "tf2_msgs/msg/TFMessage"),
        "odometry": RosTopic(f"{space}/odometry", "nav_msgs/msg/Odometry"),
        "reference": RosTopic(f"{space}/reference", "geometry_msgs/msg/PoseStamped"),
        "command": RosTopic(f"{space}/command", "geometry_msgs/msg/TwistStamped"),
        "imu": RosTopic(f"{space}/imu", "sensor_msgs/msg/Imu"),
        "path": RosTopic(f"{space}/path", "nav_msgs/msg/Path"),
        "reference_path": RosTopic(f"{space}/reference_path", "nav_msgs/msg/Path"),
        "battery": RosTopic(f"{space}/battery", "sensor_msgs/msg/BatteryState"),
        "diagnostics": RosTopic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
    }


def ros_name(vehicle: str) -> str:
    """The vehicle's name as ROS allows it: letters, digits and underscores, a letter first."""
    name = "".join(c if c.isascii() and c.isalnum() else "_" for c in vehicle)
    return name if name[:1].isalpha() else f"v{name}"


@dataclass(frozen=True)
class Place:
    """Where something was: `stamp` in s since 1970, `position` in m (ENU), `quaternion` w, x, y, z body to world."""

    stamp: float
    position: Vector3
    quaternion: np.ndarray


class Trail:
    """The places of the last `LASTING` seconds, one every `APART` seconds, oldest first."""

    LASTING, APART = 30.0, 0.1

    def __init__(self) -> None:
        self.places: deque[Place] = deque()

    def add(self, place: Place) -> None:
        """Take one more place; one before the last begins anew, for then the clock did."""
        if self.places and place.stamp < self.places[-1].stamp:
            self.places.clear()
        if not self.places or place.stamp - self.places[-1].stamp >= self.APART:
            self.places.append(place)

    def forget(self, now: float) -> None:
        """Let go what is too old at `now`, s since 1970."""
        while self.places and now - self.places[0].stamp > self.LASTING:
            self.places.popleft()


class Messages:
    """From ticks and events to ROS' messages, in CDR, of one release of ROS."""

    def __init__(self, vehicle: str, distribution: str = "jazzy") -> None:
        from rosbags.typesys import Stores, get_typestore

        self._store = get_typestore(Stores[f"ROS2_{distribution.upper()}"])
        self._hashed = distribution != "humble"
        self._body = f"{ros_name(vehicle)}/base_link"
        self._vehicle = vehicle

    def hash_of(self, kind: str) -> str:
        """The hash of a type as it stands in keys and tokens (REP 2016)."""
        return str(self._store.hash_rihs01(kind)) if self._hashed else "TypeHashNotSupported"

    def definition(self, kind: str) -> str:
        """A type's definition with those that it is made of, as ROS' `.msg` files have it, for readers without ROS."""
        text: str = self._store.generate_msgdef(kind, ros_version=2)[0]
        return text

    def of_tick(self, tick: Tick, stamp: float) -> Iterator[tuple[str, bytes]]:
        """What a tick tells, each with its key of `topics_of` and its bytes; `stamp` is its time, s since 1970."""
        q = turn(tick)
        pose = self._made(
            "geometry_msgs/msg/Pose", position=self._point(tick.position), orientation=self._turn(q)
        )
        twist = self._made(
            "geometry_msgs/msg/Twist",
            linear=self._vector(rotate_inverse(q, _array(tick.velocity)) if np.any(q) else np.zeros(3)),
            angular=self._vector(_array(tick.angular_velocity)),
        )
        if np.any(q):
            place = self._made(
                "geometry_msgs/msg/Transform",
                translation=self._vector(_array(tick.position)),
                rotation=self._turn(q),
            )
            yield self._packed("tf", "tf2_msgs/msg/TFMessage", transforms=[self._made(
                "geometry_msgs/msg/TransformStamped", header=self._header(stamp, MAP), child_frame_id=self._body,
                transform=place,
            )])  # fmt: skip
        unknown = np.zeros(36)
        yield self._packed(
            "odometry", "nav_msgs/msg/Odometry", header=self._header(stamp, MAP), child_frame_id=self._body,
            pose=self._made("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=unknown),
            twist=self._made("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown),
        )  # fmt: skip
        if tick.HasField("position_reference"):
            place = Place(stamp, tick.position_reference, reference_turn(tick))
            yield "reference", self._cdr(self._pose(place), "geometry_msgs/msg/PoseStamped")
        if tick.setpoint_sent:
            sent = self._made(
                "geometry_msgs/msg/Twist",
                linear=self._vector(np.array([0.0, 0.0, tick.thrust_command])),
                angular=self._vector(_array(tick.body_rate_command)),
            )
            yield self._packed(
                "command",
                "geometry_msgs/msg/TwistStamped",
                header=self._header(stamp, self._body),
                twist=sent,
            )
        if tick.HasField("specific_force"):
            known = np.zeros(9)
            yield self._packed(
                "imu", "sensor_msgs/msg/Imu", header=self._header(stamp, self._body), orientation=self._turn(q),
                orientation_covariance=known, angular_velocity=self._vector(_array(tick.angular_velocity)),
                angular_velocity_covariance=known, linear_acceleration=self._vector(_array(tick.specific_force)),
                linear_acceleration_covariance=known,
            )  # fmt: skip

    def path(self, topic: str, trail: Trail, stamp: float) -> tuple[str, bytes]:
        """A trail, as the path of that key of `topics_of`."""
        poses = [self._pose(place) for place in trail.places]
        return self._packed(topic, "nav_msgs/msg/Path", header=self._header(stamp, MAP), poses=poses)

    def battery(self, tick: Tick, stamp: float) -> tuple[str, bytes]:
        """The battery's voltage; what is not known is NaN, as the message's definition asks."""
        nan = float("nan")
        return self._packed(
            "battery", "sensor_msgs/msg/BatteryState", header=self._header(stamp, self._body),
            voltage=tick.battery_voltage or nan, temperature=nan, current=nan, charge=nan, capacity=nan,
            design_capacity=nan, percentage=nan, power_supply_status=0, power_supply_health=0,
            power_supply_technology=0, present=tick.battery_voltage > 0, cell_voltage=np.zeros(0, np.float32),
            cell_temperature=np.zeros(0, np.float32), location="", serial_number="",
        )  # fmt: skip

    def state(self, tick: Tick, stamp: float) -> tuple[str, bytes]:
        """How the flight stands, as a diagnostic: phase, controller, guard, what it cost."""
        tripped = "tripped" in tick.guard
        values = {
            "phase": tick.phase, "flight mode": tick.flight_mode, "armed": str(tick.armed),
            "controller": tick.controller, "model": tick.model, "guard": tick.guard, "trajectory": tick.trajectory,
            "latency (ms)": f"{1e3 * tick.latency:.2f}", "interval (ms)": f"{1e3 * tick.interval:.2f}",
        }  # fmt: skip
        text = tick.guard if tripped else tick.phase
        return self._diagnostic("flight", WARN if tripped else OK, text, values, stamp)

    def of_event(self, event: Event, stamp: float) -> tuple[str, bytes]:
        """An event of the companion as a diagnostic."""
        return self._diagnostic(event.kind, LEVELS.get(event.level, WARN), event.text, {}, stamp)

    def _diagnostic(
        self, what: str, level: int, text: str, values: dict[str, str], stamp: float
    ) -> tuple[str, bytes]:
        pairs = [self._made("diagnostic_msgs/msg/KeyValue", key=k, value=v) for k, v in values.items()]
        status = self._made(
            "diagnostic_msgs/msg/DiagnosticStatus", level=level, name=f"trueflight: {self._vehicle}: {what}",
            message=text, hardware_id=self._vehicle, values=pairs,
        )  # fmt: skip
        return self._packed(
            "diagnostics",
            "diagnostic_msgs/msg/DiagnosticArray",
            header=self._header(stamp, ""),
            status=[status],
        )

    def _packed(self, topic: str, kind: str, **fields: Any) -> tuple[str, bytes]:
        return topic, self._cdr(self._made(kind, **fields), kind)

    def _cdr(self, message: Any, kind: str) -> bytes:
        return bytes(self._store.serialize_cdr(message, kind))

    def _pose(self, place: Place) -> Any:
        pose = self._made(
            "geometry_msgs/msg/Pose",
            position=self._point(place.position),
            orientation=self._turn(place.quaternion),
        )
        return self._made("geometry_msgs/msg/PoseStamped", header=self._header(place.stamp, MAP), pose=pose)

    def _made(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def _header(self, stamp: float, frame: str) -> Any:
        whole = int(stamp)
        time = self._made(
            "builtin_interfaces/msg/Time", sec=whole, nanosec=min(int(1e9 * (stamp - whole)), 999_999_999)
        )
        return self._made("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def _vector(self, v: np.ndarray) -> Any:
        return self._made("geometry_msgs/msg/Vector3", x=float(v[0]), y=float(v[1]), z=float(v[2]))

    def _point(self, v: Vector3) -> Any:
        return self._made("geometry_msgs/msg/Point", x=v.x, y=v.y, z=v.z)

    def _turn(self, q: np.ndarray) -> Any:
        w, x, y, z = (float(c) for c in q)
        return self._made("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def turn(tick: Tick) -> np.ndarray:
    """The attitude of a tick, w x y z body to world; zeros where it is unknown."""
    return np.array([tick.quaternion.w, tick.quaternion.x, tick.quaternion.y, tick.quaternion.z])


def reference_turn(tick: Tick) -> np.ndarray:
    """The reference's yaw as a quaternion w, x, y, z."""
    return quaternion_from_euler(np.array([0.0, 0.0, tick.yaw_reference]))


class Publisher(Protocol):
    """Where messages go: a node of ROS, or a server that viewers ask."""

    @property
    def sent(self) -> int:
        """Messages sent so far."""

    def publish(self, topic: str, data: bytes, stamp: float) -> None:
        """Send one message of a key of `topics_of`; `stamp` is now, s since 1970."""


def _array(v: Vector3) -> np.ndarray:
    return np.array([v.x, v.y, v.z])


def topic_key(topic: RosTopic, type_hash: str, domain: int = 0) -> str:
    """The key that `rmw_zenoh` subscribes to for a topic."""
    return f"{domain}/{topic.name.strip('/')}/{_dds(topic.kind)}/{type_hash}"


def node_token(session_id: str, node: str, domain: int = 0) -> str:
    """The liveliness token of a node in the root namespace."""
    return f"@ros2_lv/{domain}/{session_id}/0/0/NN/%/%/{node}"


def publisher_token(
    session_id: str, node: str, number: int, topic: RosTopic, type_hash: str, domain: int = 0
) -> str:
    """The liveliness token of the node's publisher with this number, from 1 on."""
    told = f"{topic.name.replace('/', '%')}/{_dds(topic.kind)}/{type_hash}/{QUALITY}"
    return f"@ros2_lv/{domain}/{session_id}/0/{number}/MP/%/%/{node}/{told}"


def _dds(kind: str) -> str:
    """nav_msgs/msg/Odometry as nav_msgs::msg::dds_::Odometry_."""
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


def attachment(number: int, stamp: float, token: str) -> bytes:
    """What goes with every message: its number, from 1 on, the time of sending in ns, and who sends, in 16 bytes."""
    sender = hashlib.blake2b(token.encode(), digest_size=16).digest()
    return struct.pack("<qqB", number, int(1e9 * stamp), len(sender)) + sender


class RosNode:
    """A node with a publisher for each topic, on a Zenoh session that reaches `rmw_zenoh`'s router."""

    def __init__(self, session: zenoh.Session, vehicle: str, messages: Messages, domain: int = 0) -> None:
        who, node = str(session.info.zid()), f"trueflight_{ros_name(vehicle)}"
        self._tokens = [session.liveliness().declare_token(node_token(who, node, domain))]
        self._publishers: dict[str, tuple[zenoh.Publisher, str]] = {}
        self._sent: dict[str, int] = {}
        for number, (name, topic) in enumerate(topics_of(vehicle).items(), 1):
            told = messages.hash_of(topic.kind)
            token = publisher_token(who, node, number, topic, told, domain)
            self._tokens.append(session.liveliness().declare_token(token))
            publisher = session.declare_publisher(
                topic_key(topic, told, domain), congestion_control=zenoh.CongestionControl.DROP
            )
            self._publishers[name] = publisher, token

    def publish(self, topic: str, data: bytes, stamp: float) -> None:
        """Send one message; `stamp` is now, s since 1970."""
        publisher, token = self._publishers[topic]
        self._sent[topic] = self._sent.get(topic, 0) + 1
        publisher.put(data, attachment=attachment(self._sent[topic], stamp, token))

    @property
    def sent(self) -> int:
        """Messages sent so far."""
        return sum(self._sent.values())

    def close(self) -> None:
        """Take the node and its publishers away from those who look."""
        for token in self._tokens:
            token.undeclare()
        for publisher, _ in self._publishers.values():
            publisher.undeclare()
