"""Thrust of every rotor off by one factor."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Powertrain
from trueflight.sim_bridge.truth.effect import TruthEffect


class ThrustGain(TruthEffect):
    """Other propellers than believed: every rotor's thrust constant is off by one factor."""

    name = "thrust_gain"
    what = "thrust of every rotor is off by a factor"
    low, high, least, most = 0.93, 1.18, 0.5, 2.0
    drawn = True
    may_begin = True
    units: ClassVar = {"gain": "1"}

    def draw(self, vehicle: Vehicle, size: float | None, generator: random.Random) -> dict[str, float]:
        """Up by 7 to 18 %, or down by 4 to 7 %: a cascade without integral sinks too far with less thrust."""
        up, down = generator.uniform(0.07, 0.18), -generator.uniform(0.04, 0.07)
        off = generator.choice((up, down))
        return {"gain": 1.0 + off if size is None else size}

    def neutral(self, vehicle: Vehicle) -> float:
        """A factor of one."""
        return 1.0

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """Thrust constants times the gain."""
        a, b, c, d = train.thrust_constants
        gain = numbers["gain"]
        return replace(train, thrust_constants=(gain * a, gain * b, gain * c, gain * d))


EFFECT = ThrustGain()
