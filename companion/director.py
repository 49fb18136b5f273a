"""What happens around flights: missions that are asked for, one after another, orders to end them, and the status.

The ground asks on the service thread; the main thread flies (`companion.sortie`) and may block. Models go their own way
(`companion.deployment`). Answers to the ground are dictionaries with `accepted` and `reason`.
"""

from __future__ import annotations

import gc
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from trueflight.companion.deployment import Deployment
from trueflight.companion.flight import FlightStateMachine
from trueflight.companion.mission import Mission
from trueflight.companion.mission_request import mission_request
from trueflight.companion.outcome import IDLE
from trueflight.companion.readiness import Readiness
from trueflight.companion.records import Records
from trueflight.companion.sortie import Progress, Sortie
from trueflight.companion.stopping import Safety
from trueflight.companion.vehicle_link import VehicleLink
from trueflight.models.contract import WITH_MODEL
from trueflight.models.errors import InputError, shown

QUEUE_LIMIT = 16


class Director:
    """Takes missions and flies them one at a time, until `stopping` is set; then lands what is in the air.

    `emit(level, kind, text)` tells an event to the ground and the record and must not block.
    """

    def __init__(
        self,
        link: VehicleLink,
        flight: FlightStateMachine,
        records: Records,
        readiness: Readiness,
        deployment: Deployment,
        safety: Safety,
        vehicle: str,
        emit: Callable[[str, str, str], None],
    ) -> None:
        self.stopping = threading.Event()
        self._link, self._flight, self._records = link, flight, records
        self._readiness, self._deployment = readiness, deployment
        self._safety, self._vehicle = safety, vehicle
        self._sortie = Sortie(link, flight, records, readiness, deployment, self.stopping, emit)
        self._lock = threading.Lock()
        self._queue: deque[Progress] = deque()
        self._known: dict[str, Progress] = {}
        self._number = 0

    # Asked by the ground, on the service thread

    def request(self, request: dict[str, Any]) -> dict[str, Any]:
        """A mission or a command; never raises for what the ground sends."""
        try:
            if "command" in request:
                return self._command(request["command"])
            return self._mission(request)
        except InputError as error:
            return {"accepted": False, "reason": str(error)}

    def status(self) -> dict[str, Any]:
        """What the companion is doing, for JSON."""
        latest, flight = self._link.latest, self._flight
        rates, pose = self._readiness.rates, self._readiness.pose
        candidate, not_ready = flight.models.candidate, self._readiness.why_not()
        with self._lock:
            missions = [progress.describe() for progress in self._known.values()]
        mission = flight.mission if flight.phase != IDLE else None
        return {
            "accepted": True,
            "reason": "",
            "vehicle": self._vehicle,
            "phase": flight.phase,
            "flight_mode": latest.flight_mode,
            "armed": latest.armed,
            "landed": latest.landed,
            "battery_voltage": round(latest.battery_voltage, 3),
            "batteries": latest.batteries.describe(),
            "position": {} if latest.estimator is None else latest.estimator.describe(),
            "ready": not not_ready,
            "not_ready": not_ready,
            "mission": mission.identity if mission else "",
            "guard": mission.guard.status if mission and mission.guard else "off",
            "shadow": {} if candidate is None else candidate.describe(),
            "missions": missions,
            "rates": {} if rates is None else rates.describe(),
            "odometry": self._link.arrivals.status(),
            "pose": {} if pose is None else pose.status(),
            "recording": self._records.path,
            "malformed_messages": self._link.malformed,
            "others": self._link.others.describe(),
            **self._deployment.store.describe(),
        }

    def _command(self, command: object) -> dict[str, Any]:
        if command not in ("abort", "land"):
            return {"accepted": False, "reason": f"unknown command {shown(command)}; use abort or land"}
        waiting = self._drop_queue(f"{command} from the ground")
        if self._flight.phase == IDLE:
            done = f"{waiting} queued missions dropped; nothing is flying"
            return {"accepted": True, "reason": done}
        self._flight.land(f"{command} from the ground", return_home=command == "land")
        return {"accepted": True, "reason": "landing at home" if command == "land" else "landing where it is"}

    def _mission(self, request: dict[str, Any]) -> dict[str, Any]:
        asked = mission_request(request)
        path, controller, repeat = asked.path, asked.controller, asked.repeat
        reason = self._safety.check_trajectory(path)
        if reason:
            raise InputError(f"trajectory '{path.name}': {reason}")
        if self.stopping.is_set():
            raise InputError("the companion is shutting down")
        not_ready = self._readiness.why_not() if self._flight.phase == IDLE else ""
        if not_ready:
            raise InputError(not_ready)
        with self._lock:
            if len(self._queue) >= QUEUE_LIMIT:
                raise InputError(f"{QUEUE_LIMIT} missions are waiting already")
            self._number += 1
            guard = self._deployment.guard(controller) if controller in WITH_MODEL else None
            mission = Mission(f"m{self._number}", path, controller, repeat, guard)
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

    # The main thread

    def run(self) -> None:
        """Fly what is asked until `stopping` is set; then land what is in the air and return."""
        while not self.stopping.wait(0.02):
            self._deployment.settle()
            self._link.notice_systems()
            with self._lock:
                progress = self._queue.popleft() if self._queue else None
            if progress is not None:
                self._sortie.fly(progress)
                if progress.state == "aborted":
                    self._drop_queue("the flight before it ended early; ask again")
                gc.collect()  # automatic collection is off: the control thread must not pay for it

    def _drop_queue(self, reason: str) -> int:
        """Forget the missions that wait; the number of them. Whoever ended a flight early does not want the next."""
        with self._lock:
            waiting = len(self._queue)
            for progress in self._queue:
                progress.state, progress.reason = "aborted", reason
            self._queue.clear()
        return waiting
