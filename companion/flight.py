"""One flight as the control thread sees it: odometry in, a setpoint or nothing out.

`tick` is called with each odometry message and answers with what to send, or with nothing. Nothing is the
safe answer: an autopilot in Offboard that hears no setpoint for COM_OF_LOSS_T takes over by itself. *The
pilot wins*: any mode but Offboard silences the flight at once, and it never goes back by itself.

Which phase a flight is in is `companion.phases`', why it ends `companion.stopping`'s, where it should be
`companion.course`'s, which model corrects `companion.succession`'s.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from trueflight.companion.agreement import Agreement, AgreementLimits
from trueflight.companion.latest import Latest
from trueflight.companion.law.control import IDLE_STEP, ControlLaw, State
from trueflight.companion.law.controllers import BLIND, TrimLimits
from trueflight.companion.law.residual import ObserverLimits
from trueflight.companion.law.watch import Watch
from trueflight.companion.mission import Mission
from trueflight.companion.odometry import Odometry
from trueflight.companion.outcome import IDLE, MISSION, SILENT, TAKEOFF, Outcome
from trueflight.companion.phases import Phases
from trueflight.companion.resets import found_reset
from trueflight.companion.shadow import Shadow
from trueflight.companion.stopping import ReasonsToStop, Safety
from trueflight.models.trajectory import ReferenceSample


class FlightStateMachine:
    """The state machine of a flight; `tick` belongs to the control thread, the rest may be called from any.

    `on_event(level, kind, text)` must only enqueue. Orders from other threads wait for the next tick. `models` tells
    which model is live or in the shadow, `agrees` whether odometry and sensors do; `sent` and `ticked` count setpoints
    and odometry messages.
    """

    def __init__(
        self,
        law: ControlLaw,
        safety: Safety,
        on_event: Callable[[str, str, str], None] = lambda level, kind, text: None,
        trim: TrimLimits | None = None,
        agreement: AgreementLimits | None = None,
        observer: ObserverLimits | None = None,
    ) -> None:
        self.sent = self.ticked = 0
        self.agrees = Agreement(agreement or AgreementLimits())
        self._phases = Phases(law, safety, on_event, trim or TrimLimits(), observer or ObserverLimits())
        self._course = self._phases.course
        self.models = self._phases.models
        self._safety, self._on_event = safety, on_event
        self._reasons = ReasonsToStop(safety, law.vehicle.nominal_voltage)
        self._orders: deque[Callable[[], None]] = deque()
        self._previous: Odometry | None = None
        self._unwatched: tuple[Odometry, Outcome] | None = None
        self._sending = False

    @property
    def phase(self) -> str:
        """One of those in `companion.outcome`."""
        return self._phases.phase

    @property
    def mission(self) -> Mission | None:
        """The one that is flown, or was last."""
        return self._phases.mission

    @property
    def outcome(self) -> str:
        """How the flight ended, `finished` or the first reason against it; empty before that."""
        return self._phases.outcome

    @property
    def wants_land(self) -> bool:
        """What the flight asks of whoever may block: the autopilot's Land mode."""
        return self._phases.wants_land

    @property
    def home_set(self) -> bool:
        """Whether `take_off` has taken effect."""
        return self._course.leg is not None or self.phase == IDLE

    @property
    def sending(self) -> bool:
        """Whether the last tick answered with a setpoint."""
        return self._sending

    # Orders

    def prepare(self, mission: Mission) -> None:
        """Begin to stream idle setpoints (no thrust, no rates), which Offboard needs to hear first."""

        def order() -> None:
            if self.phase == IDLE:
                self._phases.begin(mission)
                self._reasons.begin()

        self._orders.append(order)

    def cancel(self, reason: str) -> None:
        """Stop streaming before the vehicle has been armed."""

        def order() -> None:
            if self._course.leg is None and self.phase == TAKEOFF:
                self._phases.finish(reason)

        self._orders.append(order)

    def take_off(self) -> None:
        """Armed and in Offboard: home is here, climb."""

        def order() -> None:
            if self.phase == TAKEOFF and self._course.leg is None:
                assert self._previous is not None
                self.agrees.begin()
                self._phases.take_off(self._previous)

        self._orders.append(order)

    def land(self, reason: str, return_home: bool) -> None:
        """End the flight: over home, or where it is now."""
        self._orders.append(lambda: self._phases.land(reason, return_home))

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
        self._orders.append(lambda: self._phases.silence("gave_up", reason))

    def lose(self, reason: str) -> None:
        """Fall silent at once in a flight to which no odometry comes any more; the autopilot flies the vehicle."""
        if self.phase not in (IDLE, SILENT):
            self._phases.silence("taken_over", reason)

    def abandon(self, reason: str) -> None:
        """Forget a flight whose vehicle is gone: no odometry will come to end it."""
        self._on_event("error", "abandoned", reason)
        self._phases.finish(reason)

    # The control thread

    def tick(self, odometry: Odometry, latest: Latest) -> Outcome:
        """Decide what to send for this odometry message."""
        interval = self._hear(odometry)
        phase = self._phases.phase
        out = Outcome(phase, interval, self._course.position(odometry), model=self.models.live)
        if phase != IDLE:
            self._answer(odometry, latest, out)
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
            self._phases.stop(stale)
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
        phases, course = self._phases, self._course
        if not phases.flying:
            return
        for reason in self._reasons.look(
            odometry, out, latest, course.here[:3], self.agrees.reason, phases.wants_land
        ):
            phases.stop(reason)
        judged = out.phase == MISSION or (course.leg is not None and course.leg.proves)
        self.models.look(odometry, out, latest, judged)

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

    def _answer(self, odometry: Odometry, latest: Latest, out: Outcome) -> None:
        """What to send, into `out`; nothing where the pilot, a failsafe or a doubt speaks against it."""
        phases = self._phases
        phases.obey(latest)
        out.phase, mission = phases.phase, phases.mission
        if mission is None or out.phase in (IDLE, SILENT):
            return
        out.controller, out.trajectory = mission.controller, mission.trajectory.name
        if mission.guard is not None:
            out.model = mission.guard.live
        stale = self._reasons.stale(odometry.age)
        if self._course.leg is None:
            out.step = IDLE_STEP if stale is None else None
            return
        if latest.flight_mode != "OFFBOARD" or phases.handed_over:
            return  # landing by the autopilot's own mode
        if stale is not None:
            phases.stop(stale)
            out.phase = phases.phase
        elif not self._reasons.mode_unknown(odometry, latest):
            self._control(mission, odometry, latest, out)

    def _control(self, mission: Mission, odometry: Odometry, latest: Latest, out: Outcome) -> None:
        """The control law's answer, on the way of the mission."""
        guard, controller = mission.guard, self._phases.controller
        out.reference = self._reference(mission, odometry, out)
        out.phase = self._phases.phase
        state = State(
            out.position,
            odometry.velocity,
            odometry.quaternion,
            out.position[2],
            latest.battery_voltage,
            odometry.angular_velocity,
            latest.specific_force if mission.controller not in BLIND else None,
        )
        assert controller is not None
        out.step = controller.step(state, self._course.preview, out.interval)
        if guard is not None:
            out.guard, out.inference = guard.status, guard.inference_time
            out.learning = guard.learning.told if guard.learning is not None else None

    def _reference(self, mission: Mission, odometry: Odometry, out: Outcome) -> ReferenceSample:
        course, guard = self._course, mission.guard
        if course.late >= 0.0 and not self._phases.wants_land:
            assert course.leg is not None
            acts = course.leg.corrects and guard is not None and guard.live != "" and not guard.tripped
            fading = acts and guard is not None and guard.engaged < 1.0
            if course.flown(out.position, odometry.velocity, hold=fading):
                self._phases.next_leg()
        return course.reference()
