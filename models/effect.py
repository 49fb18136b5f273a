"""What an effect is: one formula over arrays, with its parameters, needs, manoeuvre, confounders and source.

An effect maps a `Motion` to a `Motion`: it changes the thrust, the air's velocity, the other specific forces or the
sensor's reading. The same function is used to fit, to predict and to export: it is written against the Array API
standard and runs on numpy arrays and torch tensors alike. Effects on the rotation of the vehicle change the torque, or
how body rates follow their command; they are seen in the angular acceleration.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

from trueflight.models.flight import Flight
from trueflight.models.vehicle import Vehicle

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
    TORQUE = 7  # on the torque, which the angular acceleration shows
    RATE = 8  # on how body rates follow their command


@dataclass(frozen=True)
class Motion:
    """Samples of a flight on their way from command to acceleration. N samples, World ENU, body FLU.

    `command` (N,) is the commanded thrust over mass in m/s², as the owner's thrust model reads it, on a clock of
    period `dt` s; `thrust` (N,) the specific thrust in m/s² that acts; `thrust_acceleration` (N, 3) the acceleration
    it gives, heading frame; `force` (N, 3) all other forces over mass, body axes, m/s²; `reading` (N, 3) what the
    accelerometer adds, body axes, m/s². `rotation` (N, 3, 3) is body to heading; `air_velocity` (N, 3) the vehicle's
    velocity relative to the air, heading frame, m/s; `cos_yaw`, `sin_yaw` (N,) turn the heading frame into the world;
    `euler` is (phi, theta), rad; `height` (N,) above ground, m; `voltage` (N,) of the battery, V. `body_rate` (N, 3)
    in rad/s and `body_acceleration` (N, 3), its derivative, in rad/s²; `rotor_thrust` (N, 4) the thrust of each rotor
    in N, in the order of the vehicle's rotor_positions, as its speed or its motor command tells; `rotor_speed` (N, 4)
    in rad/s; `torque` (N, 3) on the body, N m, None where nobody asks for it; all in body axes. `rate_lag`,
    `rate_delay` in s are those of the body rates behind their command. Columns that the flight lacks are None.
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
    body_rate: Array = None
    body_acceleration: Array = None
    rotor_thrust: Array = None
    rotor_speed: Array = None
    torque: Array = None
    tau: float = 0.0
    delay: float = 0.0
    rate_lag: float = 0.0
    rate_delay: float = 0.0

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
    have shown an effect of that size, and fits start there. `structural` marks a number that says where an effect
    acts and not how much (the height of a ceiling): it is fitted, but no value of it is "no effect". `even` marks one
    that acts by its square, so that its sign means nothing.
    """

    name: str
    unit: str
    meaning: str
    neutral: float | str
    typical: float
    low: float
    high: float
    structural: bool = False
    even: bool = False

    def neutral_for(self, vehicle: Vehicle) -> float:
        """The value at which the effect does nothing beyond what the vehicle file already says."""
        return float(getattr(vehicle, self.neutral)) if isinstance(self.neutral, str) else self.neutral


@dataclass(frozen=True)
class Effect:
    """A physical effect, ready to fit, predict, diagnose, explain and export.

    `needs` names the columns of `models.flight.COLUMNS` it reads, `needs_any` those of which one is enough;
    `acts_through` the effects of which one must be in the model for this one to act (wind acts through drag); `exports`
    is False for an effect with memory, which a static correction cannot hold. `generalises` names simpler effects with
    which this one coincides unless the flight varies what it depends on (a bent thrust curve in a hover is a thrust
    gain). `aliases` are physical quantities that no flight can tell apart from this effect. `unconfounded` is the
    reason why an effect has no confounder. `rotational` effects are found in the angular acceleration; `seen_as`
    names the effects that such a one is taken for where the flight lacks the columns to tell. `exclusive` is True where
    at most one of the parameters acts (the one rotor that is damaged): each is then a candidate on its own.
    `typical_for` gives sizes that depend on where the flight went (a ceiling just above its highest point) instead of
    the parameters' own; `starts_for` further values to begin a fit from, where one start may end in a wrong optimum.
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
    acts_through: tuple[str, ...] = ()
    aliases: tuple[str, ...] = ()
    generalises: tuple[str, ...] = ()
    exports: bool = True
    needs_any: tuple[str, ...] = ()
    unconfounded: str = ""
    rotational: bool = False
    seen_as: tuple[str, ...] = ()
    exclusive: bool = False
    typical_for: Callable[[Motion], Mapping[str, float]] | None = None
    starts_for: Callable[[Motion], Sequence[Mapping[str, float]]] | None = None

    def apply(self, motion: Motion, values: Mapping[str, Any]) -> Motion:
        """The motion with this effect acting; `values` by parameter name."""
        return self.formula(motion, **{p.name: values[p.name] for p in self.parameters})

    def lacks(self, flight: Flight) -> tuple[str, ...]:
        """The columns it needs and the flight does not have."""
        missing = [n for n in self.needs if not flight.has(n)]
        if self.needs_any and not any(flight.has(n) for n in self.needs_any):
            missing.append(" or ".join(self.needs_any))
        return tuple(missing)

    def neutral(self, vehicle: Vehicle) -> dict[str, float]:
        """Parameter values at which the effect does nothing."""
        return {p.name: p.neutral_for(vehicle) for p in self.parameters}

    def typical(self, motion: Motion) -> dict[str, float]:
        """Parameter values of a size that matters, on this flight."""
        sizes = {p.name: p.typical for p in self.parameters}
        return sizes if self.typical_for is None else {**sizes, **self.typical_for(motion)}
