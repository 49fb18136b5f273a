"""Many flights in-process at once: each as `sim_bridge.in_process.fly` flies it alone, within float error."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from trueflight.companion.law.control import ControlLaw
from trueflight.models.contract import CORRECTED, CORRECTED_ADAPTIVE, LQR, LQR_INTEGRAL
from trueflight.models.errors import InputError
from trueflight.sim_bridge.in_process import FALLEN, LOST, Flown
from trueflight.sim_bridge.many.cascade import States, Steps
from trueflight.sim_bridge.many.controllers import Crew, ManyLqr, ManyLqrIntegral
from trueflight.sim_bridge.many.courses import Courses, References
from trueflight.sim_bridge.many.one_by_one import OneByOne
from trueflight.sim_bridge.many.sensing import Estimates
from trueflight.sim_bridge.many.vehicles import Vehicles
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.world import PHYSICS_STEP


@dataclass(frozen=True)
class Samples:
    """One control tick of N flights: what the vehicles knew (`position` (3, N) in the home frame), what was asked, what
    was commanded; `guard` says of each flight what its guard does, `mission` (N,) whether the trajectory has begun,
    `under_way` (N,) whether this tick is part of the flight."""

    tick: int
    estimates: Estimates
    position: np.ndarray
    references: References
    steps: Steps
    motors: np.ndarray
    guard: Sequence[str]
    inference: np.ndarray
    mission: np.ndarray
    under_way: np.ndarray


def fly_many(
    plans: Sequence[Plan],
    on_samples: Callable[[Samples], None] | None = None,
    on_end: Callable[[int, Flown], None] | None = None,
) -> list[Flown]:
    """Fly plans of one control rate together, each from hover at the start of its trajectory.

    `on_samples` is called once a control tick, until the last flight has ended; `on_end` when a flight has, with its
    index (`wall` is not known yet then). The figures of each flight are those of
    `sim_bridge.in_process.fly`; `wall` is its share of the time that all took. Raises `InputError` for a design or a
    model that belongs to another vehicle, and for rates that differ.
    """
    if len({plan.rate for plan in plans}) != 1:
        raise InputError("flights of one batch need one --rate")
    begin = time.perf_counter()
    flight = _Flight(plans, on_end)
    with np.errstate(all="ignore"):  # a flight that is lost may go on to absurd numbers beside the others
        while flight.under_way.any():
            flight.tick(on_samples)
    wall = time.perf_counter() - begin
    results = [flight.result(i) for i in range(len(plans))]
    seconds = sum(flown.simulated for flown in results)
    return [replace(f, wall=wall * f.simulated / seconds) for f in results]


class _Flight:
    """N flights under way."""

    def __init__(self, plans: Sequence[Plan], on_end: Callable[[int, Flown], None] | None = None) -> None:
        self._on_end = on_end
        count, self._steps = len(plans), plans[0].steps_per_tick
        self._plans = plans
        self._period = self._steps * PHYSICS_STEP
        self._courses = Courses(plans, self._period)
        self._crews = crews(plans, self._period)
        self._vehicles = Vehicles(plans, self._steps)
        self._ground = self._vehicles.bodies.standing_height
        self.under_way = np.ones(count, dtype=bool)
        self._outcomes = ["finished"] * count
        self._tick = 0
        self._ticks, self._touching = np.zeros(count, dtype=int), np.zeros(count, dtype=int)
        self._squares = np.zeros((3, count))
        self._guard = ["off"] * count
        self._last_guard = list(self._guard)
        self._inference = np.zeros(count)

    def tick(self, on_samples: Callable[[Samples], None] | None) -> None:
        """One control tick of all, and the physics until the next."""
        tick, vehicles = self._tick, self._vehicles
        references = self._courses.at(tick)
        begins = (self._courses.settling == tick) if tick else np.ones(len(self._plans), dtype=bool)
        for where, crew in self._crews:
            if begins[where].any():
                crew.start(begins[where])
        estimates = vehicles.sensing.sample()
        position = estimates.position.copy()
        position[2] -= self._ground
        steps = self._commanded(estimates, position, references)
        if on_samples is not None:
            on_samples(
                Samples(
                    tick, estimates, position, references, steps, vehicles.motors, self._guard, self._inference,
                    self._courses.settling <= tick, self.under_way,
                )
            )  # fmt: skip
        self._count(position, references, estimates)
        self._tick += 1
        vehicles.fly(steps.thrust_command, steps.body_rate)

    def result(self, i: int) -> Flown:
        """How a flight went."""
        x, y, z = np.sqrt(self._squares[:, i] / self._ticks[i]).tolist()
        ticks = int(self._ticks[i])
        simulated, touching = ticks * self._period, int(self._touching[i])
        return Flown(self._outcomes[i], ticks, simulated, 0.0, (x, y, z), self._last_guard[i], touching)

    def _commanded(self, estimates: Estimates, position: np.ndarray, references: References) -> Steps:
        states = States(
            position,
            estimates.velocity,
            estimates.quaternion,
            position[2],
            estimates.battery_voltage,
            estimates.angular_velocity,
            estimates.specific_force,
        )
        dt = self._period if self._tick else 0.0
        if len(self._crews) == 1:
            _, crew = self._crews[0]
            steps = crew.step(states, references, self._tick, dt)
            self._tell(np.arange(len(self._plans)), crew)
            return steps
        parts = []
        for where, crew in self._crews:
            reference = References(
                references.position[:, where],
                references.velocity[:, where],
                references.acceleration[:, where],
                references.yaw[where],
            )
            parts.append((where, crew.step(states.part(where), reference, self._tick, dt)))
            self._tell(where, crew)
        return _joined(parts, len(self._plans))

    def _tell(self, where: np.ndarray, crew: Crew) -> None:
        told = crew.guard()
        if told is not None:
            for i, text in zip(where.tolist(), told, strict=True):
                self._guard[i] = text
            self._inference[where] = crew.inference

    def _count(self, position: np.ndarray, references: References, estimates: Estimates) -> None:
        """Add this tick to the figures, and end what ends."""
        here = self.under_way
        error = position - references.position
        error *= error
        np.add(self._squares, error, out=self._squares, where=here)
        self._ticks[here] += 1
        lost = here & ~(error[0] + error[1] + error[2] <= LOST * LOST)  # true for NaN as well
        touching = here & ~lost & self._vehicles.bodies.touching
        self._touching += touching
        crashed = touching & (estimates.position[2] < FALLEN * self._ground)
        ended = here & (self._courses.ticks <= self._tick + 1)
        gone = ended | lost | crashed
        if not gone.any():
            return
        for i in np.flatnonzero(gone).tolist():
            self._outcomes[i] = "lost" if lost[i] else "crashed" if crashed[i] else "finished"
            self._last_guard[i] = self._guard[i]
            self._vehicles.park(i)
            if self._on_end is not None:
                self._on_end(i, self.result(i))
        self.under_way = here & ~gone


def crews(plans: Sequence[Plan], period: float) -> list[tuple[np.ndarray, Crew]]:
    """The flights of each kind of controller, with that controller for all of them."""
    found: list[tuple[np.ndarray, Crew]] = []
    for name in dict.fromkeys(plan.controller for plan in plans):
        where = np.array([i for i, plan in enumerate(plans) if plan.controller == name])
        mine = [plans[i] for i in where]
        laws = [ControlLaw(plan.vehicle, plan.design) for plan in mine]
        found.append((where, _crew(name, mine, laws, period)))
    return found


def _crew(name: str, plans: Sequence[Plan], laws: Sequence[ControlLaw], period: float) -> Crew:
    if name == LQR:
        return ManyLqr(laws)
    if name == LQR_INTEGRAL:
        return ManyLqrIntegral(laws)
    if name == CORRECTED_ADAPTIVE:
        raise InputError(f"many flights at once do not learn: fly {name} with `sim-bridge fly`, one by one")
    if name != CORRECTED:
        return OneByOne(laws, plans, period)
    from trueflight.sim_bridge.many.corrected import ManyCorrected

    return ManyCorrected(laws, plans, period)


def _joined(parts: Sequence[tuple[np.ndarray, Steps]], count: int) -> Steps:
    """The steps of all vehicles, of those of some each."""
    columns = {}
    for name in Steps.__dataclass_fields__:
        first = getattr(parts[0][1], name)
        whole = np.empty((*first.shape[:-1], count))
        for where, steps in parts:
            whole[..., where] = getattr(steps, name)
        columns[name] = whole
    return Steps(**columns)
