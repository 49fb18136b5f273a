"""Which of the autopilot's batteries carries the flight, and what its voltage is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_FLIGHT = (0.5, 1.4)
"""Voltage over the vehicle's nominal one that a flight battery may have; 1.85 V a lithium cell is none that flies."""
_SMALL = 0.5
"""Share of the greatest capacity below which a battery is one of something else."""
_UNKNOWN = 0xFFFF
_OTHER_USES = {3: "avionics", 4: "payload"}  # MAV_BATTERY_FUNCTION


@dataclass(frozen=True)
class Battery:
    """One battery that is connected: its number in PX4 (`BAT1_*` is 1), V, and why it does not count, '' where it
    does."""

    number: int
    voltage: float
    left_out: str


class Batteries:
    """All that the autopilot tells of, by number; belongs to MAVSDK's thread, any thread may read.

    Only connected ones count: PX4 tells of others without a voltage. Of several the flight's are those for which
    nothing else speaks: their own word (avionics, payload), a voltage far from the vehicle's `nominal` one (V), a
    capacity (`capacities`, mAh by number) much smaller than another's. The lowest of them counts, so that a good one
    hides none. `chosen` is the number of the only one that counts, 0 for none chosen.
    """

    def __init__(self, chosen: int = 0, nominal: float | None = None) -> None:
        self.chosen, self.nominal = chosen, nominal
        self.capacities: dict[int, float] = {}
        self._told: dict[int, tuple[float, int]] = {}

    def take(self, fields: Mapping[str, Any]) -> None:
        """A BATTERY_STATUS; raises `KeyError`, `TypeError` or `ValueError` for fields that are none of it."""
        voltages = [*fields["voltages"], *fields.get("voltages_ext", ())]
        cells = [mv for mv in voltages if mv not in (0, _UNKNOWN)]
        self._told[int(fields["id"]) + 1] = 1e-3 * sum(cells), int(fields.get("battery_function", 0))

    @property
    def connected(self) -> tuple[Battery, ...]:
        """Those that have a voltage, by number."""
        told = {number: one for number, one in sorted(self._told.copy().items()) if one[0] > 0.0}
        reasons = {number: self._against(number, told) for number in told}
        if not self.chosen and all(reasons.values()):
            reasons = dict.fromkeys(reasons, "")  # none fits: then all of them may be the flight's
        return tuple(Battery(number, told[number][0], reasons[number]) for number in told)

    def _against(self, number: int, told: Mapping[int, tuple[float, int]]) -> str:
        voltage, use = told[number]
        if self.chosen:
            return "" if number == self.chosen else f"{self.chosen} was chosen"
        if use in _OTHER_USES:
            return f"of the {_OTHER_USES[use]}"
        if self.nominal is not None and not _FLIGHT[0] <= voltage / self.nominal <= _FLIGHT[1]:
            return f"not of {self.nominal:g} V"
        greatest = max((self.capacities.get(one, 0.0) for one in told), default=0.0)
        if 0.0 < self.capacities.get(number, 0.0) < _SMALL * greatest:
            return f"of {self.capacities[number]:g} mAh beside {greatest:g}"
        return ""

    @property
    def voltage(self) -> float:
        """V of the flight's battery, the lowest of several; 0 where nobody tells."""
        return min((one.voltage for one in self.connected if not one.left_out), default=0.0)

    @property
    def why_not(self) -> str:
        """'' unless the battery that was chosen is not among those that are told of."""
        told = self.connected
        if not self.chosen or not told or any(one.number == self.chosen for one in told):
            return ""
        return f"battery {self.chosen} is not connected ({self.words}); choose another one with --battery"

    @property
    def words(self) -> str:
        """Every connected one with its voltage, and which count; '' for none."""
        return ", ".join(
            f"battery {one.number}: {one.voltage:.1f} V"
            + (f" (left out: {one.left_out})" if one.left_out else "")
            for one in self.connected
        )

    def describe(self) -> list[dict[str, Any]]:
        """For the status."""
        return [
            {"battery": one.number, "voltage": round(one.voltage, 3), "left_out": one.left_out}
            for one in self.connected
        ]
