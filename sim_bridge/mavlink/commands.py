"""What the simulated autopilot does with each message it receives."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

from pymavlink.dialects.v20 import common as mav

from trueflight.sim_bridge.autopilot import Autopilot, Verdict
from trueflight.sim_bridge.mavlink import wire
from trueflight.sim_bridge.mavlink.event import arming_report
from trueflight.sim_bridge.mavlink.peer import Peer
from trueflight.sim_bridge.mavlink.telemetry import STREAMS
from trueflight.sim_bridge.modes import Mode
from trueflight.sim_bridge.position_control import AttitudeSetpoint, MotionSetpoint, RateSetpoint, yaw_of

_FORCE = 21196.0  # param2 of MAV_CMD_COMPONENT_ARM_DISARM that overrides the checks
_NAN = math.nan

Reply = Iterable[Any]


class Commands:
    """Turns messages into calls of the autopilot and into replies; one instance for all peers."""

    def __init__(self, autopilot: Autopilot, system: int, component: int) -> None:
        self.autopilot = autopilot
        self.system = system
        self.component = component
        self._handlers: dict[str, Callable[[Any, Peer], Reply]] = {
            "HEARTBEAT": self._heartbeat,
            "COMMAND_LONG": self._command_long,
            "COMMAND_INT": self._command_int,
            "SET_MODE": self._set_mode,
            "SET_ATTITUDE_TARGET": self._set_attitude_target,
            "SET_POSITION_TARGET_LOCAL_NED": self._set_position_target_local,
            "SET_POSITION_TARGET_GLOBAL_INT": self._set_position_target_global,
            "PARAM_REQUEST_LIST": self._param_list,
            "PARAM_REQUEST_READ": self._param_read,
            "PARAM_SET": self._param_set,
            "MISSION_REQUEST_LIST": self._mission_list,
            "MISSION_COUNT": self._mission_refused,
            "MISSION_CLEAR_ALL": self._mission_cleared,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
        }

    def handle(self, message: Any, peer: Peer) -> Reply:
        """Replies to a message; none for one that is meant for another system or that the vehicle ignores."""
        handler = self._handlers.get(message.get_type())
        if handler is None:
            return ()
        if getattr(message, "target_system", self.system) not in (0, self.system):
            return ()
        if getattr(message, "target_component", self.component) not in (0, self.component):
            return ()
        return handler(message, peer)

    def _heartbeat(self, message: Any, peer: Peer) -> Reply:
        peer.ground_station = message.type == mav.MAV_TYPE_GCS
        return ()

    # Setpoints

    def _set_attitude_target(self, message: Any, peer: Peer) -> Reply:
        mask = message.type_mask
        thrust = min(max(message.thrust, 0.0), 1.0)
        if mask & mav.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE or not math.isfinite(thrust):
            return ()
        rates = wire.frd((message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate))
        if mask & mav.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE:
            if mask & 7 == 7 or not all(math.isfinite(rate) for rate in rates):
                return ()
            self.autopilot.offboard(RateSetpoint(thrust, rates))
            return ()
        q = tuple(message.q)
        norm = math.sqrt(sum(x * x for x in q))
        if not 0.5 < norm < 2.0:
            return ()
        w, x, y, z = (component / norm for component in q)
        ignored = mask & mav.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE or not math.isfinite(rates[2])
        turn = 0.0 if ignored else rates[2]
        self.autopilot.offboard(AttitudeSetpoint(thrust, wire.attitude((w, x, y, z)), turn))
        return ()

    def _set_position_target_local(self, message: Any, peer: Peer) -> Reply:
        position = (message.x, message.y, message.z)
        body = message.coordinate_frame in (mav.MAV_FRAME_BODY_NED, mav.MAV_FRAME_BODY_OFFSET_NED)
        if not body and message.coordinate_frame != mav.MAV_FRAME_LOCAL_NED:
            return ()
        if body:
            position = (_NAN, _NAN, _NAN)
        self._motion(message, wire.ned(position), body)
        return ()

    def _set_position_target_global(self, message: Any, peer: Peer) -> Reply:
        altitude = message.alt
        if message.coordinate_frame in (
            mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
            mav.MAV_FRAME_GLOBAL_RELATIVE_ALT,
        ):
            altitude += wire.ORIGIN[2] + self.autopilot.home[2]
        elif message.coordinate_frame not in (mav.MAV_FRAME_GLOBAL_INT, mav.MAV_FRAME_GLOBAL):
            return ()
        self._motion(message, wire.local(message.lat_int * 1e-7, message.lon_int * 1e-7, altitude), False)
        return ()

    def _motion(self, message: Any, position: wire.Vector, body: bool) -> None:
        mask = message.type_mask

        # The mask counts the axes of the wire (north, east, down); the tuples here are east, north, up.
        def unmasked(vector: wire.Vector, first: int) -> wire.Vector:
            x, y, z = (number if math.isfinite(number) else _NAN for number in vector)
            bits = (mask >> first & 1, mask >> (first + 1) & 1, mask >> (first + 2) & 1)
            return _NAN if bits[1] else x, _NAN if bits[0] else y, _NAN if bits[2] else z

        velocity = wire.ned((message.vx, message.vy, message.vz))
        acceleration = wire.ned((message.afx, message.afy, message.afz))
        if body:
            yaw_now = yaw_of(self.autopilot.simulator.estimate().quaternion)
            velocity = _turned(message.vx, -message.vy, -message.vz, yaw_now)
            acceleration = _turned(message.afx, -message.afy, -message.afz, yaw_now)
        yaw = yaw_rate = _NAN
        if not mask & mav.POSITION_TARGET_TYPEMASK_YAW_IGNORE and math.isfinite(message.yaw):
            yaw = wire.heading(message.yaw)
        if not mask & mav.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE and math.isfinite(message.yaw_rate):
            yaw_rate = -message.yaw_rate
        self.autopilot.offboard(
            MotionSetpoint(
                unmasked(position, 0), unmasked(velocity, 3), unmasked(acceleration, 6), yaw, yaw_rate
            )
        )

    # Commands

    def _command_int(self, message: Any, peer: Peer) -> Reply:
        if message.command != mav.MAV_CMD_DO_REPOSITION:
            return self._command(message, peer, (message.x, message.y, message.z))
        # Latitude and longitude; the largest negative number says that there is none.
        x, y = (_NAN if degrees == -(2**31) else degrees * 1e-7 for degrees in (message.x, message.y))
        return self._command(message, peer, (x, y, message.z))

    def _command_long(self, message: Any, peer: Peer) -> Reply:
        return self._command(message, peer, (message.param5, message.param6, message.param7))

    def _command(self, message: Any, peer: Peer, place: tuple[float, float, float]) -> Reply:
        verdict, replies = self._execute(message, peer, place)
        ack = mav.MAVLink_command_ack_message(
            message.command, int(verdict), 0, 0, message.get_srcSystem(), message.get_srcComponent()
        )
        return [ack, *replies]

    def _execute(self, m: Any, peer: Peer, place: tuple[float, float, float]) -> tuple[Verdict, list[Any]]:
        a = self.autopilot
        command = m.command
        if command == mav.MAV_CMD_COMPONENT_ARM_DISARM:
            force = m.param2 == _FORCE
            return (a.arm(force) if m.param1 >= 0.5 else a.disarm(force)), []
        if command == mav.MAV_CMD_DO_SET_MODE:
            if not _whole(m.param1) & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
                return Verdict.DENIED, []
            return self._mode(_whole(m.param2), _whole(m.param3)), []
        if command == mav.MAV_CMD_NAV_TAKEOFF:
            altitude = place[2]
            height = altitude - wire.ORIGIN[2] - a.simulator.estimate().position[2]
            return a.takeoff(height if math.isfinite(altitude) and height > 0.2 else None), []
        if command == mav.MAV_CMD_DO_REPOSITION:
            yaw = wire.heading(m.param4) if math.isfinite(m.param4) else _NAN
            return a.reposition(wire.local(*place), yaw), []
        if command == mav.MAV_CMD_NAV_LAND:
            return a.set_mode(Mode.LAND), []
        if command == mav.MAV_CMD_NAV_RETURN_TO_LAUNCH:
            return a.set_mode(Mode.RTL), []
        if command == mav.MAV_CMD_DO_FLIGHTTERMINATION:
            return (a.kill() if m.param1 >= 0.5 else Verdict.DENIED), []
        if command == mav.MAV_CMD_SET_MESSAGE_INTERVAL:
            known = peer.set_interval(_whole(m.param1), m.param2, a.time_us)
            return (Verdict.ACCEPTED if known else Verdict.FAILED), []
        if command == mav.MAV_CMD_GET_MESSAGE_INTERVAL:
            return Verdict.ACCEPTED, [self._interval(_whole(m.param1), peer)]
        if command == mav.MAV_CMD_REQUEST_MESSAGE:
            return self._requested(_whole(m.param1), _whole(m.param2), peer)
        if command == mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
            return self._requested(mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0, peer)
        if command == mav.MAV_CMD_RUN_PREARM_CHECKS:
            a.events.extend(arming_report(a.arming_refusals(), a.offboard_alive))
            return Verdict.ACCEPTED, []
        return Verdict.UNSUPPORTED, []

    def _requested(self, number: int, argument: int, peer: Peer) -> tuple[Verdict, list[Any]]:
        if number == mav.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
            return Verdict.ACCEPTED, [self._interval(argument, peer)]
        if number not in STREAMS:
            return Verdict.UNSUPPORTED, []
        return Verdict.ACCEPTED, [STREAMS[number][0](self.autopilot)]

    @staticmethod
    def _interval(number: int, peer: Peer) -> Any:
        return mav.MAVLink_message_interval_message(number, peer.interval(number))

    def _set_mode(self, message: Any, peer: Peer) -> Reply:
        if message.base_mode & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            self._mode(message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF)
        return ()

    def _mode(self, main: int, sub: int) -> Verdict:
        mode = Mode.of(main, sub)
        return Verdict.DENIED if mode is None else self.autopilot.set_mode(mode)

    # Parameters

    def _value(self, name: str) -> Any:
        parameters = self.autopilot.parameters
        value = parameters[name]
        integer = parameters.is_integer(name)
        return mav.MAVLink_param_value_message(
            name.encode(),
            wire.float_of_int(int(value)) if integer else float(value),
            mav.MAV_PARAM_TYPE_INT32 if integer else mav.MAV_PARAM_TYPE_REAL32,
            len(parameters),
            parameters.index(name),
        )

    def _param_list(self, message: Any, peer: Peer) -> Reply:
        return [self._value(name) for name in self.autopilot.parameters.names]

    def _param_read(self, message: Any, peer: Peer) -> Reply:
        parameters = self.autopilot.parameters
        if message.param_index >= 0:
            if message.param_index < len(parameters):
                return [self._value(parameters.names[message.param_index])]
            return ()
        name = message.param_id
        return [self._value(name)] if name in parameters else ()

    def _param_set(self, message: Any, peer: Peer) -> Reply:
        parameters = self.autopilot.parameters
        name = message.param_id
        if name not in parameters:
            return ()
        integer = parameters.is_integer(name)
        kind = mav.MAV_PARAM_TYPE_INT32 if integer else mav.MAV_PARAM_TYPE_REAL32
        # PX4 answers a wrong type or a value out of range with the value that stays.
        if message.param_type == kind:
            parameters.set(name, wire.int_of_float(message.param_value) if integer else message.param_value)
        return [self._value(name)]

    # The rest of what a client may wait for

    def _mission_list(self, message: Any, peer: Peer) -> Reply:
        source = message.get_srcSystem(), message.get_srcComponent()
        return [mav.MAVLink_mission_count_message(*source, 0, getattr(message, "mission_type", 0))]

    def _mission_refused(self, message: Any, peer: Peer) -> Reply:
        source = message.get_srcSystem(), message.get_srcComponent()
        return [mav.MAVLink_mission_ack_message(*source, mav.MAV_MISSION_UNSUPPORTED, message.mission_type)]

    def _mission_cleared(self, message: Any, peer: Peer) -> Reply:
        source = message.get_srcSystem(), message.get_srcComponent()
        return [mav.MAVLink_mission_ack_message(*source, mav.MAV_MISSION_ACCEPTED, message.mission_type)]

    def _ping(self, message: Any, peer: Peer) -> Reply:
        if message.target_system or message.target_component:
            return ()
        source = message.get_srcSystem(), message.get_srcComponent()
        return [mav.MAVLink_ping_message(message.time_usec, message.seq, *source)]

    def _timesync(self, message: Any, peer: Peer) -> Reply:
        if message.tc1:
            return ()
        return [mav.MAVLink_timesync_message(self.autopilot.time_us * 1000, message.ts1)]


def _turned(forward: float, left: float, up: float, yaw: float) -> wire.Vector:
    c, s = math.cos(yaw), math.sin(yaw)
    return c * forward - s * left, s * forward + c * left, up


def _whole(value: float) -> int:
    """A command's parameter as a whole number; an unused one is NaN on the wire."""
    return int(value) if math.isfinite(value) else 0
