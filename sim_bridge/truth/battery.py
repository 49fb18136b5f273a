"""A lithium-polymer battery: state of charge, open-circuit voltage, internal resistance, polarisation."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace

from trueflight.models.vehicle import Vehicle

# Rest voltage of one lithium-polymer cell over its state of charge, a typical curve (Plett, "Battery
# Management Systems I", 2015, section 2.2, shows the shape).
CELL_CHARGE = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
CELL = (3.20, 3.52, 3.63, 3.71, 3.75, 3.79, 3.84, 3.90, 3.97, 4.05, 4.13, 4.20)
_CELL_NOMINAL = 4.0
"""A vehicle's nominal_voltage is taken as 4.0 V a cell: a well charged battery under the load of a hover."""


@dataclass(frozen=True)
class BatteryCell:
    """What a battery is made of. `capacity` in C, resistances in ohm, `polarisation_time` in s."""

    volts_per_cell_volt: float
    capacity: float
    resistance: float
    polarisation_resistance: float
    polarisation_time: float
    charge: float


@dataclass(frozen=True)
class BatteryState:
    """How a battery comes to a flight: state of `charge` (0 to 1), and `age` as the factor by which its
    internal resistance has grown (1: new).
    """

    charge: float = 0.97
    age: float = 1.0


FULL = BatteryState()
"""Charged, and new."""


def in_state(cell: BatteryCell, state: BatteryState) -> BatteryCell:
    """The battery at a charge and an age.

    A lithium-ion cell is commonly retired where its resistance has doubled or a fifth of its capacity is gone
    (TWAICE, Battery Encyclopedia, "End of life": 80 % state of health or 200 % of the ohmic resistance); both are
    taken to come together, in proportion.
    """
    return replace(
        cell,
        charge=state.charge,
        capacity=cell.capacity * max(1.0 - 0.2 * (state.age - 1.0), 0.2),
        resistance=cell.resistance * state.age,
        polarisation_resistance=cell.polarisation_resistance * state.age,
    )


def battery_for(vehicle: Vehicle, hover_power: float, endurance: float = 480.0) -> BatteryCell:
    """A full and new battery that suits the vehicle: `endurance` s of hover at `hover_power` W, sagging 4 %
    under that load.
    """
    current = hover_power / vehicle.nominal_voltage
    resistance = 0.04 * vehicle.nominal_voltage / current
    return BatteryCell(
        volts_per_cell_volt=vehicle.nominal_voltage / _CELL_NOMINAL,
        capacity=current * endurance,
        resistance=0.7 * resistance,
        polarisation_resistance=0.3 * resistance,
        polarisation_time=8.0,
        charge=FULL.charge,
    )


class Battery:
    """A Thevenin battery: source, series resistance, and one resistor-capacitor pair."""

    def __init__(self, cell: BatteryCell) -> None:
        self.cell = cell
        self.charge = cell.charge
        self.current = 0.0
        self.consumed = 0.0  # C
        self._polarisation = 0.0
        self._source = self.open_circuit_voltage()
        self.voltage = self._source

    def open_circuit_voltage(self) -> float:
        """Voltage at rest, V, at the present state of charge."""
        charge = min(max(self.charge, 0.0), 1.0)
        i = min(bisect_right(CELL_CHARGE, charge), len(CELL_CHARGE) - 1)
        share = (charge - CELL_CHARGE[i - 1]) / (CELL_CHARGE[i] - CELL_CHARGE[i - 1])
        return self.cell.volts_per_cell_volt * (CELL[i - 1] + share * (CELL[i] - CELL[i - 1]))

    def load(self, power: float) -> float:
        """Terminal voltage, V, when the consumers draw `power` W now."""
        source = self._source - self._polarisation
        resistance = self.cell.resistance
        # P = V (E - V) / R; the higher root, and half the source's voltage where the battery cannot give that
        # power.
        discriminant = source * source - 4.0 * resistance * power
        self.voltage = 0.5 * (source + discriminant**0.5) if discriminant > 0.0 else 0.5 * source
        self.current = (source - self.voltage) / resistance
        return self.voltage

    def discharge(self, dt: float) -> None:
        """Let the present current flow for `dt` s (far below the polarisation time)."""
        cell = self.cell
        self.consumed += self.current * dt
        self.charge = max(self.charge - self.current * dt / cell.capacity, 0.0)
        target = self.current * cell.polarisation_resistance
        self._polarisation += (target - self._polarisation) * dt / cell.polarisation_time
        self._source = self.open_circuit_voltage()
