"""PX4's events: why it refuses to arm and why a failsafe acts, in a pilot's words.

PX4 tells its reasons in EVENT messages on every link; the older STATUSTEXT goes to ground stations alone. An
event carries no text: its number is a hash of its name, and the names that concern a quadrotor, with what each
means and what helps, stand in `companion.px4_checks`. Source: PX4's events interface (1.13 and later; 24
bits of FNV-1a, component in the upper 8) and the checks of its commander module.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from trueflight.companion.px4_checks import CHECKS, NO_SETPOINTS, TOLD_ANYWAY

ERROR, WARNING = 3, 4
"""Log levels as in syslog: lower is worse."""
_OFFBOARD_GROUP = 1 << 14
_AUTOPILOT_COMPONENT = 1 << 24


@dataclass(frozen=True)
class Px4Event:
    """One EVENT message: number, level (syslog's, as told to people), arguments as they came."""

    number: int
    level: int
    arguments: bytes


@dataclass(frozen=True)
class Problem:
    """An arming check that failed: PX4's `name` for it, what it means, what to do, and its level.

    `name` is the number in hexadecimal where this program does not know the check.
    """

    name: str
    text: str
    advice: str
    level: int

    @property
    def line(self) -> str:
        """Both in one line."""
        return f"{self.text}; {self.advice}" if self.advice else self.text


@dataclass(frozen=True)
class ArmingReport:
    """What PX4's arming checks say; `can_arm` is for Offboard, `problems` those that concern it."""

    can_arm: bool
    problems: tuple[Problem, ...]

    def reasons(self, streaming: bool) -> tuple[Problem, ...]:
        """The problems that stand against a flight; without setpoints `streaming`, not that they are missing."""
        return tuple(
            problem
            for problem in self.problems
            if problem.level <= ERROR and (streaming or problem.name not in NO_SETPOINTS)
        )


def event_number(name: str) -> int:
    """The number that PX4 gives an event of the autopilot component."""
    value = 0x811C9DC5
    for byte in name.encode():
        value = (value ^ byte) * 0x1000193 & 0xFFFFFFFF
    return value & 0xFFFFFF | _AUTOPILOT_COMPONENT


_NAMES = {event_number(name): name for name in CHECKS}
_ARMING_SUMMARY = event_number("commander_arming_check_summary")
_HEALTH_SUMMARY = event_number("commander_health_summary")
_ACTIONS = (
    "none",
    "warning",
    "Position",
    "Altitude",
    "Stabilized",
    "Hold",
    "Return",
    "Land",
    "Descend",
    "disarm",
    "terminate",
)
_CAUSES = (
    "a failed check",
    "radio control lost",
    "ground station lost",
    "battery low",
    "battery critical",
    "battery all but empty",
    "flight time running out",
)
# PX4's failsafe events, and where in the arguments action and cause stand.
_FAILSAFES: dict[int, tuple[int | None, int | None]] = {
    event_number("commander_failsafe_enter"): (4, 5),
    event_number("commander_failsafe_enter_generic"): (4, None),
    event_number("commander_failsafe_enter_autopilot_disengaged"): (4, None),
    event_number("commander_failsafe_enter_hold"): (4, 7),
    event_number("commander_failsafe_enter_generic_hold"): (4, None),
    event_number("commander_failsafe_enter_warn"): (None, 4),
    event_number("commander_failsafe_enter_generic_warn"): (None, None),
}


def describe(event: Px4Event) -> str:
    """One line for an event that matters in flight; '' for any other."""
    if event.number in _FAILSAFES:
        action_at, cause_at = _FAILSAFES[event.number]
        action = _name_of(_ACTIONS, event.arguments, action_at)
        cause = _name_of(_CAUSES, event.arguments, cause_at)
        return f"failsafe: {cause or _CAUSES[0]}, {action or _ACTIONS[1]}"
    name = _NAMES.get(event.number)
    if name is None or name in NO_SETPOINTS or (event.level > ERROR and name not in TOLD_ANYWAY):
        return ""
    return CHECKS[name][0]


def _name_of(names: Sequence[str], arguments: bytes, at: int | None) -> str:
    if at is None or at >= len(arguments) or arguments[at] >= len(names):
        return ""
    return names[arguments[at]]


class ArmingChecks:
    """Collects the report that PX4 sends when its checks change or are asked for: a summary, one event for each
    problem, a second summary.

    `report` is the last whole one; `count` tells how many there have been.
    """

    def __init__(self) -> None:
        self.report: ArmingReport | None = None
        self.count = 0
        self._can_arm: bool | None = None
        self._problems: list[Problem] = []

    def take(self, event: Px4Event) -> None:
        """Take the next event."""
        if event.number == _ARMING_SUMMARY:
            # chunk uint8, error uint32, warning uint32, can_arm uint32, can_run uint32
            (groups,) = struct.unpack_from("<I", event.arguments.ljust(17, b"\0"), 9)
            self._can_arm, self._problems = bool(groups & _OFFBOARD_GROUP), []
        elif event.number == _HEALTH_SUMMARY:
            if self._can_arm is not None:
                self.report = ArmingReport(self._can_arm, tuple(self._problems))
                self.count += 1
            self._can_arm = None
        elif self._can_arm is not None:
            (groups,) = struct.unpack_from("<I", event.arguments.ljust(4, b"\0"))
            if groups & _OFFBOARD_GROUP:
                self._problems.append(problem_of(event))


def problem_of(event: Px4Event) -> Problem:
    """The failed check of an event, in plain words."""
    name = _NAMES.get(event.number, f"0x{event.number:08x}")
    text, advice = CHECKS.get(
        name, (f"an arming check failed that is not known here (PX4 event {name})", "see QGroundControl")
    )
    return Problem(name, text, advice, event.level)


_SENSORS = {
    0x1: "gyroscope",
    0x2: "accelerometer",
    0x4: "compass",
    0x8: "barometer",
    0x20: "GPS",
    0x40: "optical flow",
    0x80: "vision position",
    0x100: "distance sensor",
    0x200: "external position",
    0x400: "body rate control",
    0x800: "attitude control",
    0x1000: "yaw control",
    0x2000: "height control",
    0x4000: "position control",
    0x8000: "motor outputs",
    0x10000: "radio control",
    0x100000: "geofence",
    0x200000: "attitude estimate",
    0x1000000: "logging",
    0x2000000: "battery",
    0x10000000: "arming checks",
}
"""Bits of SYS_STATUS (MAV_SYS_STATUS_SENSOR)."""


def unhealthy(enabled: int, health: int) -> tuple[str, ...]:
    """What SYS_STATUS says is switched on and not well."""
    return tuple(name for bit, name in _SENSORS.items() if enabled & bit and not health & bit)
