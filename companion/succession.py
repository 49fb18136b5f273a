"""Which model corrects in a flight, and which may take over: the one in the shadow, and the way back.

A model from the ground is evaluated beside the flight (`companion.shadow`) and takes over where it proves itself; one
that trips gives way to the last good one (`companion.law.guard`). What became of each is put on the disk by whoever
keeps them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from trueflight.companion.latest import Latest
from trueflight.companion.law.control import Attitude, State, euler, features
from trueflight.companion.law.guard import Guard
from trueflight.companion.law.watch import Watch
from trueflight.companion.odometry import Odometry, Vector
from trueflight.companion.outcome import Outcome
from trueflight.companion.shadow import Shadow, error_acceleration
from trueflight.models.vehicle import Vehicle


@dataclass(frozen=True)
class Decision:
    """What became of a model in flight: `kind` is `live`, `refused`, `rolled_back` (the live one, tripped) or
    `undecided` (the flight ended before).
    """

    kind: str
    model: str
    reason: str = ""


class Succession:
    """The models of one flight after another; everything but reading belongs to the control thread.

    `live` is the hash of the model that the next corrected flight uses; whoever keeps the models sets it. `candidate`
    is in the shadow. `decisions` tells what became of models in flight, for whoever keeps them. `on_event(level, kind,
    text)` must only enqueue.
    """

    def __init__(self, vehicle: Vehicle, on_event: Callable[[str, str, str], None]) -> None:
        self.live = ""
        self.candidate: Shadow | None = None
        self.decisions: deque[Decision] = deque()
        self._vehicle, self._on_event = vehicle, on_event
        self._guard: Guard | None = None
        self._corrects = ""
        """The guard's live model, as it was told last."""
        self._thrust = 0.0

    def begin(self, guard: Guard | None) -> None:
        """A flight begins, with the models of this guard; None for one without correction."""
        self._guard = guard
        self._corrects = guard.live if guard is not None else ""

    def end(self) -> None:
        """The flight is over; what is in the shadow still has not proved itself."""
        shadow, self.candidate = self.candidate, None
        if shadow is not None:
            self.decisions.append(Decision("undecided", shadow.name))

    def try_model(self, shadow: Shadow, flying: bool) -> None:
        """Evaluate a model beside this flight; in a corrected one it takes over where it proves itself."""
        tripped = self._guard.why_tripped(shadow.name) if self._guard is not None else ""
        if not flying:
            self.decisions.append(Decision("undecided", shadow.name))
        elif tripped:
            self._refuse(shadow, f"it tripped in this flight: {tripped}")
        else:
            self.candidate = shadow

    def withdraw(self) -> None:
        """Evaluate the model in the shadow no longer."""
        if self.candidate is not None:
            self._refuse(self.candidate, "withdrawn by the ground")

    def roll_back(self, earlier: Watch | None) -> None:
        """Fade over to the last good model; where this flight has none, to `earlier` or the plain cascade."""
        if self._guard is not None:
            self._guard.roll_back(earlier)
            self._corrects = self._guard.live

    def look(self, odometry: Odometry, out: Outcome, latest: Latest, flying: bool) -> None:
        """After a tick whose setpoint has left: has a model tripped, has the one in the shadow proved itself?

        `flying` where the vehicle flies what a model may be judged by. Fills in the shadow of `out`.
        """
        self._tell_trip()
        if out.step is None:
            return
        # What the accelerometer felt is what the command before this one did.
        thrust, self._thrust = self._thrust, out.step.command.thrust
        shadow = self.candidate
        if shadow is None:
            return
        out.shadow, out.guard = shadow.name, f"{out.guard}, shadow"
        out.shadow_raw = self._evaluate(shadow, odometry, out, latest, thrust, flying)
        if shadow.refused:
            self._refuse(shadow, shadow.refused)
        elif shadow.passed and flying and (self._guard is None or self._guard.settled):
            self._take_over(shadow)

    def _tell_trip(self) -> None:
        """Tell where the guard went back to the last good model by itself."""
        guard = self._guard
        if guard is not None and guard.live != self._corrects:
            gone, self._corrects = self._corrects, guard.live
            text = f"{gone} tripped ({guard.why_tripped(gone)}): back to {guard.live}"
            self.decisions.append(Decision("rolled_back", gone, guard.why_tripped(gone)))
            self._on_event("warning", "model_rolled_back", text)

    def _evaluate(
        self, shadow: Shadow, odometry: Odometry, out: Outcome, latest: Latest, thrust: float, flying: bool
    ) -> Vector:
        """One tick of the model in the shadow, at the measured state, after `thrust` (N)."""
        vehicle = self._vehicle
        voltage = latest.battery_voltage if latest.battery_voltage > 0.0 else vehicle.nominal_voltage
        roll, pitch, yaw = euler(odometry.quaternion)
        state = State(out.position, odometry.velocity, odometry.quaternion, out.position[2], voltage)
        force, measured = latest.specific_force, None
        if force is not None:
            measured = error_acceleration(odometry.quaternion, force, thrust, vehicle.mass)
        values = features(state, yaw, Attitude(roll, pitch, thrust), voltage, shadow.watch.wants_yaw)
        return shadow.step(values, measured, out.interval if flying else 0.0)

    def _take_over(self, shadow: Shadow) -> None:
        """It has proved itself: live, at once where this flight corrects."""
        self.candidate = None
        own, plain = (f"({x:.2f}, {y:.2f}, {z:.2f})" for x, y, z in shadow.errors)
        text = f"{shadow.title} passed: off by {own} m/s^2, the plain linear model by {plain}"
        self._on_event("info", "model_shadowed", text)
        self.decisions.append(Decision("live", shadow.name))
        guard = self._guard
        if guard is None:
            self._on_event("info", "model_live", f"{shadow.title} is live from the next corrected flight on")
            return
        guard.succeed(shadow.watch)
        gone, self._corrects = self._corrects, guard.live
        text = f"{shadow.title} takes over from {gone or 'the plain cascade'}"
        self._on_event("info", "model_live", text)

    def _refuse(self, shadow: Shadow, reason: str) -> None:
        self.candidate = None
        self.decisions.append(Decision("refused", shadow.name, reason))
        self._on_event("warning", "model_refused", f"{shadow.title}: {reason}")
