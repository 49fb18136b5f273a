"""EVENT (message 410), by which PX4 tells its reasons to everybody, and the arming report made of such events.

Source: the message's definition in MAVLink's common.xml, whose field order on the wire and CRC seed follow from it; an
event's number is 24 bits of FNV-1a of its name, its arguments are packed without gaps (PX4's events interface).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mav

EVENT = 410
_ARGUMENTS = 40
_OFFBOARD_GROUP = 1 << 14
_ALL_GROUPS = 0xFFFFFFFF
_PROTOCOL, _ERROR, _CRITICAL = 8, 3, 2

_CHECKS = {
    "kill switch engaged": "check_man_control_kill_engaged",
    "no valid position estimate yet": "check_modes_local_pos",
    "battery empty": "check_battery_emergency",
    "attitude failure: vehicle is tilted": "check_failure_detector_roll",
    "no offboard signal": "check_modes_offboard_signal",
    "no manual control input": "check_modes_manual_control",
}
"""PX4's names of what the simulated autopilot refuses to arm for."""


def number_of(name: str) -> int:
    """PX4's number of an event of the autopilot component."""
    value = 2166136261
    for character in name:
        value = (value ^ ord(character)) * 16777619 % 2**32
    return 2**24 + value % 2**24


def arming_report(refusals: Sequence[str], offboard_alive: bool) -> list[tuple[str, int, bytes]]:
    """Name, level and arguments of the events that tell the arming checks, as PX4 sends them after
    MAV_CMD_RUN_PREARM_CHECKS: `offboard_alive` False stands against Offboard alone.
    """
    problems = [
        (_CHECKS[text], _ERROR, struct.pack("<IB", _ALL_GROUPS, 0)) for text in refusals if text in _CHECKS
    ]
    if not offboard_alive and "no offboard signal" not in refusals:
        problems.append((_CHECKS["no offboard signal"], _ERROR, struct.pack("<IB", _OFFBOARD_GROUP, 0)))
    can_arm = _ALL_GROUPS if not problems else 0
    first = (
        "commander_arming_check_summary",
        _PROTOCOL,
        struct.pack("<BIIII", 0, 0, 0, can_arm, _ALL_GROUPS),
    )
    last = ("commander_health_summary", _PROTOCOL, struct.pack("<BIII", 0, 0, 0, 0))
    return [first, *problems, last]


class Event(mav.MAVLink_message):
    """One event of the autopilot."""

    id = EVENT
    msgname = "EVENT"
    fieldnames: ClassVar = [
        "destination_component",
        "destination_system",
        "id",
        "event_time_boot_ms",
        "sequence",
        "log_levels",
        "arguments",
    ]
    crc_extra = 160
    _layout = struct.Struct(f"<IIHBBB{_ARGUMENTS}s")

    def __init__(self, name: str, level: int, arguments: bytes, time_ms: int, sequence: int) -> None:
        mav.MAVLink_message.__init__(self, self.id, self.msgname)
        self._values = (
            number_of(name),
            time_ms % 2**32,
            sequence % 2**16,
            0,
            0,
            level << 4 | level,
            arguments,
        )

    def pack(self, link: Any, force_mavlink1: bool = False) -> bytes:
        """The message's bytes for a link."""
        payload = self._layout.pack(*self._values)
        packed: bytes = self._pack(link, self.crc_extra, payload, force_mavlink1=force_mavlink1)
        return packed
