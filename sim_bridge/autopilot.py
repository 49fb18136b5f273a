"""The simulated autopilot: modes, arming, failsafes and land detector, as a companion sees them in PX4."""

from __future__ import annotations

import math
import struct
from collections import deque
from enum import IntEnum

from trueflight.sim_bridge.modes import Mode
from trueflight.sim_bridge.parameters import Parameters
from trueflight.sim_bridge.position_control import (
    FREE,
    UNSET,
    AttitudeSetpoint,
    MotionSetpoint,
    PositionControl,
    RateSetpoint,
    Setpoint,
    Vector,
    attitude_of_thrust,
    tilt_of,
    yaw_of,
)
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.world import PHYSICS_STEP

_OUTER_STEPS = 5  # position loop and supervision at 100 Hz
_ATTITUDE_STEPS = 2  # attitude loop at 250 Hz, PX4's
_ESTIMATOR_START = 1.0  # s until the estimator gives a position
_LANDED_AFTER = 0.5  # s of contact, slow and without thrust
_EMPTY = 0.05  # state of charge below which arming is denied
_BATTERY_CRITICAL = 4  # PX4's failsafe_cause_t


class Landed(IntEnum):
    """MAV_LANDED_STATE."""

    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class Verdict(IntEnum):
    """MAV_RESULT of a request."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class Autopilot:
    """Flies a `Simulator`. Requests come as method calls, `step()` advances by one physics step.

    `notices` collects (severity, text) for STATUSTEXT; severities are MAVLink's (3 error, 4 warning, 6 info).
    `events` collects (PX4's name, severity, arguments) for EVENT.
    `pilot_present` tells whether a radio is on: the pilot's modes and PX4's default reactions need one.
    """

    def __init__(self, simulator: Simulator, parameters: Parameters) -> None:
        self.simulator = simulator
        self.parameters = parameters
        self.control = PositionControl(simulator.vehicle, parameters)
        self.mode = Mode.HOLD
        self.armed = False
        self.killed = False
        self.landed = Landed.ON_GROUND
        self.pilot_present = False
        self.failsafe = ""
        self.notices: deque[tuple[int, str]] = deque(maxlen=50)
        self.events: deque[tuple[str, int, bytes]] = deque(maxlen=50)
        self.home: Vector = simulator.estimate().position
        self.thrust = 0.0
        self.rates: Vector = (0.0, 0.0, 0.0)
        self.attitude: AttitudeSetpoint | None = None
        self._offboard: Setpoint | None = None
        self._offboard_us = -(10**12)
        self._target: MotionSetpoint = MotionSetpoint()
        self._steps = 0
        self.armed_us = 0
        self._landed_us = 0
        self._quiet_us: int | None = None
        self._flown = False

    @property
    def time_us(self) -> int:
        """The vehicle's clock."""
        return self.simulator.time_us

    # Requests

    def offboard(self, setpoint: Setpoint) -> None:
        """Take a setpoint from the companion; it acts in Offboard, and keeps Offboard available in other
        modes.
        """
        self._offboard = setpoint
        self._offboard_us = self.time_us

    @property
    def offboard_alive(self) -> bool:
        """Whether the last setpoint is younger than COM_OF_LOSS_T."""
        return self.time_us - self._offboard_us <= self.parameters["COM_OF_LOSS_T"] * 1e6

    def set_mode(self, mode: Mode) -> Verdict:
        """Change the flight mode, as asked by a MAVLink command or by the pilot."""
        if mode is Mode.OFFBOARD and not self.offboard_alive:
            self.notices.append((3, "Switching to mode 'Offboard' is currently not available: no setpoints"))
            return Verdict.TEMPORARILY_REJECTED
        if mode in (Mode.READY, Mode.MISSION):
            self.notices.append((3, f"Switching to mode '{mode.name.title()}' is currently not available"))
            return Verdict.TEMPORARILY_REJECTED
        self._enter(mode)
        return Verdict.ACCEPTED

    def _enter(self, mode: Mode) -> None:
        if mode is self.mode:
            return
        now = self.simulator.estimate()
        self.mode = mode
        self.attitude = None
        if mode is not Mode.OFFBOARD:
            # Offboard by rates leaves no trace in the position loop; start it from what flies now.
            self.control.reset()
        x, y, z = now.position
        yaw = yaw_of(now.quaternion)
        if mode is Mode.TAKEOFF:
            self._target = MotionSetpoint((x, y, z + self.parameters["MIS_TAKEOFF_ALT"]), yaw=yaw)
        elif mode is Mode.RTL:
            height = max(z, self.home[2] + self.parameters["RTL_RETURN_ALT"])
            self._target = MotionSetpoint((x, y, height), yaw=yaw)
        else:
            self._target = MotionSetpoint((x, y, z), yaw=yaw)

    def takeoff(self, height: float | None = None) -> Verdict:
        """Climb to `height` m above the present position (default MIS_TAKEOFF_ALT) and hold."""
        if not self.armed and self.arm() is not Verdict.ACCEPTED:
            return Verdict.TEMPORARILY_REJECTED
        self._enter(Mode.TAKEOFF)
        if height is not None:
            x, y, z = self.simulator.estimate().position
            self._target = MotionSetpoint((x, y, z + height), yaw=self._target.yaw)
        return Verdict.ACCEPTED

    def reposition(self, position: Vector, yaw: float) -> Verdict:
        """Go to a position (m, world) with a yaw (rad) and hold; NaN keeps what is. Denied on the ground."""
        if not self.armed or self.landed is Landed.ON_GROUND:
            return Verdict.DENIED
        self._enter(Mode.HOLD)
        x, y, z = (
            new if math.isfinite(new) else old
            for new, old in zip(position, self._target.position, strict=True)
        )
        self._target = MotionSetpoint((x, y, z), yaw=self._target.yaw if math.isnan(yaw) else yaw)
        return Verdict.ACCEPTED

    def arming_refusals(self) -> list[str]:
        """Why arming is denied now; empty when it is not."""
        reasons = []
        now = self.simulator.estimate()
        if self.killed:
            reasons.append("kill switch engaged")
        if self.time_us < _ESTIMATOR_START * 1e6:
            reasons.append("no valid position estimate yet")
        if self.simulator.airframe.battery.charge < _EMPTY:
            reasons.append("battery empty")
        if tilt_of(now.quaternion) > math.radians(45):
            reasons.append("attitude failure: vehicle is tilted")
        if self.mode is Mode.OFFBOARD and not self.offboard_alive:
            reasons.append("no offboard signal")
        if self.mode.by_pilot and not self.pilot_present:
            reasons.append("no manual control input")
        return reasons

    def arm(self, force: bool = False) -> Verdict:
        """Start the motors at idle."""
        if self.armed:
            return Verdict.ACCEPTED
        refusals = self.arming_refusals()
        if refusals and not (force and not self.killed):
            self.notices.append((3, "Arming denied: " + refusals[0]))
            self.events.append(("commander_arm_denied_resolve_failures", 2, b""))
            return Verdict.TEMPORARILY_REJECTED
        self.armed = True
        self.armed_us = self.time_us
        self._flown = False
        self.failsafe = ""
        self.home = self.simulator.estimate().position
        self.control.reset()
        self.simulator.rates.reset()
        mode, self.mode = self.mode, Mode.READY
        self._enter(mode)
        self.notices.append((6, "Armed by external command"))
        return Verdict.ACCEPTED

    def disarm(self, force: bool = False) -> Verdict:
        """Stop the motors; denied in the air unless forced."""
        if not self.armed:
            return Verdict.ACCEPTED
        if not force and self.landed is not Landed.ON_GROUND:
            self.notices.append((3, "Disarming denied: not landed"))
            return Verdict.DENIED
        self._stop("Disarmed by external command")
        return Verdict.ACCEPTED

    def kill(self) -> Verdict:
        """Flight termination: the motors stop at once and stay stopped."""
        self.killed = True
        self.events.append(("commander_kill_sw_engaged", 4, b""))
        self._stop("Flight termination active")
        return Verdict.ACCEPTED

    def release_kill(self) -> None:
        """The pilot takes the kill switch back; the vehicle stays disarmed."""
        self.killed = False

    def _stop(self, text: str) -> None:
        self.armed = False
        self.thrust, self.rates, self.attitude = 0.0, (0.0, 0.0, 0.0), None
        if self.mode in (Mode.LAND, Mode.TAKEOFF, Mode.RTL):
            self._enter(Mode.HOLD)
        self.notices.append((6, text))

    # Time

    def step(self) -> None:
        """One physics step of autopilot and vehicle."""
        if self._steps % _OUTER_STEPS == 0:
            self._supervise()
            if self.armed:
                self._steer(_OUTER_STEPS * PHYSICS_STEP)
        if self.armed and self.attitude is not None and self._steps % _ATTITUDE_STEPS == 0:
            self.thrust = self.attitude.thrust
            self.rates = self.control.rates(self.attitude, self.simulator.estimate().quaternion)
        self._steps += 1
        if not self.armed:
            self.simulator.rest()
            return
        if self.mode is Mode.OFFBOARD and isinstance(self._offboard, RateSetpoint):
            # Straight through: a rate setpoint acts in the step after its arrival, not at the next outer
            # tick.
            self.attitude = None
            self.thrust, self.rates = self._offboard.thrust, self._offboard.rates
        if self.landed is Landed.ON_GROUND and self.thrust < 0.5 * self.simulator.vehicle.hover_thrust:
            self.simulator.rates.reset()
        self.simulator.step(self.thrust, *self.rates)

    def _steer(self, dt: float) -> None:
        now = self.simulator.estimate()
        setpoint: Setpoint = self._target
        if self.mode is Mode.OFFBOARD and self._offboard is not None:
            setpoint = self._offboard
        elif self.mode is Mode.LAND:
            down = -self.parameters["MPC_LAND_SPEED"]
            x, y, _ = self._target.position
            blind = self.failsafe == "descend"
            # PX4's Descend lets go of the horizontal position: level attitude, vertical speed only.
            setpoint = MotionSetpoint(
                FREE if blind else (x, y, UNSET),
                (UNSET, UNSET, down) if blind else (0.0, 0.0, down),
                yaw=self._target.yaw,
            )
        elif self.mode is Mode.TAKEOFF:
            x, y, z = self._target.position
            climb = min(self.parameters["MPC_TKO_SPEED"], self.parameters["MPC_Z_P"] * (z - now.position[2]))
            setpoint = MotionSetpoint((x, y, UNSET), (0.0, 0.0, climb), yaw=self._target.yaw)
            if z - now.position[2] < 0.15:
                self._enter(Mode.HOLD)
                self._target = MotionSetpoint((x, y, z), yaw=setpoint.yaw)
        elif self.mode is Mode.RTL:
            self._return_home(now.position)
            setpoint = self._target
        elif self.mode in (Mode.MANUAL, Mode.STABILIZED, Mode.ACRO):
            # Sticks centred: level, at the thrust that hovers.
            level = attitude_of_thrust((0.0, 0.0, 1.0), self._target.yaw)
            setpoint = AttitudeSetpoint(self.parameters["MPC_THR_HOVER"], level)
        elif self.mode is Mode.ALTCTL:
            setpoint = MotionSetpoint((UNSET, UNSET, self._target.position[2]), yaw=self._target.yaw)
        if isinstance(setpoint, RateSetpoint):
            return
        if isinstance(setpoint, AttitudeSetpoint):
            self.attitude = setpoint
            return
        if self.landed is Landed.ON_GROUND and not self._wants_up(setpoint, now.position[2]):
            # On the ground PX4 idles until something asks to climb.
            self.control.reset()
            level = attitude_of_thrust((0.0, 0.0, 1.0), yaw_of(now.quaternion))
            self.attitude = AttitudeSetpoint(0.0, level)
            return
        self.attitude = self.control.attitude(setpoint, now, dt)

    @staticmethod
    def _wants_up(setpoint: MotionSetpoint, z: float) -> bool:
        return setpoint.position[2] > z + 0.1 or setpoint.velocity[2] > 0.05 or setpoint.acceleration[2] > 0.5

    def _return_home(self, position: Vector) -> None:
        z = self._target.position[2]
        hx, hy, _ = self.home
        if abs(position[2] - z) < 0.5:
            self._target = MotionSetpoint((hx, hy, z), yaw=self._target.yaw)
            if math.hypot(position[0] - hx, position[1] - hy) < 0.5:
                self._enter(Mode.LAND)
                self._target = MotionSetpoint((hx, hy, z), yaw=self._target.yaw)

    # Supervision

    def _supervise(self) -> None:
        self._detect_landing()
        if not self.armed:
            return
        now = self.time_us
        if self.mode is Mode.OFFBOARD and not self.offboard_alive:
            self._offboard_lost()
        self._watch_failsafes()
        if self.landed is Landed.ON_GROUND:
            after_flight = self.parameters["COM_DISARM_LAND"]
            before_flight = self.parameters["COM_DISARM_PRFLT"]
            if self._flown and after_flight > 0 and now - self._landed_us > after_flight * 1e6:
                self._stop("Disarmed by landing")
            elif not self._flown and before_flight > 0 and now - self.armed_us > before_flight * 1e6:
                self._stop("Disarmed by auto preflight disarming")

    def _offboard_lost(self) -> None:
        action = int(self.parameters["COM_OBL_RC_ACT"])
        self.notices.append((3, "Failsafe: offboard control lost"))
        if action in (0, 1, 2, -1) and not self.pilot_present:
            # The pilot's modes need a pilot; without one PX4 ends in a descent without position control.
            self.failsafe = "descend"
            self._enter(Mode.LAND)
            return
        self.failsafe = "offboard lost"
        if action == 6:
            self.kill()
        elif action == 7:
            self._stop("Disarmed by failsafe")
        else:
            pilot = {0: Mode.POSCTL, 1: Mode.ALTCTL, 2: Mode.STABILIZED, -1: Mode.POSCTL}
            self._enter({**pilot, 3: Mode.RTL, 4: Mode.LAND, 5: Mode.HOLD}[action])

    def _watch_failsafes(self) -> None:
        """Geofence and battery, each acting once a flight and only in the air, as PX4's do by their parameters."""
        if self.landed is Landed.ON_GROUND:
            return
        parameters, state = self.parameters, self.simulator.estimate()
        x, y, z = (now - home for now, home in zip(state.position, self.home, strict=True))
        across, up = parameters["GF_MAX_HOR_DIST"], parameters["GF_MAX_VER_DIST"]
        outside = 0.0 < across < math.hypot(x, y) or 0.0 < up < z
        if outside and self.failsafe != "geofence":
            self.events.append(("check_gf_violation", 3, struct.pack("<IB", 0xFFFFFFFF, 0)))
            self._fail(
                "geofence", {2: Mode.HOLD, 3: Mode.RTL, 5: Mode.LAND}.get(int(parameters["GF_ACTION"])), 0
            )
        charge = self.simulator.airframe.battery.charge
        critical = charge < parameters["BAT_CRIT_THR"]
        if critical and self.failsafe != "battery":
            action = int(parameters["COM_LOW_BAT_ACT"])
            self._fail("battery", {2: Mode.LAND, 3: Mode.RTL}.get(action), _BATTERY_CRITICAL)

    def _fail(self, what: str, mode: Mode | None, cause: int) -> None:
        """Enter a failsafe's mode (None: warn only) and tell it; the numbers are those of PX4's enumerations."""
        self.failsafe = what if mode is not None else self.failsafe
        if mode is None or mode is self.mode:
            return
        before = self.mode.custom_mode
        action = {Mode.HOLD: 5, Mode.RTL: 6, Mode.LAND: 7}[mode]
        self.notices.append((2, "Failsafe activated"))
        name = "commander_failsafe_enter" if cause else "commander_failsafe_enter_generic"
        self.events.append((name, 2, struct.pack("<IBB", before, action, cause)))
        self._enter(mode)

    def _detect_landing(self) -> None:
        world = self.simulator.world
        hover = self.parameters["MPC_THR_HOVER"]
        touching = world.touching
        vx, vy, vz = world.velocity[0], world.velocity[1], world.velocity[2]
        height = world.position[2] - world.standing_height
        if self.landed is Landed.ON_GROUND:
            if not touching and height > 0.05:
                self.landed = Landed.TAKEOFF
                self._flown = True
            return
        slow = abs(vz) < 0.25 and math.hypot(vx, vy) < 0.5
        idle = not self.armed or self.thrust < 0.6 * hover
        if touching and slow and idle:
            if self._quiet_us is None:
                self._quiet_us = self.time_us
            if self.time_us - self._quiet_us > _LANDED_AFTER * 1e6:
                self.landed = Landed.ON_GROUND
                self._landed_us = self.time_us
                self.notices.append((6, "Landing detected"))
                self._quiet_us = None
            return
        self._quiet_us = None
        if self.mode is Mode.LAND:
            self.landed = Landed.LANDING
        elif self.landed is not Landed.TAKEOFF or height > 0.5:
            self.landed = Landed.IN_AIR
