"""Body rates through a further lag."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Powertrain
from trueflight.sim_bridge.truth.effect import TruthEffect


class RateLoopLag(TruthEffect):
    """The autopilot filters the commanded body rates."""

    name = "rate_loop_lag"
    what = "body rates follow their command through a further lag"
    low, high, most, any_draws = 0.06, 0.09, 1.0, True
    units: ClassVar = {"time_constant": "s"}

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """The filter's time constant."""
        return replace(train, rate_filter=numbers["time_constant"])


EFFECT = RateLoopLag()
