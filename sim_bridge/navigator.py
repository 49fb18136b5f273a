"""Where the autopilot wants to be in its own modes: the target, and the setpoint that leads there."""

from __future__ import annotations

import math

from trueflight.sim_bridge.modes import Mode
from trueflight.sim_bridge.parameters import Parameters
from trueflight.sim_bridge.position_control import (
    FREE,
    UNSET,
    AttitudeSetpoint,
    MotionSetpoint,
    Vector,
    attitude_of_thrust,
    yaw_of,
)
from trueflight.sim_bridge.truth.sensors import Estimate

_ARRIVED_UP, _ARRIVED_ACROSS, _ARRIVED_BACK = (
    0.15,
    0.5,
    0.5,
)  # m: take-off's height; home; the height of the return
_STICKS_CENTRED = (Mode.MANUAL, Mode.STABILIZED, Mode.ACRO)


class Navigator:
    """Aims when a mode is entered, and leads from there. Positions in m, world; yaw in rad."""

    def __init__(self, parameters: Parameters, home: Vector) -> None:
        self.parameters = parameters
        self.home = home
        self.target = MotionSetpoint()

    def aim(self, mode: Mode, now: Estimate) -> None:
        """Set the target that a mode begins with."""
        x, y, z = now.position
        if mode is Mode.TAKEOFF:
            z += self.parameters["MIS_TAKEOFF_ALT"]
        elif mode is Mode.RTL:
            z = max(z, self.home[2] + self.parameters["RTL_RETURN_ALT"])
        self.target = MotionSetpoint((x, y, z), yaw=yaw_of(now.quaternion))

    def aim_at(self, position: Vector, yaw: float) -> None:
        """Set the target; NaN keeps what is."""
        x, y, z = (
            new if math.isfinite(new) else old
            for new, old in zip(position, self.target.position, strict=True)
        )
        self.target = MotionSetpoint((x, y, z), yaw=self.target.yaw if math.isnan(yaw) else yaw)

    def setpoint(self, mode: Mode, now: Estimate, blind: bool) -> MotionSetpoint | AttitudeSetpoint:
        """What leads to the target in a mode; `blind`: without a horizontal position."""
        x, y, z = self.target.position
        yaw = self.target.yaw
        if mode is Mode.LAND:
            down = -self.parameters["MPC_LAND_SPEED"]
            # PX4's Descend lets go of the horizontal position: level attitude, vertical speed only.
            if blind:
                return MotionSetpoint(FREE, (UNSET, UNSET, down), yaw=yaw)
            return MotionSetpoint((x, y, UNSET), (0.0, 0.0, down), yaw=yaw)
        if mode is Mode.TAKEOFF:
            climb = min(self.parameters["MPC_TKO_SPEED"], self.parameters["MPC_Z_P"] * (z - now.position[2]))
            return MotionSetpoint((x, y, UNSET), (0.0, 0.0, climb), yaw=yaw)
        if mode is Mode.RTL and abs(now.position[2] - z) < _ARRIVED_BACK:
            self.target = MotionSetpoint((self.home[0], self.home[1], z), yaw=yaw)
        elif mode in _STICKS_CENTRED:
            # Level, at the thrust that hovers.
            level = attitude_of_thrust((0.0, 0.0, 1.0), yaw)
            return AttitudeSetpoint(self.parameters["MPC_THR_HOVER"], level)
        elif mode is Mode.ALTCTL:
            return MotionSetpoint((UNSET, UNSET, z), yaw=yaw)
        return self.target

    def next_mode(self, mode: Mode, now: Estimate) -> Mode | None:
        """The mode that follows by itself, for the same target; None while this one has more to do."""
        x, y, z = now.position
        above = self.target.position[2]
        if mode is Mode.TAKEOFF and above - z < _ARRIVED_UP:
            return Mode.HOLD
        if mode is Mode.RTL and abs(z - above) < _ARRIVED_BACK:
            away = math.hypot(x - self.home[0], y - self.home[1])
            return Mode.LAND if away < _ARRIVED_ACROSS else None
        return None
