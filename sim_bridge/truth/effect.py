"""What a hidden effect is: the seam between one file of `truth/effects/` and the vehicle that it acts on.

An effect may change the powertrain's numbers, act on the rotors, act on the body, bias the sensors, or happen at a
time in flight. Formulas are the simulator's own: per rotor, in forces and rotor speeds.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Airframe, Powertrain
from trueflight.sim_bridge.truth.sensors import Sensors
from trueflight.sim_bridge.world import World

Event = tuple[float, Callable[[World], None]]
"""A time after take-off (s) and what then happens to the rigid body."""

USUAL_MASS, USUAL_RADIUS = 0.75, 0.0635
"""kg and m: the 5-inch quadrotor that the ranges of sizes were chosen for."""


def times_larger(vehicle: Vehicle) -> float:
    """How many times larger a vehicle is, by its rotors."""
    return vehicle.rotor_radius / USUAL_RADIUS


class TruthEffect:
    """A hidden effect: `size` is its main number, between `low` and `high` when drawn.

    `units` names every parameter of the effect with its unit, the first being the size.
    """

    name: str
    what: str
    low: float
    high: float
    units: ClassVar[dict[str, str]]
    least: float = 0.0
    most: float = math.inf
    drawn: bool = False
    """Whether `random` and `any` draw it: the first ten, so that a seed hides for ever what it hid."""
    any_draws: bool = False
    """Whether `any` draws it, though `random` does not: for one that shows in every flight."""
    may_begin: bool = False
    """Whether it can begin in flight: it acts on thrust constants, rotors, body or air alone."""

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """All parameters, drawn, or around a given size."""
        drawn = generator.uniform(self.low, self.high)
        return {next(iter(self.units)): drawn if size is None else size}

    def neutral(self, vehicle: Vehicle) -> float:
        """The size at which nothing is hidden."""
        return 0.0

    def scale(self, vehicle: Vehicle) -> float:
        """How many times larger than on the 5-inch quadrotor that `low` and `high` were chosen for."""
        return 1.0

    def possible(self, size: float) -> float:
        """The nearest size that the simulator can act by."""
        return size

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """The powertrain with this effect."""
        return train

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """Let the effect act on rotors, body or sensors; `others` are the names of all that is hidden with
        it.
        """

    def event(self, vehicle: Vehicle, numbers: dict[str, float]) -> Event | None:
        """What happens to the rigid body in flight, with its time after take-off in s; None for nothing."""
        return None
