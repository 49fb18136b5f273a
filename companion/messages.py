"""What the autopilot tells beside its odometry, message by message, as it stands on MAVLink's wire."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from trueflight.companion.arrival import Arrivals
from trueflight.companion.estimator import estimator_status
from trueflight.companion.latest import Latest, mode_name
from trueflight.companion.message_rates import MessageCounter
from trueflight.companion.px4_events import ArmingChecks, Px4Event, describe, unhealthy

Fields = dict[str, Any]
"""The fields of a message; `arrived` is added to them: when, in monotonic ns."""

_ARMED = 128
_CRITICAL, _TERMINATED = 5, 8  # MAV_STATE of a failsafe that acts, and of motors that are cut
_LANDED = {0: "unknown", 1: "on ground", 2: "in air", 3: "taking off", 4: "landing"}
_RPM = 2.0 * math.pi / 60.0


class Messages:
    """Keeps the last of everything in `latest`; belongs to MAVSDK's thread, any thread may read.

    `handlers` maps names of messages to what takes their fields; one raises `KeyError`, `TypeError`, `ValueError` or
    `IndexError` for fields that are none of that message. `arming` collects the arming checks, `version` is that of
    the autopilot, '' before it was told, `kind` its MAV_AUTOPILOT and its vehicle's MAV_TYPE. `on_notice` gets what the
    autopilot tells of failsafes, switches and failed checks, in plain words.
    """

    def __init__(self, arrivals: Arrivals, counter: MessageCounter) -> None:
        self.latest = Latest()
        self.arming = ArmingChecks()
        self.version = ""
        self.kind: tuple[int, int] | None = None
        self.on_notice: Callable[[str], None] = lambda text: None
        self.handlers: dict[str, Callable[[Fields], None]] = {
            "BATTERY_STATUS": self._battery,
            "ESC_STATUS": self._esc,
            "HEARTBEAT": self._heartbeat,
            "CURRENT_MODE": self._current_mode,
            "EXTENDED_SYS_STATE": self._landed,
            "STATUSTEXT": self._text,
            "EVENT": self._event,
            "SYS_STATUS": self._system_status,
            "ESTIMATOR_STATUS": self._estimator,
            "AUTOPILOT_VERSION": self._autopilot_version,
        }
        self._arrivals, self._counter = arrivals, counter
        self._escs: dict[int, float] = {}
        self._event_sequence = -1
        self._text_number = -1

    def imu(self, text: str) -> None:
        """A HIGHRES_IMU message, as it came: what it takes to read it would delay the setpoint."""
        self._counter.count("HIGHRES_IMU")
        self.latest.imu = text

    def _battery(self, fields: Fields) -> None:
        self._counter.count("BATTERY_STATUS")
        self.latest.batteries.take(fields)
        self.latest.battery_voltage = self.latest.batteries.voltage

    def _esc(self, fields: Fields) -> None:
        self._counter.count("ESC_STATUS")
        first = int(fields["index"])
        for i, rpm in enumerate(fields["rpm"]):
            self._escs[first + i] = abs(rpm) * _RPM
        self.latest.rotor_speed = tuple(self._escs[i] for i in sorted(self._escs))

    def _mode_told(self) -> None:
        self._counter.count("MODE")
        self.latest.mode_time_us = self._arrivals.last_us

    def _heartbeat(self, fields: Fields) -> None:
        self._mode_told()
        self.kind = int(fields["autopilot"]), int(fields["type"])
        self.latest.heartbeat = 1e-9 * fields["arrived"]
        self.latest.armed = bool(int(fields["base_mode"]) & _ARMED)
        self.latest.killed = int(fields["system_status"]) == _TERMINATED
        self.latest.failsafe = int(fields["system_status"]) == _CRITICAL
        self.latest.flight_mode = mode_name(int(fields["custom_mode"]))

    def _current_mode(self, fields: Fields) -> None:
        self._mode_told()
        # PX4 keeps the mode that somebody chose apart from what its failsafes made of it.
        intended, mode = int(fields["intended_custom_mode"]), int(fields["custom_mode"])
        self.latest.failsafe = intended not in (0, mode)
        self.latest.flight_mode = mode_name(int(fields["custom_mode"]))

    def _landed(self, fields: Fields) -> None:
        self.latest.landed = _LANDED.get(int(fields["landed_state"]), "unknown")

    def _text(self, fields: Fields) -> None:
        number, text, texts = int(fields.get("id", 0)), str(fields["text"]).rstrip("\t"), self.latest.texts
        if texts and number == self._text_number and int(fields.get("chunk_seq", 0)):
            texts[-1] += text  # a long text comes in pieces
        else:
            texts.append(text)
        self._text_number = number

    def _event(self, fields: Fields) -> None:
        if int(fields["sequence"]) == self._event_sequence:
            return
        self._event_sequence = int(fields["sequence"])
        arguments = bytes(int(byte) for byte in fields["arguments"])
        event = Px4Event(int(fields["id"]), int(fields["log_levels"]) & 0xF, arguments)
        self.arming.take(event)
        text = describe(event)
        if text:
            self.latest.notices.append((time.monotonic(), text))
            self.on_notice(text)

    def _autopilot_version(self, fields: Fields) -> None:
        version = int(fields["flight_sw_version"])
        self.version = f"PX4 {version >> 24 & 0xFF}.{version >> 16 & 0xFF}.{version >> 8 & 0xFF}"

    def _estimator(self, fields: Fields) -> None:
        self.latest.estimator = estimator_status(fields)

    def _system_status(self, fields: Fields) -> None:
        enabled = int(fields["onboard_control_sensors_enabled"])
        self.latest.unhealthy = unhealthy(enabled, int(fields["onboard_control_sensors_health"]))
