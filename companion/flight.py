"""One flight as the control thread sees it: phases, references, and every reason to stop.

    idle -> takeoff -> mission -> landing -> idle
               |          |          |
               +----------+----------+-> silent -> idle

`tick` is called with each odometry message and answers with what to send, or with nothing. Nothing is the
safe answer: an autopilot in Offboard that hears no setpoint for COM_OF_LOSS_T takes over by itself. *The
pilot wins*: any mode but Offboard silences the flight at once, and it never goes back by itself.

Positions here are in the *home frame*: axes of the world (ENU), origin on the ground below the vehicle at
arming, so that z is height above ground.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from trueflight.companion.agreement import Agreement, AgreementLimits
from trueflight.companion.latest import Latest
from trueflight.companion.law.control import (
    IDLE_STEP,
    Attitude,
    ControlLaw,
    State,
    euler,
    features,
)
from trueflight.companion.law.controllers import Controller, TrimLimits, make_controller
from trueflight.companion.law.guard import Guard
from trueflight.companion.law.watch import Watch
from trueflight.companion.odometry import Odometry
from trueflight.companion.outcome import IDLE, LANDING, MISSION, SILENT, TAKEOFF, Outcome
from trueflight.companion.resets import found_reset
from trueflight.companion.shadow import Shadow, error_acceleration
from trueflight.companion.stopping import (
    RETURN,
    SILENCE,
    TELL,
    ReasonsToStop,
    Safety,
    Stop,
    motors_cut,
    taken_over,
)
from trueflight.models.contract import CONTROLLERS, CORRECTED
from trueflight.models.errors import InputError
from trueflight.models.reference import Trajectory, transfer
from trueflight.models.trajectory import ReferenceSample, Waypoint, path

Vector = tuple[float, float, float]

_SETTLED_DISTANCE, _SETTLED_SPEED = 0.15, 0.25
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
        if self.controller not in CONTROLLERS:
            raise InputError(
                f"controller '{self.controller}' is unknown; use one of {', '.join(CONTROLLERS)}"
            )
        if (self.guard is None) != (self.controller != CORRECTED):
            raise InputError("controller 'corrected' needs a deployed model")


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


@dataclass(frozen=True)
class Decision:
    """What became of a model in flight: `kind` is `live`, `refused`, `rolled_back` (the live one, tripped) or
    `undecided` (the flight ended before).
    """

    kind: str
    model: str
    reason: str = ""


@dataclass
class FlightStateMachine:
    """The state machine of a flight; `tick` belongs to the control thread, the rest may be called from any.

    `on_event(level, kind, text)` must only enqueue. Orders from other threads wait for the next tick.
    `wants_land` is what the flight asks of whoever may block: the autopilot's Land mode. `live` is the hash of the
    model that the next corrected flight uses; whoever keeps the models sets it. `decisions` tells what became of
    models in flight, for whoever keeps them to put on the disk.
    """

    law: ControlLaw
    safety: Safety
    on_event: Callable[[str, str, str], None] = lambda level, kind, text: None
    trim: TrimLimits = field(default_factory=TrimLimits)
    agreement: AgreementLimits = field(default_factory=AgreementLimits)
    phase: str = IDLE
    wants_land: bool = False
    sent: int = 0
    ticked: int = 0
    home: Vector = (0.0, 0.0, 0.0)
    mission: Mission | None = None
    outcome: str = ""
    live: str = ""
    candidate: Shadow | None = None
    decisions: deque[Decision] = field(default_factory=deque)
    _orders: deque[Callable[[], None]] = field(default_factory=deque)
    _legs: deque[Leg] = field(default_factory=deque)
    _leg: Leg | None = None
    _leg_begin: float = 0.0
    _now: float = 0.0
    _previous: Odometry | None = None
    _handed_over: bool = False
    """The autopilot lands by its own mode: nothing is sent any more, whatever mode comes after."""
    agrees: Agreement = field(init=False)
    reasons: ReasonsToStop = field(init=False)
    _turned: float = 0.0
    """rad by which resets have turned the heading since takeoff, and with it the reference's."""
    _yaw: float = 0.0
    _sending: bool = False
    _unwatched: tuple[Odometry, Outcome] | None = None
    _guarded: str = ""
    _controller: Controller | None = None
    _thrust: float = 0.0
    _here: Waypoint = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        self.agrees = Agreement(self.agreement)
        self.reasons = ReasonsToStop(self.safety, self.law.vehicle.nominal_voltage)

    # Orders

    def prepare(self, mission: Mission) -> None:
        """Begin to stream idle setpoints (no thrust, no rates), which Offboard needs to hear first."""

        def order() -> None:
            if self.phase == IDLE:
                self.mission, self.phase, self.outcome = mission, TAKEOFF, ""
                self._guarded = mission.guard.live if mission.guard is not None else ""
                self._controller = make_controller(mission.controller, self.law, mission.guard, self.trim)
                self._legs.clear()
                self._leg, self.wants_land, self._handed_over = None, False, False
                self.reasons.begin()
                self._turned = 0.0

        self._orders.append(order)

    def cancel(self, reason: str) -> None:
        """Stop streaming before the vehicle has been armed."""

        def order() -> None:
            if self._leg is None and self.phase == TAKEOFF:
                self._finish(reason)

        self._orders.append(order)

    def take_off(self) -> None:
        """Armed and in Offboard: home is here, climb."""

        def order() -> None:
            if self.phase == TAKEOFF and self._leg is None and self.mission is not None:
                assert self._previous is not None
                self.agrees.begin()
                self.home = self._previous.position
                self._here = (0.0, 0.0, 0.0, self._yaw)
                self._legs.extend(self._plan(self.mission))
                self._next_leg()
                self.on_event("info", "takeoff", f"taking off for {self.mission.trajectory.name}")

        self._orders.append(order)

    def land(self, reason: str, return_home: bool) -> None:
        """End the flight: over home, or where it is now."""
        self._orders.append(lambda: self._land(reason, return_home))

    def try_model(self, shadow: Shadow) -> None:
        """Evaluate a model beside this flight; in a corrected one it takes over where it proves itself."""

        def order() -> None:
            guard = self.mission.guard if self.mission is not None else None
            tripped = guard.why_tripped(shadow.name) if guard is not None else ""
            if self.phase in (IDLE, SILENT):
                self.decisions.append(Decision("undecided", shadow.name))
            elif tripped:
                self._refuse(shadow, f"it tripped in this flight: {tripped}")
            else:
                self.candidate = shadow

        self._orders.append(order)

    def withdraw_candidate(self) -> None:
        """Evaluate the model in the shadow no longer."""

        def order() -> None:
            if self.candidate is not None:
                self._refuse(self.candidate, "withdrawn by the ground")

        self._orders.append(order)

    def roll_back(self, earlier: Watch | None) -> None:
        """Fade over to the last good model; where this flight has none, to `earlier` or the plain cascade."""

        def order() -> None:
            guard = self.mission.guard if self.mission is not None else None
            if guard is not None and self.phase != IDLE:
                guard.roll_back(earlier)
                self._guarded = guard.live

        self._orders.append(order)

    def give_up(self, reason: str) -> None:
        """Fall silent, so that the autopilot's own failsafe ends the flight."""
        self._orders.append(lambda: self._silence("gave_up", reason))

    def lose(self, reason: str) -> None:
        """Fall silent at once in a flight to which no odometry comes any more; the autopilot flies the vehicle."""
        if self.phase not in (IDLE, SILENT):
            self._silence("taken_over", reason)

    def abandon(self, reason: str) -> None:
        """Forget a flight whose vehicle is gone: no odometry will come to end it."""
        self.on_event("error", "abandoned", reason)
        self._finish(reason)

    @property
    def home_set(self) -> bool:
        """Whether `take_off` has taken effect."""
        return self._leg is not None or self.phase == IDLE

    @property
    def sending(self) -> bool:
        """Whether the last tick answered with a setpoint."""
        return self._sending

    # The control thread

    def tick(self, odometry: Odometry, latest: Latest) -> Outcome:
        """Decide what to send for this odometry message."""
        out = self._decide(odometry, latest)
        self._sending = out.step is not None
        self.ticked += 1
        self._unwatched = (odometry, out)
        self.sent += self._sending
        return out

    def may_leave(self, out: Outcome, age: float) -> bool:
        """Whether the setpoint of the last `tick` may be sent when its odometry is `age` s old by now.

        A process that was stopped, or had no processor, in the middle of a tick wakes up with a setpoint for a vehicle
        that has long been elsewhere, or that somebody else flies.
        """
        out.age = age
        if out.step is None:
            return False
        stale = self.reasons.stale(age)
        if stale is not None:
            self._stop(stale)
            out.step, out.phase, self._sending = None, self.phase, False
            self.sent -= 1
        return out.step is not None

    def watch(self, latest: Latest) -> None:
        """Look for reasons to end the flight in the odometry of the last `tick`, and at the models.

        Called after its setpoint has left, so that it costs no latency; what it finds acts on the next tick.
        """
        if self._unwatched is None:
            return
        odometry, out = self._unwatched
        self.agrees.step(odometry, latest.imu_sample)
        if self._leg is not None and self.phase not in (IDLE, SILENT):
            for reason in self.reasons.look(
                odometry, out, latest, self._here[:3], self.agrees.reason, self.wants_land
            ):
                self._stop(reason)
            self._watch_guard()
            if out.step is not None:
                self._watch_candidate(odometry, out, latest)

    def _decide(self, odometry: Odometry, latest: Latest) -> Outcome:
        previous, self._previous = self._previous, odometry
        interval = 0.0
        if previous is not None:
            interval = 1e-6 * (odometry.vehicle_time_us - previous.vehicle_time_us)
        self._now = 1e-6 * odometry.vehicle_time_us
        self.reasons.hear(odometry, interval)
        w, x, y, z = odometry.quaternion
        self._yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        if self._leg is not None and previous is not None:
            self._carry(odometry, previous, interval)
        hx, hy, hz = self.home
        px, py, pz = odometry.position
        position = (px - hx, py - hy, pz - hz)
        while self._orders:
            self._orders.popleft()()
            hx, hy, hz = self.home
            position = (px - hx, py - hy, pz - hz)
        out = Outcome(self.phase, interval, position, model=self.live)
        if self.phase == IDLE:
            return out
        self._watch_mode(latest)
        out.phase = self.phase
        mission = self.mission
        if mission is None or self.phase in (IDLE, SILENT):
            return out
        out.controller, out.trajectory = mission.controller, mission.trajectory.name
        if mission.guard is not None:
            out.model = mission.guard.live
        if self._leg is None:
            out.step = IDLE_STEP if self.reasons.stale(odometry.age) is None else None
            return out
        if latest.flight_mode != "OFFBOARD" or self._handed_over:
            return out  # landing by the autopilot's own mode
        stale = self.reasons.stale(odometry.age)
        if stale is not None:
            self._stop(stale)
            out.phase = self.phase
            return out
        if self.reasons.mode_unknown(odometry, latest):
            return out
        out.reference = self._reference(position, odometry)
        out.phase = self.phase
        guard = mission.guard
        state = State(
            position,
            odometry.velocity,
            odometry.quaternion,
            position[2],
            latest.battery_voltage,
            odometry.angular_velocity,
            _finite(latest.specific_force) if guard is not None else None,
        )
        assert self._controller is not None
        out.step = self._controller.step(state, self._preview, interval)
        if guard is not None:
            out.guard, out.inference = guard.status, guard.inference_time
        return out

    def _plan(self, mission: Mission) -> list[Leg]:
        trajectory, safety = mission.trajectory, self.safety
        start, end = trajectory.start, trajectory.end
        above = (0.0, 0.0, max(start[2], 0.6), self._yaw)
        legs = [
            Leg(TAKEOFF, transfer(self._here, above, safety.climb_speed, 1.5), name="climb"),
            *self._proving(above, mission.proving),
            Leg(TAKEOFF, transfer(above, start, safety.transfer_speed, 2.0), 4.0, "to the start", True),
        ]
        for i in range(mission.repeat):
            if i and math.dist(end[:3], start[:3]) + abs(end[3] - start[3]) > 1e-6:
                legs.append(
                    Leg(TAKEOFF, transfer(end, start, safety.transfer_speed, 2.0), 2.0, "to the start", True)
                )
            legs.append(Leg(MISSION, trajectory, name=trajectory.name, corrects=True))
        return legs + self._way_home(end)

    def _proving(self, above: Waypoint, seconds: float) -> list[Leg]:
        """Moves along every axis above home, for `seconds` s: what a model has to show before it may act."""
        if seconds <= 0.0:
            return []
        x, y, z, yaw = above
        aside = min(_PROVING_MOVE, 0.4 * self.safety.fence_radius)
        up = max(0.0, min(0.5 * _PROVING_MOVE, self.safety.fence_height - z - 0.5))
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

    def _way_home(self, begin: Waypoint) -> list[Leg]:
        above = (0.0, 0.0, max(begin[2], 0.6), begin[3])
        low = (0.0, 0.0, _LAND_FROM, begin[3])
        return [
            Leg(LANDING, transfer(begin, above, self.safety.transfer_speed, 2.0), name="home"),
            Leg(LANDING, transfer(above, low, self.safety.climb_speed, 1.5), 1.0, "descent"),
        ]

    def _reference(self, position: Vector, odometry: Odometry) -> ReferenceSample:
        leg = self._leg
        assert leg is not None
        t = self._now - self._leg_begin
        late = t - leg.trajectory.duration
        if late >= 0.0 and not self.wants_land:
            end = leg.trajectory.end
            there = math.dist(position, end[:3]) < _SETTLED_DISTANCE
            still = math.hypot(*odometry.velocity) < _SETTLED_SPEED
            guard = self.mission.guard if self.mission is not None else None
            acts = leg.corrects and guard is not None and guard.live != "" and not guard.tripped
            fading = acts and guard is not None and guard.engaged < 1.0
            if late >= leg.settle or (there and still and not fading):
                self._next_leg()
                assert self._leg is not None
                leg, t = self._leg, self._now - self._leg_begin
        reference = self._shown(leg.trajectory.at(t))
        self._here = (*reference.position, reference.yaw)
        return reference

    def _shown(self, reference: ReferenceSample) -> ReferenceSample:
        """The reference in the heading that the estimator has now."""
        return reference._replace(yaw=reference.yaw + self._turned) if self._turned else reference

    def _carry(self, odometry: Odometry, previous: Odometry, interval: float) -> None:
        """Where the estimate has jumped, the vehicle has not: home and the reference's heading go with it."""
        reset = found_reset(odometry, previous, interval, self.safety.jump, self.safety.reset_turn)
        if reset is None:
            return
        (hx, hy, hz), (dx, dy, dz) = self.home, reset.moved
        self.home = hx + dx, hy + dy, hz + dz
        self._turned += reset.turned
        self.reasons.reset = reset

    def _preview(self, ahead: float) -> ReferenceSample:
        """The reference of this leg `ahead` s from now; it holds still after the leg's end."""
        assert self._leg is not None
        return self._shown(self._leg.trajectory.at(self._now - self._leg_begin + ahead))

    def _next_leg(self) -> None:
        if not self._legs:
            self.wants_land = True  # keep the last reference until the autopilot has taken over
            return
        before = self.phase
        self._leg, self._leg_begin = self._legs.popleft(), self._now
        self.phase = self._leg.phase
        self._correct(self._leg.corrects)
        if self.phase == MISSION and before != MISSION:
            name = self._leg.name
            self.on_event("info", "mission_started", f"flying {name}, {self._leg.trajectory.duration:.1f} s")
        elif self.phase == LANDING and before == MISSION and not self.outcome:
            self.outcome = "finished"
            self.on_event("info", "mission_flown", "trajectory flown, landing")

    def _correct(self, on: bool) -> None:
        """Let the correction act from here on, or fade it out; the linear behaviour is expected anew from here."""
        guard = self.mission.guard if self.mission is not None else None
        for one in (guard, self._controller):
            if one is not None:
                one.start() if on else one.stop()

    def _watch_mode(self, latest: Latest) -> None:
        """The pilot wins, so do the autopilot's failsafes, and a vehicle that is not armed flies no more."""
        if self._leg is None:  # streaming, not yet armed by us: `take_off` follows only on armed and Offboard
            return
        cut = motors_cut(latest)
        if cut is not None and self.phase != SILENT:
            self._stop(cut)
        if not latest.armed:
            if self.phase != LANDING and not self.outcome:
                self.outcome = "the vehicle was disarmed in flight"
                self.on_event("error", "disarmed", self.outcome)
            self._finish(self.outcome or "finished")
        elif self.phase != SILENT:
            taken = taken_over(latest)
            if self.wants_land and latest.flight_mode == "LAND":
                self._handed_over = True
            elif taken is not None:
                self._stop(taken)

    def _stop(self, reason: Stop) -> None:
        """Do what a reason to stop asks for."""
        if reason.act == SILENCE:
            self._silence(reason.kind, reason.text)
        elif reason.act == TELL:
            self.on_event("warning", reason.kind, reason.text)
        else:
            self._land(reason.text, reason.act == RETURN, reason.kind)

    def _watch_guard(self) -> None:
        """Tell where the guard went back to the last good model by itself."""
        guard = self.mission.guard if self.mission is not None else None
        if guard is not None and guard.live != self._guarded:
            gone, self._guarded = self._guarded, guard.live
            text = f"{gone} tripped ({guard.why_tripped(gone)}): back to {guard.live}"
            self.decisions.append(Decision("rolled_back", gone, guard.why_tripped(gone)))
            self.on_event("warning", "model_rolled_back", text)

    def _watch_candidate(self, odometry: Odometry, out: Outcome, latest: Latest) -> None:
        """One tick of the model in the shadow, at the measured state, and what follows from it."""
        assert out.step is not None
        # What the accelerometer felt is what the command before this one did.
        thrust, self._thrust = self._thrust, out.step.command.thrust
        shadow = self.candidate
        if shadow is None:
            return
        vehicle = self.law.vehicle
        voltage = latest.battery_voltage if latest.battery_voltage > 0.0 else vehicle.nominal_voltage
        roll, pitch, yaw = euler(odometry.quaternion)
        state = State(out.position, odometry.velocity, odometry.quaternion, out.position[2], voltage)
        force, measured = _finite(latest.specific_force), None
        if force is not None:
            measured = error_acceleration(odometry.quaternion, force, thrust, vehicle.mass)
        values = features(state, yaw, Attitude(roll, pitch, thrust), voltage, shadow.watch.wants_yaw)
        flying = out.phase == MISSION or (self._leg is not None and self._leg.proves)
        out.shadow, out.guard = shadow.name, f"{out.guard}, shadow"
        out.shadow_raw = shadow.step(values, measured, out.interval if flying else 0.0)
        if shadow.refused:
            self._refuse(shadow, shadow.refused)
            return
        guard = self.mission.guard if self.mission is not None else None
        if not shadow.passed or not flying or (guard is not None and not guard.settled):
            return
        self.candidate = None
        own, plain = (f"({x:.2f}, {y:.2f}, {z:.2f})" for x, y, z in shadow.errors)
        text = f"{shadow.title} passed: off by {own} m/s^2, the plain linear model by {plain}"
        self.on_event("info", "model_shadowed", text)
        self.decisions.append(Decision("live", shadow.name))
        if guard is None:
            self.on_event("info", "model_live", f"{shadow.title} is live from the next corrected flight on")
            return
        guard.succeed(shadow.watch)
        gone, self._guarded = self._guarded, guard.live
        self.on_event("info", "model_live", f"{shadow.title} takes over from {gone or 'the plain cascade'}")

    def _refuse(self, shadow: Shadow, reason: str) -> None:
        self.candidate = None
        self.decisions.append(Decision("refused", shadow.name, reason))
        self.on_event("warning", "model_refused", f"{shadow.title}: {reason}")

    def _land(self, reason: str, return_home: bool, kind: str = "landing") -> None:
        if self.phase not in (TAKEOFF, MISSION, LANDING):
            return
        if self._leg is None:
            self._finish(reason)
            return
        self.outcome = self.outcome or reason
        self.on_event("warning", kind, f"{reason}: landing {'at home' if return_home else 'here'}")
        self._correct(False)
        self._legs.clear()
        if return_home:
            self._legs.extend(self._way_home(self._here))
            self._next_leg()
        else:
            stay = self._here
            self._leg, self._leg_begin = Leg(LANDING, transfer(stay, stay, 1.0, 1.0), name="stay"), self._now
            self.phase, self.wants_land = LANDING, True

    def _silence(self, kind: str, text: str) -> None:
        self.phase, self.wants_land = SILENT, False
        self.outcome = self.outcome or text
        self._legs.clear()
        self.on_event("warning", kind, text)

    def _finish(self, outcome: str) -> None:
        self.phase, self.outcome, self.wants_land = IDLE, outcome, False
        self._leg = None
        self._legs.clear()
        shadow, self.candidate = self.candidate, None
        if shadow is not None:
            self.decisions.append(Decision("undecided", shadow.name))


def _finite(force: Vector | None) -> Vector | None:
    """The specific force, where the accelerometer has told a whole one."""
    if force is None or any(component is None for component in force) or not math.isfinite(sum(force)):
        return None
    return force
