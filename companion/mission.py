"""What a flight is to fly: a mission, and the legs that it is made of. Home frame: z is height above ground, m.

climb -> (proving) -> to the start -> the trajectory, as often as asked -> home -> descent
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from trueflight.companion.law.guard import Guard
from trueflight.companion.outcome import LANDING, MISSION, TAKEOFF
from trueflight.companion.stopping import Safety
from trueflight.models.contract import WITH_MODEL
from trueflight.models.controllers import check_controller
from trueflight.models.errors import InputError
from trueflight.models.reference import Trajectory, transfer
from trueflight.models.trajectory import Waypoint, path

_LAND_FROM = 0.4  # m above ground at which the autopilot's own Land mode takes the last bit
_PROVING_MOVE = 0.6
"""m, aside and (half of it) up, of the moves before a mission by which a model from the ground is judged."""
_PROVING_LAPS = 3


@dataclass(frozen=True)
class Mission:
    """What to fly: a trajectory (home frame), how often, with which controller, guarded by what.

    `guard` holds the models that correct; none for a controller without correction. `proving` s are flown before the
    mission for a model that was deployed on the ground and has not proved itself yet.
    """

    identity: str
    trajectory: Trajectory
    controller: str = "lqr"
    repeat: int = 1
    guard: Guard | None = None
    proving: float = 0.0

    def __post_init__(self) -> None:
        check_controller(self.controller)
        if (self.guard is None) != (self.controller not in WITH_MODEL):
            raise InputError(f"controller '{self.controller}' needs a deployed model")


@dataclass(frozen=True)
class Leg:
    """A stretch of a flight: fly `trajectory`, then wait up to `settle` s until the vehicle is there.

    `corrects` where the correction acts: from the way to the start on, so that it has faded in when the mission
    begins, and not while landing. `proves` where a model in the shadow is judged though no mission is flown yet.
    """

    phase: str
    trajectory: Trajectory
    settle: float = 0.0
    name: str = ""
    corrects: bool = False
    proves: bool = False


def legs_of(mission: Mission, here: Waypoint, safety: Safety) -> list[Leg]:
    """All of a flight, from `here` (on the ground) until the autopilot is to land over home."""
    trajectory = mission.trajectory
    start, end = trajectory.start, trajectory.end
    above = (0.0, 0.0, max(start[2], 0.6), here[3])
    legs = [
        Leg(TAKEOFF, transfer(here, above, safety.climb_speed, 1.5), name="climb"),
        *_proving(above, mission.proving, safety),
        Leg(TAKEOFF, transfer(above, start, safety.transfer_speed, 2.0), 4.0, "to the start", True),
    ]
    for i in range(mission.repeat):
        if i and math.dist(end[:3], start[:3]) + abs(end[3] - start[3]) > 1e-6:
            back = transfer(end, start, safety.transfer_speed, 2.0)
            legs.append(Leg(TAKEOFF, back, 2.0, "to the start", True))
        legs.append(Leg(MISSION, trajectory, name=trajectory.name, corrects=True))
    return legs + way_home(end, safety)


def way_home(begin: Waypoint, safety: Safety) -> list[Leg]:
    """From anywhere to just above home."""
    above = (0.0, 0.0, max(begin[2], 0.6), begin[3])
    low = (0.0, 0.0, _LAND_FROM, begin[3])
    return [
        Leg(LANDING, transfer(begin, above, safety.transfer_speed, 2.0), name="home"),
        Leg(LANDING, transfer(above, low, safety.climb_speed, 1.5), 1.0, "descent"),
    ]


def stay(here: Waypoint) -> Leg:
    """Nowhere else, until the autopilot has landed."""
    return Leg(LANDING, transfer(here, here, 1.0, 1.0), name="stay")


def _proving(above: Waypoint, seconds: float, safety: Safety) -> list[Leg]:
    """Moves along every axis above home, for `seconds` s: what a model has to show before it may act."""
    if seconds <= 0.0:
        return []
    x, y, z, yaw = above
    aside = min(_PROVING_MOVE, 0.4 * safety.fence_radius)
    up = max(0.0, min(0.5 * _PROVING_MOVE, safety.fence_height - z - 0.5))
    corners = [
        above,
        (x + aside, y, z, yaw),
        (x + aside, y + aside, z + up, yaw),
        (x, y + aside, z, yaw),
        above,
    ]
    lap = Trajectory("proving", tuple(path(corners, 1.0, 3.0)))
    laps = min(_PROVING_LAPS, math.ceil((seconds + 0.5) / lap.duration))
    return [Leg(TAKEOFF, lap, 0.0, "proving", corrects=True, proves=True)] * laps
