"""Whether the vehicle is on the ground or in the air, as the autopilot finds it out."""

from __future__ import annotations

import math
from enum import IntEnum

from trueflight.sim_bridge.parameters import Parameters
from trueflight.sim_bridge.world import World

_LANDED_AFTER = 0.5  # s of contact, slow and without thrust
_LEFT_GROUND, _HIGH = 0.05, 0.5  # m above standing: it has taken off; it has climbed away


class Landed(IntEnum):
    """MAV_LANDED_STATE."""

    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class LandDetector:
    """Judges by contact, speed and thrust. `flown` tells whether the vehicle has left the ground since `arm`, and
    `landed_us` when it was last found landed (the vehicle's clock).
    """

    def __init__(self) -> None:
        self.state = Landed.ON_GROUND
        self.flown = False
        self.landed_us = 0
        self._quiet_us: int | None = None

    def arm(self) -> None:
        """A flight may begin."""
        self.flown = False

    def step(self, world: World, time_us: int, idle: bool, landing: bool) -> bool:
        """Look again; True when the vehicle has just been found landed.

        `idle`: the motors give little or no thrust; `landing`: the vehicle is told to land.
        """
        touching = world.touching
        vx, vy, vz = world.velocity[0], world.velocity[1], world.velocity[2]
        height = world.position[2] - world.standing_height
        if self.state is Landed.ON_GROUND:
            if not touching and height > _LEFT_GROUND:
                self.state = Landed.TAKEOFF
                self.flown = True
            return False
        slow = abs(vz) < 0.25 and math.hypot(vx, vy) < 0.5
        if touching and slow and idle:
            if self._quiet_us is None:
                self._quiet_us = time_us
            if time_us - self._quiet_us > _LANDED_AFTER * 1e6:
                self.state = Landed.ON_GROUND
                self.landed_us = time_us
                self._quiet_us = None
                return True
            return False
        self._quiet_us = None
        if landing:
            self.state = Landed.LANDING
        elif self.state is not Landed.TAKEOFF or height > _HIGH:
            self.state = Landed.IN_AIR
        return False

    def reason_to_disarm(self, parameters: Parameters, time_us: int, armed_us: int) -> str:
        """Why a vehicle that stands on the ground disarms by itself now; empty while it need not."""
        if self.state is not Landed.ON_GROUND:
            return ""
        after_flight, before_flight = parameters["COM_DISARM_LAND"], parameters["COM_DISARM_PRFLT"]
        if self.flown and after_flight > 0 and time_us - self.landed_us > after_flight * 1e6:
            return "Disarmed by landing"
        if not self.flown and before_flight > 0 and time_us - armed_us > before_flight * 1e6:
            return "Disarmed by auto preflight disarming"
        return ""
