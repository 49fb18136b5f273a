"""Which effect on the vehicle's rotation is missing: measured in the angular acceleration, from each rotor's thrust.

The torque of the rotors over the inertia is compared with the gyroscope's derivative. What no vehicle file knows well
is fitted beside every effect, so that it is not taken for one: a gain of the control torque about each axis (inertia,
thrust and drag-torque constants), a shift in time of it, damping by the body's rates, the torque of edgewise flow on
the rotors (flapping), and the rotors' spin-up about z. Effects are chosen as in `identify.translation`: given all
others, on held-out blocks, with inference that holds under autocorrelated residuals.

Body rates against their command (`rate_loop_lag`) need no rotor data and are judged on their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import optimize, stats

from trueflight.groundstation.identify.actuation import fit_rate_loop, rate_loop_sensitivity
from trueflight.groundstation.identify.fitting import (
    BLOCK,
    Fit,
    FreeParameter,
    block_errors,
    critical_value,
    robust_covariance,
    variance_per_independent_sample,
)
from trueflight.groundstation.measured.measurement import Rotation, measure_rotation
from trueflight.groundstation.results import EffectVerdict, ParameterEstimate, RotationalRms
from trueflight.models.effect import Effect, Motion, Parameter, Stage
from trueflight.models.effects import catalogue
from trueflight.models.flight import Flight
from trueflight.models.frames import rotate_inverse
from trueflight.models.lag import delayed, lagged
from trueflight.models.model import Term
from trueflight.models.prediction import apply_effects, derivative, motion_of_flight

FAMILY = 0.01
"""Probability that any rotational effect at all is significant by chance."""
MATERIAL_SHARE = 0.01
"""Smallest part of the remaining squared error that an effect must take away on held-out blocks."""
MATERIAL_SIZE = 0.1
"""Smallest parameter that is called missing, in typical sizes: rotors of one set differ by a percent."""
STRONG_EVIDENCE = 6.0
"""Twice the log likelihood ratio from which one explanation is told from another (Kass & Raftery 1995)."""
SURE_TO_SEE = 0.8
"""Power below which a flight is said not to have excited an effect."""
UNBELIEVED_LAG = 0.15
"""s of lag and delay of a rate loop that are granted to a vehicle whose file says nothing of it: what look-ahead can
still make good (`models.contract.ACTUATION_LIMITS`). Beyond, no attitude loop is fast enough to fly on."""
RATE_TOLERANCE = 1.5
"""Factor on the vehicle file's rate_time_constant, which is known from a step or a design, not from a fit."""

LOOP_PER_ROTOR = 2.0
"""s by which a rate loop with 60 degrees of phase margin slows down for every s that its rotors are later."""

Choice = tuple[str, tuple[str, ...]]
"""An effect and those of its parameters that act."""


@dataclass(frozen=True)
class RotationalFindings:
    """What the rotation of a flight says: verdicts, the terms found, and the residual where rotors were recorded."""

    verdicts: tuple[EffectVerdict, ...]
    terms: tuple[Term, ...]
    rms: RotationalRms | None


def judge_rotation(
    flight: Flight, included: Sequence[str] = (), effects_directory: str | None = None
) -> RotationalFindings:
    """Verdicts on all effects on the torque; `included` are in the model already."""
    known = {n: e for n, e in catalogue(effects_directory).items() if e.rotational and n not in included}
    verdicts: list[EffectVerdict] = []
    terms: list[Term] = []
    rms = None
    torque = {n: e for n, e in known.items() if e.stage is not Stage.RATE}
    measurable = {n: e for n, e in torque.items() if not e.lacks(flight)}
    problem = torque_problem(flight) if measurable else None
    if problem is not None:
        search = _Search(problem, measurable)
        verdicts += search.run()
        terms += search.terms()
        rms = search.rms()
    verdicts += [_unmeasured(e, flight) for n, e in torque.items() if problem is None or n not in measurable]
    return RotationalFindings(tuple(verdicts), tuple(terms), rms)


def judge_rates(
    flight: Flight, included: Sequence[str] = (), effects_directory: str | None = None, later: float = 0.0
) -> tuple[list[EffectVerdict], list[Term]]:
    """Verdicts on how body rates follow their command, and the terms found; `later` s is by how much more than
    believed the rotors were found to lag theirs."""
    verdicts, terms = [], []
    for name, effect in catalogue(effects_directory).items():
        if effect.stage is Stage.RATE and name not in included:
            verdict, term = _judge_rates(effect, flight, later)
            verdicts.append(verdict)
            terms += [] if term is None else [term]
    return verdicts, terms


def fit_rotation(flight: Flight, effect: Effect) -> Term | None:
    """`effect` alone, fitted to the rotation of `flight`; None where the flight cannot tell."""
    if effect.stage is Stage.RATE:
        loop = fit_rate_loop([flight])
        return None if loop is None else Term(effect.name, {"lag": loop.lag, "delay": loop.delay})
    problem = torque_problem(flight)
    if problem is None:
        return None
    search = _Search(problem, {effect.name: effect})
    choices = [(c,) for c in search.choices]
    best = min(choices, key=lambda c: search.fit(c).sse)
    return search.term(search.fit(best), best[0])


# --- torque ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TorqueProblem:
    """The measured angular acceleration and the columns that explain it, filtered and thinned alike.

    `motion` is the flight with each rotor's thrust as late as it acts.
    """

    measurements: tuple[Rotation, ...]
    motion: Motion
    inertia: np.ndarray

    def unit(self) -> float:
        """Squared error worth one independent sample, in units of the weighted residual."""
        return 1.0

    @property
    def rotation(self) -> Rotation:
        """The one measured flight."""
        return self.measurements[0]

    def columns(self, torque: np.ndarray) -> np.ndarray:
        """Angular acceleration (K, 3) of a torque (N, 3) on the believed inertia, at the used samples."""
        return self.rotation.smooth(torque / self.inertia)[self.rotation.used]

    @cached_property
    def measured(self) -> np.ndarray:
        """Angular acceleration (K, 3), rad/s², without what Euler's equations give to the believed inertia."""
        rate = self.motion.body_rate
        euler = np.cross(rate, rate * self.inertia) / self.inertia
        r = self.rotation
        return r.value[r.used] + r.smooth(euler)[r.used]

    @cached_property
    def control(self) -> np.ndarray:
        """Angular acceleration (K, 3) of the rotors' thrusts without any effect."""
        return self.columns(apply_effects(self.motion, ()).torque)

    @cached_property
    def nuisances(self) -> list[tuple[str, np.ndarray]]:
        """Name and column (K, 3) of what is fitted beside every effect, apart from the control torque's gains."""
        motion, r = self.motion, self.rotation
        torque = apply_effects(motion, ()).torque / self.inertia
        rate, shift = motion.body_rate, derivative(torque, self.rotation.flight.t)
        found = []
        for axis, name in enumerate("xyz"):
            only = np.eye(3)[axis]
            found += [(f"shift_{name}", shift * only), (f"damping_{name}", rate * only)]
        speeds = np.sqrt(np.clip(motion.rotor_thrust, 0.0, None))
        spin = derivative(speeds @ np.array(motion.vehicle.rotor_directions, float)[:, None], r.flight.t)
        found.append(("spin_up", spin * np.eye(3)[2]))
        if motion.air_velocity is not None and r.flight.velocity is not None:
            body = rotate_inverse(r.flight.quaternion, r.flight.velocity)  # type: ignore[arg-type]
            found += [
                ("flapping_x", body[:, 1:2] * np.eye(3)[0]),
                ("flapping_y", body[:, 0:1] * np.eye(3)[1]),
            ]
        kept = []
        for name, column in found:
            seen = r.smooth(column)[r.used]
            size = float(np.sqrt(np.mean(seen**2)))
            if size > 1e-9:
                kept.append((name, seen / size))
        return kept

    def blocks(self) -> np.ndarray:
        """Number of the held-out block of each used sample (K,)."""
        r = self.rotation
        _, block = np.unique(((r.t[r.used] - r.t[0]) / BLOCK).astype(int), return_inverse=True)
        return block


def torque_problem(flight: Flight) -> TorqueProblem | None:
    """The rotation of a flight with rotor speeds or motor commands; None where it cannot be compared."""
    rotation = measure_rotation(flight)
    motion = motion_of_flight(flight)
    if rotation is None or motion.rotor_thrust is None or len(flight.vehicle.rotor_positions) != 4:
        return None
    inertia = np.array(flight.vehicle.inertia, dtype=float)
    if np.any(inertia <= 0.0):  # not told: every axis has a gain of its own anyway
        arm = float(np.mean(np.abs(np.array(flight.vehicle.rotor_positions)[:, :2])))
        inertia = np.array([0.4, 0.4, 0.8]) * flight.vehicle.mass * max(arm, 1e-3) ** 2
    motion = motion.with_(torque=np.zeros_like(rotation.flight.angular_velocity))
    if flight.rotor_speed is None:
        motion = _as_late_as_it_acts(motion, rotation, inertia)
    problem = TorqueProblem((rotation,), motion, inertia)
    return problem if float(np.std(problem.control[:, :2])) > 1e-6 else None


def _as_late_as_it_acts(motion: Motion, rotation: Rotation, inertia: np.ndarray) -> Motion:
    """Motor commands through the delay and lag with which their torque is best seen in the angular acceleration."""
    speeds = np.sqrt(np.clip(motion.rotor_thrust, 0.0, None))
    dt = motion.dt

    def acting(delay: float, tau: float) -> Motion:
        late = [lagged(delayed(column, delay, dt), tau, dt) ** 2 for column in speeds.T]
        return motion.with_(rotor_thrust=np.stack(late, axis=1))

    measured = rotation.value[rotation.used][:, :2]

    def misfit(x: np.ndarray) -> float:
        torque = apply_effects(acting(*x), ()).torque / inertia
        seen = rotation.smooth(torque[:, :2])[rotation.used]
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
    return acting(*found.x)


class _Search:
    """Forward selection of torque effects with a backward check; fits are kept by their set of choices."""

    def __init__(self, problem: TorqueProblem, effects: dict[str, Effect]) -> None:
        self.problem, self.effects = problem, effects
        self.choices: list[Choice] = []
        for name, effect in effects.items():
            names = tuple(p.name for p in effect.parameters)
            self.choices += [(name, (n,)) for n in names] if effect.exclusive else [(name, names)]
        self.significance = FAMILY / max(1, len(self.choices))
        self.blocks = problem.blocks()
        self._columns = {
            (name, p.name): self._contribution(effect, p)
            for name, effect in effects.items()
            for p in effect.parameters
        }
        self._fits: dict[frozenset[Choice], Fit] = {}
        self.weight = np.ones(3)
        everything = [(n, tuple(p.name for p in e.parameters)) for n, e in effects.items()]
        left = self._solve(everything).residual
        self.weight = 1.0 / np.maximum(np.sqrt(np.mean(left**2, axis=0)), 1e-9)
        self.found: tuple[Choice, ...] = ()

    def _contribution(self, effect: Effect, parameter: Parameter) -> np.ndarray:
        """Angular acceleration (K, 3) of a unit of the parameter: these effects are linear in theirs."""
        neutral = effect.neutral(self.problem.motion.vehicle)
        moved = {**neutral, parameter.name: parameter.typical}
        with_it = self.problem.columns(apply_effects(self.problem.motion, [(effect, moved)]).torque)
        without = self.problem.columns(apply_effects(self.problem.motion, [(effect, neutral)]).torque)
        return (with_it - without) / (parameter.typical - neutral[parameter.name])

    def fit(self, choices: Sequence[Choice]) -> Fit:
        """The nuisances and the effects of `choices`, fitted together; weighted residuals."""
        key = frozenset(choices)
        if key not in self._fits:
            self._fits[key] = self._solve(choices)
        return self._fits[key]

    def _solve(self, choices: Sequence[Choice]) -> Fit:
        problem = self.problem
        gains = [(f"gain_{n}", problem.control * np.eye(3)[i]) for i, n in enumerate("xyz")]
        others = [*gains, *problem.nuisances]
        own = [(name, p) for name, names in choices for p in self.effects[name].parameters if p.name in names]
        linear = np.stack([c for _, c in others], axis=2) * self.weight[None, :, None]
        shapes = [self._columns[name, p.name] * self.weight for name, p in own]
        k = len(linear)
        fixed = linear.shape[2]
        measured = problem.measured * self.weight
        x = np.zeros(fixed + len(own))
        x[:3] = 1.0
        for _ in range(12):
            gain = x[:3]
            scaled = [c * gain for c in shapes]
            jacobian = np.concatenate([linear, *(c[:, :, None] for c in scaled)], axis=2)
            for axis in range(3):  # an effect's torque, too, goes through the axis' gain
                for value, c in zip(x[fixed:], shapes, strict=True):
                    jacobian[:, axis, axis] += value * c[:, axis]
            predicted = linear @ x[:fixed] + sum(v * c for v, c in zip(x[fixed:], scaled, strict=True))
            residual = measured - predicted
            flat = jacobian.reshape(3 * k, -1)
            step = np.linalg.lstsq(flat.T @ flat, flat.T @ residual.ravel(), rcond=1e-14)[0]
            x = x + step
            if np.max(np.abs(step) / (np.abs(x) + 1e-6)) < 1e-6:
                break
        free = [
            FreeParameter(name, _nuisance(name), 0.0, -np.inf, np.inf, 0.0, nuisance=True)
            for name, _ in others
        ]
        neutral = {name: self.effects[name].neutral(problem.motion.vehicle) for name, _ in own}
        free += [FreeParameter(name, p, 0.0, p.low, p.high, neutral[name][p.name]) for name, p in own]
        jacobian = -jacobian
        covariance, _ = robust_covariance(problem, jacobian, residual, np.zeros(len(free)))  # type: ignore[arg-type]
        r = problem.rotation
        seconds = float(r.used.sum()) * float(np.median(np.diff(r.t)))
        return Fit((), tuple(free), x, covariance, critical_value(seconds), jacobian, residual)

    # --- the steps ---------------------------------------------------------------------------------------------

    def run(self) -> list[EffectVerdict]:
        """Select, exchange, judge."""
        current: tuple[Choice, ...] = ()
        while True:
            taken = {name for name, _ in current}
            steps = [(*current, c) for c in self.choices if c[0] not in taken]
            good = [s for s in steps if self._useful(s, current)]
            if not good:
                break
            current = min(good, key=lambda s: self.fit(s).sse)
            current = self._backward(current)
        self.found = current
        return self._verdicts()

    def _backward(self, current: tuple[Choice, ...]) -> tuple[Choice, ...]:
        for choice in current[:-1]:
            without = tuple(c for c in current if c != choice)
            if not self._useful((*without, choice), without):
                return self._backward(without)
        return current

    def _useful(self, with_: tuple[Choice, ...], without: tuple[Choice, ...]) -> bool:
        """Whether the last choice of `with_` is significant, evident, plausible, and matters on held-out blocks."""
        name, names = with_[-1]
        fitted = self.fit(with_)
        held_out = (float(block_errors(self.fit(s), self.blocks).sum()) for s in (with_, without))
        here, there = held_out
        sizes = [
            abs(fitted.estimate[i] - fitted.free[i].neutral) / abs(fitted.free[i].parameter.typical)
            for i in fitted.of(name)
        ]
        return (
            fitted.wald(name) < self.significance
            and self._evidence(fitted, self.fit(without)) > STRONG_EVIDENCE + 2.0 * len(names)
            and (there - here) / here > MATERIAL_SHARE
            and max(sizes) > MATERIAL_SIZE
            and all(self._plausible(fitted, n) for n, _ in with_)
        )

    def _evidence(self, for_: Fit, against: Fit) -> float:
        unit = variance_per_independent_sample(self.problem, for_.residual)  # type: ignore[arg-type]
        return (against.sse - for_.sse) / unit

    def _plausible(self, fitted: Fit, name: str) -> bool:
        return all(
            fitted.free[i].parameter.low <= fitted.estimate[i] <= fitted.free[i].parameter.high
            for i in fitted.of(name)
        )

    # --- the verdicts ------------------------------------------------------------------------------------------

    def term(self, fitted: Fit, choice: Choice) -> Term:
        """The effect with its values and intervals."""
        name, _ = choice
        values = self.effects[name].neutral(self.problem.motion.vehicle)
        intervals = {}
        for i in fitted.of(name):
            values[fitted.free[i].parameter.name] = float(fitted.estimate[i])
            intervals[fitted.free[i].parameter.name] = fitted.interval(i)
        return Term(name, values, intervals)

    def terms(self) -> list[Term]:
        """What was found."""
        return [self.term(self.fit(self.found), choice) for choice in self.found]

    def rms(self) -> RotationalRms:
        """Residual of the rotors' torque alone, and of what was found, rad/s² over all axes."""
        r = self.problem.rotation
        residuals = (self.fit(c).residual / self.weight for c in ((), self.found))
        before, after, noise = (float(np.sqrt(np.mean(x**2))) for x in (*residuals, r.noise))
        return RotationalRms(before, after, noise, r.bandwidth)

    def _verdicts(self) -> list[EffectVerdict]:
        before = self.fit(()).sse
        out = []
        shares = []
        for choice in self.found:
            without = self.fit(tuple(c for c in self.found if c != choice))
            shares.append(((without.sse - self.fit(self.found).sse) / before, choice))
        stands_for: dict[str, str] = {}
        for rank, (share, choice) in enumerate(sorted(shares, reverse=True), 1):
            name, _ = choice
            effect, fitted = self.effects[name], self.fit(self.found)
            same = self._rivals(choice)
            stands_for |= {rival: name for rival in same}
            out.append(
                EffectVerdict(
                    name,
                    "possible" if same else "missing",
                    rank,
                    float(np.clip(share, 0.0, 1.0)),
                    fitted.wald(name),
                    _estimates(fitted, name),
                    (*same, *effect.aliases),
                    f"to tell it from {', '.join(same)}, fly {effect.manoeuvre}"
                    if same
                    else f"add it: groundstation model add {name}",
                    "rotation",
                )
            )
        for name in self.effects:
            if name not in {n for n, _ in self.found}:
                out.append(self._absent(name, stands_for.get(name)))
        return out

    def _rivals(self, choice: Choice) -> tuple[str, ...]:
        """Effects that could stand in for the one of `choice` at no cost."""
        rest = tuple(c for c in self.found if c != choice)
        taken = {n for n, _ in rest} | {choice[0]}
        here = self.fit(self.found)
        rivals = []
        for other in self.choices:
            if other[0] in taken or other[0] in rivals:
                continue
            fitted = self.fit((*rest, other))
            equal = self._evidence(here, fitted) < STRONG_EVIDENCE
            if equal and self._plausible(fitted, other[0]) and self._useful((*rest, other), rest):
                rivals.append(other[0])
        return tuple(rivals)

    def _absent(self, name: str, stands_for: str | None) -> EffectVerdict:
        effect = self.effects[name]
        here = self.fit(self.found)
        own = [c for c in self.choices if c[0] == name]
        best = min(own, key=lambda c: self.fit((*self.found, c)).sse)
        fitted = self.fit((*self.found, best))
        share, p = (here.sse - fitted.sse) / self.fit(()).sse, fitted.wald(name)
        estimates = _estimates(fitted, name)
        if stands_for is not None:
            advice = f"to tell it from {stands_for}, fly {effect.manoeuvre}"
            return EffectVerdict(
                name, "possible", None, share, p, estimates, (stands_for,), advice, "rotation"
            )
        if not all(self._excited(here, c) for c in own):
            advice = f"to see it, fly {effect.manoeuvre}"
            return EffectVerdict(name, "not_excited", None, share, p, estimates, (), advice, "rotation")
        return EffectVerdict(name, "not_supported", None, share, p, estimates, (), "", "rotation")

    def _excited(self, here: Fit, choice: Choice) -> bool:
        """Whether this flight would have shown the effect at its typical size, beside what is being fitted."""
        name, names = choice
        acting = [p for p in self.effects[name].parameters if p.name in names]
        mine = (
            np.stack([p.typical * self._columns[name, p.name] * self.weight for p in acting])
            .sum(axis=0)
            .ravel()
        )
        fitted = here.jacobian.reshape(len(mine), -1)
        rest = mine - fitted @ np.linalg.lstsq(fitted, mine, rcond=1e-10)[0]
        energy = float(rest @ rest)
        threshold = stats.chi2.isf(self.significance, len(names)) * (here.critical / 1.96) ** 2
        unit = variance_per_independent_sample(self.problem, here.residual)  # type: ignore[arg-type]
        power = float(stats.ncx2.sf(threshold, len(names), energy / unit))
        return power > SURE_TO_SEE and energy > MATERIAL_SHARE * here.sse


def _nuisance(name: str) -> Parameter:
    return Parameter(name, "1", "fitted beside every effect", 0.0, 1.0, -np.inf, np.inf)


def _estimates(fitted: Fit, name: str) -> tuple[ParameterEstimate, ...]:
    return tuple(
        ParameterEstimate(
            fitted.free[i].parameter.name,
            float(fitted.estimate[i]),
            *fitted.interval(i),
            fitted.free[i].parameter.unit,
        )
        for i in fitted.of(name)
    )


def _unmeasured(effect: Effect, flight: Flight) -> EffectVerdict:
    """The verdict on an effect whose columns the flight lacks."""
    missing = ", ".join(effect.lacks(flight)) or "a flight that turns"
    hidden = "; without them the rate controller's integral hides its torque" if effect.needs_any else ""
    advice = f"needs {missing}{hidden}; record it, and fly {effect.manoeuvre}"
    return EffectVerdict(effect.name, "not_excited", None, 0.0, 1.0, (), (), advice, "rotation")


# --- rates ----------------------------------------------------------------------------------------------------


def _judge_rates(effect: Effect, flight: Flight, later: float) -> tuple[EffectVerdict, Term | None]:
    """The closed rate loop against what is believed of it."""
    if effect.lacks(flight):
        return _unmeasured(effect, flight), None
    loop = fit_rate_loop([flight])
    if loop is None:
        advice = f"body rates follow no loop of that kind, or hardly move; fly {effect.manoeuvre}"
        return EffectVerdict(effect.name, "not_excited", None, 0.0, 1.0, (), (), advice, "rotation"), None
    covariance, critical = rate_loop_sensitivity(flight, loop)
    period = flight.dt
    half = [critical * float(np.sqrt(max(v, 0.0))) for v in np.diag(covariance)[:2]]
    half[1] += period  # no log's clock is better
    values = {"lag": loop.lag, "delay": loop.delay}
    unit = {p.name: p.unit for p in effect.parameters}
    intervals = {n: (max(0.0, v - h), v + h) for (n, v), h in zip(values.items(), half, strict=True)}
    estimates = tuple(ParameterEstimate(n, v, *intervals[n], unit[n]) for n, v in values.items())
    believed = flight.vehicle.rate_time_constant
    granted = RATE_TOLERANCE * (believed + flight.vehicle.command_delay) + period
    if believed == 0.0:
        granted = max(UNBELIEVED_LAG, granted)
    granted += LOOP_PER_ROTOR * later
    total = loop.lag + loop.delay
    spread = critical * float(np.sqrt(max(covariance[:2, :2].sum(), 0.0)))
    z = (total - granted) / max(spread / 1.96, 1e-6)
    p = float(stats.norm.sf(z))
    late = p < FAMILY
    told = f"{1e3 * loop.lag:.0f} ms lag and {1e3 * loop.delay:.0f} ms delay"
    beyond = f"the {1e3 * granted:.0f} ms that are granted" + (
        "; set rate_time_constant in the vehicle file to hold it to less" if believed == 0.0 else ""
    )
    verdict = EffectVerdict(
        effect.name,
        "missing" if late else "not_supported",
        1 if late else None,
        float(np.clip(1.0 - loop.unexplained, 0.0, 1.0)) if late else 0.0,
        p,
        estimates,
        (),
        f"rates follow with {told}, beyond {beyond}"
        if late
        else f"rates follow with {told}, within {beyond}",
        "rotation",
    )
    return verdict, Term(effect.name, values, intervals) if late else None
