"""What happens around a flight: checks, mode changes, arming, the queue of missions, the record, the status.

Everything here may block and runs on the main thread or the service thread; the control thread only ever
looks at `FlightStateMachine`. Answers to the ground are dictionaries with `accepted` and `reason`.
"""

from __future__ import annotations

import gc
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from trueflight.companion.flight import FlightStateMachine
from trueflight.companion.law.guard import Guard
from trueflight.companion.law.watch import GuardLimits
from trueflight.companion.message_rates import Rates, link_too_slow, odometry_too_low
from trueflight.companion.mission import Mission
from trueflight.companion.mission_request import mission_request
from trueflight.companion.outcome import IDLE, LANDING, MISSION, SILENT, TAKEOFF
from trueflight.companion.pose import PoseFeed
from trueflight.companion.records import Records
from trueflight.companion.shadow import Shadow, ShadowLimits
from trueflight.companion.stopping import Safety
from trueflight.companion.store import ModelStore
from trueflight.companion.succession import Decision
from trueflight.companion.vehicle_link import VehicleLink
from trueflight.models.contract import CORRECTED
from trueflight.models.design import Design
from trueflight.models.errors import InputError, shown
from trueflight.models.reference import Trajectory
from trueflight.models.vehicle import Vehicle

QUEUE_LIMIT = 16
_STREAM_BEFORE_OFFBOARD = 0.6  # s; PX4 wants to have heard setpoints for half a second
_MODE_TIMEOUT, _ARM_TIMEOUT = 4.0, 5.0
_LAND_RETRY, _LAND_TRIES = 1.0, 5
_DISARM_AFTER = 3.0  # s on the ground after which we ask for what the autopilot should have done by itself
_STALLED, _GONE = (
    0.5,
    10.0,
)  # s without a tick that are told, and without any sign of the vehicle that end a flight
_ORDER_TIMEOUT = 0.2  # s for the next tick
_LEAST_MODE_RATE = 0.4  # Hz: PX4 1.14 gives 1 whatever is asked for (HEARTBEAT alone), later ones 3
_MODE_MEASURED = 1.5  # s of measuring below which so rare a message may well be missing
_SHADOW_SECONDS = (0.5, 600.0)


@dataclass
class Progress:
    """One mission on its way: queued, flying, finished, failed or aborted."""

    mission: Mission
    state: str = "queued"
    reason: str = ""
    record: str = ""


@dataclass
class Director:
    """Brings missions into the air and back, one at a time; each flight has its own record.

    `emit(level, kind, text)` tells an event to the ground and the record and must not block.
    """

    link: VehicleLink
    flight: FlightStateMachine
    vehicle: Vehicle
    design: Design
    store: ModelStore
    safety: Safety
    guard_limits: GuardLimits
    shadow_limits: ShadowLimits
    folder: Path
    rate: float
    emit: Callable[[str, str, str], None]
    require_record: bool = True
    rates: Rates | None = None
    pose: PoseFeed | None = None
    stopping: threading.Event = field(default_factory=threading.Event)
    _queue: deque[Progress] = field(default_factory=deque)
    _known: dict[str, Progress] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _deploying: threading.RLock = field(default_factory=threading.RLock)
    """Held where what is live and whether a flight is under way must not change apart."""
    _number: int = 0
    _seconds: dict[str, float] = field(default_factory=dict)
    """How long the models from the ground are to be in the shadow."""

    def __post_init__(self) -> None:
        self.records = Records(self.folder, self.rate, self.require_record, self.emit)

    # Asked by the ground, on the service thread

    def request(self, request: dict[str, Any]) -> dict[str, Any]:
        """A mission or a command; never raises for what the ground sends."""
        try:
            if "command" in request:
                return self._command(request["command"])
            return self._mission(request)
        except InputError as error:
            return {"accepted": False, "reason": str(error)}

    def deploy(self, onnx: bytes, shadow: float | None = None) -> dict[str, Any]:
        """Check a model, and let it prove itself for `shadow` s: in this flight, or before the next corrected mission.

        Blocks for the check, which has a process of its own. The answer's `state` is `shadow` in flight, `staged` on
        the ground, and `live` for a model that has proved itself in an earlier flight; what became of a model in the
        shadow is told by events and the status.
        """
        candidate = self.flight.models.candidate
        if candidate is not None:
            reason = f"{candidate.title} is in the shadow for another {candidate.remaining:.1f} s; wait, or roll back"
            return {"accepted": False, "reason": reason}
        low, high = _SHADOW_SECONDS
        if shadow is not None and not low <= shadow <= high:
            return {"accepted": False, "reason": f"shadow = {shadow:g} s is outside {low:g} to {high:g} s"}
        finding = self.store.stage(onnx)
        if finding.info is None:
            self.emit("warning", "model_refused", finding.reason)
            return {"accepted": False, "reason": finding.reason}
        name, title = finding.info.hash, f"{finding.info.hash} ({finding.reason})"
        with self._deploying:
            if self.flight.phase == IDLE:
                return self._on_the_ground(name, title, finding.reason, shadow)
        if name == self.store.live_name:
            self.store.discard(name)
            return {
                "accepted": True,
                "state": "live",
                "reason": "it is live already",
                **self.store.describe(),
            }
        self.emit("info", "model_staged", f"{title}: accepted by its check, evaluated but not applied")
        reason = self._try(name, shadow)
        if reason:
            self.emit("warning", "model_refused", f"{title}: {reason}")
            return {"accepted": False, "reason": reason}
        reason = f"{finding.reason}; in the shadow"
        return {"accepted": True, "state": "shadow", "reason": reason, **self.store.describe()}

    def roll_back(self) -> dict[str, Any]:
        """Withdraw the model in the shadow; without one, make the previous model live, also in flight."""
        candidate = self.flight.models.candidate
        if candidate is not None:
            self.flight.withdraw_candidate()
            reason = (
                f"{candidate.title} is withdrawn from the shadow; live stays {self.store.live_name or 'none'}"
            )
            return {"accepted": True, "reason": reason, **self.store.describe()}
        with self._deploying:
            staged = self.store.staged_name
            if staged and self.flight.phase == IDLE:
                title = self.store.title(staged)
                self.store.discard(staged)
                reason = f"{title} is withdrawn before its first flight; live stays {self.store.live_name or 'none'}"
                self.emit("info", "model_rolled_back", f"by command: {reason}")
                return {"accepted": True, "reason": reason, **self.store.describe()}
            earlier = self.store.previous_name
            try:
                earlier_model = self.store.open(earlier) if earlier and self.flight.phase != IDLE else None
            except InputError as error:
                return {"accepted": False, "reason": str(error)}
            answer = self.store.roll_back()
            if answer["accepted"]:
                self.flight.roll_back(earlier_model.watched(self.guard_limits) if earlier_model else None)
                self.flight.models.live = self.store.live_name
                self.emit("info", "model_rolled_back", f"by command: {answer['reason']}")
            return answer

    def status(self) -> dict[str, Any]:
        """What the companion is doing, for JSON."""
        latest, flight = self.link.latest, self.flight
        candidate, not_ready = flight.models.candidate, self.not_ready()
        with self._lock:
            missions = [
                {
                    "mission": identity,
                    "trajectory": progress.mission.trajectory.name,
                    "controller": progress.mission.controller,
                    "state": progress.state,
                    "reason": progress.reason,
                    "record": progress.record,
                }
                for identity, progress in self._known.items()
            ]
        rates = self.rates
        mission = flight.mission if flight.phase != IDLE else None
        return {
            "accepted": True,
            "reason": "",
            "vehicle": self.vehicle.name,
            "phase": flight.phase,
            "flight_mode": latest.flight_mode,
            "armed": latest.armed,
            "landed": latest.landed,
            "battery_voltage": round(latest.battery_voltage, 3),
            "position": {} if latest.estimator is None else latest.estimator.describe(),
            "ready": not not_ready,
            "not_ready": not_ready,
            "mission": mission.identity if mission else "",
            "guard": mission.guard.status if mission and mission.guard else "off",
            "shadow": {}
            if candidate is None
            else {
                "hash": candidate.name,
                "title": candidate.title,
                "remaining": round(candidate.remaining, 2),
                "refused": candidate.refused,
            },
            "missions": missions,
            "rates": {}
            if rates is None
            else {"odometry": round(rates.odometry, 1), "imu": round(rates.imu, 1)},
            "odometry": self.link.arrivals.status(),
            "pose": {} if self.pose is None else self.pose.status(),
            "recording": self.records.path,
            "malformed_messages": self.link.malformed,
            **self.store.describe(),
        }

    def not_ready(self) -> str:
        """'' where a mission could start now, otherwise the reason."""
        if self.flight.phase != IDLE:
            return f"a flight is under way ({self.flight.phase})"
        latest = self.link.latest
        if time.monotonic() - latest.heartbeat > 3.0:
            return "the autopilot is silent"
        if latest.armed:
            return "the vehicle is armed by somebody else"
        low = self.safety.takeoff_voltage * self.vehicle.nominal_voltage
        if 0.0 < latest.battery_voltage < low:
            return f"the battery has {latest.battery_voltage:.1f} V, a flight needs {low:.1f} V"
        no_record = self.records.why_not()
        if no_record:
            return no_record
        if self.pose is not None and self.pose.why_not:
            return self.pose.why_not
        if self.lost_position:
            return self.lost_position
        if self.flight.agrees.standing:
            return self.flight.agrees.standing
        return self.link.ambiguous or self.rates_too_low(self.rates)

    @property
    def lost_position(self) -> str:
        """'' where the estimator has a position that is good enough, or says nothing of it."""
        estimator = self.link.latest.estimator
        return "" if estimator is None else estimator.refusal(self.safety.position_accuracy)

    def rates_too_low(self, rates: Rates | None) -> str:
        """'' where odometry and accelerometer arrive often enough, otherwise what is missing."""
        if rates is None:
            return "rates have not been measured yet"
        too_low = odometry_too_low(rates, self.rate)
        if too_low:
            return too_low
        if rates.longest_gap > self.safety.odometry_gap:
            return f"odometry had a gap of {rates.longest_gap:.2f} s; the link or this machine is too busy"
        if rates.imu < 0.5 * min(self.rate, 100.0):
            return link_too_slow(f"HIGHRES_IMU at {rates.imu:.0f} Hz")
        if rates.duration > _MODE_MEASURED and rates.mode < _LEAST_MODE_RATE:
            what = f"the flight mode (HEARTBEAT, CURRENT_MODE) at {rates.mode:.1f} Hz, so that a pilot is heard late,"
            return link_too_slow(what)
        return ""

    def _command(self, command: object) -> dict[str, Any]:
        if command not in ("abort", "land"):
            return {"accepted": False, "reason": f"unknown command {shown(command)}; use abort or land"}
        waiting = self._drop_queue(f"{command} from the ground")
        if self.flight.phase == IDLE:
            done = f"{waiting} queued missions dropped; nothing is flying"
            return {"accepted": True, "reason": done}
        self.flight.land(f"{command} from the ground", return_home=command == "land")
        return {"accepted": True, "reason": "landing at home" if command == "land" else "landing where it is"}

    def _mission(self, request: dict[str, Any]) -> dict[str, Any]:
        asked = mission_request(request)
        path, controller, repeat = asked.path, asked.controller, asked.repeat
        reason = self.safety.check_trajectory(path)
        if reason:
            raise InputError(f"trajectory '{path.name}': {reason}")
        if self.stopping.is_set():
            raise InputError("the companion is shutting down")
        not_ready = self.not_ready() if self.flight.phase == IDLE else ""
        if not_ready:
            raise InputError(not_ready)
        with self._lock:
            if len(self._queue) >= QUEUE_LIMIT:
                raise InputError(f"{QUEUE_LIMIT} missions are waiting already")
            self._number += 1
            mission = self._prepared(f"m{self._number}", path, controller, repeat)
            progress = Progress(mission)
            self._known[mission.identity] = progress
            self._queue.append(progress)
            ahead = len(self._queue) - 1
            while len(self._known) > 4 * QUEUE_LIMIT:
                self._known.pop(next(iter(self._known)))
        return {
            "accepted": True,
            "reason": f"{ahead} missions before it" if ahead else "next",
            "mission": mission.identity,
            "duration": round(path.duration * repeat, 2),
        }

    def _prepared(self, identity: str, path: Trajectory, controller: str, repeat: int) -> Mission:
        guard = self._guard() if controller == CORRECTED else None
        return Mission(identity, path, controller, repeat, guard)

    def _guard(self) -> Guard | None:
        """A guard around the live model, or around none where one is staged; None where there is neither."""
        model = self.store.live
        if model is None and not self.store.staged_name:
            return None

        def tripped(name: str, reason: str) -> None:
            self.emit("warning", "guard_trip", f"correction {name} switched off: {reason}")

        watch = model.watched(self.guard_limits) if model is not None else None
        return Guard(watch, tripped, self.guard_limits)

    def _try(self, name: str, seconds: float | None = None) -> str:
        """Put the staged model into the shadow of the flight; '' or why not."""
        try:
            watch = self.store.open(name).watched(self.guard_limits)
        except InputError as error:
            self.store.discard(name)
            return str(error)
        seconds = seconds or self._seconds.get(name, 0.0)
        shadow = Shadow(watch, self.shadow_limits, self.store.title(name), seconds)
        self.flight.try_model(shadow)
        # The next tick takes it over; an answer before that would describe the state of before.
        self._wait(lambda: self.flight.models.candidate is shadow, _ORDER_TIMEOUT)
        return ""

    def _on_the_ground(self, name: str, title: str, reason: str, seconds: float | None) -> dict[str, Any]:
        """The staged model waits for its first flight; one that proved itself in an earlier flight is live at once."""
        if not self.store.proved(name):
            self._seconds[name] = seconds or self.shadow_limits.seconds
            told = f"it flies its first {self._seconds[name]:g} s of the next corrected flight in the shadow"
            self.emit("info", "model_staged", f"{title}: accepted by its check; {told}")
            return {
                "accepted": True,
                "state": "staged",
                "reason": f"{reason}; {told}",
                **self.store.describe(),
            }
        failed = self.store.commit(name)
        if failed:
            self.store.discard(name)
            self.emit("warning", "model_refused", f"{title}: {failed}")
            return {"accepted": False, "reason": failed}
        self.flight.models.live = self.store.live_name
        self.emit("info", "model_live", f"{title} is live: it has proved itself in an earlier flight")
        return {"accepted": True, "state": "live", "reason": reason, **self.store.describe()}

    def _settle(self) -> None:
        """Put on the disk what became of models in flight."""
        while self.flight.models.decisions:
            self._keep(self.flight.models.decisions.popleft())
        self.flight.models.live = self.store.live_name

    def _keep(self, decision: Decision) -> None:
        name, store = decision.model, self.store
        failed = ""
        if decision.kind == "live":
            failed = store.commit(name)
        elif decision.kind == "rolled_back":
            failed = store.withdraw(name)
        elif decision.kind == "refused":
            store.discard(name)
        else:
            self.emit(
                "warning",
                "model_staged",
                f"{store.title(name)}: landed before it proved itself; the next flight goes on with it",
            )
        if failed:
            self.emit("warning", "model_not_kept", f"{store.title(name)}: {failed}")

    # The main thread

    def run(self) -> None:
        """Fly what is asked until `stopping` is set; then land what is in the air and return."""
        while not self.stopping.wait(0.02):
            self._settle()
            with self._lock:
                progress = self._queue.popleft() if self._queue else None
            if progress is not None:
                self._fly(progress)
                gc.collect()  # automatic collection is off: the control thread must not pay for it

    def _fly(self, progress: Progress) -> None:
        mission = progress.mission
        progress.state = "flying"
        reason = self._check(mission) or self._start(progress)
        if reason:
            self.flight.cancel(reason)
            self.emit("error", "mission_failed", f"{mission.trajectory.name} not flown: {reason}")
            progress.record = self.records.end()
            progress.state, progress.reason = "failed", reason
            return
        self._accompany()
        self._settle()
        outcome = self.flight.outcome
        self.emit("info", "mission_ended", f"{mission.trajectory.name}: {outcome}")
        progress.record = self.records.end()
        # Told last: whoever hears that it is over may fetch the record, which must be whole by then.
        progress.reason = outcome
        progress.state = "finished" if outcome == "finished" else "aborted"
        if progress.state == "aborted":
            self._drop_queue("the flight before it ended early; ask again")

    def _drop_queue(self, reason: str) -> int:
        """Forget the missions that wait; the number of them. Whoever ended a flight early does not want the next."""
        with self._lock:
            waiting = len(self._queue)
            for progress in self._queue:
                progress.state, progress.reason = "aborted", reason
            self._queue.clear()
        return waiting

    def _renewed(self, progress: Progress) -> str:
        """What is live now flies, not what was when the mission was asked for; '' or the reason why not."""
        if progress.mission.guard is None:
            return ""
        guard = self._guard()
        if guard is None:
            return "no model is live any more; deploy one"
        staged = self.store.staged_name
        proving = self._seconds.get(staged, self.shadow_limits.seconds) if staged else 0.0
        progress.mission = replace(progress.mission, guard=guard, proving=proving)
        return ""

    def _check(self, mission: Mission) -> str:
        self.rates = self.link.measure(0.5)
        return self.not_ready() or self.records.why_not(mission.trajectory.duration * mission.repeat)

    def _start(self, progress: Progress) -> str:
        """Stream, Offboard, arm, go; '' or the reason why not."""
        latest, flight = self.link.latest, self.flight
        sent = flight.sent
        with self._deploying:
            reason = self._renewed(progress)
            if reason:
                return reason
            flight.prepare(progress.mission)
            self._wait(lambda: flight.phase != IDLE, _ORDER_TIMEOUT)
        time.sleep(_STREAM_BEFORE_OFFBOARD)
        if flight.sent == sent:
            return "no odometry, so no setpoint could be sent"
        reason = self.link.set_mode("OFFBOARD")
        if reason:
            return self._refused(f"the autopilot refused Offboard ({reason})")
        if not self._wait(lambda: latest.flight_mode == "OFFBOARD", _MODE_TIMEOUT):
            return f"the autopilot stayed in {latest.flight_mode}"
        mission = progress.mission
        model = (mission.guard.live or self.store.staged_name) if mission.guard is not None else ""
        progress.record, reason = self.records.begin(mission, model, self.vehicle, self.design)
        if reason:
            return reason
        reason = self.link.arm()
        if reason:
            return self._refused(f"the autopilot refused to arm ({reason})")
        if not self._wait(lambda: latest.armed, _ARM_TIMEOUT):
            return "the autopilot did not arm"
        if latest.flight_mode != "OFFBOARD":
            return f"the mode changed to {latest.flight_mode} while arming"
        flight.take_off()
        if not self._wait(lambda: flight.home_set, 1.0):
            return "no odometry after arming"
        staged = self.store.staged_name
        if staged and flight.models.candidate is None:
            self._try(staged)
        return ""

    def _refused(self, what: str) -> str:
        """Why, in plain words, where the autopilot tells; asked while setpoints are still streaming."""
        report = self.link.arming_report()
        problems = report.reasons(streaming=True) if report is not None else ()
        return f"{what}: {'; '.join(problem.line for problem in problems)}" if problems else what

    def _accompany(self) -> None:
        """Do what the flight asks for that may block, until it is over."""
        flight, latest = self.flight, self.link.latest
        asked, tries, grounded = -math.inf, 0, math.inf
        ticked, ticked_at, told = flight.ticked, time.monotonic(), False
        while flight.phase != IDLE:
            time.sleep(0.02)
            self._settle()
            self.records.look()
            now = time.monotonic()
            if self.stopping.is_set() and flight.phase not in (LANDING, SILENT):
                flight.land("the companion is shutting down", return_home=False)
            if flight.wants_land and latest.flight_mode == "OFFBOARD" and now - asked > _LAND_RETRY:
                asked, tries = now, tries + 1
                reason = self.link.set_mode("LAND")
                if reason and tries >= _LAND_TRIES:
                    flight.give_up(f"the autopilot refused Land ({reason})")
            if flight.phase in (TAKEOFF, MISSION):
                blind = (self.pose.why_not if self.pose is not None else "") or self.lost_position
                if blind:
                    flight.land(blind, return_home=False)
            on_ground = latest.landed == "on ground" and flight.phase != TAKEOFF and not flight.sending
            grounded = min(grounded, now) if on_ground else math.inf
            if now - grounded > _DISARM_AFTER and latest.armed and flight.phase == LANDING:
                self.link.disarm()
                grounded = math.inf
            if flight.ticked != ticked:
                ticked, ticked_at, told = flight.ticked, now, False
            elif now - ticked_at > _STALLED:
                if not told:
                    told = True
                    text = "no new odometry, or the control thread hangs: nothing is sent"
                    self.emit("error", "no_odometry", text)
                self._without_odometry()
            if now - max(latest.heartbeat, ticked_at) > _GONE:
                flight.abandon("the autopilot fell silent in flight")

    def _without_odometry(self) -> None:
        """No tick will see that somebody else flies by now, or that the vehicle has landed."""
        flight, latest = self.flight, self.link.latest
        if not latest.armed:
            flight.abandon("the odometry stayed away until the vehicle was disarmed")
        elif latest.flight_mode != "OFFBOARD":
            flight.lose(f"the odometry stayed away and {latest.flight_mode} was chosen: silent")

    def _wait(self, condition: Callable[[], bool], timeout: float) -> bool:
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > end:
                return False
            time.sleep(0.01)
        return True
