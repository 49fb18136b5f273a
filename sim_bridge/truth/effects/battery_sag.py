"""Thrust that follows the battery's voltage."""

from __future__ import annotations

from typing import Any, ClassVar

from trueflight.sim_bridge.truth.airframe import Act, Airframe, Motion
from trueflight.sim_bridge.truth.effect import TruthEffect
from trueflight.sim_bridge.truth.sensors import Sensors


class BatterySag(TruthEffect):
    """Rotor speed is not regulated: thrust follows a power of the voltage."""

    name = "battery_sag"
    what = "thrust follows a power of the battery's voltage over the nominal one"
    low, high, least, most = 0.9, 2.0, -4.0, 4.0
    drawn = True
    units: ClassVar = {"exponent": "1"}

    def attach(
        self, airframe: Airframe, sensors: Sensors, numbers: dict[str, float], others: frozenset[str]
    ) -> None:
        """All thrusts times (V / V_nominal) to the exponent."""
        nominal, exponent = airframe.vehicle.nominal_voltage, numbers["exponent"]
        airframe.act_on_rotors(by_voltage, nominal, exponent)


def by_voltage(nominal: Any, exponent: Any) -> Act:
    """Thrusts times (V / nominal) to the exponent."""

    def act(m: Motion) -> None:
        factor = (m.voltage / nominal) ** exponent
        thrusts = m.thrusts
        for i in (0, 1, 2, 3):
            thrusts[i] *= factor

    return act


EFFECT = BatterySag()
