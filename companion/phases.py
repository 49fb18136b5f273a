"""The phase that a flight is in, and how it gets into the next.

idle -> takeoff -> mission -> landing -> idle
           |          |          |
           +----------+----------+-> silent -> idle
"""

from __future__ import annotations

from collections.abc import Callable

from trueflight.companion.course import Course
from trueflight.companion.latest import Latest
from trueflight.companion.law.control import ControlLaw, euler
from trueflight.companion.law.controllers import Controller, TrimLimits, make_controller
from trueflight.companion.law.residual import ObserverLimits
from trueflight.companion.mission import Mission, legs_of, stay, way_home
from trueflight.companion.odometry import Odometry
from trueflight.companion.outcome import IDLE, LANDING, MISSION, SILENT, TAKEOFF
from trueflight.companion.stopping import RETURN, SILENCE, TELL, Safety, Stop, motors_cut, taken_over
from trueflight.companion.succession import Succession


class Phases:
    """The phases of one flight after another; changes belong to the control thread, any thread may read.

    `wants_land` is what the flight asks of whoever may block: the autopilot's Land mode. Once the autopilot lands by it
    (`handed_over`) nothing is sent any more, whatever mode comes after. `on_event(level, kind, text)` must not block.
    """

    def __init__(
        self,
        law: ControlLaw,
        safety: Safety,
        on_event: Callable[[str, str, str], None],
        trim: TrimLimits,
        observer: ObserverLimits,
    ) -> None:
        self.phase = IDLE
        self.mission: Mission | None = None
        self.controller: Controller | None = None
        self.outcome = ""
        self.wants_land = False
        self.handed_over = False
        self.course = Course()
        self.models = Succession(law.vehicle, on_event)
        self._law, self._safety, self._on_event = law, safety, on_event
        self._trim, self._observer = trim, observer

    @property
    def flying(self) -> bool:
        """Whether a leg is flown, and not by somebody else."""
        return self.course.leg is not None and self.phase not in (IDLE, SILENT)

    def begin(self, mission: Mission) -> None:
        """Stream idle setpoints for this mission, until `take_off`."""
        self.mission, self.phase, self.outcome = mission, TAKEOFF, ""
        self.models.begin(mission.guard)
        self.controller = make_controller(
            mission.controller, self._law, mission.guard, self._trim, self._observer
        )
        self.course.clear()
        self.wants_land, self.handed_over = False, False

    def take_off(self, here: Odometry) -> None:
        """Home is here, climb."""
        course, mission = self.course, self.mission
        assert mission is not None
        course.set_home(here.position, euler(here.quaternion)[2])
        course.plan(legs_of(mission, course.here, self._safety))
        self.next_leg()
        self._on_event("info", "takeoff", f"taking off for {mission.trajectory.name}")

    def next_leg(self) -> None:
        """Go on, or ask the autopilot to land where nothing is left to be flown."""
        before, leg = self.phase, self.course.next()
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

    def obey(self, latest: Latest) -> None:
        """The pilot wins, so do the autopilot's failsafes, and a vehicle that is not armed flies no more."""
        if (
            self.course.leg is None
        ):  # streaming, not yet armed by us: `take_off` follows only on armed and Offboard
            return
        cut = motors_cut(latest)
        if cut is not None and self.phase != SILENT:
            self.stop(cut)
        if not latest.armed:
            if self.phase != LANDING and not self.outcome:
                self.outcome = "the vehicle was disarmed in flight"
                self._on_event("error", "disarmed", self.outcome)
            self.finish(self.outcome or "finished")
        elif self.phase != SILENT:
            taken = taken_over(latest)
            if self.wants_land and latest.flight_mode == "LAND":
                self.handed_over = True
            elif taken is not None:
                self.stop(taken)

    def stop(self, reason: Stop) -> None:
        """Do what a reason to stop asks for."""
        if reason.act == SILENCE:
            self.silence(reason.kind, reason.text)
        elif reason.act == TELL:
            self._on_event("warning", reason.kind, reason.text)
        else:
            self.land(reason.text, reason.act == RETURN, reason.kind)

    def land(self, reason: str, return_home: bool, kind: str = "landing") -> None:
        """Fly home and land there, or land here; a flight that has not taken off is over."""
        if self.phase not in (TAKEOFF, MISSION, LANDING):
            return
        course = self.course
        if course.leg is None:
            self.finish(reason)
            return
        self.outcome = self.outcome or reason
        self._on_event("warning", kind, f"{reason}: landing {'at home' if return_home else 'here'}")
        self._correct(False)
        if return_home:
            course.plan(way_home(course.here, self._safety))
            self.next_leg()
        else:
            course.plan(())
            course.switch(stay(course.here))
            self.phase, self.wants_land = LANDING, True

    def silence(self, kind: str, text: str) -> None:
        """Send nothing any more in this flight, whatever comes."""
        self.phase, self.wants_land = SILENT, False
        self.outcome = self.outcome or text
        self.course.plan(())
        self._on_event("warning", kind, text)

    def finish(self, outcome: str) -> None:
        """The flight is over."""
        self.phase, self.outcome, self.wants_land = IDLE, outcome, False
        self.course.forget()
        self.models.end()

    def _correct(self, on: bool) -> None:
        """Let the correction act from here on, or fade it out; the linear behaviour is expected anew from here."""
        guard = self.mission.guard if self.mission is not None else None
        for one in (guard, self.controller):
            if one is not None:
                one.start() if on else one.stop()
