"""One flight as the control thread sees it: its phases, and what is sent in each.

    idle -> takeoff -> mission -> landing -> idle
               |          |          |
               +----------+----------+-> silent -> idle

`tick` is called with each odometry message and answers with what to send, or with nothing. Nothing is the
safe answer: an autopilot in Offboard that hears no setpoint for COM_OF_LOSS_T takes over by itself. *The
pilot wins*: any mode but Offboard silences the flight at once, and it never goes back by itself.

Why a flight ends is `companion.stopping`'s, where it should be `companion.course`'s, which model corrects
`companion.succession`'s.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from trueflight.companion.agreement import Agreement, AgreementLimits
from trueflight.companion.course import Course
from trueflight.companion.latest import Latest
from trueflight.companion.law.control import IDLE_STEP, ControlLaw, State, euler
from trueflight.companion.law.controllers import Controller, TrimLimits, make_controller
from trueflight.companion.law.watch import Watch
from trueflight.companion.mission import Mission, legs_of, stay, way_home
from trueflight.companion.odometry import Odometry
from trueflight.companion.outcome import IDLE, LANDING, MISSION, SILENT, TAKEOFF, Outcome
from trueflight.companion.resets import found_reset
from trueflight.companion.shadow import Shadow
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
from trueflight.companion.succession import Succession
from trueflight.models.trajectory import ReferenceSample


class FlightStateMachine:
    """The state machine of a flight; `tick` belongs to the control thread, the rest may be called from any.

    `on_event(level, kind, text)` must only enqueue. Orders from other threads wait for the next tick. `wants_land` is
    what the flight asks of whoever may block: the autopilot's Land mode. `models` tells which model is live or in the
    shadow, `agrees` whether odometry and sensors do; `sent` and `ticked` count setpoints and odometry messages.
    """

    def __init__(
        self,
        law: ControlLaw,
        safety: Safety,
        on_event: Callable[[str, str, str], None] = lambda level, kind, text: None,
        trim: TrimLimits | None = None,
        agreement: AgreementLimits | None = None,
    ) -> None:
        self.phase = IDLE
        self.mission: Mission | None = None
        self.outcome = ""
        self.wants_land = False
        self.sent = self.ticked = 0
        self.agrees = Agreement(agreement or AgreementLimits())
        self.models = Succession(law.vehicle, on_event)
        self._law, self._safety, self._trim, self._on_event = law, safety, trim or TrimLimits(), on_event
        self._reasons = ReasonsToStop(safety, law.vehicle.nominal_voltage)
        self._course = Course()
        self._controller: Controller | None = None
        self._orders: deque[Callable[[], None]] = deque()
        self._previous: Odometry | None = None
        self._unwatched: tuple[Odometry, Outcome] | None = None
        self._sending = False
        self._handed_over = False
        """The autopilot lands by its own mode: nothing is sent any more, whatever mode comes after."""

    # Orders

    def prepare(self, mission: Mission) -> None:
        """Begin to stream idle setpoints (no thrust, no rates), which Offboard needs to hear first."""

        def order() -> None:
            if self.phase == IDLE:
                self.mission, self.phase, self.outcome = mission, TAKEOFF, ""
                self.models.begin(mission.guard)
                self._controller = make_controller(mission.controller, self._law, mission.guard, self._trim)
                self._course.clear()
                self._reasons.begin()
                self.wants_land, self._handed_over = False, False

        self._orders.append(order)

    def cancel(self, reason: str) -> None:
        """Stop streaming before the vehicle has been armed."""

        def order() -> None:
            if self._course.leg is None and self.phase == TAKEOFF:
                self._finish(reason)

        self._orders.append(order)

    def take_off(self) -> None:
        """Armed and in Offboard: home is here, climb."""

        def order() -> None:
            course, mission, here = self._course, self.mission, self._previous
            if self.phase == TAKEOFF and course.leg is None and mission is not None:
                assert here is not None
                self.agrees.begin()
                course.set_home(here.position, euler(here.quaternion)[2])
                course.plan(legs_of(mission, course.here, self._safety))
                self._next_leg()
                self._on_event("info", "takeoff", f"taking off for {mission.trajectory.name}")

        self._orders.append(order)

    def land(self, reason: str, return_home: bool) -> None:
        """End the flight: over home, or where it is now."""
        self._orders.append(lambda: self._land(reason, return_home))

    def try_model(self, shadow: Shadow) -> None:
        """Evaluate a model beside this flight; in a corrected one it takes over where it proves itself."""
        self._orders.append(lambda: self.models.try_model(shadow, self.phase not in (IDLE, SILENT)))

    def withdraw_candidate(self) -> None:
        """Evaluate the model in the shadow no longer."""
        self._orders.append(self.models.withdraw)

    def roll_back(self, earlier: Watch | None) -> None:
        """Fade over to the last good model; where this flight has none, to `earlier` or the plain cascade."""

        def order() -> None:
            if self.phase != IDLE:
                self.models.roll_back(earlier)

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
        self._on_event("error", "abandoned", reason)
        self._finish(reason)

    @property
    def home_set(self) -> bool:
        """Whether `take_off` has taken effect."""
        return self._course.leg is not None or self.phase == IDLE

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
        stale = self._reasons.stale(age)
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
        course = self._course
        if course.leg is None or self.phase in (IDLE, SILENT):
            return
        for reason in self._reasons.look(
            odometry, out, latest, course.here[:3], self.agrees.reason, self.wants_land
        ):
            self._stop(reason)
        judged = out.phase == MISSION or (course.leg is not None and course.leg.proves)
        self.models.look(odometry, out, latest, judged)

    def _decide(self, odometry: Odometry, latest: Latest) -> Outcome:
        interval = self._hear(odometry)
        out = Outcome(self.phase, interval, self._course.position(odometry), model=self.models.live)
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
        stale = self._reasons.stale(odometry.age)
        if self._course.leg is None:
            out.step = IDLE_STEP if stale is None else None
            return out
        if latest.flight_mode != "OFFBOARD" or self._handed_over:
            return out  # landing by the autopilot's own mode
        if stale is not None:
            self._stop(stale)
            out.phase = self.phase
        elif not self._reasons.mode_unknown(odometry, latest):
            self._control(mission, odometry, latest, out)
        return out

    def _hear(self, odometry: Odometry) -> float:
        """Take the odometry in, then the orders; s of the vehicle's clock since the odometry before."""
        previous, self._previous = self._previous, odometry
        interval = 0.0
        if previous is not None:
            interval = 1e-6 * (odometry.vehicle_time_us - previous.vehicle_time_us)
        self._course.now = 1e-6 * odometry.vehicle_time_us
        self._reasons.hear(odometry, interval)
        if self._course.leg is not None and previous is not None:
            safety = self._safety
            reset = found_reset(odometry, previous, interval, safety.jump, safety.reset_turn)
            if reset is not None:
                self._course.carry(reset)
                self._reasons.reset = reset
        while self._orders:
            self._orders.popleft()()
        return interval

    def _control(self, mission: Mission, odometry: Odometry, latest: Latest, out: Outcome) -> None:
        """The control law's answer, on the way of the mission."""
        guard = mission.guard
        out.reference = self._reference(mission, odometry, out)
        out.phase = self.phase
        state = State(
            out.position,
            odometry.velocity,
            odometry.quaternion,
            out.position[2],
            latest.battery_voltage,
            odometry.angular_velocity,
            latest.specific_force if guard is not None else None,
        )
        assert self._controller is not None
        out.step = self._controller.step(state, self._course.preview, out.interval)
        if guard is not None:
            out.guard, out.inference = guard.status, guard.inference_time

    def _reference(self, mission: Mission, odometry: Odometry, out: Outcome) -> ReferenceSample:
        course, guard = self._course, mission.guard
        if course.late >= 0.0 and not self.wants_land:
            assert course.leg is not None
            acts = course.leg.corrects and guard is not None and guard.live != "" and not guard.tripped
            fading = acts and guard is not None and guard.engaged < 1.0
            if course.flown(out.position, odometry.velocity, hold=fading):
                self._next_leg()
        return course.reference()

    def _next_leg(self) -> None:
        before, leg = self.phase, self._course.next()
        if leg is None:
            self.wants_land = True  # keep the last reference until the autopilot has taken over
            return
        self.phase = leg.phase
        self._correct(leg.corrects)
        if self.phase == MISSION and before != MISSION:
            self._on_event("info", "mission_started", f"flying {leg.name}, {leg.trajectory.duration:.1f} s")
        elif self.phase == LANDING and before == MISSION and not self.outcome:
            self.outcome = "finished"
            self._on_event("info", "mission_flown", "trajectory flown, landing")

    def _correct(self, on: bool) -> None:
        """Let the correction act from here on, or fade it out; the linear behaviour is expected anew from here."""
        guard = self.mission.guard if self.mission is not None else None
        for one in (guard, self._controller):
            if one is not None:
                one.start() if on else one.stop()

    def _watch_mode(self, latest: Latest) -> None:
        """The pilot wins, so do the autopilot's failsafes, and a vehicle that is not armed flies no more."""
        if (
            self._course.leg is None
        ):  # streaming, not yet armed by us: `take_off` follows only on armed and Offboard
            return
        cut = motors_cut(latest)
        if cut is not None and self.phase != SILENT:
            self._stop(cut)
        if not latest.armed:
            if self.phase != LANDING and not self.outcome:
                self.outcome = "the vehicle was disarmed in flight"
                self._on_event("error", "disarmed", self.outcome)
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
            self._on_event("warning", reason.kind, reason.text)
        else:
            self._land(reason.text, reason.act == RETURN, reason.kind)

    def _land(self, reason: str, return_home: bool, kind: str = "landing") -> None:
        if self.phase not in (TAKEOFF, MISSION, LANDING):
            return
        course = self._course
        if course.leg is None:
            self._finish(reason)
            return
        self.outcome = self.outcome or reason
        self._on_event("warning", kind, f"{reason}: landing {'at home' if return_home else 'here'}")
        self._correct(False)
        if return_home:
            course.plan(way_home(course.here, self._safety))
            self._next_leg()
        else:
            course.plan(())
            course.switch(stay(course.here))
            self.phase, self.wants_land = LANDING, True

    def _silence(self, kind: str, text: str) -> None:
        self.phase, self.wants_land = SILENT, False
        self.outcome = self.outcome or text
        self._course.plan(())
        self._on_event("warning", kind, text)

    def _finish(self, outcome: str) -> None:
        self.phase, self.outcome, self.wants_land = IDLE, outcome, False
        self._course.forget()
        self.models.end()
