"""A vehicle seen by ROS 2: keys, tokens and attachments of rmw_zenoh on real sessions; its messages are decoded by
another library than wrote them."""

import json
import math
import queue
import socket
import struct
import sys
import time

import numpy as np
import programs
import pytest
import websockets.sync.client
import zenoh
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore

from trueflight.companion.telemetry import Telemetry, make_event
from trueflight.companion.zenoh_session import ZenohSettings, open_session
from trueflight.groundstation.operate.foxglove import FoxgloveServer, layout
from trueflight.groundstation.operate.link import Link
from trueflight.groundstation.operate.ros2 import (
    Messages,
    Place,
    RosNode,
    RosTopic,
    Trail,
    attachment,
    publisher_token,
    ros_name,
    topic_key,
    topics_of,
)
from trueflight.groundstation.operate.ros2_bridge import Bridge, open_ros
from trueflight.groundstation.operate.settings import Settings
from trueflight.models.errors import InputError
from trueflight.models.frames import quaternion_from_euler, rotate
from trueflight.models.record_pb2 import Tick

pytestmark = pytest.mark.realtime
PATIENCE = 30.0
STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
"""The hash of std_msgs/String that ROS 2 itself tells (`ros2 topic info -v /chatter`)."""


def decoded(kind: str, data: bytes):
    """A message as mcap-ros2-support reads it, by the definition that ROS distributes."""
    definition = get_typestore(Stores.ROS2_JAZZY).generate_msgdef(kind, ros_version=2)[0]
    return read(kind, definition.encode(), data)


def read(kind: str, definition: bytes, data: bytes):
    """A message by a definition in ROS' own words."""
    decode = DecoderFactory().decoder_for("cdr", Schema(1, definition, "ros2msg", kind))
    return decode(data)


def tick(t: float = 1.0, yaw: float = 0.7) -> Tick:
    one = Tick(
        vehicle_time_us=round(1e6 * t), phase="mission", armed=True, setpoint_sent=True, thrust_command=0.4
    )
    one.position.x, one.position.y, one.position.z = 1.0, -2.0, 3.0
    one.velocity.x, one.velocity.z = 0.5, -0.25
    q = quaternion_from_euler(np.array([0.1, -0.2, yaw]))
    one.quaternion.w, one.quaternion.x, one.quaternion.y, one.quaternion.z = q
    one.angular_velocity.z, one.specific_force.z, one.position_reference.z, one.body_rate_command.y = (
        0.3,
        9.8,
        3.5,
        0.2,
    )
    one.yaw_reference, one.battery_voltage, one.guard = yaw, 15.5, "active"
    return one


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def router():
    """What `rmw_zenohd` is: a Zenoh router, here with a subscriber of everything in it."""
    endpoint = free_endpoint()
    config = zenoh.Config()
    for key, value in (
        ("mode", "router"),
        ("listen/endpoints", [endpoint]),
        ("scouting/multicast/enabled", False),
    ):
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield endpoint, session


def test_messages_are_what_the_tick_says_in_the_frames_that_ros_wants():
    made = dict(Messages("quad5").of_tick(tick(), 1_780_000_000.25))
    odometry = decoded("nav_msgs/msg/Odometry", made["odometry"])
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "quad5/base_link")
    assert (odometry.header.stamp.sec, odometry.header.stamp.nanosec) == (1_780_000_000, 250_000_000)
    assert (odometry.pose.pose.position.x, odometry.pose.pose.position.y) == (1.0, -2.0)
    turn, twist = odometry.pose.pose.orientation, odometry.twist.twist
    q = np.array([turn.w, turn.x, turn.y, turn.z])
    np.testing.assert_allclose(
        rotate(q, [twist.linear.x, twist.linear.y, twist.linear.z]), [0.5, 0.0, -0.25], atol=1e-12
    )
    assert twist.angular.z == 0.3
    assert decoded("geometry_msgs/msg/PoseStamped", made["reference"]).pose.position.z == 3.5
    command = decoded("geometry_msgs/msg/TwistStamped", made["command"])
    assert (command.twist.linear.z, command.twist.angular.y) == (0.4, 0.2)
    assert decoded("sensor_msgs/msg/Imu", made["imu"]).linear_acceleration.z == 9.8
    battery = decoded("sensor_msgs/msg/BatteryState", Messages("quad5").battery(tick(), 1.0)[1])
    assert battery.voltage == 15.5 and math.isnan(battery.current)
    state = decoded("diagnostic_msgs/msg/DiagnosticArray", Messages("quad5").state(tick(), 1.0)[1]).status[0]
    assert {pair.key: pair.value for pair in state.values}["guard"] == "active"


def test_keys_tokens_and_attachments_are_those_of_rmw_zenoh():
    """As rmw_zenoh's source of October 2024 forms them, and its types' hashes."""
    chatter = RosTopic("/chatter", "std_msgs/msg/String")
    assert Messages("x").hash_of("std_msgs/msg/String") == STRING
    assert Messages("x", "humble").hash_of("std_msgs/msg/String") == "TypeHashNotSupported"
    assert topic_key(chatter, STRING, 2) == f"2/chatter/std_msgs::msg::dds_::String_/{STRING}"
    token = publisher_token("aac3178e", "talker", 1, chatter, STRING, 2)
    assert token == (
        f"@ros2_lv/2/aac3178e/0/1/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/{STRING}/::,10:,:,:,,"
    )
    number, when, length = struct.unpack_from("<qqB", attachment(3, 1.5, token))
    assert (number, when, length, len(attachment(3, 1.5, token))) == (3, 1_500_000_000, 16, 33)
    assert ros_name("my-quad.2") == "my_quad_2" and ros_name("5inch") == "v5inch"


def test_a_subscriber_of_ros_gets_what_the_companion_tells(router, tmp_path):
    endpoint, ros = router
    arrived: queue.SimpleQueue = queue.SimpleQueue()
    ros.declare_subscriber("0/**", arrived.put)
    tokens: list[str] = []
    ros.liveliness().declare_subscriber(
        "@ros2_lv/**", lambda sample: tokens.append(f"{sample.kind} {sample.key_expr}")
    )
    vehicle = free_endpoint()
    status = {"status": lambda payload, parameters: {"accepted": True, "phase": "idle"}}
    telemetry = Telemetry(open_session(ZenohSettings(listen=(vehicle,))), "quad5", status, tmp_path)
    try:
        with open_ros(endpoint) as session, Link(Settings(connect=(vehicle,), timeout=5.0)) as link:
            messages = Messages("quad5")
            node = RosNode(session, "quad5", messages)
            bridge = Bridge(node, messages)
            link.follow(bridge.ticks.put, bridge.events.put)
            found: dict[str, zenoh.Sample] = {}
            wanted = {topic_key(t, messages.hash_of(t.kind)) for t in topics_of("quad5").values()}
            until, row = time.monotonic() + PATIENCE, 0
            while time.monotonic() < until and not wanted <= set(found):
                row += 1
                telemetry.tick(tick(1.0 + 0.02 * row).SerializeToString())
                if row == 5:
                    telemetry.event(make_event("warning", "guard_trip", "out of the envelope"))
                time.sleep(0.02)
                bridge.forward()
                while not arrived.empty():
                    sample = arrived.get()
                    found[str(sample.key_expr)] = sample
            assert wanted <= set(found)
            key = topic_key(topics_of("quad5")["odometry"], messages.hash_of("nav_msgs/msg/Odometry"))
            assert decoded("nav_msgs/msg/Odometry", found[key].payload.to_bytes()).pose.pose.position.z == 3.0
            number, when, length = struct.unpack_from("<qqB", found[key].attachment.to_bytes())
            assert number >= 1 and length == 16 and abs(1e-9 * when - time.time()) < PATIENCE
            node.close()
    finally:
        telemetry.close()
    put = [t for t in tokens if "PUT" in t]
    assert sum("/MP/" in t for t in put) == len(topics_of("quad5")) and sum("/NN/" in t for t in put) == 1
    assert all("trueflight_quad5" in t for t in put)


def test_a_viewer_without_ros_reads_every_topic_by_the_definition_that_is_served():
    """A client of Foxglove's WebSocket protocol, spoken here; what it gets is read by another library."""
    messages, got = Messages("my-quad"), {}
    with FoxgloveServer("my-quad", messages, port=0) as server:
        bridge = Bridge(server, messages)
        with websockets.sync.client.connect(
            f"ws://127.0.0.1:{server.port}", subprotocols=["foxglove.sdk.v1"]
        ) as viewer:
            channels = {}
            while len(channels) < len(topics_of("my-quad")):
                told = json.loads(viewer.recv(PATIENCE))
                channels |= {one["id"]: one for one in told.get("channels", ())}
            asked = [{"id": number, "channelId": number} for number in channels]
            viewer.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
            until, row = time.monotonic() + PATIENCE, 0
            while time.monotonic() < until and len(got) < len(channels):
                row += 1
                bridge.ticks.put(tick(1.0 + 0.1 * row))
                bridge.forward()
                try:
                    frame = viewer.recv(0.05)
                except TimeoutError:
                    continue
                if isinstance(frame, bytes) and frame[0] == 1:
                    channel = channels[struct.unpack_from("<I", frame, 1)[0]]
                    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
                    got[channel["topic"]] = read(
                        channel["schemaName"], channel["schema"].encode(), frame[13:]
                    )
        with pytest.raises(InputError, match=f"127.0.0.1:{server.port}.*--port"):
            FoxgloveServer("my-quad", messages, port=server.port)
    assert set(got) == {topic.name for topic in topics_of("my-quad").values()}
    transform = got["/tf"].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "my_quad/base_link")
    assert (transform.transform.translation.x, transform.transform.translation.z) == (1.0, 3.0)
    assert got["/my_quad/odometry"].pose.pose.position.y == -2.0
    assert got["/my_quad/path"].poses[0].pose.position.z == 3.0
    assert got["/my_quad/reference_path"].poses[0].pose.position.z == 3.5


def test_the_layout_shows_topics_that_are_served():
    served = {topic.name for topic in topics_of("my-quad").values()}
    panels = layout("my-quad")["configById"]
    shown = set(panels["3D!scene"]["topics"])
    shown |= {path["value"].split(".")[0] for name in panels for path in panels[name].get("paths", ())}
    assert shown and shown <= served


def test_without_foxglove_sdk_what_to_install_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(InputError, match=r"pip install 'trueflight\[foxglove\]'"):
        FoxgloveServer("quad5", Messages("quad5"), port=0)


def test_a_path_is_the_last_half_minute_and_begins_anew_with_the_clock():
    trail = Trail()
    for row in range(64 * 40):
        trail.add(Place(100.0 + row / 64, tick().position, np.array([1.0, 0.0, 0.0, 0.0])))
    trail.forget(140.0)
    stamps = [place.stamp for place in trail.places]
    assert 110.0 <= stamps[0] < 110.2 and stamps[-1] > 139.8
    assert all(Trail.APART <= gap < Trail.APART + 2 / 64 for gap in np.diff(stamps))
    trail.add(Place(5.0, tick().position, np.array([1.0, 0.0, 0.0, 0.0])))
    assert [place.stamp for place in trail.places] == [5.0]


def test_no_router_is_told_with_how_to_start_it():
    with pytest.raises(InputError, match="rmw_zenohd"):
        open_ros(free_endpoint())
    done = programs.run("groundstation", "ros2-bridge", "--ros", "melodic")
    assert done.returncode == 2 and "humble, jazzy, kilted" in done.stderr
