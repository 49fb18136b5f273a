"""What an effect is: one formula over arrays, with its parameters, needs, manoeuvre, confounders and source.

An effect maps a `Motion` to a `Motion`: it changes the thrust, the air's velocity, the other specific forces or the
sensor's reading. The same function is used to fit, to predict and to export: it is written against the Array API
standard and runs on numpy arrays and torch tensors alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

from models.vehicle import Vehicle

Array = Any
"""An array of any library that follows the Array API standard."""


class Stage(IntEnum):
    """When an effect acts, on the way from command to measurement. Effects of one stage commute."""

    COMMAND = 0  # on the history of the command
    THRUST = 1  # on the magnitude of the thrust
    ROTATION = 2  # on its direction
    REMAINDER = 3  # on the acceleration: what is learnt, from the vehicle's own state
    AIR = 4  # on the velocity of the air
    FORCE = 5  # on the other forces
    SENSOR = 6  # on the reading, not on the vehicle


@dataclass(frozen=True)
class Motion:
    """Samples of a flight on their way from command to acceleration. N samples, World ENU, body FLU.

    `command` (N,) is the commanded thrust over mass in m/s², as the owner's thrust model reads it, on a clock of
    period `dt` s; `thrust` (N,) the specific thrust in m/s² that acts; `thrust_acceleration` (N, 3) the acceleration
    it gives, heading frame; `force` (N, 3) all other forces over mass, body axes, m/s²; `reading` (N, 3) what the
    accelerometer adds, body axes, m/s². `rotation` (N, 3, 3) is body to heading; `air_velocity` (N, 3) the vehicle's
    velocity relative to the air, heading frame, m/s; `cos_yaw`, `sin_yaw` (N,) turn the heading frame into the world;
    `euler` is (phi, theta), rad; `height` (N,) above ground, m; `voltage` (N,) of the battery, V.
    Columns that the flight lacks are None.
    """

    vehicle: Vehicle
    dt: float
    command: Array
    thrust: Array
    force: Array
    reading: Array
    thrust_acceleration: Array = None
    rotation: Array = None
    euler: Array = None
    air_velocity: Array = None
    cos_yaw: Array = None
    sin_yaw: Array = None
    height: Array = None
    voltage: Array = None
    tau: float = 0.0
    delay: float = 0.0

    @property
    def body_velocity(self) -> tuple[Array, Array, Array]:
        """Velocity relative to the air along the body's axes, three (N,), m/s."""
        r, v = self.rotation, self.air_velocity
        x, y, z = v[:, 0], v[:, 1], v[:, 2]
        # written out: a batch of small products is slow in every array library
        return tuple(r[:, 0, j] * x + r[:, 1, j] * y + r[:, 2, j] * z for j in range(3))

    def with_(self, **changes: Any) -> Motion:
        """A copy with some fields changed."""
        return replace(self, **changes)


@dataclass(frozen=True)
class Parameter:
    """A number of an effect.

    `neutral` is the value without effect (or the name of the vehicle's field that holds it), `low` and `high` the
    physically plausible range, `typical` a size that matters in flight: the diagnosis asks whether a flight could
    have shown an effect of that size, and fits start there.
    """

    name: str
    unit: str
    meaning: str
    neutral: float | str
    typical: float
    low: float
    high: float

    def neutral_for(self, vehicle: Vehicle) -> float:
        """The value at which the effect does nothing beyond what the vehicle file already says."""
        return float(getattr(vehicle, self.neutral)) if isinstance(self.neutral, str) else self.neutral


@dataclass(frozen=True)
class Effect:
    """A physical effect, ready to fit, predict, diagnose, explain and export.

    `needs` names the columns of `models.flight.COLUMNS` it reads; `with_any` the effects of which one must be in the
    model for this one to act (wind acts through drag); `exports` is False for an effect with memory, which a static
    correction cannot hold. `beyond` names simpler effects with which this one coincides unless the flight
    varies what it depends on (a bent thrust curve in a hover is a thrust gain). `aliases` are physical quantities
    that no flight can tell apart from this effect.
    """

    name: str
    title: str
    stage: Stage
    formula: Callable[..., Motion]
    parameters: tuple[Parameter, ...]
    needs: tuple[str, ...]
    manoeuvre: str
    citation: str
    confounded_with: tuple[str, ...] = ()
    with_any: tuple[str, ...] = ()
    aliases: tuple[str, ...] = ()
    beyond: tuple[str, ...] = ()
    exports: bool = True

    def apply(self, motion: Motion, values: Mapping[str, Any]) -> Motion:
        """The motion with this effect acting; `values` by parameter name."""
        return self.formula(motion, **{p.name: values[p.name] for p in self.parameters})

    def neutral(self, vehicle: Vehicle) -> dict[str, float]:
        """Parameter values at which the effect does nothing."""
        return {p.name: p.neutral_for(vehicle) for p in self.parameters}
