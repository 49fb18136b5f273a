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

import ctypes
import json
import time
from collections.abc import Callable
from typing import Any

import mavsdk
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkDirect, MavlinkMessage
from mavsdk.plugins.mocap.mocap import (
    AngleBody,
    Covariance,
    Mocap,
    MocapError,
    PositionBody,
    VisionPositionEstimate,
)
from mavsdk.system import System

from trueflight.companion.address import checked_address, for_mavsdk, taken, why_not_open
from trueflight.companion.arrival import Arrivals
from trueflight.companion.batteries import Batteries
from trueflight.companion.commands import AUTOPILOT, Commands, Parameters
from trueflight.companion.message_rates import MessageCounter, Rates
from trueflight.companion.messages import Fields, Messages
from trueflight.companion.odometry import (
    Odometry,
    Vector,
    odometry_from_wire,
    setpoint_on_wire,
    vision_estimate,
    without_covariance,
)
from trueflight.companion.others import Others
from trueflight.models.errors import InputError
from trueflight.models.pose import Pose

_TIMESYNC_RATE = 50.0  # Hz; PX4 wants 500 answers


_PX4, _ARDUPILOT = 12, 3  # MAV_AUTOPILOT
_NO_MULTIROTORS = {1: "a fixed-wing", 10: "a rover", 11: "a boat", 12: "a submarine"}  # MAV_TYPE
_NO_MULTIROTORS |= dict.fromkeys(range(19, 26), "a VTOL")
_MOST_SYSTEMS = 16  # that are counted; somebody may make up 255
_HEARTBEATS = 2.5  # s; PX4 sends one a second
_LEAVES = 2.0
"""s in which a companion that was killed has left the autopilot's port to the next one."""


class NoAutopilot(InputError):
    """Nobody answers, or not the one that was asked for."""


class VehicleLink:
    """A connection to one autopilot.

    Raises `InputError` where the address cannot be used or nobody answers within `timeout` s. `on_odometry`
    is called with each odometry message on the control thread, but for those that are repeated, or overtaken by newer
    ones; what it raises ends up in `on_error` and sends nothing; `on_blind` takes its place for a message without an
    estimate. `system` is the MAVLink system that is flown, 0 the first autopilot that is heard; `batteries` judges
    which of its batteries counts. What else it tells is in `messages`, the last of it in `latest`; what it is asked
    goes through `commands` and `parameters`. Who else speaks on the link is counted in `others`.
    """

    def __init__(
        self,
        address: str = "udpin://127.0.0.1:14540",
        timeout: float = 10.0,
        system: int = 0,
        batteries: Batteries | None = None,
    ) -> None:
        self.address = address
        self.on_odometry: Callable[[Odometry], None] = lambda odometry: None
        self.on_blind: Callable[[], None] = lambda: None
        self.on_error: Callable[[str], None] = lambda text: None
        self.malformed = 0
        self.arrivals = Arrivals()
        self.counter = MessageCounter()
        self.messages = Messages(self.arrivals, self.counter)
        self.latest = self.messages.latest
        self.latest.batteries = batteries or Batteries()
        self.others = Others()
        self._overtaken = 0
        self._kept = False
        self._shares_clock = False
        self._closing = False
        checked_address(address)
        self._mavsdk = self._opened()
        autopilot = self._autopilot(timeout, system)
        self._system = autopilot.get_system_id()
        self._chosen = bool(system)
        self._systems: dict[int, MavlinkDirect] = {}
        self._mocap = Mocap(autopilot)
        self._direct = self._systems[self._system] = MavlinkDirect(autopilot)
        self.commands = Commands(self._direct, self._system, self.messages)
        self.parameters = Parameters(autopilot)
        handlers = {
            "ODOMETRY": self._odometry,
            "TIMESYNC": self._timesync,
            "PING": self._pinged,
            **self.messages.handlers,
        }
        for name, handler in handlers.items():
            self._direct.subscribe_message(name, self._safe(handler))
        self._direct.subscribe_message("HIGHRES_IMU", self._imu)
        self._check_kind(min(timeout, _HEARTBEATS))

    def close(self) -> None:
        """Disconnect."""
        self._closing = True
        for direct in self._systems.values():
            direct.destroy()
        self._mavsdk.destroy()

    def _opened(self) -> Mavsdk:
        # MAVSDK prints what it does in colour on standard output, which belongs to our caller.
        mavsdk.log_subscribe(lambda level, text, file, line: True)
        end = time.monotonic() + _LEAVES
        while user := taken(self.address):
            if time.monotonic() > end:
                raise InputError(f"cannot open {self.address}: {user}")
            time.sleep(0.05)
        # A ground station's heartbeat would turn STATUSTEXT on, but PX4 then counts us as its data link.
        wire = Mavsdk(Configuration.create_with_component_type(mavsdk.ComponentType.COMPANION_COMPUTER))
        if wire.add_any_connection(for_mavsdk(self.address)) != mavsdk.ConnectionResult.SUCCESS:
            wire.destroy()
            raise InputError(f"cannot open {self.address}: {why_not_open(self.address)}")
        return wire

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
            raise NoAutopilot(
                f"{which} answering on {self.address} within {timeout:g} s{others}; start it, or pass its address "
                f"with --connect{' and its MAV_SYS_ID with --system' if number else ''}"
            )
        return found

    def _check_kind(self, patience: float) -> None:
        """Raise `InputError` where what answers is no PX4 or no multirotor; silence is found later."""
        end = time.monotonic() + patience
        while self.messages.kind is None and time.monotonic() < end:
            time.sleep(0.02)
        autopilot, vehicle = self.messages.kind or (_PX4, 0)
        if autopilot == _PX4 and vehicle not in _NO_MULTIROTORS:
            return
        self.close()
        who = (
            f"PX4 of {_NO_MULTIROTORS[vehicle]} (MAV_TYPE {vehicle})"
            if autopilot == _PX4
            else "ArduPilot"
            if autopilot == _ARDUPILOT
            else f"an autopilot of another kind (MAV_AUTOPILOT {autopilot})"
        )
        raise InputError(
            f"{who} answers on {self.address} as system {self._system}, but only multirotors with PX4 (1.14 or newer) "
            "can be flown; pass another address with --connect, or another system with --system"
        )

    def read_capacities(self) -> None:
        """Ask for the batteries' capacities where several are connected; a second for each that PX4 does not know."""
        batteries = self.latest.batteries
        several = batteries.connected
        if len(several) < 2 or batteries.chosen:
            return
        for one in several:
            capacity = self.parameters.read(f"BAT{one.number}_CAPACITY")
            if capacity is not None and capacity > 0.0:
                batteries.capacities[one.number] = float(capacity)
        self.latest.battery_voltage = batteries.voltage

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

    def measure(self, duration: float = 1.0) -> Rates:
        """Count what arrives for `duration` s."""
        self.notice_systems()
        rates = self.counter.measure(duration)
        self.notice_systems()
        return rates

    def notice_systems(self) -> None:
        """Count other systems' heartbeats too, which MAVSDK keeps apart from ours; cheap where no system is new.

        One thread at a time.
        """
        if self._mavsdk.system_count() <= len(self._systems) or len(self._systems) > _MOST_SYSTEMS:
            return
        for one in self._mavsdk.get_systems():
            number = one.get_system_id()
            if number in self._systems:
                continue
            for component in one.component_ids():
                self.others.count(number, component)
            self._systems[number] = MavlinkDirect(one)
            self._systems[number].subscribe_message("HEARTBEAT", self._count_other)

    def _count_other(self, message: MavlinkMessage, _: Any) -> None:
        self.others.count(message.system_id, message.component_id)

    # What goes out

    def send_rates(self, time_us: int, thrust: float, body_rate: Vector) -> None:
        """One SET_ATTITUDE_TARGET: normalised collective and body rates (rad/s, FLU); attitude ignored.

        Raises `MavlinkDirectError` where MAVSDK refuses it.
        """
        self._direct.send_message(
            MavlinkMessage(
                "SET_ATTITUDE_TARGET",
                target_system_id=self._system,
                target_component_id=AUTOPILOT,
                fields_json=setpoint_on_wire(self._system, time_us, thrust, body_rate),
            )
        )

    def share_clock(self) -> None:
        """Answer the autopilot's questions for our time, so that it understands the time stamps of poses.

        MAVSDK leaves them unanswered, and PX4 then takes a pose for one of the moment of its arrival. It believes
        the answers after 500 of them.
        """
        self._shares_clock = True
        self.commands.request_timesync(_TIMESYNC_RATE)

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

    def _send_timesync(self, fields: str) -> None:
        self._direct.send_message(
            MavlinkMessage(
                "TIMESYNC",
                target_system_id=self._system,
                target_component_id=AUTOPILOT,
                fields_json=fields,
            )
        )

    def _ask_time(self, now_ns: int) -> None:
        asked = now_ns // 1000 * 1000  # PING tells whole microseconds
        arrivals = self.arrivals
        arrivals.clock.ask(asked)
        self._send_timesync(f'{{"tc1":0,"ts1":{asked},"target_system":{self._system},"target_component":1}}')
        if arrivals.clock.now(asked) is None:
            arrivals.echo.ask(asked)
            fields = f'{{"time_usec":{asked // 1000},"seq":0,"target_system":0,"target_component":0}}'
            self._direct.send_message(MavlinkMessage("PING", fields_json=fields))

    # What comes in

    def _safe(self, handler: Callable[[Fields], None]) -> Callable[[MavlinkMessage, Any], None]:
        def callback(message: MavlinkMessage, _: Any) -> None:
            arrived = time.monotonic_ns()
            if not self._kept:
                self._keep_thread()
            if not self._is_autopilot(message):
                self.others.count(message.system_id, message.component_id)
                return
            try:
                fields = json.loads(without_covariance(message.fields_json))
                fields["arrived"] = arrived
                handler(fields)
            except (KeyError, TypeError, ValueError, IndexError) as error:
                self.malformed += 1
                self.on_error(f"{message.message_name}: {type(error).__name__}: {error}")
            except RuntimeError:
                if not self._closing:  # what a last message makes us send while we disconnect goes nowhere
                    raise

        return callback

    def _keep_thread(self) -> None:
        """Let Python keep what it has of MAVSDK's thread, which it would make and forget again with every callback."""
        self._kept = True
        ctypes.pythonapi.PyGILState_Ensure()  # never given back: the thread lives as long as we do

    def _is_autopilot(self, message: MavlinkMessage) -> bool:
        """Cameras, gimbals, smart batteries and other vehicles may speak on the same link: none of them decides."""
        return message.component_id == AUTOPILOT and message.system_id == self._system

    def _odometry(self, fields: Fields) -> None:
        stamp = int(fields["time_usec"])
        arrival = self.arrivals.judge(stamp, fields["arrived"])
        if arrival.newer:
            self.counter.odometry(stamp)
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

    def _pinged(self, fields: Fields) -> None:
        if int(fields["target_system"]):  # an answer
            self.arrivals.echoed(1000 * int(fields["time_usec"]))

    def _timesync(self, fields: Fields) -> None:
        theirs = int(fields["tc1"])
        if theirs:
            self.arrivals.clock.answered(int(fields["ts1"]), theirs)
        elif self._shares_clock:
            ours = time.time_ns() - (time.monotonic_ns() - fields["arrived"])
            self._send_timesync(
                f'{{"tc1":{ours},"ts1":{fields["ts1"]},"target_system":{self._system},"target_component":1}}'
            )

    def _imu(self, message: MavlinkMessage, _: Any) -> None:
        if self._is_autopilot(message):
            self.messages.imu(message.fields_json)
        else:
            self.others.count(message.system_id, message.component_id)
