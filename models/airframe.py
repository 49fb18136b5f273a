"""A vehicle in the numbers that simulators and autopilots share: what an effect of the model is to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from trueflight.models.vehicle import GRAVITY, Vehicle


def _told(default: Any, meaning: str) -> Any:
    return field(default=default, metadata={"meaning": meaning})


@dataclass(frozen=True)
class Airframe:
    """A multirotor as others describe one. Body FLU, world ENU, SI units; drag is over mass, as the effects have it.

    `curve` is the collective thrust in N at the nominal voltage as a polynomial of the normalised command u: its
    coefficients of u, u², u³ and so on. `lag` in s is the time constant of rotor speed, `delay` in s from command
    to motor; `rate_lag` and `rate_delay` in s those of the body rates behind their command. `hub_drag` (x, y) in
    1/s and `inflow` in 1/s act at hover thrust and grow with rotor speed; `frame_drag` (x, y, z) in 1/m with `|v|
    v`; `lift` in 1/m along body z with the square of the airspeed in the rotors' plane. `moving_air` (x, y) in m/s
    is where the air moves to, world. `lean` (x, y) in rad is that of the thrust towards body x and y.
    `centre_of_mass` (x, y) in m is measured from the believed one; `strength` has the share of its thrust that each
    rotor gives, and is empty where all give all; `spin_inertia` in kg m² is that of what turns with one rotor.
    """

    vehicle: Vehicle
    curve: tuple[float, ...] = _told((), "thrust of a command")
    lag: float = _told(0.0, "lag of the rotors")
    delay: float = _told(0.0, "delay from command to motor")
    rate_lag: float = _told(0.0, "lag of the body rates")
    rate_delay: float = _told(0.0, "delay of the body rates")
    hub_drag: tuple[float, float] = _told((0.0, 0.0), "drag of the rotors")
    inflow: float = _told(0.0, "thrust lost by climbing")
    frame_drag: tuple[float, float, float] = _told((0.0, 0.0, 0.0), "drag of the frame")
    lift: float = _told(0.0, "thrust gained by airspeed")
    moving_air: tuple[float, float] = _told((0.0, 0.0), "moving air (wind)")
    lean: tuple[float, float] = _told((0.0, 0.0), "lean of the thrust")
    centre_of_mass: tuple[float, float] = _told((0.0, 0.0), "centre of mass")
    strength: tuple[float, ...] = _told((), "strength of each rotor")
    spin_inertia: float = _told(0.0, "inertia of a rotor")

    def with_(self, **changes: object) -> Airframe:
        """A copy with some fields changed."""
        return replace(self, **changes)  # type: ignore[arg-type]

    def scaled(self, factor: float) -> Airframe:
        """The thrust of every command times `factor`."""
        return self.with_(curve=tuple(factor * c for c in self.curve))

    def bent(self, curvature: float) -> Airframe:
        """The thrust of every command times `1 + curvature (r - 1)`, r the believed thrust over the hover thrust."""
        flat = [(1.0 - curvature) * c for c in self.curve]
        power, ratio = _believed_ratio(self.vehicle)
        steep = [0.0] * power + [curvature * ratio * c for c in self.curve]
        flat += [0.0] * (len(steep) - len(flat))
        return self.with_(curve=tuple(a + b for a, b in zip(flat, steep, strict=True)))

    def thrust(self, command: float) -> float:
        """Collective thrust in N of a normalised command, once the rotors have settled; every rotor whole."""
        return sum(c * command ** (k + 1) for k, c in enumerate(self.curve))

    def top(self) -> float:
        """The command of most thrust: 1, unless the curve as it was fitted, to gentler commands, falls before."""
        commands = np.linspace(0.0, 1.0, 1001)
        return float(commands[np.argmax([self.thrust(u) for u in commands])])

    def changed_from(self, other: Airframe) -> tuple[str, ...]:
        """The fields in which it differs from another."""
        return tuple(f.name for f in fields(self) if getattr(self, f.name) != getattr(other, f.name))


def _believed_ratio(vehicle: Vehicle) -> tuple[int, float]:
    """Power and factor of the believed thrust over weight, `factor u^power`."""
    power = 1 if vehicle.thrust_model == "linear" else 2
    return power, vehicle.hover_thrust**-power


def believed_airframe(vehicle: Vehicle) -> Airframe:
    """The airframe of a vehicle file, before any effect."""
    power, factor = _believed_ratio(vehicle)
    return Airframe(
        vehicle,
        curve=(*(0.0,) * (power - 1), vehicle.mass * GRAVITY * factor),
        lag=vehicle.motor_time_constant,
        delay=vehicle.command_delay,
        rate_lag=vehicle.rate_time_constant,
        rate_delay=vehicle.command_delay,
    )


MEANINGS: Mapping[str, str] = {f.name: f.metadata["meaning"] for f in fields(Airframe) if f.metadata}
"""What each number of an airframe is, in words."""
