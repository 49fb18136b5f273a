"""The vehicle on MAVLink, seen with pymavlink from the other end of a real UDP link."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from bridge_process import Bridge
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mav

from trueflight.models.frames import enu_flu_from_ned_frd, enu_from_ned, rotate
from trueflight.sim_bridge.mavlink.esc_status import ESC_STATUS, EscStatus
from trueflight.sim_bridge.mavlink.wire import float_of_int, int_of_float
from trueflight.sim_bridge.modes import Mode
from trueflight.sim_bridge.pilot import send_order

pytestmark = pytest.mark.realtime

mavutil.mavlink = mav
OFFBOARD = Mode.OFFBOARD.custom_mode


class Client:
    """A ground station or companion on the link; keeps every message it has seen."""

    def __init__(self, bridge: Bridge, kind: int) -> None:
        self.link = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{bridge.companion}", source_system=245, source_component=191, dialect="common"
        )
        self.kind = kind
        self.seen: list[Any] = []
        self._beat = 0.0
        self.wait(lambda m: m.get_type() == "HEARTBEAT")

    def pump(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._next(max(end - time.monotonic(), 0.001))

    def _next(self, timeout: float) -> Any:
        if time.monotonic() - self._beat > 0.5 and self.link.address is not None:
            self._beat = time.monotonic()
            self.link.mav.heartbeat_send(self.kind, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE)
        message = self.link.recv_match(blocking=True, timeout=timeout)
        if message is not None:
            self.seen.append(message)
        return message

    def wait(self, condition: Callable[[Any], bool], timeout: float = 60.0) -> Any:
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            message = self._next(0.2)
            if message is not None and condition(message):
                return message
        raise AssertionError("the message did not come")

    def of(self, kind: str, since: int = 0) -> list[Any]:
        return [message for message in self.seen[since:] if message.get_type() == kind]

    def command(self, number: int, *parameters: float) -> int:
        values = [*parameters, *(math.nan,) * (7 - len(parameters))]
        self.link.mav.command_long_send(1, 1, number, 0, *values)
        ack = self.wait(lambda m: m.get_type() == "COMMAND_ACK" and m.command == number)
        assert (ack.target_system, ack.target_component) == (245, 191)
        return int(ack.result)

    def heartbeat(self, condition: Callable[[Any], bool]) -> Any:
        return self.wait(lambda m: m.get_type() == "HEARTBEAT" and condition(m))

    def position(self, north: float, east: float, down: float, yaw: float) -> None:
        mask = 0b101111111000
        self.link.mav.set_position_target_local_ned_send(
            0, 1, 1, mav.MAV_FRAME_LOCAL_NED, mask, north, east, down, 0, 0, 0, 0, 0, 0, yaw, 0
        )

    def estimator(self) -> None:
        """Wait until the vehicle's clock is past the start of its estimator, before which arming is denied."""
        self.wait(lambda m: m.get_type() == "ODOMETRY" and m.time_usec > 1_100_000)

    def close(self) -> None:
        self.link.close()


@pytest.fixture
def connect(bridge: Callable[..., Bridge]) -> Iterator[Callable[..., tuple[Bridge, Client]]]:
    clients: list[Client] = []

    def start(*arguments: str, kind: int = mav.MAV_TYPE_ONBOARD_CONTROLLER) -> tuple[Bridge, Client]:
        running = bridge(*arguments)
        clients.append(Client(running, kind))
        return running, clients[-1]

    yield start
    for client in clients:
        client.close()


def fly_to(client: Client, north: float, east: float, down: float, yaw: float) -> None:
    """Arm, start Offboard with a stream of position setpoints, and wait until the vehicle is there."""
    client.estimator()
    end = time.monotonic() + 60.0
    client.position(0.0, 0.0, 0.0, yaw)
    assert client.command(mav.MAV_CMD_DO_SET_MODE, 1, 6, 0) == mav.MAV_RESULT_ACCEPTED
    assert client.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1, 0) == mav.MAV_RESULT_ACCEPTED
    while time.monotonic() < end:
        client.position(north, east, down, yaw)
        client.pump(0.05)
        last = client.of("LOCAL_POSITION_NED")[-1]
        if math.dist((last.x, last.y, last.z), (north, east, down)) < 0.15:
            return
    raise AssertionError("the vehicle did not get there")


def test_it_presents_itself_as_px4(connect) -> None:
    _, client = connect()
    beat = client.of("HEARTBEAT")[0]
    assert (beat.autopilot, beat.type) == (mav.MAV_AUTOPILOT_PX4, mav.MAV_TYPE_QUADROTOR)
    assert beat.custom_mode == Mode.HOLD.custom_mode
    assert client.command(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == 0
    version = client.wait(lambda m: m.get_type() == "AUTOPILOT_VERSION")
    assert version.capabilities & mav.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    assert client.command(mav.MAV_CMD_REQUEST_MESSAGE, 60000) == mav.MAV_RESULT_UNSUPPORTED
    assert client.command(31999) == mav.MAV_RESULT_UNSUPPORTED


def test_messages_come_at_the_rate_asked_for(connect) -> None:
    """Intervals are those of the vehicle's clock, so that a busy machine cannot change them."""
    _, client = connect()
    client.pump(0.3)
    for rate, expected_us in ((100, 10_000), (250, 4_000), (500, 2_000), (30, 33_333)):
        number = mav.MAVLINK_MSG_ID_ODOMETRY
        assert client.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / rate) == 0
        since = len(client.seen)
        client.pump(1.0)
        stamps = np.array([message.time_usec for message in client.of("ODOMETRY", since)])
        gaps = np.diff(stamps)
        # Physics ticks every 2 ms: no gap is further from the one asked for, and on average there is none.
        assert np.all(np.abs(gaps - expected_us) <= 2_000)
        assert gaps.mean() == pytest.approx(expected_us, rel=0.03)
    assert client.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_ODOMETRY, -1) == 0
    client.pump(0.1)
    since = len(client.seen)
    client.pump(0.4)
    assert client.of("ODOMETRY", since) == [] and client.of("ATTITUDE", since)
    assert client.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, 60000, 1e5) == mav.MAV_RESULT_FAILED


def test_the_estimator_sets_the_fastest_odometry(connect) -> None:
    _, client = connect("--param", "EKF2_PREDICT_US=8000")
    assert client.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_ODOMETRY, 2000) == 0
    since = len(client.seen)
    client.pump(0.6)
    gaps = np.diff([message.time_usec for message in client.of("ODOMETRY", since)])
    assert set(gaps[1:]) == {8000}  # the first one only finds the grid
    assert client.command(mav.MAV_CMD_GET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_ODOMETRY) == 0
    assert client.wait(lambda m: m.get_type() == "MESSAGE_INTERVAL").interval_us == 2000


def test_parameters_are_listed_and_strictly_typed(connect) -> None:
    _, client = connect()

    def answer(name: str) -> Any:
        return client.wait(lambda m: m.get_type() == "PARAM_VALUE" and m.param_id == name)

    client.link.mav.param_request_list_send(1, 1)
    count = client.wait(lambda m: m.get_type() == "PARAM_VALUE").param_count
    client.wait(lambda m: m.get_type() == "PARAM_VALUE" and m.param_index == count - 1)
    values = client.of("PARAM_VALUE")
    assert {message.param_index for message in values} == set(range(count))
    listed = {message.param_id: message for message in values}
    assert listed["COM_OBL_RC_ACT"].param_type == mav.MAV_PARAM_TYPE_INT32
    assert listed["COM_OF_LOSS_T"].param_type == mav.MAV_PARAM_TYPE_REAL32
    assert listed["MPC_THR_HOVER"].param_value == pytest.approx(0.38)

    action = b"COM_OBL_RC_ACT"
    client.link.mav.param_set_send(1, 1, action, float_of_int(4), mav.MAV_PARAM_TYPE_INT32)
    assert int_of_float(answer("COM_OBL_RC_ACT").param_value) == 4
    for wrong, kind in ((5.0, mav.MAV_PARAM_TYPE_REAL32), (float_of_int(99), mav.MAV_PARAM_TYPE_INT32)):
        client.link.mav.param_set_send(1, 1, action, wrong, kind)
        assert int_of_float(answer("COM_OBL_RC_ACT").param_value) == 4
    client.link.mav.param_request_read_send(1, 1, b"SYS_AUTOSTART", -1)
    assert int_of_float(answer("SYS_AUTOSTART").param_value) == 4001


def test_frames_on_the_wire_are_those_of_px4(connect) -> None:
    """At a heading other than north, with all of position, velocity and attitude in play."""
    mav.mavlink_map[ESC_STATUS] = EscStatus
    _, client = connect("--speed", "2", "--noise", "0")
    wanted = ("ODOMETRY", "HIGHRES_IMU", "ATTITUDE", "BATTERY_STATUS", "EXTENDED_SYS_STATE")
    for name in wanted:
        number = getattr(mav, f"MAVLINK_MSG_ID_{name}")
        assert client.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, number, 20_000) == 0
    fly_to(client, 1.0, -2.0, -2.5, math.radians(120))
    since = len(client.seen)
    for _ in range(12):
        client.position(4.0, 1.0, -2.5, math.radians(120))
        client.pump(0.05)
    odometry = client.of("ODOMETRY", since)
    last = odometry[-1]
    assert (last.frame_id, last.child_frame_id) == (mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_LOCAL_NED)
    assert math.hypot(last.vx, last.vy) > 0.5
    # The velocity is the position's derivative in the same NED axes, whatever the heading.
    stamps = np.array([message.time_usec for message in odometry]) * 1e-6
    positions = np.array([(message.x, message.y, message.z) for message in odometry])
    velocities = np.array([(message.vx, message.vy, message.vz) for message in odometry])
    moved = np.cumsum(0.5 * (velocities[1:] + velocities[:-1]) * np.diff(stamps)[:, None], axis=0)
    assert moved == pytest.approx(positions[1:] - positions[0], abs=0.01)
    # It accelerates where it leans: thrust along body z up, of an attitude FRD to NED.
    leaning = max(odometry, key=lambda message: 1.0 - message.q[0] ** 2 - message.q[3] ** 2)
    q = enu_flu_from_ned_frd(np.array(leaning.q))
    thrust = rotate(q, np.array([0.0, 0.0, 1.0]))
    toward = enu_from_ned(np.array([4.0, 1.0, 0.0]) - [1.0, -2.0, 0.0])
    assert np.cross(thrust, toward)[2] ** 2 < 0.1 * (thrust[:2] @ thrust[:2]) * (toward @ toward)
    imu = {message.time_usec: message for message in client.of("HIGHRES_IMU", since)}
    paired = [imu[message.time_usec] for message in odometry if message.time_usec in imu]
    assert len(paired) > 10
    assert np.mean([message.zacc for message in paired]) == pytest.approx(-9.81, abs=1.0)
    euler = client.of("ATTITUDE", since)[-1]
    assert euler.yaw == pytest.approx(math.radians(120), abs=0.1)
    battery = client.of("BATTERY_STATUS", since)[-1]
    assert sum(v for v in battery.voltages if v != 65535) * 1e-3 == pytest.approx(16.0, rel=0.05)
    assert min(client.of("ESC_STATUS", since)[-1].rpm) > 5000
    assert client.of("EXTENDED_SYS_STATE", since)[-1].landed_state == mav.MAV_LANDED_STATE_IN_AIR


def test_silence_lands_and_tells_the_ground_station(connect) -> None:
    arguments = ("--speed", "3", "--param", "COM_OF_LOSS_T=1.5", "--param", "COM_OBL_RC_ACT=4")
    _, client = connect(*arguments, kind=mav.MAV_TYPE_GCS)
    fly_to(client, 0.0, 0.0, -1.5, 0.0)
    client.heartbeat(lambda m: m.custom_mode == OFFBOARD)
    assert client.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 0, 0) == mav.MAV_RESULT_DENIED
    client.heartbeat(lambda m: m.custom_mode == Mode.LAND.custom_mode)
    client.heartbeat(lambda m: not m.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
    texts = [message.text for message in client.of("STATUSTEXT")]
    assert "Failsafe: offboard control lost" in texts and "Landing detected" in texts


def test_a_companion_gets_no_status_texts(connect) -> None:
    _, client = connect()
    # Denied, with a reason that only a ground station would hear.
    assert client.command(mav.MAV_CMD_DO_SET_MODE, 1, 6, 0) == mav.MAV_RESULT_TEMPORARILY_REJECTED
    client.pump(0.5)
    assert client.of("STATUSTEXT") == []


def test_the_pilot_takes_over_on_schedule_and_by_command(connect) -> None:
    bridge, client = connect("--speed", "2", "--pilot-takes-over-at", "4", "--pilot-mode", "ALTCTL")
    fly_to(client, 0.0, 0.0, -1.0, 0.0)
    end = time.monotonic() + 60.0
    while client.of("HEARTBEAT")[-1].custom_mode != Mode.ALTCTL.custom_mode and time.monotonic() < end:
        client.position(0.0, 0.0, -1.0, 0.0)  # a companion that goes on is not listened to
        client.pump(0.05)
    assert client.of("HEARTBEAT")[-1].custom_mode == Mode.ALTCTL.custom_mode
    assert send_order("KILL", bridge.pilot)["accepted"]
    client.heartbeat(lambda m: not m.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
    assert not send_order("NOWHERE", bridge.pilot)["accepted"]


def test_what_is_not_mavlink_is_survived(connect) -> None:
    bridge, client = connect("--json")
    assert json.loads(bridge.ready)["ready"] is True
    for noise in (b"", b"hello", bytes(range(256)) * 4, b"\xfd" * 300):
        client.link.write(noise)
    nan = math.nan
    client.link.mav.set_attitude_target_send(0, 1, 1, 0x80, [nan] * 4, nan, nan, nan, nan)
    client.link.mav.set_attitude_target_send(0, 1, 1, 0x07, [0.0] * 4, 0, 0, 0, 0.5)
    client.link.mav.command_long_send(1, 1, mav.MAV_CMD_DO_SET_MODE, 0, nan, nan, nan, nan, nan, nan, nan)
    client.link.mav.set_mode_send(1, 1, 0xFFFFFFFF)
    client.link.mav.mission_request_list_send(1, 1)
    assert client.wait(lambda m: m.get_type() == "MISSION_COUNT").count == 0
    # Setpoints without sense opened nothing.
    assert client.command(mav.MAV_CMD_DO_SET_MODE, 1, 6, 0) == mav.MAV_RESULT_TEMPORARILY_REJECTED
    # Infinite targets of a setpoint that is well formed otherwise leave the axis free.
    client.estimator()
    infinite = (math.inf,) * 11
    client.link.mav.set_position_target_local_ned_send(0, 1, 1, mav.MAV_FRAME_LOCAL_NED, 0, *infinite)
    assert client.command(mav.MAV_CMD_DO_SET_MODE, 1, 6, 0) == mav.MAV_RESULT_ACCEPTED
    assert client.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1, 0) == mav.MAV_RESULT_ACCEPTED
    client.pump(0.3)
    odometry = client.of("ODOMETRY")[-1]
    assert math.isfinite(odometry.x + odometry.vx + odometry.rollspeed + sum(odometry.q))
    client.link.mav.timesync_send(0, 123)
    assert client.wait(lambda m: m.get_type() == "TIMESYNC").ts1 == 123
