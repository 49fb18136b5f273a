"""What an effect is: one formula over arrays, with its parameters, needs, manoeuvre, confounders and source.

An effect maps a `Motion` to a `Motion`: it changes the thrust, the air's velocity, the other specific forces or the
sensor's reading. The same function is used to fit, to predict and to export: it is written against the Array API
standard and runs on numpy arrays and torch tensors alike. Effects on the rotation of the vehicle change the torque, or
how body rates follow their command; they are seen in the angular acceleration.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from trueflight.models.airframe import Airframe
from trueflight.models.array import ABSENT, Array
from trueflight.models.flight import Flight
from trueflight.models.vehicle import GRAVITY, Vehicle

ROTOR_SHARE, CENTRE_SHARE = "rotor", "centre"
"""What an effect does to the part of the thrust that each rotor carries: one rotor, that of its parameter, has to be
driven harder; or the centre of the thrust moves, along body x and y, in m."""
DESCENT, BELOW_CEILING = "descent", "below_ceiling"
"""Flights that alone show some effects: a fast descent into one's own wake; close below something that hangs."""

VEHICLE, FLIGHT = "vehicle", "flight"
"""Whose a number is: one for every flight of a vehicle (drag), or one for each flight (wind)."""


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
    thrust_acceleration: Array = ABSENT
    rotation: Array = ABSENT
    euler: tuple[Array, Array] | None = None
    air_velocity: Array = ABSENT
    cos_yaw: Array = ABSENT
    sin_yaw: Array = ABSENT
    height: Array = ABSENT
    voltage: Array = ABSENT
    body_rate: Array = ABSENT
    body_acceleration: Array = ABSENT
    rotor_thrust: Array = ABSENT
    rotor_speed: Array = ABSENT
    torque: Array = ABSENT
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
        a, b, c = (r[:, 0, j] * x + r[:, 1, j] * y + r[:, 2, j] * z for j in range(3))
        return a, b, c

    def with_(self, **changes: Any) -> Motion:
        """A copy with some fields changed. Raises `TypeError` for what is no field."""
        if unknown := changes.keys() - self.__dict__.keys():
            raise TypeError(f"a motion has no {', '.join(sorted(unknown))}")
        copy: Motion = object.__new__(type(self))  # fits make thousands of them
        copy.__dict__.update(self.__dict__, **changes)
        return copy


@dataclass(frozen=True)
class Parameter:
    """A number of an effect.

    `neutral` is the value without effect (or the name of the vehicle's field that holds it), `low` and `high` the
    physically plausible range, `typical` a size that matters in flight: the diagnosis asks whether a flight could
    have shown an effect of that size, and fits start there. `structural` marks a number that says where an effect
    acts and not how much (the height of a ceiling): it is fitted, but no value of it is "no effect". `even` marks one
    that acts by its square, so that its sign means nothing. `belongs_to` says whose number it is where several flights
    are looked at together: the `VEHICLE`'s, the same in all of them, or each `FLIGHT`'s own. `grows` and `shrinks` say
    in words that a vehicle's number is not what it was, with a place for the difference: "rotor 3 has lost {:.0%}".
    `rotor` is the number of the rotor that it belongs to, from 1: a vehicle with fewer does not have it.
    `drifts` is the share of `typical` by which it may change within ten seconds of flight: 1 for what happens at once
    (a payload picked up, a gust), less for what wears, 0 for what stays. Those are learnt in flight.

    Raises `ValueError` for any other owner.
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
    clock_samples: float = 0.0
    actuation: str = ""
    truth: str = ""
    rotor: int = 0
    belongs_to: str = VEHICLE
    grows: str = ""
    shrinks: str = ""
    drifts: float = 0.0

    def __post_init__(self) -> None:
        if self.belongs_to not in (VEHICLE, FLIGHT):
            raise ValueError(
                f"parameter '{self.name}' belongs_to {self.belongs_to!r}; it is VEHICLE or FLIGHT"
            )

    def neutral_for(self, vehicle: Vehicle) -> float:
        """The value at which the effect does nothing beyond what the vehicle file already says."""
        return float(getattr(vehicle, self.neutral)) if isinstance(self.neutral, str) else self.neutral


@dataclass(frozen=True)
class Effect:
    """A physical effect, ready to fit, predict, diagnose, explain and export.

    `needs` names the columns of `models.flight.COLUMNS` it reads, `needs_any` those of which one is enough;
    `needs_accelerometer` is True for an error of that sensor: no acceleration that was differentiated or estimated
    has it; `noisy` names those of its columns whose noise is not small beside what it does; `acts_through` the
    effects of which one must be in the model for this one to act (wind acts through drag); `exports` is False for
    an effect with memory, which a static correction cannot hold. `generalises` names simpler effects with which
    this one coincides unless the flight varies what it depends on (a bent thrust curve in a hover is a thrust
    gain). `aliases` are physical quantities that no flight can tell apart from this effect. `unconfounded` is the
    reason why an effect has no confounder. `rotational` effects are found in the angular acceleration; `seen_as`
    names the effects that such a one is taken for where the flight lacks the columns to tell. `exclusive` is True
    where at most one of the parameters acts (the one rotor that is damaged): each is then a candidate on its own.
    `in_shares` says how it shows in what each rotor carries: `ROTOR_SHARE` or `CENTRE_SHARE`.
    `typical_for` gives sizes that depend on where the flight went (a ceiling just above its highest point) instead
    of the parameters' own; `starts_for` further values to begin a fit from, where one start may end in a wrong
    optimum.

    The rest are parts that few effects play; an effect that leaves them out is treated as one that acts between the
    rotors and the acceleration. `exact_rotation` is True for what turns thrust exactly: every diagnosis starts from
    it. `shifts_clock` is True for a shift in time between command and measurement: a model without it is given one
    within a sample, the error of a log's clock. Where rotor speeds are recorded, `before_rotors` effects are looked for
    between command and rotors, with `scales_rotors` effects fitted beside them: no vehicle file tells what thrust a
    rotor speed gives.

    `learnt_unasked` effects are learnt in flight even by a model that lacks them, from where they do nothing: what may
    happen to any vehicle (a payload, a gust).

    For studies of known truth: `shown_in` is the one kind of flight that shows it, `DESCENT` or `BELOW_CEILING`;
    `truth_for` gives the true values of the parameters by the simulator's numbers and the neutral values, where a
    parameter's own `truth` is not enough; `carrier_truth` is the simulator's number for every parameter of the first of
    `acts_through`, where none of these is hidden with it.

    For other simulators and autopilots: `on_airframe` puts the parameters into the numbers that they have
    (`models.airframe`); None where they have none.
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
    needs_accelerometer: bool = False
    noisy: tuple[str, ...] = ()
    unconfounded: str = ""
    rotational: bool = False
    seen_as: tuple[str, ...] = ()
    exclusive: bool = False
    in_shares: str = ""
    typical_for: Callable[[Motion], Mapping[str, float]] | None = None
    starts_for: Callable[[Motion], Sequence[Mapping[str, float]]] | None = None
    exact_rotation: bool = False
    shifts_clock: bool = False
    before_rotors: bool = False
    scales_rotors: bool = False
    learnt_unasked: bool = False
    shown_in: str = ""
    truth_for: Callable[[Mapping[str, float], Mapping[str, float]], Mapping[str, float]] | None = None
    carrier_truth: str = ""
    on_airframe: Callable[[Airframe, Mapping[str, float]], Airframe] | None = None

    def apply(self, motion: Motion, values: Mapping[str, Any]) -> Motion:
        """The motion with this effect acting; `values` by parameter name."""
        given = [p.name for p in self.parameters if p.name in values or not p.rotor]
        return self.formula(motion, **{name: values[name] for name in given})

    def lacks(self, flight: Flight) -> tuple[str, ...]:
        """The columns it needs and the flight does not have."""
        missing = [n for n in self.needs if not flight.has(n)]
        if self.needs_any and not any(flight.has(n) for n in self.needs_any):
            missing.append(" or ".join(self.needs_any))
        if self.needs_accelerometer and not flight.accelerometer:
            missing.append("an accelerometer")
        return tuple(missing)

    def neutral(self, vehicle: Vehicle) -> dict[str, float]:
        """Parameter values at which the effect does nothing."""
        return {p.name: p.neutral_for(vehicle) for p in self.parameters_of(vehicle)}

    def parameters_of(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """Its parameters without those of rotors that the vehicle does not have (one that tells none has four)."""
        rotors = len(vehicle.rotor_positions) or 4
        return tuple(p for p in self.parameters if p.rotor <= rotors)

    def typical(self, motion: Motion) -> dict[str, float]:
        """Parameter values of a size that matters, on this flight."""
        sizes = {p.name: p.typical for p in self.parameters}
        return sizes if self.typical_for is None else {**sizes, **self.typical_for(motion)}

    def truth(self, hidden: Mapping[str, float], vehicle: Vehicle) -> dict[str, float]:
        """True values of those parameters that have one, where the simulator hid the numbers `hidden`."""
        if self.truth_for is not None:
            return dict(self.truth_for(hidden, self.neutral(vehicle)))
        return {p.name: hidden[p.truth] for p in self.parameters if p.truth}

    @property
    def undone_by_look_ahead(self) -> bool:
        """Whether the controller undoes it by looking ahead, so that no correction has to."""
        return any(p.actuation for p in self.parameters)

    @property
    def needs_yaw(self) -> bool:
        """Whether the formula reads the heading in the world, as wind does; the formula itself is asked."""
        heading = _any_motion()
        return self._acts_on(heading) and not self._acts_on(heading.with_(cos_yaw=None, sin_yaw=None))

    def _acts_on(self, motion: Motion) -> bool:
        try:
            self.apply(motion, {p.name: p.typical for p in self.parameters})
        except Exception:  # noqa: BLE001 - a user's formula may fail in any way where something is None
            return False
        return True


def _any_motion() -> Motion:
    """Two samples of a hover with every column, for asking a formula what it reads."""
    n = 2
    vehicle = Vehicle(
        "any", 1.0, 0.5, (0.01, 0.01, 0.02), 0.1, ((0.1, -0.1, 0.0), (-0.1, 0.1, 0.0)) * 2, (1, 1, -1, -1)
    )
    thrust, level, nothing = np.full(n, GRAVITY), np.zeros(n), np.zeros((n, 3))
    return Motion(
        vehicle=vehicle,
        dt=0.01,
        command=thrust,
        thrust=thrust,
        force=nothing,
        reading=nothing,
        thrust_acceleration=np.tile([0.0, 0.0, GRAVITY], (n, 1)),
        rotation=np.tile(np.eye(3), (n, 1, 1)),
        euler=(level, level),
        air_velocity=np.ones((n, 3)),
        cos_yaw=np.ones(n),
        sin_yaw=level,
        height=np.ones(n),
        voltage=np.full(n, vehicle.nominal_voltage),
        body_rate=nothing,
        body_acceleration=nothing,
        rotor_thrust=np.full((n, 4), 0.25 * vehicle.weight),
        rotor_speed=np.full((n, 4), 1000.0),
        torque=nothing,
    )
