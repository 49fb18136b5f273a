"""The wire to the autopilot: MAVSDK, with every message that matters read as it stands on the wire.

`mavlink_direct` is used instead of MAVSDK's telemetry and offboard plugins, for two reasons. The odometry's
child frame decides whether its velocity is in the body or in the world, and the plugin loses that field. The
offboard plugin sends the last setpoint again at 20 Hz for ever; here a setpoint leaves only when the control
law made one, so that a companion that hangs, is stopped or is killed falls silent and the autopilot's
offboard-loss failsafe takes over.

What MAVLink says in NED and FRD is turned into ENU and FLU by `companion.odometry`. Callbacks run on MAVSDK's thread;
it is the control thread.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import mavsdk
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkDirect, MavlinkDirectError, MavlinkMessage
from mavsdk.plugins.mocap.mocap import (
    AngleBody,
    Covariance,
    Mocap,
    MocapError,
    PositionBody,
    VisionPositionEstimate,
)
from mavsdk.plugins.param.param import Param, ParamError, ParamResult
from mavsdk.system import System

from trueflight.companion.arrival import Arrivals
from trueflight.companion.estimator import estimator_status
from trueflight.companion.latest import Latest, mode_name
from trueflight.companion.message_rates import Rates
from trueflight.companion.odometry import (
    Odometry,
    Vector,
    odometry_from_wire,
    setpoint_on_wire,
    vision_estimate,
    without_covariance,
)
from trueflight.companion.px4_events import ArmingChecks, ArmingReport, Px4Event, describe, unhealthy
from trueflight.models.errors import InputError
from trueflight.models.pose import Pose

_COUNTED = ("ODOMETRY", "HIGHRES_IMU", "BATTERY_STATUS", "ESC_STATUS", "MODE")
_MESSAGE_IDS = {
    "ODOMETRY": 331,
    "HIGHRES_IMU": 105,
    "BATTERY_STATUS": 147,
    "ESC_STATUS": 291,
    "EXTENDED_SYS_STATE": 245,
    "CURRENT_MODE": 436,
    "HEARTBEAT": 0,
    "AUTOPILOT_VERSION": 148,
    "TIMESYNC": 111,
    "ESTIMATOR_STATUS": 230,
}
_SET_MESSAGE_INTERVAL, _DO_SET_MODE, _ARM_DISARM = 511, 176, 400
_RUN_PREARM_CHECKS, _REQUEST_MESSAGE = 401, 512
_ACCEPTED = 0
_RESULTS = {
    1: "temporarily rejected",
    2: "denied",
    3: "unsupported",
    4: "failed",
    5: "in progress",
    6: "cancelled",
}
_ARMED = 128
_CRITICAL, _TERMINATED = 5, 8  # MAV_STATE of a failsafe that acts, and of motors that are cut
_GROUND_STATION_HEARTBEAT = (
    '{"type":6,"autopilot":8,"base_mode":0,"custom_mode":0,"system_status":4,"mavlink_version":3}'
)
_MODE_NUMBERS = {"OFFBOARD": (6, 0), "LAND": (4, 6), "HOLD": (4, 3)}
_LANDED = {0: "unknown", 1: "on ground", 2: "in air", 3: "taking off", 4: "landing"}
_MODE_RATE = (
    50.0  # Hz: PX4 looks so often for a change of mode, and then tells it (CURRENT_MODE, from 1.15 on)
)
_TIMESYNC_RATE = 50.0  # Hz; PX4 wants 500 answers
_RPM = 2.0 * math.pi / 60.0
_AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1


class VehicleLink:
    """A connection to one autopilot.

    Raises `InputError` where the address cannot be used or nobody answers within `timeout` s. `on_odometry`
    is called with each odometry message on the control thread, but for those that are repeated, or overtaken by newer
    ones; what it raises ends up in `on_error` and sends nothing; `on_blind` takes its place for a message without an
    estimate. `system` is the MAVLink system that is flown, 0 the first autopilot that is heard. `on_notice` gets what
    the autopilot tells of failsafes, switches and failed checks, in plain words.
    """

    def __init__(
        self, address: str = "udpin://127.0.0.1:14540", timeout: float = 10.0, system: int = 0
    ) -> None:
        self.address = address
        self.latest = Latest()
        self.on_odometry: Callable[[Odometry], None] = lambda odometry: None
        self.on_blind: Callable[[], None] = lambda: None
        self.on_state: Callable[[], None] = lambda: None
        self.on_error: Callable[[str], None] = lambda text: None
        self.on_notice: Callable[[str], None] = lambda text: None
        self.malformed = 0
        self.arrivals = Arrivals()
        self._overtaken = 0
        self._counts = dict.fromkeys(_COUNTED, 0)
        self._times: deque[int] = deque(maxlen=4096)
        self._escs: dict[int, float] = {}
        self._param_lock = threading.Lock()
        self._arming = ArmingChecks()
        self._event_sequence = -1
        self._text_number = -1
        self._version = ""
        self._shares_clock = False
        # MAVSDK prints what it does in colour on standard output, which belongs to our caller.
        mavsdk.log_subscribe(lambda level, text, file, line: True)
        # A ground station's heartbeat would turn STATUSTEXT on, but PX4 then counts us as its data link.
        self._mavsdk = Mavsdk(
            Configuration.create_with_component_type(mavsdk.ComponentType.COMPANION_COMPUTER)
        )
        result = self._mavsdk.add_any_connection(address)
        if result != mavsdk.ConnectionResult.SUCCESS:
            self._mavsdk.destroy()
            reason = result.name.lower().replace("_", " ")
            raise InputError(
                f"cannot open {address} ({reason}): is another program using the port, or the address "
                "misspelt?"
            )
        autopilot = self._autopilot(timeout, system)
        self._system = autopilot.get_system_id()
        self._chosen = bool(system)
        self._param = Param(autopilot)
        self._mocap = Mocap(autopilot)
        self._direct = MavlinkDirect(autopilot)
        for name, handler in (
            ("ODOMETRY", self._odometry),
            ("BATTERY_STATUS", self._battery),
            ("ESC_STATUS", self._esc),
            ("HEARTBEAT", self._heartbeat),
            ("CURRENT_MODE", self._current_mode),
            ("EXTENDED_SYS_STATE", self._landed),
            ("STATUSTEXT", self._text),
            ("EVENT", self._event),
            ("SYS_STATUS", self._system_status),
            ("ESTIMATOR_STATUS", self._estimator),
            ("AUTOPILOT_VERSION", self._autopilot_version),
            ("TIMESYNC", self._timesync),
            ("PING", self._pinged),
        ):
            self._direct.subscribe_message(name, self._safe(handler))
        self._direct.subscribe_message("HIGHRES_IMU", self._imu)

    def close(self) -> None:
        """Disconnect."""
        self._direct.destroy()
        self._mavsdk.destroy()

    def _autopilot(self, timeout: float, number: int) -> System:
        """The autopilot to fly; raises `InputError` where it does not answer."""
        found = self._mavsdk.first_autopilot(timeout)
        end = time.monotonic() + timeout
        while found is not None and number and found.get_system_id() != number:
            heard = {one.get_system_id(): one for one in self._mavsdk.get_systems() if one.has_autopilot()}
            found = heard.get(number, found if time.monotonic() < end else None)
            time.sleep(0.05)
        if found is None:
            heard_ids = sorted(one.get_system_id() for one in self._mavsdk.get_systems())
            self._mavsdk.destroy()
            which = f"no autopilot with system id {number}" if number else "no autopilot"
            others = f"; heard there: {', '.join(map(str, heard_ids))}" if heard_ids else ""
            raise InputError(
                f"{which} answering on {self.address} within {timeout:g} s{others}; start it, or pass its address "
                f"with --connect{' and its MAV_SYS_ID with --system' if number else ''}"
            )
        return found

    @property
    def ambiguous(self) -> str:
        """'' where it is certain which autopilot is flown: it is the only one on this link, or was chosen."""
        if self._chosen or self._mavsdk.system_count() < 2:
            return ""
        speaking = [one for one in self._mavsdk.get_systems() if one.has_autopilot() and one.is_connected()]
        heard = sorted(one.get_system_id() for one in speaking)
        if len(heard) < 2:
            return ""
        return (
            f"{len(heard)} autopilots speak on {self.address} (systems {', '.join(map(str, heard))}): say which one "
            "is flown with --system, or give each a link of its own"
        )

    # What goes out

    def send_rates(self, time_us: int, thrust: float, body_rate: Vector) -> None:
        """One SET_ATTITUDE_TARGET: normalised collective and body rates (rad/s, FLU); attitude ignored.

        Raises `MavlinkDirectError` where MAVSDK refuses it.
        """
        self._direct.send_message(
            MavlinkMessage(
                "SET_ATTITUDE_TARGET",
                target_system_id=self._system,
                target_component_id=_AUTOPILOT,
                fields_json=setpoint_on_wire(self._system, time_us, thrust, body_rate),
            )
        )

    def share_clock(self) -> None:
        """Answer the autopilot's questions for our time, so that it understands the time stamps of poses.

        MAVSDK leaves them unanswered, and PX4 then takes a pose for one of the moment of its arrival. It believes
        the answers after 500 of them.
        """
        self._shares_clock = True
        self.command(_SET_MESSAGE_INTERVAL, float(_MESSAGE_IDS["TIMESYNC"]), 1e6 / _TIMESYNC_RATE)

    def send_pose(self, pose: Pose, taken_us: int, reset_counter: int) -> None:
        """One VISION_POSITION_ESTIMATE, taken `taken_us` microseconds since 1970 by this machine's clock.

        PX4's estimator takes this message and ODOMETRY alone, and MAVSDK's ODOMETRY names a frame that PX4 no
        longer reads. Raises `RuntimeError` where MAVSDK refuses it.
        """
        told = vision_estimate(pose, taken_us, reset_counter)
        position, angles = PositionBody(*told.position), AngleBody(*told.angles)
        covariance = Covariance(told.covariance)
        try:
            self._mocap.set_vision_position_estimate(
                VisionPositionEstimate(told.taken_us, position, angles, covariance, told.reset_counter)
            )
        except MocapError as error:
            raise RuntimeError(error.result.name.lower().replace("_", " ")) from None

    def set_mode(self, mode: str) -> str:
        """Ask for a flight mode (OFFBOARD, LAND, HOLD); returns '' where accepted, otherwise the reason."""
        main, sub = _MODE_NUMBERS[mode]
        return self.command(_DO_SET_MODE, 1.0, float(main), float(sub))

    def arm(self) -> str:
        """Ask for arming; returns '' where accepted, otherwise the reason."""
        return self.command(_ARM_DISARM, 1.0)

    def disarm(self) -> str:
        """Ask for disarming (refused in the air); returns '' where accepted, otherwise the reason."""
        return self.command(_ARM_DISARM, 0.0)

    def request_rates(self, rate: float) -> None:
        """Ask for odometry at `rate` Hz, the accelerometer no slower, and the rest as often as they are
        useful.

        A wish only: `measure` tells what arrives.
        """
        wishes = {
            "ODOMETRY": rate,
            "HIGHRES_IMU": max(rate, 250.0) if rate < 250.0 else min(rate, 500.0),
            "BATTERY_STATUS": 10.0,
            "ESC_STATUS": min(rate, 100.0),
            "EXTENDED_SYS_STATE": 5.0,
            "CURRENT_MODE": _MODE_RATE,  # PX4 from 1.15 on
            "ESTIMATOR_STATUS": 5.0,
            "HEARTBEAT": _MODE_RATE,
        }
        for name, wish in wishes.items():
            self.command(_SET_MESSAGE_INTERVAL, float(_MESSAGE_IDS[name]), 1e6 / wish)

    def command(self, number: int, *parameters: float) -> str:
        """A COMMAND_LONG; blocks until acknowledged. Returns '' where accepted, otherwise the reason."""
        fields: dict[str, Any] = {f"param{i}": 0.0 for i in range(1, 8)}
        fields.update({f"param{i}": value for i, value in enumerate(parameters, 1)})
        fields.update(target_system=self._system, target_component=_AUTOPILOT, command=number, confirmation=0)
        message = MavlinkMessage(
            "COMMAND_LONG",
            target_system_id=self._system,
            target_component_id=_AUTOPILOT,
            fields_json=json.dumps(fields),
        )
        try:
            ack = json.loads(self._direct.send_command(message).fields_json)
        except MavlinkDirectError as error:
            return f"no answer ({error.result.name.lower()})"
        result = int(ack["result"])
        if result == _ACCEPTED:
            return ""
        told = f": {self.latest.texts[-1]}" if self.latest.texts else ""
        return _RESULTS.get(result, f"result {result}") + told

    def parameter(self, name: str) -> float | int | None:
        """A parameter of the autopilot, whichever type it has; None where it has none of that name or is
        silent.
        """
        with self._param_lock:
            try:
                return float(self._param.get_param_float(name))
            except ParamError as error:
                if error.result != ParamResult.WRONG_TYPE:
                    return None
            try:
                return int(self._param.get_param_int(name))
            except ParamError:
                return None

    def set_parameter(self, name: str, value: float | int) -> str:
        """Set a parameter; an int is sent as INT32, a float as REAL32. Returns '' where the autopilot has taken
        it, otherwise the reason.
        """
        with self._param_lock:
            try:
                if isinstance(value, int):
                    self._param.set_param_int(name, value)
                else:
                    self._param.set_param_float(name, value)
            except ParamError as error:
                return error.result.name.lower().replace("_", " ")
        now = self.parameter(name)
        if now is None or abs(now - value) > 1e-6 * max(1.0, abs(value)):
            return f"the autopilot kept {now}"
        return ""

    def arming_report(self, timeout: float = 2.0) -> ArmingReport | None:
        """What the autopilot's arming checks say now; None where it does not tell (PX4 before 1.13, others).

        The checks run again for this; the vehicle must be disarmed.
        """
        count = self._arming.count
        refused = self.command(_RUN_PREARM_CHECKS)
        end = time.monotonic() + timeout
        while not refused and self._arming.count == count and time.monotonic() < end:
            time.sleep(0.02)
        return self._arming.report

    def autopilot_version(self, timeout: float = 1.0) -> str:
        """Such as 'PX4 1.15.2'; 'unknown' where the autopilot does not tell."""
        self.command(_REQUEST_MESSAGE, float(_MESSAGE_IDS["AUTOPILOT_VERSION"]))
        end = time.monotonic() + timeout
        while not self._version and time.monotonic() < end:
            time.sleep(0.02)
        return self._version or "unknown"

    def show_as_ground_station(self) -> None:
        """One heartbeat of a ground station: PX4 sends STATUSTEXT for some seconds after it.

        Only for a vehicle that does not fly: PX4 then takes us for its data link, and misses us later.
        """
        message = MavlinkMessage("HEARTBEAT", fields_json=_GROUND_STATION_HEARTBEAT)
        self._direct.send_message(message)

    # What comes in

    def measure(self, duration: float = 1.0) -> Rates:
        """Count what arrives for `duration` s."""
        before = dict(self._counts)
        self._times.clear()
        begin = time.monotonic()
        time.sleep(duration)
        elapsed = time.monotonic() - begin
        times = list(self._times)
        count = {name: (self._counts[name] - before[name]) / elapsed for name in before}
        gaps = [1e-6 * (b - a) for a, b in pairwise(times)]
        span = 1e-6 * (times[-1] - times[0]) if len(times) > 1 else 0.0
        return Rates(
            odometry=(len(times) - 1) / span if span > 0.0 else 0.0,
            imu=count["HIGHRES_IMU"],
            battery=count["BATTERY_STATUS"],
            esc=count["ESC_STATUS"],
            longest_gap=max(gaps, default=math.inf),
            duration=elapsed,
            mode=count["MODE"],
        )

    def _safe(self, handler: Callable[[dict[str, Any]], None]) -> Callable[[MavlinkMessage, Any], None]:
        def callback(message: MavlinkMessage, _: Any) -> None:
            arrived = time.monotonic_ns()
            if not self._is_autopilot(message):
                return
            try:
                fields = json.loads(without_covariance(message.fields_json))
                fields["arrived"] = arrived
                handler(fields)
            except (KeyError, TypeError, ValueError, IndexError) as error:
                self.malformed += 1
                self.on_error(f"{message.message_name}: {type(error).__name__}: {error}")

        return callback

    def _is_autopilot(self, message: MavlinkMessage) -> bool:
        """Cameras, gimbals, smart batteries and other vehicles may speak on the same link: none of them decides."""
        return message.component_id == _AUTOPILOT and message.system_id == self._system

    def _odometry(self, fields: dict[str, Any]) -> None:
        stamp = int(fields["time_usec"])
        arrival = self.arrivals.judge(stamp, fields["arrived"])
        if arrival.newer:
            self._counts["ODOMETRY"] += 1
            self._times.append(stamp)
        if arrival.overtaken:
            self._overtaken += 1
            return
        odometry = odometry_from_wire(fields, arrival.age, self._overtaken) if arrival.newer else None
        if odometry is not None:
            self._overtaken = 0
            self.on_odometry(odometry)
        else:
            self.on_blind()
        now = time.monotonic_ns()
        self.arrivals.done(now)
        if self.arrivals.clock.due(now):
            self._ask_time(now)

    def _ask_time(self, now_ns: int) -> None:
        asked = now_ns // 1000 * 1000  # PING tells whole microseconds
        arrivals = self.arrivals
        arrivals.clock.ask(asked)
        self._send_timesync(f'{{"tc1":0,"ts1":{asked},"target_system":{self._system},"target_component":1}}')
        if arrivals.clock.now(asked) is None:
            arrivals.echo.ask(asked)
            fields = f'{{"time_usec":{asked // 1000},"seq":0,"target_system":0,"target_component":0}}'
            self._direct.send_message(MavlinkMessage("PING", fields_json=fields))

    def _pinged(self, fields: dict[str, Any]) -> None:
        if int(fields["target_system"]):  # an answer
            self.arrivals.echoed(1000 * int(fields["time_usec"]))

    def _send_timesync(self, fields: str) -> None:
        self._direct.send_message(
            MavlinkMessage(
                "TIMESYNC",
                target_system_id=self._system,
                target_component_id=_AUTOPILOT,
                fields_json=fields,
            )
        )

    def _imu(self, message: MavlinkMessage, _: Any) -> None:
        if self._is_autopilot(message):
            self._counts["HIGHRES_IMU"] += 1
            self.latest.imu = message.fields_json

    def _battery(self, fields: dict[str, Any]) -> None:
        self._counts["BATTERY_STATUS"] += 1
        cells = [mv for mv in fields["voltages"] + fields.get("voltages_ext", []) if mv not in (0, 0xFFFF)]
        batteries = self.latest.batteries
        batteries[int(fields["id"])] = 1e-3 * sum(cells)
        self.latest.battery_voltage = batteries[min(batteries)]

    def _esc(self, fields: dict[str, Any]) -> None:
        self._counts["ESC_STATUS"] += 1
        first = int(fields["index"])
        for i, rpm in enumerate(fields["rpm"]):
            self._escs[first + i] = abs(rpm) * _RPM
        self.latest.rotor_speed = tuple(self._escs[i] for i in sorted(self._escs))

    def _mode_told(self) -> None:
        self._counts["MODE"] += 1
        self.latest.mode_time_us = self.arrivals.last_us

    def _heartbeat(self, fields: dict[str, Any]) -> None:
        self._mode_told()
        self.latest.heartbeat = 1e-9 * fields["arrived"]
        self.latest.armed = bool(int(fields["base_mode"]) & _ARMED)
        self.latest.killed = int(fields["system_status"]) == _TERMINATED
        self.latest.failsafe = int(fields["system_status"]) == _CRITICAL
        self.latest.flight_mode = mode_name(int(fields["custom_mode"]))
        self.on_state()

    def _current_mode(self, fields: dict[str, Any]) -> None:
        self._mode_told()
        # PX4 keeps the mode that somebody chose apart from what its failsafes made of it.
        intended, mode = int(fields["intended_custom_mode"]), int(fields["custom_mode"])
        self.latest.failsafe = intended not in (0, mode)
        self.latest.flight_mode = mode_name(int(fields["custom_mode"]))
        self.on_state()

    def _landed(self, fields: dict[str, Any]) -> None:
        self.latest.landed = _LANDED.get(int(fields["landed_state"]), "unknown")

    def _text(self, fields: dict[str, Any]) -> None:
        number, text, texts = int(fields.get("id", 0)), str(fields["text"]).rstrip("\t"), self.latest.texts
        if texts and number == self._text_number and int(fields.get("chunk_seq", 0)):
            texts[-1] += text  # a long text comes in pieces
        else:
            texts.append(text)
        self._text_number = number

    def _event(self, fields: dict[str, Any]) -> None:
        if int(fields["sequence"]) == self._event_sequence:
            return
        self._event_sequence = int(fields["sequence"])
        arguments = bytes(int(byte) for byte in fields["arguments"])
        event = Px4Event(int(fields["id"]), int(fields["log_levels"]) & 0xF, arguments)
        self._arming.take(event)
        text = describe(event)
        if text:
            self.latest.notices.append((time.monotonic(), text))
            self.on_notice(text)

    def _autopilot_version(self, fields: dict[str, Any]) -> None:
        version = int(fields["flight_sw_version"])
        self._version = f"PX4 {version >> 24 & 0xFF}.{version >> 16 & 0xFF}.{version >> 8 & 0xFF}"

    def _timesync(self, fields: dict[str, Any]) -> None:
        theirs = int(fields["tc1"])
        if theirs:
            self.arrivals.clock.answered(int(fields["ts1"]), theirs)
        elif self._shares_clock:
            ours = time.time_ns() - (time.monotonic_ns() - fields["arrived"])
            self._send_timesync(
                f'{{"tc1":{ours},"ts1":{fields["ts1"]},"target_system":{self._system},"target_component":1}}'
            )

    def _estimator(self, fields: dict[str, Any]) -> None:
        self.latest.estimator = estimator_status(fields)

    def _system_status(self, fields: dict[str, Any]) -> None:
        enabled = int(fields["onboard_control_sensors_enabled"])
        self.latest.unhealthy = unhealthy(enabled, int(fields["onboard_control_sensors_health"]))
