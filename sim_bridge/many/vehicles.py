"""Many simulated vehicles: bodies, air, rotors, inner loops, sensors, stepped together; `Simulator` is one of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from trueflight.sim_bridge.many.airframes import Airframes
from trueflight.sim_bridge.many.bodies import Bodies, Load
from trueflight.sim_bridge.many.delays import Delays
from trueflight.sim_bridge.many.rate_loops import RateLoops
from trueflight.sim_bridge.many.sensing import Sensing
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.simulator import LEFT_GROUND
from trueflight.sim_bridge.truth.airframe import Airframe, believed_powertrain
from trueflight.sim_bridge.truth.battery import in_state
from trueflight.sim_bridge.truth.installation import after_takeoff, install
from trueflight.sim_bridge.truth.sensors import Noise, Sensors
from trueflight.sim_bridge.world import PHYSICS_STEP, World

Happening = Callable[[World], None]


class Vehicles:
    """The vehicles of N plans, in hover at the start of their trajectories; `motors` (4, N) are the last commands."""

    def __init__(self, plans: Sequence[Plan], steps_per_tick: int) -> None:
        self._steps_per_tick = steps_per_tick
        made = [_installed(plan) for plan in plans]
        self._frames = [frame for frame, _ in made]
        sensors = [one for _, one in made]
        vehicles = [plan.vehicle for plan in plans]
        self.bodies = Bodies(vehicles)
        self.frames = Airframes(self._frames)
        self.rates = RateLoops(vehicles)
        self.sensing = Sensing(sensors, self.bodies, self.frames, steps_per_tick)
        self._starts = []
        for i, plan in enumerate(plans):
            x, y, z, yaw = plan.trajectory.start
            start = (x, y, z + float(self.bodies.standing_height[i]))
            self.bodies.place(i, start, yaw)
            self._starts.append((start, yaw))
        hovers = [vehicle.hover_thrust for vehicle in vehicles]
        speeds = [frame.speed_of(hover) for frame, hover in zip(self._frames, hovers, strict=True)]
        self.frames.hover(np.array(speeds))
        self.motors = np.repeat(np.array(hovers)[None], 4, axis=0)
        still = np.zeros((4, len(plans)))
        still[0] = hovers
        self._delays = Delays([frame.powertrain for frame in self._frames], steps_per_tick, still)
        self.sensing.begin()
        self._events = {
            i: events
            for i, (plan, frame, one) in enumerate(zip(plans, self._frames, sensors, strict=True))
            if (events := after_takeoff(plan.hidden, plan.vehicle, frame, one))
        }
        """What happens in flight in vehicles that have not left the ground yet."""
        self._due: dict[int, list[tuple[int, Happening]]] = {}
        self._parked: list[int] = []
        self._step = 0

    def fly(self, command: np.ndarray, rates: np.ndarray) -> None:
        """One control tick under normalised collective commands (N,) and body rates (3, N) in rad/s."""
        bodies, frames, sensing, loops = self.bodies, self.frames, self.sensing, self.rates
        self._delays.push(np.concatenate((command[None], rates)))
        for i in self._parked:
            bodies.place(i, *self._starts[i])
        for step in range(self._steps_per_tick):
            acting = self._delays.acting(step)
            self.motors = loops.motors(loops.relative(acting[0]), acting[1:], bodies.velocity[3:])
            bodies.step(frames.act(bodies.position, bodies.velocity, self.motors))
            sensing.stepped()
            self._step += 1
            if self._events:
                self._take_off()
            if self._step in self._due:
                self._happen(self._due.pop(self._step))

    def park(self, index: int) -> None:
        """This flight is over: its vehicle no longer matters, and stays where it does no harm."""
        self._parked.append(index)
        self._events.pop(index, None)

    def _take_off(self) -> None:
        """Where a vehicle leaves the ground, its clock starts."""
        height = self.bodies.position[2] - self.bodies.standing_height
        for i in [i for i in self._events if height[i] >= LEFT_GROUND]:
            for moment, happens in self._events.pop(i):
                steps = max(math.ceil(moment / PHYSICS_STEP - 1e-9), 1)
                self._due.setdefault(self._step - 1 + steps, []).append((i, happens))

    def _happen(self, due: Sequence[tuple[int, Happening]]) -> None:
        for i, happens in due:
            if i not in self._parked:
                load: Any = Load(self.bodies, i)  # the part of a `World` that events use
                happens(load)
        self.frames.refresh()


def _installed(plan: Plan) -> tuple[Airframe, Sensors]:
    """The true airframe and sensors of a plan's vehicle."""
    sensors = Sensors(Noise() if plan.noise is None else plan.noise, plan.seed)
    believed = believed_powertrain(plan.vehicle)
    believed = replace(believed, battery=in_state(believed.battery, plan.battery))
    _, frame = install(plan.vehicle, plan.hidden, believed, sensors, PHYSICS_STEP)
    return frame, sensors
