"""One mission in the air: streaming, Offboard, arming, the record, what the flight asks for, until it is over.

Runs on the main thread and may block; the control thread only ever looks at the `FlightStateMachine`.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from trueflight.companion.deployment import Deployment, wait_until
from trueflight.companion.flight import FlightStateMachine
from trueflight.companion.mission import Mission
from trueflight.companion.outcome import IDLE, LANDING, MISSION, SILENT, TAKEOFF
from trueflight.companion.readiness import Readiness
from trueflight.companion.records import Records
from trueflight.companion.vehicle_link import VehicleLink

_STREAM_BEFORE_OFFBOARD = 0.6  # s; PX4 wants to have heard setpoints for half a second
_MODE_TIMEOUT, _ARM_TIMEOUT = 4.0, 5.0
_LAND_RETRY, _LAND_TRIES = 1.0, 5
_DISARM_AFTER = 3.0  # s on the ground after which we ask for what the autopilot should have done by itself
_STALLED = 0.5
"""s without a tick that are told."""
_GONE = 10.0
"""s without any sign of the vehicle that end a flight."""


@dataclass
class Progress:
    """One mission on its way: queued, flying, finished, failed or aborted."""

    mission: Mission
    state: str = "queued"
    reason: str = ""
    record: str = ""

    def describe(self) -> dict[str, str]:
        """For the status."""
        return {
            "mission": self.mission.identity,
            "trajectory": self.mission.trajectory.name,
            "controller": self.mission.controller,
            "state": self.state,
            "reason": self.reason,
            "record": self.record,
        }


class Sortie:
    """Brings a mission into the air and back; each flight has its own record.

    `emit(level, kind, text)` must not block. While `stopping` is set what is in the air is landed.
    """

    def __init__(
        self,
        link: VehicleLink,
        flight: FlightStateMachine,
        records: Records,
        readiness: Readiness,
        deployment: Deployment,
        stopping: threading.Event,
        emit: Callable[[str, str, str], None],
    ) -> None:
        self._link, self._flight, self._records = link, flight, records
        self._readiness, self._deployment = readiness, deployment
        self._stopping, self._emit = stopping, emit

    def fly(self, progress: Progress) -> None:
        """All of it; what came of it is in `progress`."""
        progress.state = "flying"
        name = progress.mission.trajectory.name
        reason = self._check(progress.mission) or self._start(progress)
        if reason:
            self._flight.cancel(reason)
            self._emit("error", "mission_failed", f"{name} not flown: {reason}")
            progress.record = self._records.end()
            progress.state, progress.reason = "failed", reason
            return
        self._accompany()
        self._deployment.settle()
        outcome = self._flight.outcome
        self._emit("info", "mission_ended", f"{name}: {outcome}")
        progress.record = self._records.end()
        # Told last: whoever hears that it is over may fetch the record, which must be whole by then.
        progress.reason = outcome
        progress.state = "finished" if outcome == "finished" else "aborted"

    def _check(self, mission: Mission) -> str:
        self._readiness.rates = self._link.measure(0.5)
        seconds = mission.trajectory.duration * mission.repeat
        return self._readiness.why_not() or self._records.why_not(seconds)

    def _start(self, progress: Progress) -> str:
        """Stream, Offboard, arm, go; '' or the reason why not."""
        latest, flight, link = self._link.latest, self._flight, self._link
        sent = flight.sent
        mission, reason = self._deployment.prepare(progress.mission)
        if reason:
            return reason
        progress.mission = mission
        time.sleep(_STREAM_BEFORE_OFFBOARD)
        if flight.sent == sent:
            return "no odometry, so no setpoint could be sent"
        reason = link.commands.set_mode("OFFBOARD")
        if reason:
            return self._refused(f"the autopilot refused Offboard ({reason})")
        if not wait_until(lambda: latest.flight_mode == "OFFBOARD", _MODE_TIMEOUT):
            return f"the autopilot stayed in {latest.flight_mode}"
        progress.record, reason = self._records.begin(mission, self._deployment.flies_with(mission))
        if reason:
            return reason
        reason = link.commands.arm()
        if reason:
            return self._refused(f"the autopilot refused to arm ({reason})")
        if not wait_until(lambda: latest.armed, _ARM_TIMEOUT):
            return "the autopilot did not arm"
        if latest.flight_mode != "OFFBOARD":
            return f"the mode changed to {latest.flight_mode} while arming"
        flight.take_off()
        if not wait_until(lambda: flight.home_set, 1.0):
            return "no odometry after arming"
        self._deployment.try_staged()
        return ""

    def _refused(self, what: str) -> str:
        """Why, in plain words, where the autopilot tells; asked while setpoints are still streaming."""
        report = self._link.commands.arming_report()
        problems = report.reasons(streaming=True) if report is not None else ()
        return f"{what}: {'; '.join(problem.line for problem in problems)}" if problems else what

    def _accompany(self) -> None:
        """Do what the flight asks for that may block, until it is over."""
        escort = _Escort(self._link, self._flight, self._emit)
        while self._flight.phase != IDLE:
            time.sleep(0.02)
            self._deployment.settle()
            self._records.look()
            now = time.monotonic()
            if self._stopping.is_set() and self._flight.phase not in (LANDING, SILENT):
                self._flight.land("the companion is shutting down", return_home=False)
            escort.ask_to_land(now)
            if self._flight.phase in (TAKEOFF, MISSION):
                blind = self._readiness.blind
                if blind:
                    self._flight.land(blind, return_home=False)
            escort.disarm_on_ground(now)
            escort.look_for_odometry(now)


class _Escort:
    """What one flight asks of the autopilot, and what becomes of it without odometry. Times in monotonic s."""

    def __init__(
        self, link: VehicleLink, flight: FlightStateMachine, emit: Callable[[str, str, str], None]
    ) -> None:
        self._link, self._flight, self._emit = link, flight, emit
        self._asked, self._tries = -math.inf, 0
        self._grounded = math.inf
        self._ticked, self._ticked_at, self._told = flight.ticked, time.monotonic(), False

    def ask_to_land(self, now: float) -> None:
        """The autopilot's Land mode, as often as it takes; silence, where it is refused for good."""
        flight = self._flight
        offboard = self._link.latest.flight_mode == "OFFBOARD"
        if flight.wants_land and offboard and now - self._asked > _LAND_RETRY:
            self._asked, self._tries = now, self._tries + 1
            reason = self._link.commands.set_mode("LAND")
            if reason and self._tries >= _LAND_TRIES:
                flight.give_up(f"the autopilot refused Land ({reason})")

    def disarm_on_ground(self, now: float) -> None:
        """Ask for what the autopilot should have done by itself."""
        flight, latest = self._flight, self._link.latest
        on_ground = latest.landed == "on ground" and flight.phase != TAKEOFF and not flight.sending
        self._grounded = min(self._grounded, now) if on_ground else math.inf
        if now - self._grounded > _DISARM_AFTER and latest.armed and flight.phase == LANDING:
            self._link.commands.disarm()
            self._grounded = math.inf

    def look_for_odometry(self, now: float) -> None:
        """Tell that none comes; end a flight that no tick will end, because somebody else flies or it has landed."""
        flight, latest = self._flight, self._link.latest
        if flight.ticked != self._ticked:
            self._ticked, self._ticked_at, self._told = flight.ticked, now, False
        elif now - self._ticked_at > _STALLED:
            if not self._told:
                self._told = True
                text = "no new odometry, or the control thread hangs: nothing is sent"
                self._emit("error", "no_odometry", text)
            if not latest.armed:
                flight.abandon("the odometry stayed away until the vehicle was disarmed")
            elif latest.flight_mode != "OFFBOARD":
                flight.lose(f"the odometry stayed away and {latest.flight_mode} was chosen: silent")
        if now - max(latest.heartbeat, self._ticked_at) > _GONE:
            flight.abandon("the autopilot fell silent in flight")
