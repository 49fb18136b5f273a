"""Models on their way from the ground into flight: checked, staged, in the shadow, live, rolled back.

Runs on the service thread and the main thread and may block. The control thread only ever looks at the `Succession` of
a flight; what it decided there is put on the disk here.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from trueflight.companion.flight import FlightStateMachine
from trueflight.companion.law.guard import Guard
from trueflight.companion.law.inference import cannot_learn
from trueflight.companion.law.watch import GuardLimits
from trueflight.companion.mission import Mission
from trueflight.companion.outcome import IDLE
from trueflight.companion.shadow import Shadow, ShadowLimits
from trueflight.companion.store import ModelStore
from trueflight.companion.succession import Decision
from trueflight.models.contract import CORRECTED, CORRECTED_ADAPTIVE
from trueflight.models.errors import InputError

ORDER_TIMEOUT = 0.2
"""s for the next tick, which takes orders."""
_SHADOW_SECONDS = (0.5, 600.0)


def wait_until(condition: Callable[[], bool], timeout: float) -> bool:
    """Whether the condition holds within `timeout` s."""
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


class Deployment:
    """Brings models of a store into flights; answers to the ground are dictionaries with `accepted` and `reason`.

    `emit(level, kind, text)` must not block.
    """

    def __init__(
        self,
        store: ModelStore,
        flight: FlightStateMachine,
        guard_limits: GuardLimits,
        shadow_limits: ShadowLimits,
        emit: Callable[[str, str, str], None],
    ) -> None:
        self.store = store
        self._flight, self._emit = flight, emit
        self._guard_limits, self._shadow_limits = guard_limits, shadow_limits
        self._lock = threading.RLock()
        """Held where what is live and whether a flight is under way must not change apart."""
        self._seconds: dict[str, float] = {}
        """How long the models from the ground are to be in the shadow."""

    # Asked by the ground, on the service thread

    def deploy(self, onnx: bytes, shadow: float | None = None) -> dict[str, Any]:
        """Check a model, and let it prove itself for `shadow` s: in this flight, or before the next corrected mission.

        Blocks for the check, which has a process of its own. The answer's `state` is `shadow` in flight, `staged` on
        the ground, and `live` for a model that has proved itself in an earlier flight; what became of a model in the
        shadow is told by events and the status.
        """
        candidate = self._flight.models.candidate
        if candidate is not None:
            reason = f"{candidate.title} is in the shadow for another {candidate.remaining:.1f} s; wait, or roll back"
            return {"accepted": False, "reason": reason}
        low, high = _SHADOW_SECONDS
        if shadow is not None and not low <= shadow <= high:
            return {"accepted": False, "reason": f"shadow = {shadow:g} s is outside {low:g} to {high:g} s"}
        finding = self.store.stage(onnx)
        if finding.info is None:
            self._emit("warning", "model_refused", finding.reason)
            return {"accepted": False, "reason": finding.reason}
        name, title = finding.info.hash, f"{finding.info.hash} ({finding.reason})"
        with self._lock:
            if self._flight.phase == IDLE:
                return self._on_the_ground(name, title, finding.reason, shadow)
        if name == self.store.live_name:
            self.store.discard(name)
            return self._accepted("it is live already", state="live")
        self._emit("info", "model_staged", f"{title}: accepted by its check, evaluated but not applied")
        reason = self._try(name, shadow)
        if reason:
            self._emit("warning", "model_refused", f"{title}: {reason}")
            return {"accepted": False, "reason": reason}
        return self._accepted(f"{finding.reason}; in the shadow", state="shadow")

    def roll_back(self) -> dict[str, Any]:
        """Withdraw the model in the shadow; without one, make the previous model live, also in flight."""
        candidate = self._flight.models.candidate
        live = self.store.live_name or "none"
        if candidate is not None:
            self._flight.withdraw_candidate()
            return self._accepted(f"{candidate.title} is withdrawn from the shadow; live stays {live}")
        with self._lock:
            staged = self.store.staged_name
            if staged and self._flight.phase == IDLE:
                title = self.store.title(staged)
                self.store.discard(staged)
                live = self.store.live_name or "none"
                reason = f"{title} is withdrawn before its first flight; live stays {live}"
                self._emit("info", "model_rolled_back", f"by command: {reason}")
                return self._accepted(reason)
            return self._to_the_previous()

    # Around a flight, on the main thread

    def guard(self, controller: str = CORRECTED) -> Guard | None:
        """A guard around the live model, or around none where one is staged; None where there is neither.

        For `corrected_adaptive` the model learns; raises `InputError` where the one that will fly cannot.
        """
        model, learns = self.store.live, controller == CORRECTED_ADAPTIVE
        flies = self.store.open(self.store.staged_name) if self.store.staged_name else model
        if learns and flies is not None and not flies.info.learnables:
            raise InputError(cannot_learn(flies.info.name))
        if model is None and not self.store.staged_name:
            return None

        def tripped(name: str, reason: str) -> None:
            self._emit("warning", "guard_trip", f"correction {name} switched off: {reason}")

        watch = model.watched(self._guard_limits, learns) if model is not None else None
        return Guard(watch, tripped, self._guard_limits)

    def prepare(self, mission: Mission) -> tuple[Mission, str]:
        """Let the flight begin to stream for a mission: as it will be flown, and '' or why it cannot be.

        What is live now flies, not what was when the mission was asked for.
        """
        with self._lock:
            if mission.guard is not None:
                try:
                    guard = self.guard(mission.controller)
                except InputError as error:
                    return mission, str(error)
                if guard is None:
                    return mission, "no model is live any more; deploy one"
                staged = self.store.staged_name
                proving = self._seconds.get(staged, self._shadow_limits.seconds) if staged else 0.0
                mission = replace(mission, guard=guard, proving=proving)
            self._flight.prepare(mission)
            wait_until(lambda: self._flight.phase != IDLE, ORDER_TIMEOUT)
        return mission, ""

    def flies_with(self, mission: Mission) -> str:
        """Hash of the model that corrects this mission, or may come to; '' for none."""
        return (mission.guard.live or self.store.staged_name) if mission.guard is not None else ""

    def try_staged(self) -> None:
        """Put the model that waits for its first flight into the shadow of the one that has just begun."""
        staged = self.store.staged_name
        if staged and self._flight.models.candidate is None:
            self._try(staged)

    def settle(self) -> None:
        """Put on the disk what became of models in flight."""
        models = self._flight.models
        while models.decisions:
            self._keep(models.decisions.popleft())
        models.live = self.store.live_name

    @property
    def _learns(self) -> bool:
        """Whether models learn in the flight under way."""
        mission = self._flight.mission
        return mission is not None and mission.controller == CORRECTED_ADAPTIVE

    def _accepted(self, reason: str, **more: str) -> dict[str, Any]:
        return {"accepted": True, **more, "reason": reason, **self.store.describe()}

    def _to_the_previous(self) -> dict[str, Any]:
        """Make the previous model live, in the flight under way as well."""
        earlier, flying = self.store.previous_name, self._flight.phase != IDLE
        try:
            earlier_model = self.store.open(earlier) if earlier and flying else None
        except InputError as error:
            return {"accepted": False, "reason": str(error)}
        answer = self.store.roll_back()
        if answer["accepted"]:
            watch = earlier_model.watched(self._guard_limits, self._learns) if earlier_model else None
            self._flight.roll_back(watch)
            self._flight.models.live = self.store.live_name
            self._emit("info", "model_rolled_back", f"by command: {answer['reason']}")
        return answer

    def _try(self, name: str, seconds: float | None = None) -> str:
        """Put the staged model into the shadow of the flight; '' or why not."""
        try:
            watch = self.store.open(name).watched(self._guard_limits, self._learns)
        except InputError as error:
            self.store.discard(name)
            return str(error)
        seconds = seconds or self._seconds.get(name, 0.0)
        shadow = Shadow(watch, self._shadow_limits, self.store.title(name), seconds)
        self._flight.try_model(shadow)
        # The next tick takes it over; an answer before that would describe the state of before.
        wait_until(lambda: self._flight.models.candidate is shadow, ORDER_TIMEOUT)
        return ""

    def _on_the_ground(self, name: str, title: str, reason: str, seconds: float | None) -> dict[str, Any]:
        """The staged model waits for its first flight; one that proved itself in an earlier flight is live at once."""
        if not self.store.proved(name):
            self._seconds[name] = seconds or self._shadow_limits.seconds
            told = f"it flies its first {self._seconds[name]:g} s of the next corrected flight in the shadow"
            self._emit("info", "model_staged", f"{title}: accepted by its check; {told}")
            return self._accepted(f"{reason}; {told}", state="staged")
        failed = self.store.commit(name)
        if failed:
            self.store.discard(name)
            self._emit("warning", "model_refused", f"{title}: {failed}")
            return {"accepted": False, "reason": failed}
        self._flight.models.live = self.store.live_name
        self._emit("info", "model_live", f"{title} is live: it has proved itself in an earlier flight")
        return self._accepted(reason, state="live")

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
            text = f"{store.title(name)}: landed before it proved itself; the next flight goes on with it"
            self._emit("warning", "model_staged", text)
        if failed:
            self._emit("warning", "model_not_kept", f"{store.title(name)}: {failed}")
