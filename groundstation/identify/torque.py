"""The torque on the vehicle, from each rotor's thrust, against the angular acceleration of the gyroscope.

The torque of the rotors over the inertia is compared with the gyroscope's derivative. What no vehicle file knows well
is fitted beside every effect, so that it is not taken for one: a gain of the control torque about each axis (inertia,
thrust and drag-torque constants), a shift in time of it, damping by the body's rates, the torque of edgewise flow on
the rotors (flapping), and the rotors' spin-up about z.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from trueflight.groundstation.identify.fitting import (
    BLOCK,
    Fit,
    FreeParameter,
    critical_value,
    robust_covariance,
)
from trueflight.groundstation.identify.search import Choice, State, whole
from trueflight.groundstation.identify.spans import EVERYWHERE, Span, Value, number
from trueflight.groundstation.measured.measurement import ROTATION_BANDWIDTH, Rotation, measure_rotation
from trueflight.groundstation.results import RotationalRms
from trueflight.models.effect import Effect, Motion, Parameter
from trueflight.models.flight import Flight
from trueflight.models.frames import rotate_inverse
from trueflight.models.lag import delayed, lagged
from trueflight.models.model import Term
from trueflight.models.prediction import apply_effects, derivative, motion_of_flight

FEWEST = 3
"""Rotors of a vehicle whose torques are told apart: with fewer, something else than their thrust turns it."""
MATERIAL_SIZE = 0.1
"""Smallest parameter that is called missing, in typical sizes: rotors of one set differ by a percent."""


@dataclass(frozen=True)
class Turning:
    """The measured angular acceleration and the columns that explain it, filtered and thinned alike, on the A axes
    that are measured.

    `motion` is the flight with each rotor's thrust as late as it acts, `actuation` the delay and lag of it in s that
    were fitted, None where rotor speeds were recorded.
    """

    rotation: Rotation
    motion: Motion
    inertia: np.ndarray
    actuation: tuple[float, float] | None = None

    def seen(self, column: np.ndarray) -> np.ndarray:
        """A column (N, 3) of angular acceleration as it is measured, (K, A)."""
        r = self.rotation
        return r.smooth(column)[r.used][:, r.axes]

    def columns(self, torque: np.ndarray) -> np.ndarray:
        """Angular acceleration (K, A) of a torque (N, 3) on the believed inertia, at the used samples."""
        return self.seen(torque / self.inertia)

    @cached_property
    def measured(self) -> np.ndarray:
        """Angular acceleration (K, A), rad/s², without what Euler's equations give to the believed inertia."""
        rate = self.motion.body_rate
        euler = np.cross(rate, rate * self.inertia) / self.inertia
        r = self.rotation
        return r.value[r.used][:, r.axes] + self.seen(euler)

    @cached_property
    def control(self) -> np.ndarray:
        """Angular acceleration (K, A) of the rotors' thrusts without any effect."""
        return self.columns(np.asarray(apply_effects(self.motion, ()).torque))

    @cached_property
    def nuisances(self) -> list[tuple[str, np.ndarray]]:
        """Name and column (K, A) of what is fitted beside every effect: first a gain of the control torque about each
        axis, which effects go through as well."""
        motion, r = self.motion, self.rotation
        torque = np.asarray(apply_effects(motion, ()).torque) / self.inertia
        rate, shift = motion.body_rate, derivative(torque, self.rotation.flight.t)
        found = []
        for axis, name in enumerate("xyz"):
            only = np.eye(3)[axis]
            found += [(f"shift_{name}", shift * only), (f"damping_{name}", rate * only)]
        speeds = np.sqrt(np.clip(motion.rotor_thrust, 0.0, None))
        spin = derivative(speeds @ np.array(motion.vehicle.rotor_directions, float)[:, None], r.flight.t)
        found.append(("spin_up", spin * np.eye(3)[2]))
        # motors that lean by a degree, or drag that differs between the two directions, turn a healthy vehicle
        found.append(("trim_z", np.sum(motion.rotor_thrust, axis=1)[:, None] * np.eye(3)[2]))
        if motion.air_velocity is not None and r.flight.velocity is not None:
            body = rotate_inverse(r.flight.quaternion, r.flight.velocity)  # type: ignore[arg-type]
            found += [
                ("flapping_x", body[:, 1:2] * np.eye(3)[0]),
                ("flapping_y", body[:, 0:1] * np.eye(3)[1]),
            ]
        along = np.eye(len(r.axes))
        kept = [(f"gain_{'xyz'[axis]}", self.control * along[i]) for i, axis in enumerate(r.axes)]
        for name, column in found:
            seen = self.seen(column)
            size = float(np.sqrt(np.mean(seen**2)))
            if size > 1e-9:
                kept.append((name, seen / size))
        return kept

    def blocks(self) -> np.ndarray:
        """Number of the held-out block of each used sample (K,)."""
        r = self.rotation
        _, block = np.unique(((r.t[r.used] - r.t[0]) / BLOCK).astype(int), return_inverse=True)
        return block


def turning_of(flight: Flight, bandwidth: float = ROTATION_BANDWIDTH) -> Turning | None:
    """The rotation of a flight with rotor speeds or motor commands, below `bandwidth` Hz; None where it cannot be
    compared."""
    rotation = measure_rotation(flight, bandwidth)
    if rotation is None:
        return None
    flight = rotation.flight
    motion = motion_of_flight(flight)
    if motion.rotor_thrust is None or len(flight.vehicle.rotor_positions) < FEWEST:
        return None
    inertia = np.array(flight.vehicle.inertia, dtype=float)
    if np.any(inertia <= 0.0):  # not told: every axis has a gain of its own anyway
        arm = float(np.mean(np.abs(np.array(flight.vehicle.rotor_positions)[:, :2])))
        inertia = np.array([0.4, 0.4, 0.8]) * flight.vehicle.mass * max(arm, 1e-3) ** 2
    motion = motion.with_(torque=np.zeros_like(flight.angular_velocity))
    actuation = None
    if flight.rotor_speed is None:
        motion, actuation = _as_late_as_it_acts(motion, rotation, inertia)
    turning = Turning(rotation, motion, inertia, actuation)
    tilts = [i for i, axis in enumerate(rotation.axes) if axis < 2]
    return turning if float(np.std(turning.control[:, tilts])) > 1e-6 else None


def _as_late_as_it_acts(
    motion: Motion, rotation: Rotation, inertia: np.ndarray
) -> tuple[Motion, tuple[float, float]]:
    """Motor commands through the delay and lag, s, with which their torque is best seen in the angular acceleration."""
    from scipy import optimize  # dear to load

    speeds = np.sqrt(np.clip(motion.rotor_thrust, 0.0, None))
    dt = motion.dt

    def acting(delay: float, tau: float) -> Motion:
        late = [lagged(delayed(column, delay, dt), tau, dt) ** 2 for column in speeds.T]
        return motion.with_(rotor_thrust=np.stack(late, axis=1))

    tilts = [axis for axis in rotation.axes if axis < 2]
    measured = rotation.value[rotation.used][:, tilts]

    def misfit(x: np.ndarray) -> float:
        torque = np.asarray(apply_effects(acting(*x), ()).torque) / inertia
        seen = rotation.smooth(torque[:, tilts])[rotation.used]
        seen = seen - seen.mean(axis=0)
        gain = np.sum(seen * measured, axis=0) / np.maximum(np.sum(seen**2, axis=0), 1e-12)
        return float(np.sum((measured - measured.mean(axis=0) - gain * seen) ** 2))

    start = np.array([motion.delay, max(motion.tau, 0.02)])
    found = optimize.minimize(
        misfit,
        start,
        method="Nelder-Mead",
        bounds=[(0.0, 0.3), (0.0, 0.4)],
        options={"xatol": 1e-3, "maxfev": 60},
    )
    delay, tau = (float(x) for x in found.x)
    return acting(delay, tau), (delay, tau)


class OfRotation:
    """What every search in the rotation answers alike, of one flight or of several: a handful of candidates, linear in
    their sizes but for the gain of the control torque, and no held-out flight."""

    def contribution(self, here: Fit, choice: Choice, through: str | None = None) -> np.ndarray:
        """As in `identify.search.Problem`."""
        raise NotImplementedError

    def linearised_gain(self, here: Fit, step: tuple[Choice, ...]) -> float:
        """Reduction of the squared error by the step, at the gains of the control torque found so far."""
        residual = here.residual.ravel()
        own = [self.contribution(here, choice) for choice in step]
        matrix = np.column_stack([here.jacobian.reshape(len(residual), -1), *own])
        solution = np.linalg.lstsq(matrix.T @ matrix, matrix.T @ residual, rcond=1e-14)[0]
        return float(residual @ matrix @ solution)

    def beside(self, here: Fit, choice: Choice) -> Fit | None:
        """None: a fit in full takes no longer."""
        return None

    def adequate(self, here: Fit) -> bool:
        """True: with a handful of candidates, each step sees all there is."""
        return True

    def scale_of_thrust(self, here: Fit) -> None:
        """None: a gain about each axis is fitted beside every effect."""

    def matters(self, with_: State, without: State, step: tuple[Choice, ...]) -> bool:
        """Whether each effect of the step has a parameter larger than `MATERIAL_SIZE` of its typical size."""

        def size(name: str) -> float:
            own = [(with_.fit.estimate[i], with_.fit.free[i]) for i in with_.fit.of(name)]
            return max(float(abs(x - f.neutral) / abs(f.parameter.typical)) for x, f in own)

        return all(size(c.effect) > MATERIAL_SIZE for c in step)

    def visible(self, energy: float) -> bool:
        """Whatever the gyroscope sees: what is of interest is told by the size of the parameters."""
        return True

    def held_out_error(self, fitted: Fit) -> float | None:
        """None: the rotation is judged on held-out blocks alone."""
        return None


@dataclass(frozen=True)
class TorqueProblem(OfRotation):
    """The angular acceleration of a flight against its rotors' torque and more effects: the `Problem` of a search.

    `effects` are all that act on the torque, `included` those of the model, `candidates` those that may be missing;
    `weighed_with` are those that are known to change in flight, for the weight of the axes.
    """

    turning: Turning
    effects: Mapping[str, Effect]
    candidates: tuple[str, ...]
    included: tuple[str, ...] = ()
    settled: tuple[Choice, ...] = ()
    weighed_with: tuple[Choice, ...] = ()
    _seen: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)

    @cached_property
    def choices(self) -> tuple[Choice, ...]:
        """The candidates; of an exclusive effect one for each parameter."""
        found: list[Choice] = []
        for effect in (self.effects[n] for n in self.candidates):
            alone = [Choice(effect.name, (p.name,)) for p in self._own_parameters(effect)]
            found += alone if effect.exclusive else [whole(effect)]
        return tuple(found)

    @property
    def measurements(self) -> tuple[Rotation, ...]:
        """As in `identify.fitting.Measured`."""
        return (self.turning.rotation,)

    @cached_property
    def blocks(self) -> np.ndarray:
        """Number of the held-out block of each sample (K,)."""
        return self.turning.blocks()

    @cached_property
    def weight(self) -> np.ndarray:
        """Of each axis (A,), s²/rad: one over what is left of it with all candidates fitted."""
        named = {c.effect: c for c in self.weighed_with}
        everything = tuple(
            named.get(n, Choice(n, tuple(p.name for p in self._own_parameters(self.effects[n]))))
            for n in self.candidates
        )
        left = self._solve(everything, np.ones(len(self.turning.rotation.axes))).residual
        return 1.0 / np.maximum(np.sqrt(np.mean(left**2, axis=0)), 1e-9)

    def unit(self) -> float:
        """Squared error worth one independent sample, in units of the weighted residual."""
        return 1.0

    def column(self, name: str, parameter: Parameter) -> np.ndarray:
        """Angular acceleration (K, A) of a unit of the parameter: these effects are linear in theirs."""
        key = (name, parameter.name)
        if key not in self._seen:
            effect, motion = self.effects[name], self.turning.motion
            neutral = effect.neutral(motion.vehicle)
            moved = {**neutral, parameter.name: parameter.typical}
            with_it = self.turning.columns(np.asarray(apply_effects(motion, [(effect, moved)]).torque))
            without = self.turning.columns(np.asarray(apply_effects(motion, [(effect, neutral)]).torque))
            self._seen[key] = (with_it - without) / (parameter.typical - neutral[parameter.name])
        return self._seen[key]

    def _own_parameters(self, effect: Effect) -> tuple[Parameter, ...]:
        return effect.parameters_of(self.turning.motion.vehicle)

    def _own(self, choice: Choice) -> list[tuple[Parameter, Span]]:
        return [
            (p, span)
            for p in self.effects[choice.effect].parameters
            if p.name in choice.parameters
            for span in choice.spans or (EVERYWHERE,)
        ]

    def _during(self, span: Span, column: np.ndarray) -> np.ndarray:
        """A column (K, A) in its span, and nothing outside."""
        if span == EVERYWHERE:
            return column
        r = self.turning.rotation
        t = r.t[r.used]
        return np.where(((t >= span.start) & (t < span.stop))[:, None], column, 0.0)

    def fit(self, choices: tuple[Choice, ...], near: Fit | None = None) -> Fit:
        """The nuisances and the effects of `choices`, fitted together; weighted residuals."""
        return self._solve(choices, self.weight)

    def _solve(self, choices: tuple[Choice, ...], weight: np.ndarray) -> Fit:
        turning = self.turning
        own = [(c.effect, p, span) for c in choices for p, span in self._own(c)]
        linear = np.stack([c for _, c in turning.nuisances], axis=2) * weight[None, :, None]
        shapes = [self._during(span, self.column(name, p)) * weight for name, p, span in own]
        x, jacobian, residual = _through_gains(turning.measured * weight, linear, shapes)
        neutral = {name: self.effects[name].neutral(turning.motion.vehicle) for name, _, _ in own}
        free = [
            FreeParameter(name, _nuisance(name), 0.0, -np.inf, np.inf, 0.0, nuisance=True, flat=True)
            for name, _ in turning.nuisances
        ]
        free += [
            FreeParameter(name, p, 0.0, p.low, p.high, neutral[name][p.name], flat=True, span=span)
            for name, p, span in own
        ]
        covariance, _ = robust_covariance(self, -jacobian, residual, np.zeros(len(free)))
        r = turning.rotation
        seconds = float(r.used.sum()) * float(np.median(np.diff(r.t)))
        fitted = Fit((), tuple(free), x, covariance, critical_value(seconds), -jacobian, residual)
        spanned = {c.effect: self._over_time(fitted, c) for c in choices if c.spans}
        return replace(fitted, terms=tuple(self._term(fitted, c) for c in choices), spanned=spanned)

    def _over_time(self, fitted: Fit, choice: Choice) -> dict[str, Value]:
        """The effect's values in each of its spans."""
        none = self.effects[choice.effect].neutral(self.turning.motion.vehicle)
        parts: dict[str, list[tuple[Span, float]]] = {}
        for i in fitted.of(choice.effect):
            free = fitted.free[i]
            parts.setdefault(free.parameter.name, []).append((free.span, float(fitted.estimate[i])))
        return {name: number(own, none[name]) for name, own in parts.items()}

    def _term(self, fitted: Fit, choice: Choice) -> Term:
        """The effect with its values and intervals."""
        values = self.effects[choice.effect].neutral(self.turning.motion.vehicle)
        intervals = {}
        for i in fitted.of(choice.effect):
            values[fitted.free[i].parameter.name] = float(fitted.estimate[i])
            intervals[fitted.free[i].parameter.name] = fitted.interval(i)
        return Term(choice.effect, values, intervals)

    def contribution(self, here: Fit, choice: Choice, through: str | None = None) -> np.ndarray:
        """What the choice at its typical size adds to the weighted angular acceleration, (3 K, P), one column each
        parameter; it is the same beside whatever else acts."""
        columns = (
            p.typical * self._during(span, self.column(choice.effect, p)) * self.weight
            for p, span in self._own(choice)
        )
        return np.column_stack([c.ravel() for c in columns])

    def rms(self, before: Fit, after: Fit) -> RotationalRms:
        """Residual of the rotors' torque alone, and of what was found, rad/s² over all axes."""
        r = self.turning.rotation
        residuals = (fitted.residual / self.weight for fitted in (before, after))
        was, left, noise = (float(np.sqrt(np.mean(x**2))) for x in (*residuals, r.noise[list(r.axes)]))
        return RotationalRms(was, left, noise, r.bandwidth, r.source)


def _through_gains(
    measured: np.ndarray, linear: np.ndarray, shapes: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares of `measured` (K, A) on the columns `linear` (K, A, F), whose first A are the gains of the
    control torque about each axis, and `shapes`, each (K, A), which go through those gains as well: estimate (F + P),
    derivative of the prediction (K, A, F + P) and residual, by Gauss-Newton."""
    fixed, axes = linear.shape[2], linear.shape[1]
    x = np.zeros(fixed + len(shapes))
    x[:axes] = 1.0
    for _ in range(12):
        scaled = [c * x[:axes] for c in shapes]
        jacobian = np.concatenate([linear, *(c[:, :, None] for c in scaled)], axis=2)
        for axis in range(axes):  # an effect's torque, too, goes through the axis' gain
            for value, c in zip(x[fixed:], shapes, strict=True):
                jacobian[:, axis, axis] += value * c[:, axis]
        predicted = linear @ x[:fixed] + sum(v * c for v, c in zip(x[fixed:], scaled, strict=True))
        residual = measured - predicted
        flat = jacobian.reshape(residual.size, -1)
        step = np.linalg.lstsq(flat.T @ flat, flat.T @ residual.ravel(), rcond=1e-14)[0]
        x = x + step
        if np.max(np.abs(step) / (np.abs(x) + 1e-6)) < 1e-6:
            break
    return x, jacobian, residual


def _nuisance(name: str) -> Parameter:
    return Parameter(name, "1", "fitted beside every effect", 0.0, 1.0, -np.inf, np.inf)
