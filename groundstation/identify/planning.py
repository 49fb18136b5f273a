"""The short flight that best tells apart what a flight left open.

Every question is between two explanations of what was seen (or one explanation and nothing). What one says the
accelerometer would read on a manoeuvre, less the nearest that the other can say with its parameters free, is their
separation: twice the log likelihood ratio to be expected, the T-optimality of Atkinson & Fedorov ("The design of
experiments for discriminating between two rival models", Biometrika 62, 1975). Manoeuvres begin and end at rest in one
place, so that their information adds up, and a flight is chosen one manoeuvre at a time: the one that answers most a
second (Fedorov's exchange without exchanges, Theory of Optimal Experiments 1972). How the vehicle moves is predicted by
its linear closed loop, and what the effects then do by their own formulas.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from trueflight.groundstation.design.linear_response import Reference, expected_behaviour
from trueflight.groundstation.identify.fitting import (
    BLOCK,
    HAC_LAG,
    SCALE,
    UNMODELLED,
    MeasuredFlights,
    critical_value,
    fit,
    free_parameters,
    shifted_clock,
    variance_per_independent_sample,
)
from trueflight.groundstation.identify.search import STRONG_EVIDENCE
from trueflight.groundstation.measured.measurement import Measurement, measure
from trueflight.groundstation.results import Diagnosis
from trueflight.models.design import Design
from trueflight.models.effect import Effect
from trueflight.models.effects import EXACT_ROTATION, catalogue, effect_named
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.frames import rotate_inverse
from trueflight.models.model import Term
from trueflight.models.prediction import Chain
from trueflight.models.reference import trajectory
from trueflight.models.trajectory import Segment, Trajectory, Waypoint, hold, min_jerk, path
from trueflight.models.vehicle import GRAVITY, Vehicle

RATE = 50.0
"""Hz at which manoeuvres are predicted."""
ENOUGH = 45.0
"""Evidence at which a question counts as answered: 99 times in 100 it will then be above `STRONG_EVIDENCE`, since it
spreads by twice its root."""
PRECISE = 0.2
"""Half width of a 95 % interval over the size of the parameter, at which it counts as known."""
LEAST = 3.5 * BLOCK
"""s of flight, so that every manoeuvre is seen again on a part that was held out."""
SAMPLING = 0.1
"""s between two setpoints of the file."""


@dataclass(frozen=True)
class Limits:
    """Where and how the planned flight may go: m around home, m above ground, m/s, m/s², s altogether."""

    radius: float = 3.0
    low: float = 0.4
    high: float = 2.5
    speed: float = 3.0
    acceleration: float = 5.0
    duration: float = 40.0

    def __post_init__(self) -> None:
        if self.high - self.low < 0.5:
            raise InputError(
                f"--low {self.low:g} --high {self.high:g}: give at least 0.5 m of height to fly in"
            )


@dataclass(frozen=True)
class Question:
    """Two explanations, each a tuple of effects' names (empty: nothing but what is known), and the evidence expected
    from the flight at hand (`before`, None without one) and from the planned one."""

    one: tuple[str, ...]
    other: tuple[str, ...]
    before: float | None
    after: float

    @property
    def answered(self) -> bool:
        """Whether the planned flight will tell them apart."""
        return self.after > STRONG_EVIDENCE


@dataclass(frozen=True)
class Precision:
    """A parameter, the size it is planned for and the half width of its 95 % interval, before and after."""

    effect: str
    parameter: str
    unit: str
    value: float
    before: float | None
    after: float


@dataclass(frozen=True)
class FlightPlan:
    """A flight to be flown: its trajectory (home frame), what it is made of, and what it will tell.

    `left_out` says why a candidate could not be planned for.
    """

    trajectory: Trajectory
    manoeuvres: tuple[str, ...]
    questions: tuple[Question, ...]
    precision: tuple[Precision, ...]
    left_out: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Manoeuvre:
    text: str
    segments: tuple[Segment, ...]

    @property
    def trajectory(self) -> Trajectory:
        return Trajectory(self.text, self.segments)


def plan_flight(
    design: Design,
    vehicle: Vehicle,
    limits: Limits,
    diagnosis: Diagnosis | None = None,
    between: Sequence[str] = (),
    effects_directory: str | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> FlightPlan:
    """Design the flight that best tells the effects of `between` apart; without them, what `diagnosis` left open.

    Raises `InputError` where nothing is open, or a name is unknown.
    """
    for name in between:
        effect_named(name, effects_directory)
    study = _Study(vehicle, diagnosis, tuple(between), effects_directory)
    manoeuvres = _library(limits)
    before = None if diagnosis is None else study.information(diagnosis.flight)
    known = []
    for number, one in enumerate(manoeuvres, 1):
        progress(f"predicting manoeuvre {number} of {len(manoeuvres)}")
        known.append(study.information(_flown(one.trajectory, design, vehicle, diagnosis)))
    progress("choosing")
    chosen = _choose(study, manoeuvres, known, limits)
    if not chosen:
        raise InputError(
            f"no manoeuvre within these limits tells {_listed(study.names)} apart; raise --radius, --speed, "
            "--high or --duration, or lower --low"
        )
    after = sum((known[i] for i in chosen), study.nothing())
    base = _base(limits)
    segments: list[Segment] = [hold(base, 1.0)]
    for i in chosen:
        segments += manoeuvres[i].segments
    flown = Trajectory("planned", (*segments, hold(base, 1.0)))
    return FlightPlan(
        flown,
        tuple(manoeuvres[i].text for i in chosen),
        study.answers(before, after),
        study.precision(
            before, after, None if diagnosis is None else diagnosis.flight.duration, flown.duration
        ),
        study.left_out,
    )


def _listed(names: Sequence[str]) -> str:
    return " and ".join(names) if len(names) < 3 else f"{', '.join(names[:-1])} and {names[-1]}"


# --- what can be flown ----------------------------------------------------------------------------------------


def _base(limits: Limits) -> Waypoint:
    """Where every manoeuvre begins and ends at rest."""
    return (0.0, 0.0, min(max(limits.low + 0.5, 1.3), limits.high - 0.2), 0.0)


def _library(limits: Limits) -> list[_Manoeuvre]:
    """Manoeuvres of every kind, within the limits; each begins and ends at rest at `_base`."""
    base = _base(limits)
    height, reach, a = base[2], 0.9 * limits.radius, limits.acceleration
    speeds = sorted({0.4 * limits.speed, 0.7 * limits.speed, limits.speed})
    found: list[_Manoeuvre] = [_Manoeuvre("hover for 3 s", (hold(base, 3.0),))]

    def add(text: str, *segments: Segment) -> None:
        found.append(_Manoeuvre(text, segments))

    for degrees in (90, 180):
        turned = (*base[:3], math.radians(degrees))
        time = math.radians(degrees) * 1.875 / 1.2
        add(
            f"turn by {degrees}°, hold 2 s, and back",
            min_jerk(base, turned, time), hold(turned, 2.0), min_jerk(turned, base, time),
        )  # fmt: skip
    for degrees, way in ((0, "along body x"), (90, "along body y"), (45, "diagonally")):
        x, y = reach * math.cos(math.radians(degrees)), reach * math.sin(math.radians(degrees))
        for speed in speeds:
            points = [base, (x, y, height, 0.0), (-x, -y, height, 0.0), base]
            add(f"pass {way} at {speed:.2g} m/s, there and back", *path(points, speed, a))
    for degrees in (90, 180):
        yaw = math.radians(degrees)
        turned, time = (*base[:3], yaw), yaw * 1.875 / 1.2
        for axis, way in ((0.0, "east"), (0.5 * math.pi, "north")):
            x, y = reach * math.cos(axis), reach * math.sin(axis)
            points = [turned, (x, y, height, yaw), (-x, -y, height, yaw), turned]
            add(
                f"yawed by {degrees}°, pass {way} at {limits.speed:.2g} m/s, there and back",
                min_jerk(base, turned, time), *path(points, limits.speed, a), min_jerk(turned, base, time),
            )  # fmt: skip
    top, bottom = (0.0, 0.0, limits.high, 0.0), (0.0, 0.0, limits.low, 0.0)
    for speed in speeds:
        add(f"climb and descend at {speed:.2g} m/s", *path([base, top, bottom, base], speed, a))
    hard = min(2.0 * a, 0.65 * GRAVITY)  # thrust stays well above nothing
    jolt = (0.0, 0.0, min(height + 0.4, limits.high), 0.0)
    add("four hard vertical jolts", *(path([base, jolt], 5.0, hard) + path([jolt, base], 5.0, hard)) * 4)
    if limits.low < 0.8:
        stairs = [base, *((0.0, 0.0, limits.low + step, 0.0) for step in (0.4, 0.2, 0.1, 0.0))]
        add("down in stairs and up again", *path(stairs, 0.8, 2.0, 0.6), *path([bottom, base], 1.0, 2.0))
    ends = [(-0.7 * reach, 0.0, limits.low, 0.0), (0.7 * reach, 0.0, limits.low, 0.0)]
    for speed in (speeds[0], speeds[-1]):
        add(
            f"low pass at {speed:.2g} m/s",
            *path([base, bottom], 1.0, 2.0), *path([bottom, ends[0]], speed, a), *path(ends, speed, a),
            *path([ends[1], bottom], speed, a), *path([bottom, base], 1.0, 2.0),
        )  # fmt: skip
    for speed in speeds[1:]:
        radius = min(0.8 * reach, 1.5)
        turning = trajectory("circle", radius=radius, speed=speed, height=height, laps=2.0)
        out = path([base, (radius, 0.0, height, 0.0)], speed, a)
        back = path([(radius, 0.0, height, 0.0), base], speed, a)
        add(f"two circles at {speed:.2g} m/s", *out, *turning.segments, *back)
    return [m for m in found if _within(m.trajectory, limits)]


def _within(flown: Trajectory, limits: Limits) -> bool:
    (x0, y0, z0), (x1, y1, z1) = flown.bounds
    far = math.hypot(max(abs(x0), abs(x1)), max(abs(y0), abs(y1)))
    slow = flown.max_speed <= 1.01 * max(limits.speed, 1.0)
    return far <= limits.radius and z0 >= limits.low - 1e-6 and z1 <= limits.high + 1e-6 and slow


def _flown(flown: Trajectory, design: Design, vehicle: Vehicle, diagnosis: Diagnosis | None) -> Flight:
    """The manoeuvre as the linear closed loop would fly it; thrust and attitude are those its acceleration takes."""
    # long enough to be compared, whatever the manoeuvre
    t = np.arange(0.0, max(flown.duration, 5.5), 1.0 / RATE)
    wanted = flown.sample(t)
    reference = Reference(wanted.position, wanted.velocity, wanted.acceleration, wanted.yaw)
    start = (wanted.position[0], np.zeros(3), np.array([0.0, 0.0, wanted.yaw[0]]))
    motion = expected_behaviour(design, t, reference, start)
    force = np.gradient(motion.velocity, t, axis=0) + np.array([0.0, 0.0, GRAVITY])
    thrust = np.linalg.norm(force, axis=1)
    quaternion = _attitude(force / thrust[:, None], motion.zeta[:, 2])
    voltage = np.full(len(t), vehicle.nominal_voltage)
    if diagnosis is not None and diagnosis.flight.battery_voltage is not None:
        voltage = np.full(len(t), float(np.median(diagnosis.flight.battery_voltage)))
    turn = np.gradient(quaternion, t, axis=0)
    return Flight(
        name=flown.name,
        vehicle=vehicle,
        t=t,
        position=motion.position,
        velocity=motion.velocity,
        quaternion=quaternion,
        angular_velocity=2.0 * _conjugate_product(quaternion, turn),
        specific_force=rotate_inverse(quaternion, force),
        thrust_command=np.array([vehicle.command(vehicle.mass * x) for x in thrust]),
        battery_voltage=voltage,
    )


def _attitude(up: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Quaternion (N, 4) of the attitude with body z along `up` (N, 3), world, and this yaw (N,)."""
    roll_pitch = np.column_stack([-np.sin(yaw), np.cos(yaw), np.zeros_like(yaw)])
    x = np.cross(roll_pitch, up)
    x /= np.linalg.norm(x, axis=1)[:, None]
    y = np.cross(up, x)
    w = 0.5 * np.sqrt(np.maximum(1.0 + x[:, 0] + y[:, 1] + up[:, 2], 1e-9))
    first = (
        np.column_stack([4 * w * w, y[:, 2] - up[:, 1], up[:, 0] - x[:, 2], x[:, 1] - y[:, 0]])
        / (4 * w)[:, None]
    )
    # half a turn from the world the formula above divides by zero; about z there is another
    z = 0.5 * np.sqrt(np.maximum(1.0 - x[:, 0] - y[:, 1] + up[:, 2], 1e-9))
    second = (
        np.column_stack([x[:, 1] - y[:, 0], up[:, 0] + x[:, 2], y[:, 2] + up[:, 1], 4 * z * z])
        / (4 * z)[:, None]
    )
    quaternion = np.where((w > z)[:, None], first, second)
    flips = np.cumprod(np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0.0, -1.0, 1.0))
    quaternion[1:] *= flips[:, None]
    return quaternion / np.linalg.norm(quaternion, axis=1)[:, None]


def _conjugate_product(q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Vector part (N, 3) of conj(q) r."""
    return q[:, :1] * r[:, 1:] - r[:, :1] * q[:, 1:] - np.cross(q[:, 1:], r[:, 1:])


# --- what it tells --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Candidate:
    """An explanation: the effects it adds, in order, with the values it is planned for."""

    names: tuple[str, ...]
    values: tuple[dict[str, float], ...]


class _Study:
    """The open questions, and how much a flight says on each.

    Information is one matrix of inner products over time, of the columns of `self.columns`: what is fitted anyhow, then
    for each candidate its Jacobian and what it adds at its planned size, over the variance of an independent second.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        diagnosis: Diagnosis | None,
        between: tuple[str, ...],
        effects_directory: str | None,
    ) -> None:
        self.vehicle, self.directory = vehicle, effects_directory
        self.known = catalogue(effects_directory)
        self.left_out: dict[str, str] = {}
        terms: tuple[Term, ...] = (Term(EXACT_ROTATION.name, {}),)
        if diagnosis is not None:
            terms = diagnosis.model.terms
        open_names = list(between) or self._open(diagnosis)
        self.settled = tuple(
            t for t in terms if t.effect not in open_names and not self.known[t.effect].rotational
        )
        self.names = tuple(n for n in dict.fromkeys(open_names) if self._plannable(n))
        if not self.names:
            reasons = "; ".join(f"{n}: {why}" for n, why in self.left_out.items())
            raise InputError(
                "nothing is left open that a flight could tell" + (f" ({reasons})" if reasons else "")
                + "; name what to tell apart with --between"
            )  # fmt: skip
        self.settled += self._carriers(diagnosis)
        self.candidates = tuple(self._candidate(n, diagnosis) for n in self.names)
        self.pairs = self._pairs(diagnosis, bool(between))
        self.density = self._density(diagnosis)
        self._layout()

    def _open(self, diagnosis: Diagnosis | None) -> list[str]:
        """What a diagnosis left open: the rivals, or else what the flight could not have shown."""
        if diagnosis is None:
            raise InputError(
                "name the effects to tell apart with --between (twice or more), or pass a flight that left some open"
            )
        rivals = list(diagnosis.named("possible"))
        return rivals or [n for n in diagnosis.named("not_excited") if n in self.known]

    def _plannable(self, name: str) -> bool:
        effect = self.known[name]
        if effect.rotational or not effect.parameters:
            self.left_out[name] = "it is seen in the rotation, which this plan does not predict"
            return False
        return True

    def _carriers(self, diagnosis: Diagnosis | None) -> tuple[Term, ...]:
        """What the candidates act through and is neither known nor in question: it may be there whichever is true."""
        present = {t.effect for t in self.settled} | set(self.names)
        found: dict[str, Term] = {}
        for name in self.names:
            needed = self.known[name].acts_through
            if needed and not (present | set(found)) & set(needed):
                found[needed[0]] = Term(needed[0], self._size(needed[0], diagnosis))
        return tuple(found.values())

    def _candidate(self, name: str, diagnosis: Diagnosis | None) -> _Candidate:
        effect = self.known[name]
        present = {t.effect for t in self.settled}
        names: tuple[str, ...] = (name,)
        if effect.acts_through and not present & set(effect.acts_through):
            through = next((n for n in effect.acts_through if n in self.names), effect.acts_through[0])
            names = (through, name)
        return _Candidate(names, tuple(self._size(n, diagnosis) for n in names))

    def _size(self, name: str, diagnosis: Diagnosis | None) -> dict[str, float]:
        """The size the diagnosis estimated where it was a possible cause, else the typical one."""
        effect = self.known[name]
        sizes = {p.name: p.typical for p in effect.parameters}
        if diagnosis is None:
            return sizes
        for verdict in diagnosis.effects:
            if verdict.name == name and verdict.verdict in ("possible", "missing"):
                found = {p.name: p.value for p in verdict.parameters if np.isfinite(p.value)}
                sizes |= {k: float(np.clip(v, *self._range(effect, k))) for k, v in found.items()}
        return sizes

    def _range(self, effect: Effect, parameter: str) -> tuple[float, float]:
        p = next(p for p in effect.parameters if p.name == parameter)
        return p.low, p.high

    def _pairs(self, diagnosis: Diagnosis | None, asked: bool) -> list[tuple[int, int | None]]:
        """The questions: rivals against one another, and where there are none each candidate against nothing."""
        count = len(self.candidates)
        rivals = asked or (diagnosis is not None and bool(diagnosis.named("possible")))
        if not rivals or count == 1:
            return [(i, None) for i in range(count)]
        told: dict[str, set[str]] = {}
        if diagnosis is not None and not asked:
            told = {e.name: set(e.indistinguishable_from) for e in diagnosis.effects}
        return [
            (i, j)
            for i in range(count)
            for j in range(count)
            if i != j
            and (asked or self.names[j] in told[self.names[i]] or self.names[i] in told[self.names[j]])
        ]

    def _density(self, diagnosis: Diagnosis | None) -> float:
        """Variance of the residual times its correlation time, (m/s²)² s: what one second of evidence costs."""
        if diagnosis is None:
            return float(UNMODELLED**2 * HAC_LAG + 0.05**2 / RATE)
        m = measure(diagnosis.flight, diagnosis.bandwidth)
        problem = MeasuredFlights((m,), self.directory, diagnosis.model.network_chain())
        fitted = fit(problem, list(diagnosis.model.terms), refit=[])
        return variance_per_independent_sample(problem, fitted.residual) * float(np.median(np.diff(m.t)))

    # --- the columns ---

    def _layout(self) -> None:
        """Where each column stands, and the weight of each parameter's prior, by its spread."""
        at = 0
        spread: list[float] = []
        motion = MeasuredFlights((_still(self.vehicle),), self.directory).survey
        period = 1.0 / RATE

        def places(names: Sequence[str], values: Sequence[dict[str, float]]) -> list[int]:
            nonlocal at
            found = []
            for name, value in zip(names, values, strict=True):
                for free in free_parameters(self.known[name], motion, value, period):
                    found.append(at)
                    spread.append(free.spread)
                    at += 1
            return found

        settled = [t for t in self.settled if self.known[t.effect].parameters]
        self.nuisance = places([t.effect for t in settled], [dict(t.values) for t in settled])
        self.clock = at
        self.nuisance.append(at)
        spread.append(period)
        at += 1
        self.own: list[list[int]] = []
        self.size: list[int] = []
        for c in self.candidates:
            self.own.append(places(c.names, c.values))
            self.size.append(at)
            spread.append(np.inf)
            at += 1
        self.count, self.spread = at, np.array(spread)

    def nothing(self) -> np.ndarray:
        """The information of no flight."""
        return np.zeros((self.count, self.count))

    def information(self, flight: Flight) -> np.ndarray:
        """Inner products (C, C) of all columns over a flight, in units of the evidence."""
        m = measure(flight)
        problem = MeasuredFlights((m,), self.directory)
        period = float(np.median(np.diff(m.t)))
        settled: list[tuple[Effect, dict[str, float]]] = [
            (self.known[t.effect], dict(t.values)) for t in self.settled
        ]
        base = problem.predict(settled)
        columns = np.zeros((base.size, self.count))

        def slopes(chain: Chain, positions: Sequence[int], first: int) -> None:
            here, place = problem.predict(chain), iter(positions)
            for index in range(first, len(chain)):
                effect, values = chain[index]
                for free in free_parameters(effect, problem.survey, values, period):
                    name, step = free.parameter.name, 0.01 * free.spread
                    if values[name] + step > free.high:
                        step = -step
                    moved = [
                        *chain[:index],
                        (effect, {**values, name: values[name] + step}),
                        *chain[index + 1 :],
                    ]
                    columns[:, next(place)] = ((problem.predict(moved) - here) / step).ravel()

        with_parameters = [link for link in settled if link[0].parameters]
        without = [link for link in settled if not link[0].parameters]
        slopes([*without, *with_parameters], self.nuisance[:-1], len(without))
        if not any(effect.shifts_clock for effect, _ in settled):
            later = shifted_clock(self.vehicle.command_delay + 0.5 * period)
            columns[:, self.clock] = ((problem.predict([*settled, later]) - base) / (0.5 * period)).ravel()
        for c, own, size in zip(self.candidates, self.own, self.size, strict=True):
            added = [(self.known[n], dict(v)) for n, v in zip(c.names, c.values, strict=True)]
            columns[:, size] = (problem.predict([*settled, *added]) - base).ravel()
            slopes([*settled, *added], own, len(settled))
        return columns.T @ columns * period / self.density

    def evidence(self, information: np.ndarray, one: int, other: int | None) -> float:
        """Twice the log likelihood ratio expected for candidate `one` against `other` where `one` is true."""
        free = [*self.nuisance, *([] if other is None else self.own[other])]
        seen = self.size[one]
        inner = information[np.ix_(free, free)] + np.diag(self.spread[free] ** -2.0)
        cross = information[free, seen]
        return float(max(0.0, information[seen, seen] - cross @ np.linalg.solve(inner, cross)))

    def worth(self, information: np.ndarray) -> float:
        """How well all is answered: a sum of logarithms, in which no question counts beyond `ENOUGH` and no parameter
        beyond a half width of `PRECISE`."""
        questions = sum(math.log1p(min(self.evidence(information, i, j), ENOUGH)) for i, j in self._all_pairs)
        sharpness = sum(math.log1p(min(x, 1.0 / PRECISE) ** 2) for x in self._sharpness(information))
        return float(questions + sharpness)

    def answered(self, information: np.ndarray) -> bool:
        """Whether every question is answered, and every parameter known."""
        sure = all(self.evidence(information, i, j) >= ENOUGH for i, j in self._all_pairs)
        return sure and all(x >= 1.0 / PRECISE for x in self._sharpness(information))

    @property
    def _all_pairs(self) -> list[tuple[int, int | None]]:
        """Every question, and for each candidate whether it is there at all."""
        alone: list[tuple[int, int | None]] = [(i, None) for i in range(len(self.candidates))]
        return [*self.pairs, *(pair for pair in alone if pair not in self.pairs)]

    def _sharpness(self, information: np.ndarray) -> list[float]:
        """Size over standard half width of each parameter of each candidate."""
        found: list[float] = []
        for c, own in zip(self.candidates, self.own, strict=True):
            sizes = [
                max(
                    abs(values[p.name] - p.neutral_for(self.vehicle)),
                    abs(p.typical - p.neutral_for(self.vehicle)),
                )
                for name, values in zip(c.names, c.values, strict=True)
                for p in self.known[name].parameters
            ]
            found += [x / (1.96 * s) for x, s in zip(sizes, self._deviations(information, own), strict=True)]
        return found

    def _deviations(self, information: np.ndarray, own: list[int]) -> np.ndarray:
        """Standard deviation of a candidate's parameters, beside all that is fitted anyhow."""
        free = [*self.nuisance, *own]
        inner = information[np.ix_(free, free)] + np.diag(self.spread[free] ** -2.0)
        return np.sqrt(np.maximum(np.diag(np.linalg.inv(inner))[len(self.nuisance) :], 0.0))

    def answers(self, before: np.ndarray | None, after: np.ndarray) -> tuple[Question, ...]:
        """The questions with their answers; of two rivals the harder way round."""
        found: dict[tuple[int, int | None], Question] = {}
        for i, j in self._all_pairs:
            key = (i, j) if j is None else (min(i, j), max(i, j))
            asked = Question(
                self.candidates[i].names,
                () if j is None else self.candidates[j].names,
                None if before is None else self.evidence(before, i, j),
                self.evidence(after, i, j),
            )
            if key not in found or asked.after < found[key].after:
                found[key] = asked
        return tuple(found.values())

    def precision(
        self, before: np.ndarray | None, after: np.ndarray, seconds: float | None, planned: float
    ) -> tuple[Precision, ...]:
        """Half widths of the 95 % intervals of each candidate's parameters, with all that is fitted anyhow."""
        found = []
        for c, own in zip(self.candidates, self.own, strict=True):
            labels = [(n, p) for n in c.names for p in self.known[n].parameters]
            values = [
                v[p.name] for v, n in zip(c.values, c.names, strict=True) for p in self.known[n].parameters
            ]
            halves = []
            for information, duration in ((before, seconds), (after, planned)):
                if information is None or duration is None:
                    halves.append([None] * len(own))
                    continue
                statistical = critical_value(duration) * self._deviations(information, own)
                halves.append(np.hypot(statistical, SCALE * np.array(values)).tolist())
            for (name, p), value, was, will in zip(labels, values, *halves, strict=True):
                found.append(Precision(name, p.name, p.unit, value, was, will))
        return tuple(found)


def _still(vehicle: Vehicle) -> Measurement:
    """A hover of six seconds, for what needs a flight to be asked at all."""
    n = round(6.0 * RATE)
    flight = Flight(
        name="hover",
        vehicle=vehicle,
        t=np.arange(n) / RATE,
        position=np.tile([0.0, 0.0, 1.3], (n, 1)),
        velocity=np.zeros((n, 3)),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        angular_velocity=np.zeros((n, 3)),
        specific_force=np.tile([0.0, 0.0, GRAVITY], (n, 1)),
        thrust_command=np.full(n, vehicle.hover_thrust),
        battery_voltage=np.full(n, vehicle.nominal_voltage),
    )
    return measure(flight)


def _choose(
    study: _Study, manoeuvres: Sequence[_Manoeuvre], known: Sequence[np.ndarray], limits: Limits
) -> list[int]:
    """The manoeuvres, in order: each the one that answers most a second, until all is answered or time is up."""
    total, chosen = study.nothing(), []
    left = limits.duration - 2.0
    while not study.answered(total):
        here = study.worth(total)
        best, rate = None, 1e-3
        for i, one in enumerate(manoeuvres):
            seconds = one.trajectory.duration
            if seconds > left:
                continue
            gain = (study.worth(total + known[i]) - here) / seconds
            if gain > rate:
                best, rate = i, gain
        if best is None:
            break
        chosen.append(best)
        total = total + known[best]
        left -= manoeuvres[best].trajectory.duration
    once = list(chosen)
    while once and limits.duration - left < LEAST:
        again = once[(len(chosen) - len(once)) % len(once)]
        if manoeuvres[again].trajectory.duration > left:
            break
        chosen.append(again)
        left -= manoeuvres[again].trajectory.duration
    return chosen


def setpoints(flown: Trajectory) -> str:
    """The trajectory as a table of setpoints that the companion and the simulator fly."""
    t = np.append(np.arange(0.0, flown.duration, SAMPLING), flown.duration)
    t = t[np.append(np.diff(t) > 1e-6, True)]
    c = flown.sample(t)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["t", *"xyz", "vx", "vy", "vz", "ax", "ay", "az", "yaw"])
    rows = np.column_stack([c.t, c.position, c.velocity, c.acceleration, c.yaw])
    writer.writerows([f"{value:.6f}" for value in row] for row in rows)
    return out.getvalue()
