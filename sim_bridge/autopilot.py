"""The simulated autopilot: modes, arming, failsafes and land detector, as a companion sees them in PX4."""

from __future__ import annotations

import math
from collections import deque
from enum import IntEnum

from trueflight.sim_bridge.failsafes import Breach, Stop, breaches, failsafe_event, without_offboard
from trueflight.sim_bridge.land_detector import LandDetector, Landed
from trueflight.sim_bridge.modes import Mode
from trueflight.sim_bridge.navigator import Navigator
from trueflight.sim_bridge.parameters import Parameters
from trueflight.sim_bridge.position_control import (
    AttitudeSetpoint,
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
_EMPTY = 0.05  # state of charge below which arming is denied


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
        self.pilot_present = False
        self.failsafe = ""
        self.notices: deque[tuple[int, str]] = deque(maxlen=50)
        self.events: deque[tuple[str, int, bytes]] = deque(maxlen=50)
        self._ground = LandDetector()
        self._navigator = Navigator(parameters, simulator.estimate().position)
        self.thrust = 0.0
        self.rates: Vector = (0.0, 0.0, 0.0)
        self.attitude: AttitudeSetpoint | None = None
        self._offboard: Setpoint | None = None
        self._offboard_us = -(10**12)
        self._steps = 0
        self.armed_us = 0

    @property
    def time_us(self) -> int:
        """The vehicle's clock."""
        return self.simulator.time_us

    @property
    def landed(self) -> Landed:
        """Where the vehicle is between ground and air, as far as it knows."""
        return self._ground.state

    @property
    def home(self) -> Vector:
        """Where the vehicle was armed, m, world."""
        return self._navigator.home

    # Requests

    def offboard(self, setpoint: Setpoint) -> None:
        """Take a setpoint from the companion; it acts in Offboard, and keeps Offboard available in other modes."""
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
        self.mode = mode
        self.attitude = None
        if mode is not Mode.OFFBOARD:
            # Offboard by rates leaves no trace in the position loop; start it from what flies now.
            self.control.reset()
        self._navigator.aim(mode, self.simulator.estimate())

    def takeoff(self, height: float | None = None) -> Verdict:
        """Climb to `height` m above the present position (default MIS_TAKEOFF_ALT) and hold."""
        if not self.armed and self.arm() is not Verdict.ACCEPTED:
            return Verdict.TEMPORARILY_REJECTED
        self._enter(Mode.TAKEOFF)
        if height is not None:
            x, y, z = self.simulator.estimate().position
            self._navigator.aim_at((x, y, z + height), math.nan)
        return Verdict.ACCEPTED

    def reposition(self, position: Vector, yaw: float) -> Verdict:
        """Go to a position (m, world) with a yaw (rad) and hold; NaN keeps what is. Denied on the ground."""
        if not self.armed or self.landed is Landed.ON_GROUND:
            return Verdict.DENIED
        self._enter(Mode.HOLD)
        self._navigator.aim_at(position, yaw)
        return Verdict.ACCEPTED

    def arming_refusals(self) -> list[str]:
        """Why arming is denied now; empty when it is not."""
        tilt = tilt_of(self.simulator.estimate().quaternion)
        refusals = {
            "kill switch engaged": self.killed,
            "no valid position estimate yet": self.time_us < _ESTIMATOR_START * 1e6,
            "battery empty": self.simulator.airframe.battery.charge < _EMPTY,
            "attitude failure: vehicle is tilted": tilt > math.radians(45),
            "no offboard signal": self.mode is Mode.OFFBOARD and not self.offboard_alive,
            "no manual control input": self.mode.by_pilot and not self.pilot_present,
        }
        return [refusal for refusal, holds in refusals.items() if holds]

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
        self._ground.arm()
        self.failsafe = ""
        self._navigator.home = self.simulator.estimate().position
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
            # Straight through: a rate setpoint acts in the step after its arrival, not at the next outer tick.
            self.attitude = None
            self.thrust, self.rates = self._offboard.thrust, self._offboard.rates
        if self.landed is Landed.ON_GROUND and self.thrust < 0.5 * self.simulator.vehicle.hover_thrust:
            self.simulator.rates.reset()
        self.simulator.step(self.thrust, *self.rates)

    def _steer(self, dt: float) -> None:
        now = self.simulator.estimate()
        setpoint: Setpoint
        if self.mode is Mode.OFFBOARD and self._offboard is not None:
            setpoint = self._offboard
        else:
            setpoint = self._navigator.setpoint(self.mode, now, self.failsafe == "descend")
            if (following := self._navigator.next_mode(self.mode, now)) is not None:
                target = self._navigator.target
                self._enter(following)
                self._navigator.target = target
        if isinstance(setpoint, RateSetpoint):
            return
        if isinstance(setpoint, AttitudeSetpoint):
            self.attitude = setpoint
            return
        if self.landed is Landed.ON_GROUND and not setpoint.climbs_from(now.position[2]):
            # On the ground PX4 idles until something asks to climb.
            self.control.reset()
            level = attitude_of_thrust((0.0, 0.0, 1.0), yaw_of(now.quaternion))
            self.attitude = AttitudeSetpoint(0.0, level)
            return
        self.attitude = self.control.attitude(setpoint, now, dt)

    # Supervision

    def _supervise(self) -> None:
        idle = not self.armed or self.thrust < 0.6 * self.parameters["MPC_THR_HOVER"]
        if self._ground.step(self.simulator.world, self.time_us, idle, self.mode is Mode.LAND):
            self.notices.append((6, "Landing detected"))
        if not self.armed:
            return
        if self.mode is Mode.OFFBOARD and not self.offboard_alive:
            self._offboard_lost()
        self._watch_failsafes()
        if reason := self._ground.reason_to_disarm(self.parameters, self.time_us, self.armed_us):
            self._stop(reason)

    def _offboard_lost(self) -> None:
        self.notices.append((3, "Failsafe: offboard control lost"))
        self.failsafe, reaction = without_offboard(self.parameters, self.pilot_present)
        if reaction is Stop.KILL:
            self.kill()
        elif reaction is Stop.DISARM:
            self._stop("Disarmed by failsafe")
        else:
            self._enter(reaction)

    def _watch_failsafes(self) -> None:
        """Geofence and battery, each acting once a flight and only in the air, as PX4's do by their parameters."""
        if self.landed is Landed.ON_GROUND:
            return
        x, y, z = (
            now - home for now, home in zip(self.simulator.estimate().position, self.home, strict=True)
        )
        for breach in breaches(self.parameters, (x, y, z), self.simulator.airframe.battery.charge):
            if self.failsafe != breach.what:
                self._react(breach)

    def _react(self, breach: Breach) -> None:
        """Enter a failsafe's mode and tell it; a breach without a mode is told only."""
        self.events.extend(breach.events)
        mode = breach.mode
        if mode is None:
            return
        self.failsafe = breach.what
        if mode is not self.mode:
            self.notices.append((2, "Failsafe activated"))
            self.events.append(failsafe_event(self.mode, mode, breach.cause))
            self._enter(mode)
