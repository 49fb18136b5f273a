"""What is asked of the autopilot and answered by it: modes, arming, message rates, reports, parameters. It blocks."""

from __future__ import annotations

import json
import threading
import time
from typing import Any

from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkDirect, MavlinkDirectError, MavlinkMessage
from mavsdk.plugins.param.param import Param, ParamError, ParamResult
from mavsdk.system import System

from trueflight.companion.messages import Messages
from trueflight.companion.px4_events import ArmingReport

AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1
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
_GROUND_STATION_HEARTBEAT = (
    '{"type":6,"autopilot":8,"base_mode":0,"custom_mode":0,"system_status":4,"mavlink_version":3}'
)
_MODE_NUMBERS = {"OFFBOARD": (6, 0), "LAND": (4, 6), "HOLD": (4, 3)}
_MODE_RATE = (
    50.0  # Hz: PX4 looks so often for a change of mode, and then tells it (CURRENT_MODE, from 1.15 on)
)


class Commands:
    """Commands to one autopilot, `number` its MAVLink system; what it tells besides is in `messages`. Any thread."""

    def __init__(self, direct: MavlinkDirect, number: int, messages: Messages) -> None:
        self._direct, self._system, self._messages = direct, number, messages

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

    def request_timesync(self, rate: float) -> None:
        """Ask for the autopilot's questions for our time, at `rate` Hz."""
        self.command(_SET_MESSAGE_INTERVAL, float(_MESSAGE_IDS["TIMESYNC"]), 1e6 / rate)

    def command(self, number: int, *parameters: float) -> str:
        """A COMMAND_LONG; blocks until acknowledged. Returns '' where accepted, otherwise the reason."""
        fields: dict[str, Any] = {f"param{i}": 0.0 for i in range(1, 8)}
        fields.update({f"param{i}": value for i, value in enumerate(parameters, 1)})
        fields.update(target_system=self._system, target_component=AUTOPILOT, command=number, confirmation=0)
        message = MavlinkMessage(
            "COMMAND_LONG",
            target_system_id=self._system,
            target_component_id=AUTOPILOT,
            fields_json=json.dumps(fields),
        )
        try:
            ack = json.loads(self._direct.send_command(message).fields_json)
        except MavlinkDirectError as error:
            return f"no answer ({error.result.name.lower()})"
        result = int(ack["result"])
        if result == _ACCEPTED:
            return ""
        texts = self._messages.latest.texts
        told = f": {texts[-1]}" if texts else ""
        return _RESULTS.get(result, f"result {result}") + told

    def arming_report(self, timeout: float = 2.0) -> ArmingReport | None:
        """What the autopilot's arming checks say now; None where it does not tell (PX4 before 1.13, others).

        The checks run again for this; the vehicle must be disarmed.
        """
        count = self._messages.arming.count
        refused = self.command(_RUN_PREARM_CHECKS)
        end = time.monotonic() + timeout
        while not refused and self._messages.arming.count == count and time.monotonic() < end:
            time.sleep(0.02)
        return self._messages.arming.report

    def autopilot_version(self, timeout: float = 1.0) -> str:
        """Such as 'PX4 1.15.2'; 'unknown' where the autopilot does not tell."""
        self.command(_REQUEST_MESSAGE, float(_MESSAGE_IDS["AUTOPILOT_VERSION"]))
        end = time.monotonic() + timeout
        while not self._messages.version and time.monotonic() < end:
            time.sleep(0.02)
        return self._messages.version or "unknown"

    def show_as_ground_station(self) -> None:
        """One heartbeat of a ground station: PX4 sends STATUSTEXT for some seconds after it.

        Only for a vehicle that does not fly: PX4 then takes us for its data link, and misses us later.
        """
        message = MavlinkMessage("HEARTBEAT", fields_json=_GROUND_STATION_HEARTBEAT)
        self._direct.send_message(message)


class Parameters:
    """The autopilot's parameters. Any thread, one at a time."""

    def __init__(self, autopilot: System) -> None:
        self._param = Param(autopilot)
        self._lock = threading.Lock()

    def read(self, name: str) -> float | int | None:
        """A parameter of the autopilot, whichever type it has; None where it has none of that name or is
        silent.
        """
        with self._lock:
            try:
                return float(self._param.get_param_float(name))
            except ParamError as error:
                if error.result != ParamResult.WRONG_TYPE:
                    return None
            try:
                return int(self._param.get_param_int(name))
            except ParamError:
                return None

    def write(self, name: str, value: float | int) -> str:
        """Set a parameter; an int is sent as INT32, a float as REAL32. Returns '' where the autopilot has taken
        it, otherwise the reason.
        """
        with self._lock:
            try:
                if isinstance(value, int):
                    self._param.set_param_int(name, value)
                else:
                    self._param.set_param_float(name, value)
            except ParamError as error:
                return error.result.name.lower().replace("_", " ")
        now = self.read(name)
        if now is None or abs(now - value) > 1e-6 * max(1.0, abs(value)):
            return f"the autopilot kept {now}"
        return ""
