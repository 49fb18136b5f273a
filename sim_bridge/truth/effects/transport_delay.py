"""Setpoints later than believed."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.airframe import Powertrain
from trueflight.sim_bridge.truth.effect import TruthEffect


class TransportDelay(TruthEffect):
    """Setpoints reach the motors later than believed."""

    name = "transport_delay"
    what = "setpoints reach the motors later than believed, by this much more"
    low, high, least, most = 0.018, 0.036, 0.0, 0.5
    drawn = True
    units: ClassVar = {"extra_delay": "s"}

    def powertrain(self, train: Powertrain, vehicle: Vehicle, numbers: dict[str, float]) -> Powertrain:
        """The believed delay plus the hidden one."""
        return replace(train, delay=train.delay + numbers["extra_delay"])


EFFECT = TransportDelay()
