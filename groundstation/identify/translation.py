"""Which physical effect is missing from a model, from one flight and, better, a held-out one.

Forward selection over the catalogue with a backward check after every step. A candidate is screened by its
linearisation at the current optimum; the best are fitted in full, given everything already in the model. It
stays only if it is significant under autocorrelated residuals, matters in size, predicts held-out blocks
better and has a physically plausible value. Afterwards every effect found is exchanged for each of its
rivals: where the exchange costs nothing, the data cannot tell them apart, and both are reported as possible.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from trueflight.groundstation.identify.fitting import (
    Fit,
    Problem,
    block_errors,
    fit,
    free_parameters,
    model_of,
    robust_covariance,
    variance_per_independent_sample,
    with_clock,
)
from trueflight.groundstation.identify.remainder import unexplained
from trueflight.groundstation.identify.rotation import RotationalFindings, judge_rates, judge_rotation
from trueflight.groundstation.identify.rotors import RotorProblem, has_rotor_speeds
from trueflight.groundstation.measured.measurement import Measurement, measure
from trueflight.groundstation.results import Diagnosis, EffectVerdict, ParameterEstimate
from trueflight.models.effect import Effect, Parameter, Stage
from trueflight.models.effects import catalogue, effect_named
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.model import Model, Term

FAMILY = 0.01
"""Probability that any effect at all is significant by chance, shared by all candidates (Bonferroni)."""
MATERIAL_SHARE = 0.01
"""Smallest part of the remaining squared error that an effect must take away on held-out blocks."""
MATERIAL_ACCELERATION = 0.02
"""m/s² RMS; smaller effects are within the bias stability of a MEMS accelerometer (2 mg)."""
SURE_TO_SEE = 0.8
"""Power below which a flight is said not to have excited an effect."""
SCREENED = 3
"""Acceptable candidates fitted in full at each step, the most promising first."""
STRONG_EVIDENCE = 6.0
"""Twice the log likelihood ratio from which one explanation is told from another (Kass & Raftery 1995)."""
LINEARISED = 2.0
"""Factor that the linearised gain of an effect is trusted to, before a full fit is saved by it."""
LONG, PART = 240.0, 20.0
"""s of flight beyond which effects are looked for in parts of so many s, as much altogether, spread evenly; what is
found is fitted to all of the flight and dropped where that does not support it."""
MOST_EFFECTS = 6


@dataclass(frozen=True)
class _State:
    """A fitted set of effects on the way."""

    added: tuple[str, ...]
    fit: Fit
    cv: np.ndarray

    @property
    def cv_total(self) -> float:
        return float(self.cv.sum())


def diagnose(
    flight: Flight,
    base: Model,
    validation: Flight | None = None,
    bandwidth: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Find the effects that `base` lacks on `flight`, checked on held-out blocks and on `validation`.

    A network of `base` is held as it is: what it has learnt is not missing any more.

    Raises `InputError` where the flight lacks the columns for any comparison, or is too short.
    """
    whole = Problem((measure(flight, bandwidth),), base.effects_directory, base.network_chain())
    held_out = None if validation is None else measure(validation, bandwidth)
    progress("looking at the rotation")
    rotation = judge_rotation(flight, base.names(), base.effects_directory)
    everything = _Search(whole, base, held_out, rotation, progress)
    search = everything
    if flight.duration > LONG:
        parts = replace(whole, measurements=_spread(flight, bandwidth) or whole.measurements)
        search = _Search(parts, base, held_out, rotation, progress)
    if has_rotor_speeds(flight):
        progress("looking between command and rotors")
        search.on_the_way = _on_the_way(search, base, rotation)
    found = search.select()
    if search is everything:
        return search.report(found, everything)
    progress("fitting what was found to the whole flight")
    kept = everything.settle(found.added)
    return search.report(search.state(kept.added), everything)


def _on_the_way(search: _Search, base: Model, rotation: RotationalFindings) -> tuple[Term, ...]:
    """The effects that rotor speeds show between command and rotor.

    None where they leave more of the rotors' thrust unexplained than the accelerometer's noise: there the rotors did
    not follow the collective (a saturated mixer), and prove nothing.
    """
    problem = RotorProblem(search.problem.measurements, base.effects_directory)
    path = _Search(problem, base, None, replace(rotation, terms=()), lambda _: None)
    path.candidates = [n for n in path.candidates if path.known[n].before_rotors]
    path.beside = tuple(n for n, e in path.known.items() if e.scales_rotors and n not in base.names())
    found = path.select()
    left = np.sqrt(found.fit.sse / path.samples)
    floor = min(float(m.noise[2]) for m in problem.measurements)
    return tuple(t for t in found.fit.terms if t.effect in found.added) if left < floor else ()


def _spread(flight: Flight, bandwidth: float | None) -> tuple[Measurement, ...]:
    """Parts of `PART` s, evenly spread over a long flight; those that cannot be compared are left out."""
    rows = round(PART / flight.dt)
    found = []
    for start in np.linspace(0, len(flight) - rows, round(LONG / PART)).astype(int):
        try:
            found.append(measure(flight.part(slice(start, start + rows)), bandwidth))
        except InputError:
            continue
    return tuple(found)


class _Search:
    """One diagnosis: fits are kept by their set of effects, for the steps visit many sets again."""

    def __init__(
        self,
        problem: Problem,
        base: Model,
        held_out: Measurement | None,
        rotation: RotationalFindings,
        progress: Callable[[str], None],
    ) -> None:
        self.problem, self.base, self.progress = problem, base, progress
        self.rotation = rotation
        self.held_out = (
            None if held_out is None else Problem((held_out,), base.effects_directory, base.network_chain())
        )
        self.blocks = problem.blocks()
        self.known = catalogue(base.effects_directory)
        self.candidates = [n for n in self.known if n not in base.names() and self._measurable(self.known[n])]
        self.samples = problem.measured().size
        self.significance = FAMILY / max(1, len(self.candidates))
        self.on_the_way: tuple[Term, ...] = ()
        """Effects that rotor speeds have shown to act before the rotors."""
        self.beside: tuple[str, ...] = ()
        """Effects fitted in every state without being judged."""
        self._states: dict[frozenset[str], _State] = {}
        self._errors_before: dict[bool, float] = {}

    @property
    def flight(self) -> Flight:
        """The flight, or its first part."""
        return self.problem.measurements[0].flight

    def _measurable(self, effect: Effect) -> bool:
        flight = self.flight
        if effect.rotational or (effect.stage is Stage.SENSOR and not flight.accelerometer):
            return False
        return bool(effect.parameters) and not effect.lacks(flight)

    def state(self, added: Sequence[str]) -> _State:
        """The base model with `added`, all of `added` fitted."""
        key = frozenset(added)
        if key not in self._states:
            near = max((k for k in self._states if k <= key), key=len, default=frozenset())
            start = {t.effect: t.values for t in self._states[near].fit.terms} if near else {}
            # what the rotation has found acts on the thrust, too, and is not fitted to it once more
            free = (*self.beside, *added)
            terms = [*self.base.terms, *self.rotation.terms, *(Term(n, start.get(n, {})) for n in free)]
            terms = self._placed(terms, added)
            fitted = fit(self.problem, terms, refit=free)
            if through := [n for n in added if self.known[n].acts_through]:
                # what acts through another can balance it far from the best fit: begin once more from "none of it"
                other = fit(self.problem, self._anew(terms, through), refit=free)
                fitted = other if self._evidence(other, fitted) > 0.0 else fitted
            self._states[key] = _State(tuple(added), fitted, block_errors(fitted, self.blocks))
        return self._states[key]

    def _anew(self, terms: list[Term], through: Sequence[str]) -> list[Term]:
        """`terms` with the effects `through` at none of it, and those that they act through at their typical size."""
        carriers = {n for name in through for n in self.known[name].acts_through} - set(self.base.names())
        values = {n: self.known[n].typical(self.problem.survey) for n in carriers}
        values |= {n: self._at_rest(self.known[n]) for n in through}
        return [replace(t, values=values.get(t.effect, t.values)) for t in terms]

    def _placed(self, terms: list[Term], added: Sequence[str]) -> list[Term]:
        """`terms` with those effects that may end in a wrong optimum begun where they explain most."""
        for name in added:
            if (starts := self.known[name].starts_for) is None:
                continue
            tried = [
                [replace(t, values=dict(place)) if t.effect == name else t for t in terms]
                for place in (
                    *(t.values for t in terms if t.effect == name and t.values),
                    *starts(self.problem.survey),
                )
            ]
            terms = min(tried, key=self._start_error)
        return terms

    def _start_error(self, terms: list[Term]) -> float:
        """Squared error before any fit; effects without a value yet at none of it."""
        chain = [
            (
                effect_named(t.effect, self.base.effects_directory),
                t.values or self._at_rest(self.known[t.effect]),
            )
            for t in terms
        ]
        return float(np.sum((self.problem.measured() - self.problem.predict(chain)) ** 2))

    # --- the steps ------------------------------------------------------------------------------------------

    def settle(self, added: Sequence[str]) -> _State:
        """The fit of `added`, without those that this flight does not support."""
        return self._agrees_with_held_out(self._backward(self.state(added)))

    def select(self) -> _State:
        """The effects that are missing."""
        current = self._backward(self.state([t.effect for t in self.on_the_way]))
        visited = {frozenset(current.added)}
        while len(current.added) < MOST_EFFECTS:
            self.progress(f"{len(current.added)} effects found, looking for the next")
            following = self._forward(current) or self._exchange(current)
            if following is None:
                break
            following = self._backward(following)
            if frozenset(following.added) in visited:
                break
            visited.add(frozenset(following.added))
            current = following
        return self._agrees_with_held_out(current)

    def _exchange(self, current: _State) -> _State | None:
        """The best state with one effect exchanged for another that explains the flight evidently better."""
        best: _State | None = None
        for name in current.added:
            for rival in self._standing_in(current, name):
                other = self.state((*(n for n in current.added if n != name), rival))
                if (
                    self._evident(other, best or current)
                    and other.cv_total < (best or current).cv_total
                    and all(self._plausible(other.fit, n) for n in other.added)
                    and self._shows(other, rival)
                ):
                    best = other
        return best

    def _steps(self, current: _State) -> list[tuple[str, ...]]:
        """What may be added at once: one effect, or two where the one acts only through the other."""
        present = {*self.base.names(), *current.added}
        steps: list[tuple[str, ...]] = []
        for name in self.candidates:
            if name in present:
                continue
            needed = self.known[name].acts_through
            if not needed or present & set(needed):
                steps.append((name,))
            else:
                steps += [(through, name) for through in needed if through in self.candidates]
        return steps

    def _forward(self, current: _State) -> _State | None:
        scored = []
        for step in self._steps(current):
            scored.append((self._screen(current, step), step))
        scored.sort(reverse=True)
        best: _State | None = None
        accepted = 0
        for promise, step in scored:
            if accepted == SCREENED or promise < MATERIAL_SHARE * current.fit.sse:
                break
            candidate = self.state((*current.added, *step))
            if not self._acceptable(candidate, current, step) or not all(
                self._shows(candidate, n) for n in step
            ):
                continue
            accepted += 1
            if best is None or self._score(candidate) < self._score(best):
                best = candidate
        return best

    def _score(self, state: _State) -> float:
        """Held-out error with a small price on every further effect, so that of two equal models the smaller
        wins."""
        return state.cv_total * (1.0 + MATERIAL_SHARE) ** len(state.added)

    def _screen(self, current: _State, step: tuple[str, ...]) -> float:
        """Reduction of the squared error by the step, linearised at the current optimum and at its typical size, at the
        best of the places where it may act."""
        starts = self.known[step[-1]].starts_for
        places = [] if starts is None else starts(self.problem.survey)
        return max(self._screened(current, step, place) for place in ({}, *places))

    def _screened(self, current: _State, step: tuple[str, ...], place: Mapping[str, float]) -> float:
        values = {t.effect: dict(t.values) for t in current.fit.terms}
        here = -current.fit.residual + 0.0
        chain = [(effect_named(n, self.base.effects_directory), v) for n, v in values.items()]
        base = self.problem.measured() + here
        columns = []
        for name in step:
            effect = self.known[name]
            at = {p.name: place[p.name] for p in effect.parameters if p.structural and p.name in place}
            neutral = dict(values.get(name, self._at_rest(effect))) | at
            rest = [(e, v) for e, v in chain if e.name != name]
            for p in _sizes(effect):
                moved = {**neutral, p.name: p.typical if p.typical != neutral[p.name] else p.typical * 1.5}
                prediction = self.problem.predict([*rest, (effect, moved)])
                columns.append((prediction - base).ravel())
            chain = [*rest, (effect, effect.typical(self.problem.survey) | at)]
            base = self.problem.predict(chain) if len(step) > 1 else base
        matrix = np.column_stack([current.fit.jacobian.reshape(self.samples, -1), *columns])
        residual = current.fit.residual.ravel()
        solution = np.linalg.lstsq(
            matrix.T @ matrix + 1e-9 * np.eye(matrix.shape[1]), matrix.T @ residual, rcond=None
        )[0]
        return float(residual @ matrix @ solution)

    def _at_rest(self, effect: Effect) -> dict[str, float]:
        """Parameter values without effect, placed where it would act on this flight."""
        placed = effect.typical(self.problem.survey)
        neutral = effect.neutral(self.problem.vehicle)
        return {p.name: placed[p.name] if p.structural else neutral[p.name] for p in effect.parameters}

    def _contribution(self, current: _State, name: str, through: str | None = None) -> np.ndarray:
        """What the effect at its typical size changes in the predicted specific force, (K A, P): one column each.

        `through` is an effect that must act, at its typical size, for this one to act.
        """
        values = {t.effect: dict(t.values) for t in current.fit.terms}
        effect = self.known[name]
        if through is not None:
            values[through] = self.known[through].typical(self.problem.survey)
        rest = [(self.known[n], v) for n, v in values.items() if n != name]
        neutral = self._at_rest(effect)
        base = self.problem.predict([*rest, (effect, neutral)])
        moved = ({**neutral, p.name: p.typical} for p in _sizes(effect))
        return np.column_stack([(self.problem.predict([*rest, (effect, m)]) - base).ravel() for m in moved])

    def _shows(self, candidate: _State, name: str) -> bool:
        """Whether the flight tells the effect from the simpler ones it may coincide with: at its typical size beyond
        them, or at its fitted size better than they do in its place."""
        beyond = [n for n in self.known[name].generalises if n in self.candidates or n in self.base.names()]
        if not beyond:
            return True
        mine = self._contribution(candidate, name).sum(axis=1)
        simpler = np.column_stack([self._contribution(candidate, n) for n in beyond])
        rest = mine - simpler @ np.linalg.lstsq(simpler, mine, rcond=None)[0]
        if self._power(candidate, float(np.sum(rest**2)), len(_sizes(self.known[name]))) > SURE_TO_SEE:
            return True
        if any(n in candidate.added or n in self.base.names() for n in beyond):
            return False
        others = [n for n in candidate.added if n != name]
        return self._evident(candidate, self.state((*others, *beyond)))

    def _power(self, current: _State, energy: float, count: int) -> float:
        """Probability that `count` parameters are significant when what they change has this squared sum."""
        threshold = stats.chi2.isf(self.significance, count) * (current.fit.critical / 1.96) ** 2
        unit = variance_per_independent_sample(self.problem, current.fit.residual)
        return float(stats.ncx2.sf(threshold, count, energy / unit))

    def _evident(self, with_: _State, without: _State) -> bool:
        """Whether the evidence for `with_` pays for its further parameters (two each, as Akaike's criterion)."""
        price = 2.0 * (len(with_.fit.free) - len(without.fit.free))
        return self._evidence(with_.fit, without.fit) > STRONG_EVIDENCE + price

    def _gain(self, with_: _State, without: _State) -> float:
        """Part of the remaining squared error on held-out blocks that `with_` takes away."""
        return (without.cv_total - with_.cv_total) / with_.cv_total

    def _acceptable(self, candidate: _State, current: _State, step: tuple[str, ...]) -> bool:
        gain = self._gain(candidate, current)
        size = np.sqrt(max(current.cv_total - candidate.cv_total, 0.0) / len(self.problem.measured()))
        return (
            gain > MATERIAL_SHARE * len(step)
            and size > MATERIAL_ACCELERATION
            and all(candidate.fit.wald(n) < self.significance for n in step)
            and self._evident(candidate, current)
            and all(self._plausible(candidate.fit, n) for n in candidate.added)
        )

    def _plausible(self, fitted: Fit, name: str) -> bool:
        """Whether each parameter's interval reaches into its physical range."""
        for i in fitted.of(name):
            _, high = fitted.interval(i)
            p = fitted.free[i].parameter
            x = fitted.estimate[i]
            if high < p.low or x > p.high + 1e-9 or (p.low != 0.0 and x < p.low - 1e-9):
                return False
        return True

    def _backward(self, current: _State) -> _State:
        """Drop what the others have made superfluous, the least useful first."""
        while True:
            weakest = None
            for name in current.added:
                without = self._without(current, name)
                useful = (
                    self._gain(current, without) > MATERIAL_SHARE
                    and current.fit.wald(name) < self.significance
                    and self._evident(current, without)
                    and self._plausible(current.fit, name)
                )
                if not useful and (weakest is None or without.cv_total < weakest.cv_total):
                    weakest = without
            if weakest is None:
                return current
            current = weakest

    def _without(self, current: _State, name: str) -> _State:
        """The state without the effect, and without those that act only through it."""
        rest = tuple(n for n in current.added if n != name)
        present = {*self.base.names(), *rest}
        return self.state(
            tuple(
                n for n in rest if not self.known[n].acts_through or present & set(self.known[n].acts_through)
            )
        )

    def _agrees_with_held_out(self, current: _State) -> _State:
        """Drop effects that predict the held-out flight worse than the model without them."""
        if self.held_out is None:
            return current
        while current.added:
            here = self._held_out_error(current)
            assert here is not None
            worse = []
            for name in current.added:
                without = self._without(current, name)
                error = self._held_out_error(without)
                assert error is not None
                if error < here * (1.0 - MATERIAL_SHARE):
                    worse.append((error, without))
            if not worse:
                break
            current = min(worse, key=lambda w: w[0])[1]
        return current

    def _held_out_error(self, state: _State) -> float | None:
        """Squared error on the held-out flight."""
        if self.held_out is None:
            return None
        chain = [(effect_named(t.effect, self.base.effects_directory), t.values) for t in state.fit.terms]
        return float(np.sum((self.held_out.measured() - self.held_out.predict(chain)) ** 2))

    # --- the verdicts ---------------------------------------------------------------------------------------

    def _rivals(self, current: _State, name: str) -> tuple[str, ...]:
        """Effects that could stand in for `name` at no cost."""
        found = []
        for rival in self._standing_in(current, name):
            other = self.state((*(n for n in current.added if n != name), rival))
            if not self._plausible(other.fit, rival):
                continue
            equal = self._evidence(current.fit, other.fit) < STRONG_EVIDENCE
            if equal and self._evident(other, self._without(current, name)):
                found.append(rival)
        return tuple(found)

    def _standing_in(self, current: _State, name: str) -> Iterator[str]:
        """Effects that could take the place of `name` among those found, by their linearisation."""
        rest = [n for n in current.added if n != name]
        present = {*self.base.names(), *rest}
        if name in {t.effect for t in self.on_the_way}:
            return  # the rotors themselves show it
        for rival in self.candidates:
            needed = self.known[rival].acts_through
            if rival in current.added or (needed and not present & set(needed)):
                continue
            if any(
                self.known[n].acts_through and not {*present, rival} & set(self.known[n].acts_through)
                for n in rest
            ):
                continue
            if not self._cannot_stand_in(current, name, rival):
                yield rival

    def _cannot_stand_in(self, current: _State, name: str, rival: str) -> bool:
        """Whether the linearised rival takes away so little of what the effect does that no fit need be made."""
        without = self._without(current, name)
        lost = without.fit.sse - current.fit.sse
        unit = variance_per_independent_sample(self.problem, current.fit.residual)
        near = LINEARISED * self._screen(without, (rival,))
        return near < lost and (lost - near) / unit > LINEARISED * STRONG_EVIDENCE

    def _evidence(self, for_: Fit, against: Fit) -> float:
        """Evidence for one fit against another with as many effects, on the scale of twice a log likelihood ratio:
        squared error in units of one independent sample, and the distance of the parameters from "no effect"."""
        unit = variance_per_independent_sample(self.problem, for_.residual)
        return (against.sse - for_.sse) / unit + against.prior_penalty - for_.prior_penalty

    def report(self, current: _State, whole: _Search) -> Diagnosis:
        """The verdicts; figures of what was found are those of the whole flight, which `whole` sees."""
        here = whole.state(current.added)
        before, all_before = self._before(), whole._before()
        verdicts = [EffectVerdict(n, "included", None, 0.0, 0.0, (), (), "") for n in self.base.names()]
        rivals = {n: self._rivals(current, n) for n in current.added}
        found = []
        for name in current.added:
            share = (self._without(current, name).fit.sse - current.fit.sse) / (before * self.samples)
            found.append((share, name))
        found.sort(reverse=True)
        for rank, (share, name) in enumerate(found, 1):
            effect, same = self.known[name], rivals[name]
            verdicts.append(
                EffectVerdict(
                    name,
                    "possible" if same else "missing",
                    rank,
                    float(np.clip(share, 0.0, 1.0)),
                    here.fit.wald(name),
                    self._estimates(here.fit, name),
                    (*same, *effect.aliases, *self._seen_as(name, here.fit)),
                    f"to tell it from {', '.join(same)}, fly {effect.manoeuvre}" if same else _add(effect),
                )
            )
        standing_in = {r: [n for n in current.added if r in rivals[n]] for r in self.candidates}
        rest = [
            self._judge_absent(current, n, standing_in[n]) for n in self.candidates if n not in current.added
        ]
        verdicts += sorted(rest, key=lambda v: (v.verdict != "possible", v.p_value))
        for name, effect in self.known.items():
            if name not in self.candidates and name not in self.base.names() and not effect.rotational:
                verdicts.append(self._judge_unmeasured(effect))
        rates, rate_terms = judge_rates(
            whole.flight, self.base.names(), self.base.effects_directory, self._later(here)
        )
        rank = len(found)
        unseen = tuple(v.name for v in rest if v.verdict == "not_excited" and self._in_command(v.name))
        if unseen:
            rates = [_possible(v, unseen) if v.verdict == "missing" else v for v in rates]
        for verdict in (*self.rotation.verdicts, *rates):
            rank += verdict.rank is not None
            verdicts.append(replace(verdict, rank=None if verdict.rank is None else rank))
        validation_after = whole._held_out_error(here)
        held_samples = 0 if self.held_out is None else self.held_out.measured().size
        m = whole.problem.measurements[0]
        axes = list(m.axes)
        shift = [float(here.fit.estimate[i]) for i, f in enumerate(here.fit.free) if f.nuisance]
        left = float(np.sqrt(here.fit.sse / whole.samples))
        final = model_of(here.fit, self.base)
        final = final.with_terms((*final.terms, *rate_terms))
        return Diagnosis(
            flight=m.flight,
            base=self.base,
            model=final,
            rms_before=float(np.sqrt(all_before)),
            rms_after=left,
            # noise cannot leave more than what is left: a vibration is stronger beyond the pass band than in it
            noise_floor=min(float(np.sqrt(np.mean(m.noise[axes] ** 2))), left),
            bandwidth=m.bandwidth,
            axes=m.axes,
            validation_before=None if self.held_out is None else float(np.sqrt(whole._before(held_out=True))),
            validation_after=None
            if validation_after is None
            else float(np.sqrt(validation_after / held_samples)),
            clock_shift=shift[0] - self.problem.vehicle.command_delay if shift else None,
            effects=tuple(verdicts),
            unexplained=unexplained(m, here.fit.residual),
            left_out=m.left_out,
            rotational=self.rotation.rms,
        )

    def _in_command(self, name: str) -> bool:
        return self.known[name].stage is Stage.COMMAND

    def _later(self, current: _State) -> float:
        """s by which rotors were found to follow their command later than believed: the rate loop is built on them."""
        vehicle = self.problem.vehicle
        found = {t.effect: t for t in current.fit.terms if t.effect in current.added}
        found |= {t.effect: t for t in self.on_the_way}
        return sum(
            max(0.0, float(term.values[p.name]) - p.neutral_for(vehicle))
            for name, term in found.items()
            for p in self.known[name].parameters
            if self._in_command(name)
        )

    def _seen_as(self, name: str, fitted: Fit) -> tuple[str, ...]:
        """Rotational effects that may be what `name` shows, where the flight lacks the columns to tell."""
        flight = self.flight
        return tuple(
            e.name
            for e in self.known.values()
            if name in e.seen_as
            and e.lacks(flight)
            and all(fitted.estimate[i] < 1.0 for i in fitted.of(name))
        )

    def _before(self, held_out: bool = False) -> float:
        """Mean squared error of the base model as it stands, nothing refitted but the clock."""
        # not functools.cache: it would keep every search of a long survey alive
        if held_out not in self._errors_before:
            self._errors_before[held_out] = self._error_before(held_out)
        return self._errors_before[held_out]

    def _error_before(self, held_out: bool) -> float:
        problem = self.held_out if held_out and self.held_out is not None else self.problem
        chain = with_clock(problem.measurements[0], self.base.chain())
        alone = [(effect, values) for effect, values in chain if effect.stage is not Stage.REMAINDER]
        return float(np.mean((problem.measured() - problem.predict(alone)) ** 2))

    def _estimates(self, fitted: Fit, name: str) -> tuple[ParameterEstimate, ...]:
        return tuple(
            ParameterEstimate(
                fitted.free[i].parameter.name,
                float(fitted.estimate[i]),
                *fitted.interval(i),
                fitted.free[i].parameter.unit,
            )
            for i in fitted.of(name)
            if np.any(fitted.jacobian[:, :, i])  # an axis that the flight does not measure has no estimate
        )

    def _judge_absent(self, current: _State, name: str, stands_for: list[str]) -> EffectVerdict:
        """The verdict on an effect that was not selected."""
        effect = self.known[name]
        present = {*self.base.names(), *current.added}
        through = None
        if effect.acts_through and not present & set(effect.acts_through):
            through = next((n for n in effect.acts_through if n in self.candidates), None)
            if through is None:
                return self._judge_unmeasured(effect)
            extended = self.state((*current.added, through, name)).fit
        elif effect.stage is Stage.COMMAND or any(p.even for p in effect.parameters):
            extended = self.state((*current.added, name)).fit
        else:
            extended = self._beside(current, name)
        share = (current.fit.sse - extended.sse) / (self._before() * self.samples)
        p = extended.wald(name)
        estimates = self._estimates(extended, name)
        if stands_for:
            # as a stand-in for the effect found, not beside it
            swapped = self.state(tuple(name if n == stands_for[0] else n for n in current.added))
            estimates = self._estimates(swapped.fit, name)
            advice = f"to tell it from {', '.join(stands_for)}, fly {effect.manoeuvre}"
            return EffectVerdict(name, "possible", None, share, p, estimates, tuple(stands_for), advice)
        if not self._excited(current, name, through):
            advice = f"to see it, fly {effect.manoeuvre}"
            return EffectVerdict(name, "not_excited", None, share, p, estimates, (), advice)
        size = np.sqrt(max(share, 0.0) * self._before())
        seen = p < self.significance and share > 0.0
        advice = f"seen, but too small to matter here: {size:.3f} m/s² RMS" if seen else ""
        return EffectVerdict(name, "not_supported", None, share, p, estimates, (), advice)

    def _beside(self, current: _State, name: str) -> Fit:
        """The effect beside all that is fitted, by one Gauss-Newton step from the present optimum."""
        effect, here = self.known[name], current.fit
        rest = self._at_rest(effect)
        own = [f for f in free_parameters(effect, self.problem.survey) if not f.parameter.structural]
        free = (*here.free, *own)
        scale = np.array([f.parameter.typical - rest[f.parameter.name] for f in own])
        columns = -self._contribution(current, name) / scale
        jacobian = np.concatenate([here.jacobian, columns.reshape(*here.residual.shape, len(own))], axis=2)
        start = np.concatenate([here.estimate, [rest[f.parameter.name] for f in own]])
        weight = np.sqrt(self.problem.unit()) / np.array([f.spread for f in free])
        flat = jacobian.reshape(self.samples, -1)
        pull = weight**2 * (start - np.array([f.neutral for f in free]))
        step = -np.linalg.solve(flat.T @ flat + np.diag(weight**2), flat.T @ here.residual.ravel() + pull)
        residual = here.residual + jacobian @ step
        covariance, critical = robust_covariance(self.problem, jacobian, residual, weight)
        return Fit(here.terms, free, start + step, covariance, critical, jacobian, residual)

    def _excited(self, current: _State, name: str, through: str | None) -> bool:
        """Whether this flight would have shown the effect at its typical size, beside what is being fitted."""
        mine = self._contribution(current, name, through).sum(axis=1)
        fitted = current.fit.jacobian.reshape(self.samples, -1)
        if fitted.shape[1]:
            mine = mine - fitted @ np.linalg.lstsq(fitted, mine, rcond=None)[0]
        energy = float(np.sum(mine**2))
        material = np.sqrt(energy / len(self.problem.measured())) > MATERIAL_ACCELERATION
        power = self._power(current, energy, len(_sizes(self.known[name])))
        return bool(material and power > SURE_TO_SEE and energy > MATERIAL_SHARE * current.fit.sse)

    def _judge_unmeasured(self, effect: Effect) -> EffectVerdict:
        """The verdict on an effect whose measurements the flight lacks."""
        missing = effect.lacks(self.flight)
        through = f" and one of {', '.join(effect.acts_through)} in the model" if effect.acts_through else ""
        advice = (
            f"needs {', '.join(missing) or 'measurements'}{through}; record it, and fly {effect.manoeuvre}"
        )
        return EffectVerdict(effect.name, "not_excited", None, 0.0, 1.0, (), (), advice)


def _possible(verdict: EffectVerdict, rivals: tuple[str, ...]) -> EffectVerdict:
    """The verdict where effects that this flight could not show would look the same."""
    advice = f"{verdict.advice}; to tell it from {', '.join(rivals)}, fly quick vertical steps as well"
    return replace(verdict, verdict="possible", indistinguishable_from=rivals, advice=advice)


def _sizes(effect: Effect) -> list[Parameter]:
    """The parameters that say how much of the effect there is."""
    return [p for p in effect.parameters if not p.structural]


def _add(effect: Effect) -> str:
    alias = f"; no flight can tell it from {', '.join(effect.aliases)}" if effect.aliases else ""
    return f"add it: groundstation model add {effect.name}{alias}"
