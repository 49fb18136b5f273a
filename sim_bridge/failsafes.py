"""What the autopilot does by itself, as PX4's parameters say: pure decisions, which `Autopilot` carries out."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import Enum

from trueflight.sim_bridge.modes import Mode
from trueflight.sim_bridge.parameters import Parameters
from trueflight.sim_bridge.position_control import Vector

Event = tuple[str, int, bytes]
"""PX4's name of an event, its severity and its arguments."""

_BATTERY_CRITICAL = 4  # PX4's failsafe_cause_t
_ACTIONS = {Mode.HOLD: 5, Mode.RTL: 6, Mode.LAND: 7}  # PX4's failsafe_action_t
_FENCE_LEFT: Event = ("check_gf_violation", 3, struct.pack("<IB", 0xFFFFFFFF, 0))


class Stop(Enum):
    """Reactions that stop the motors."""

    KILL = "kill"
    DISARM = "disarm"


@dataclass(frozen=True)
class Breach:
    """A limit that the vehicle is beyond: the mode that it calls for (None: warn only), PX4's number of the cause (0:
    none), and the events that tell of it.
    """

    what: str
    mode: Mode | None
    cause: int = 0
    events: tuple[Event, ...] = ()


def breaches(parameters: Parameters, from_home: Vector, charge: float) -> list[Breach]:
    """Geofence and battery, for a vehicle so far from home (m, world) with such a state of charge."""
    found = []
    x, y, z = from_home
    across, up = parameters["GF_MAX_HOR_DIST"], parameters["GF_MAX_VER_DIST"]
    if 0.0 < across < math.hypot(x, y) or 0.0 < up < z:
        mode = {2: Mode.HOLD, 3: Mode.RTL, 5: Mode.LAND}.get(int(parameters["GF_ACTION"]))
        found.append(Breach("geofence", mode, events=(_FENCE_LEFT,)))
    if charge < parameters["BAT_CRIT_THR"]:
        mode = {2: Mode.LAND, 3: Mode.RTL}.get(int(parameters["COM_LOW_BAT_ACT"]))
        found.append(Breach("battery", mode, _BATTERY_CRITICAL))
    return found


def failsafe_event(before: Mode, after: Mode, cause: int) -> Event:
    """What tells of a failsafe that changes the mode; the numbers are those of PX4's enumerations."""
    name = "commander_failsafe_enter" if cause else "commander_failsafe_enter_generic"
    return name, 2, struct.pack("<IBB", before.custom_mode, _ACTIONS[after], cause)


def without_offboard(parameters: Parameters, pilot_present: bool) -> tuple[str, Mode | Stop]:
    """What is done when Offboard's setpoints stop: the failsafe's name, and the mode or the stop that follows."""
    action = int(parameters["COM_OBL_RC_ACT"])
    pilot = {0: Mode.POSCTL, 1: Mode.ALTCTL, 2: Mode.STABILIZED, -1: Mode.POSCTL}
    if action in pilot and not pilot_present:
        # The pilot's modes need a pilot; without one PX4 ends in a descent without position control.
        return "descend", Mode.LAND
    others: dict[int, Mode | Stop] = {3: Mode.RTL, 4: Mode.LAND, 5: Mode.HOLD, 6: Stop.KILL, 7: Stop.DISARM}
    reactions: dict[int, Mode | Stop] = {**pilot, **others}
    return "offboard lost", reactions[action]
