"""Which effects are missing: one search, whatever they are seen in.

Forward selection over the candidates with a backward check after every step. A candidate is screened by its
linearisation at the current optimum; the best are fitted in full, given everything already in the model. It stays only
if it is significant under autocorrelated residuals, matters in size, predicts held-out blocks better and has a
physically plausible value. Where no candidate helps, one that was found may be exchanged for another. Where more than
noise is left then, the first step may have been wrong: the sets of two and three that are best by their linearisation
are fitted, too. Afterwards every effect found is exchanged for each of its rivals: where the exchange costs nothing,
the data cannot tell them apart, and no more where another set explains the flight nearly as well.

What is measured, and how effects act on it, is a `Problem`: the specific force (`identify.translation`) or the angular
acceleration (`identify.rotation`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy import special

from trueflight.groundstation.identify.fitting import (
    Fit,
    Measured,
    block_errors,
    variance_per_independent_sample,
)
from trueflight.groundstation.identify.spans import EVERYWHERE, Span, changes_of, one_change_less
from trueflight.models.effect import Effect, Parameter, Stage

FAMILY = 0.01
"""Probability that any effect at all is significant by chance, shared by all candidates (Bonferroni)."""
MATERIAL_SHARE = 0.01
"""Smallest part of the remaining squared error that an effect must take away on held-out blocks."""
SURE_TO_SEE = 0.8
"""Power below which a flight is said not to have excited an effect."""
SCREENED = 3
"""Acceptable candidates fitted in full at each step, the most promising first."""
STRONG_EVIDENCE = 6.0
"""Twice the log likelihood ratio from which one explanation is told from another (Kass & Raftery 1995)."""
LINEARISED = 2.0
"""Factor that the linearised gain of an effect is trusted to, before a full fit is saved by it."""
LAW = 0.1
"""Part of what an effect does, RMS, by which the law of a vehicle may differ from the catalogue's: a measured thrust
curve is no parabola, and four rotors near the ground are not one."""
MOST_EFFECTS = 6
ACTS = 1e-3
"""Part of the held-out error from which an effect is said to act there."""
NOTHING = 0.1
"""Typical sizes below which a number is next to nothing."""
SETS = 3
"""Sets of each size that are fitted in full where more than noise is left."""


@dataclass(frozen=True, order=True)
class Choice:
    """An effect as a candidate, with the names of those of its parameters that act: all of them, or the one of an
    `exclusive` effect. With `spans`, it has a size of its own in each of them, and none outside."""

    effect: str
    parameters: tuple[str, ...]
    spans: tuple[Span, ...] = ()


def whole(effect: Effect) -> Choice:
    """The effect with all of its parameters."""
    return Choice(effect.name, tuple(p.name for p in effect.parameters))


@dataclass(frozen=True)
class State:
    """Effects on the way to a diagnosis, fitted together; `cv` (B,) squared errors on held-out blocks."""

    choices: tuple[Choice, ...]
    fit: Fit
    cv: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its effects, in the order in which they were added."""
        return tuple(c.effect for c in self.choices)

    @property
    def cv_total(self) -> float:
        """Squared error on all held-out blocks."""
        return float(self.cv.sum())


class Problem(Measured, Protocol):
    """Something measured, K samples of A axes, and the effects that may explain it."""

    @property
    def effects(self) -> Mapping[str, Effect]:
        """Every effect by name, those in the model included."""

    @property
    def included(self) -> tuple[str, ...]:
        """Names of the effects that are in the model already."""

    @property
    def choices(self) -> tuple[Choice, ...]:
        """The candidates that this flight has the measurements for."""

    @property
    def settled(self) -> tuple[Choice, ...]:
        """Candidates that something else has shown: the search begins with them, and nothing stands in for them."""

    @property
    def blocks(self) -> np.ndarray:
        """Number of the held-out block of each sample (K,)."""

    def fit(self, choices: tuple[Choice, ...], near: Fit | None) -> Fit:
        """The model with `choices`, all of them fitted; `near` is the fit of some of them, to start from."""

    def linearised_gain(self, here: Fit, step: tuple[Choice, ...]) -> float:
        """Reduction of the squared error by a step, linearised at the optimum `here`."""

    def contribution(self, here: Fit, choice: Choice, through: str | None = None) -> np.ndarray:
        """What the choice at its typical size adds to the prediction, (K A, P), one column each parameter; `through`
        is an effect that must act, at its typical size, for this one to act."""

    def beside(self, here: Fit, choice: Choice) -> Fit | None:
        """The choice beside all that is fitted `here`, linearised; None where only a fit in full tells."""

    def adequate(self, here: Fit) -> bool:
        """Whether no more than noise is left."""

    def scale_of_thrust(self, here: Fit) -> tuple[tuple[str, ...], np.ndarray] | None:
        """The effects that scale the thrust as a whole, and what they change in the prediction (K A,); None where
        nothing does."""

    def matters(self, with_: State, without: State, step: tuple[Choice, ...]) -> bool:
        """Whether what the step adds is large enough to be of interest."""

    def visible(self, energy: float) -> bool:
        """Whether a squared sum over all samples is large enough to be of interest."""

    def held_out_error(self, fitted: Fit) -> float | None:
        """Squared error on a flight held out of every fit; None without one."""


def sizes(effect: Effect, choice: Choice | None = None) -> list[Parameter]:
    """The parameters (of a choice) that say how much of the effect there is."""
    return [
        p for p in effect.parameters if not p.structural and (choice is None or p.name in choice.parameters)
    ]


def evidence(problem: Measured, for_: Fit, against: Fit) -> float:
    """Evidence for one fit against another with as many effects, on the scale of twice a log likelihood ratio: squared
    error in units of one independent sample, and the distance of the parameters from "no effect"."""
    unit = variance_per_independent_sample(problem, for_.residual)
    return (against.sse - for_.sse) / unit + against.prior_penalty - for_.prior_penalty


def plausible(fitted: Fit, name: str) -> bool:
    """Whether the interval of each parameter of the effect reaches into its physical range. A number that holds on a
    span only, and is next to nothing there, is no worse for its sign."""
    for i in fitted.of(name):
        _, high = fitted.interval(i)
        p, x = fitted.free[i].parameter, fitted.estimate[i]
        if fitted.free[i].span != EVERYWHERE and not p.structural:
            neutral = fitted.free[i].neutral
            if abs(x - neutral) < NOTHING * abs(p.typical - neutral):
                continue
        if high < p.low or x > p.high + 1e-9 or (p.low != 0.0 and x < p.low - 1e-9):
            return False
    return True


def gain(with_: State, without: State) -> float:
    """Part of the remaining squared error on held-out blocks that `with_` takes away."""
    return (without.cv_total - with_.cv_total) / with_.cv_total


def _score(state: State) -> float:
    """Held-out error with a small price on every further effect, so that of two equal models the smaller wins."""
    return state.cv_total * (1.0 + MATERIAL_SHARE) ** len(state.choices)


class Search:
    """One search: states are kept by their set of choices, for the steps visit many sets again.

    `tried` is the number of candidates that share the risk of a chance find, where it is not that of `problem`;
    Without `other_sets` no sets are looked for that explain the flight as well as the one that the steps lead to.
    `dropped` are the effects that were left out because the held-out flight does not want them, `of_another_law` those
    that may be the difference between the vehicle's law and that of the effect that each names.
    """

    def __init__(
        self,
        problem: Problem,
        progress: Callable[[str], None] = lambda _: None,
        tried: int | None = None,
        other_sets: bool = True,
    ) -> None:
        self.problem, self.progress, self._asks_for_others = problem, progress, other_sets
        self.significance = FAMILY / max(1, len(problem.choices) if tried is None else tried)
        self.dropped: set[str] = set()
        self.of_another_law: dict[str, str] = {}
        self._states: dict[frozenset[Choice], State] = {}
        self._sets: dict[frozenset[Choice], tuple[State, ...]] = {}

    def state(self, choices: Sequence[Choice]) -> State:
        """The model with `choices`, all of them fitted."""
        key = frozenset(choices)
        if key not in self._states:
            near = max((k for k in self._states if k <= key), key=len, default=frozenset())
            fitted = self.problem.fit(tuple(choices), self._states[near].fit if near else None)
            self._states[key] = State(tuple(choices), fitted, block_errors(fitted, self.problem.blocks))
        return self._states[key]

    def select(self) -> State:
        """The effects that are missing."""
        current = self.grown(self.state(self.problem.settled))
        for other in self._other_sets(current):
            if self.evident(other, current) and other.cv_total < current.cv_total:
                current = other
        return self.agreed_by_held_out(self._of_one_law(self._backward(current)))

    def grown(self, current: State) -> State:
        """What the steps end in that begin at `current`."""
        current = self._backward(current)
        visited = {frozenset(current.choices)}
        while len(current.choices) < MOST_EFFECTS:
            self.progress(f"{len(current.choices)} effects found, looking for the next")
            following = self._forward(current) or self._exchange(current)
            if following is None:
                break
            following = self._backward(following)
            if frozenset(following.choices) in visited:
                break
            visited.add(frozenset(following.choices))
            current = following
        return current

    def settle(self, choices: Sequence[Choice]) -> State:
        """The fit of `choices`, without those that this flight does not support."""
        return self.agreed_by_held_out(self._of_one_law(self._backward(self.state(choices))))

    # --- the steps ------------------------------------------------------------------------------------------

    def _steps(self, current: State) -> Iterator[tuple[Choice, ...]]:
        """What may be added at once: one effect, or two where the one acts only through the other."""
        present = {*self.problem.included, *current.names}
        for choice in self.problem.choices:
            if choice.effect in present:
                continue
            needed = self.problem.effects[choice.effect].acts_through
            if not needed or present & set(needed):
                yield (choice,)
            else:
                yield from ((c, choice) for n in needed for c in self.problem.choices if c.effect == n)

    def _forward(self, current: State) -> State | None:
        scored = [(self.problem.linearised_gain(current.fit, step), step) for step in self._steps(current)]
        scored.sort(reverse=True)
        best: State | None = None
        accepted = 0
        for promise, step in scored:
            if accepted == SCREENED or promise < MATERIAL_SHARE * current.fit.sse:
                break
            candidate = self.state((*current.choices, *step))
            if not self._acceptable(candidate, current, step):
                continue
            if not all(self._shows(candidate, c) for c in step):
                continue
            accepted += 1
            if best is None or self._better(candidate, best):
                best = candidate
        return best

    def _better(self, one: State, other: State) -> bool:
        """Whether the evidence, or else the error on held-out blocks, speaks for `one`."""
        if self.evident(one, other) or self.evident(other, one):
            return self.evident(one, other)
        return _score(one) < _score(other)

    def _exchange(self, current: State) -> State | None:
        """The best state with one effect exchanged for another that explains the flight evidently better."""
        best: State | None = None
        for choice in current.choices:
            for rival in self._standing_in(current, choice):
                other = self.state((*(c for c in current.choices if c != choice), rival))
                if (
                    self.evident(other, best or current)
                    and other.cv_total < (best or current).cv_total
                    and all(plausible(other.fit, n) for n in other.names)
                    and self._shows(other, rival)
                ):
                    best = other
        return best

    def _backward(self, current: State) -> State:
        """Drop what the others have made superfluous, the least useful first."""
        while True:
            weakest = None
            for choice in current.choices:
                for without in self._lesser(current, choice):
                    useful = (
                        gain(current, without) > MATERIAL_SHARE
                        and current.fit.wald(choice.effect) < self.significance
                        and self.evident(current, without)
                        and plausible(current.fit, choice.effect)
                    )
                    if not useful and (weakest is None or without.cv_total < weakest.cv_total):
                        weakest = without
            if weakest is None:
                return current
            current = weakest

    def _lesser(self, current: State, choice: Choice) -> Iterator[State]:
        """The state without the choice, and those with one of its changes less."""
        yield self.without(current, choice)
        for spans in one_change_less(choice.spans):
            yield self.state([replace(c, spans=spans) if c == choice else c for c in current.choices])

    def without(self, current: State, choice: Choice) -> State:
        """The state without the choice, and without those that act only through it."""
        rest = [c for c in current.choices if c != choice]
        present = {*self.problem.included, *(c.effect for c in rest)}
        return self.state([c for c in rest if self._acts(c, present)])

    def _acts(self, choice: Choice, present: Iterable[str]) -> bool:
        """Whether one of the effects that it acts through is present, if it acts through any."""
        needed = self.problem.effects[choice.effect].acts_through
        return not needed or not set(needed).isdisjoint(present)

    def _of_one_law(self, current: State) -> State:
        """The state without effects that may be the difference between the vehicle's law of thrust and the catalogue's:
        those that do less than `LAW` of what one does that is more than a scale, and that may be taken for it."""
        effects = self.problem.effects
        while True:
            lost = {c: self.without(current, c).fit.sse - current.fit.sse for c in current.choices}
            small = [
                (size, one, other)
                for one, size in lost.items()
                for other, much in lost.items()
                if size < LAW**2 * much
                and effects[other.effect].stage is Stage.THRUST
                and effects[other.effect].generalises
                and one.effect in effects[other.effect].confounded_with
            ]
            if not small:
                return current
            _, one, other = min(small, key=lambda found: found[0])
            self.of_another_law[one.effect] = other.effect
            current = self.without(current, one)

    def agreed_by_held_out(self, current: State) -> State:
        """Drop effects that predict the held-out flight no better than the model without them does, where they act
        there at all."""
        while current.choices:
            here = self.problem.held_out_error(current.fit)
            if here is None:
                break
            others = [self.without(current, choice) for choice in current.choices]
            errors = [(self.problem.held_out_error(other.fit) or 0.0, other) for other in others]
            worse = [e for e in errors if e[0] < here * (1.0 - ACTS)]
            if not worse:
                break
            following = min(worse, key=lambda e: e[0])[1]
            self.dropped |= {*current.names} - {*following.names}
            current = following
        return current

    # --- other sets -----------------------------------------------------------------------------------------

    def _other_sets(self, current: State) -> tuple[State, ...]:
        """Sets of two and three effects that are best by their linearisation where nothing is in the model yet, fitted
        in full; none where no more than noise is left."""
        key = frozenset(current.choices)
        if key not in self._sets:
            enough = not self._asks_for_others or self.problem.adequate(current.fit)
            found = () if enough else self._best_subsets(current)
            self._sets[key] = tuple(
                s
                for s in map(self.state, found)
                if all(plausible(s.fit, n) for n in s.names)
                and all(s.fit.wald(n) < self.significance for n in s.names)
            )
        return self._sets[key]

    def _best_subsets(self, current: State) -> list[tuple[Choice, ...]]:
        start = self.state(self.problem.settled).fit
        residual = start.residual.ravel()
        unit = variance_per_independent_sample(self.problem, current.fit.residual)
        columns = [start.jacobian.reshape(len(residual), -1)]
        choices = [c for c in self.problem.choices if c not in self.problem.settled]
        for choice in choices:
            needed = self.problem.effects[choice.effect].acts_through
            through = needed[0] if needed and not set(needed) & set(self.problem.included) else None
            columns.append(self.problem.contribution(start, choice, through))
        matrix = np.column_stack([*columns, residual])
        gram = matrix.T @ matrix
        edges = np.cumsum([c.shape[1] for c in columns])
        own = {c: list(range(edges[i], edges[i + 1])) for i, c in enumerate(choices)}
        base, found = list(range(edges[0])), []
        for size in (2, 3):
            scored = []
            for chosen in itertools.combinations(choices, size):
                present = {*self.problem.included, *(c.effect for c in chosen)}
                once = len({c.effect for c in chosen}) == size
                if not once or not all(self._acts(c, present) for c in chosen):
                    continue
                mine = set(current.choices) - {*self.problem.settled}
                if mine <= {*chosen} and size <= len(mine) + 1:
                    continue  # one more beside all that is found has been tried
                at = [*base, *(i for c in chosen for i in own[c])]
                inner = gram[np.ix_(at, at)]
                # the prior: columns are of a typical size, which it is two of wide
                weight = np.where(np.arange(len(at)) < len(base), 1e-9 * np.diag(inner) + 1e-12, 0.25 * unit)
                inner = inner + np.diag(weight)
                left = gram[-1, -1] - gram[at, -1] @ np.linalg.solve(inner, gram[at, -1])
                scored.append((left / unit + 2.0 * len(at), chosen))
            scored.sort(key=lambda pair: pair[0])
            found += [chosen for _, chosen in scored[:SETS]]
        return [(*self.problem.settled, *chosen) for chosen in found]

    def near(self, current: State) -> tuple[State, ...]:
        """Other sets that explain the flight nearly as well, in units of what is left: they hold an effect that is not
        found, and lack one that is."""
        mine = set(current.names)

        def as_good(other: State) -> bool:
            unit = max(
                variance_per_independent_sample(self.problem, s.fit.residual) for s in (current, other)
            )
            worse = (other.fit.sse - current.fit.sse) / unit
            price = 2.0 * (len(other.fit.free) - len(current.fit.free))
            return worse + other.fit.prior_penalty - current.fit.prior_penalty + price < STRONG_EVIDENCE

        return tuple(
            s for s in self._other_sets(current) if mine - set(s.names) and set(s.names) - mine and as_good(s)
        )

    # --- rivals ---------------------------------------------------------------------------------------------

    def rivals(self, current: State, choice: Choice) -> tuple[str, ...]:
        """Effects that could stand in for `choice` at no cost."""
        found: list[str] = []
        for rival in self._standing_in(current, choice):
            if rival.effect == choice.effect or rival.effect in found:
                continue
            other = self.state((*(c for c in current.choices if c != choice), rival))
            if not plausible(other.fit, rival.effect):
                continue
            equal = evidence(self.problem, current.fit, other.fit) < STRONG_EVIDENCE
            if equal and self.evident(other, self.without(current, choice)):
                found.append(rival.effect)
        found += [n for n in dict.fromkeys(self._carried(current, choice)) if n not in found]
        for other in self.near(current):
            if choice.effect not in other.names:
                found += [n for n in other.names if n not in {*current.names, *found}]
        return tuple(found)

    def _carried(self, current: State, choice: Choice) -> Iterator[str]:
        """Effects that could stand in for `choice` with another that they act through, and which is not there: wind
        across a hover, with drag."""
        if choice in self.problem.settled or any(not self._acts(c, ()) for c in current.choices):
            return
        rest = [c for c in current.choices if c != choice]
        without = self.without(current, choice)
        lost = without.fit.sse - current.fit.sse
        unit = variance_per_independent_sample(self.problem, current.fit.residual)
        known = self.problem.effects[choice.effect].confounded_with
        for step in self._steps(without):
            if len(step) < 2 or choice in step or step[-1].effect not in known:
                continue
            near = LINEARISED * self.problem.linearised_gain(without.fit, step)
            if near < lost and (lost - near) / unit > LINEARISED * STRONG_EVIDENCE:
                continue
            other = self.state((*rest, *step))
            if (
                all(plausible(other.fit, c.effect) for c in step)
                and evidence(self.problem, current.fit, other.fit) < STRONG_EVIDENCE
                and self.evident(other, without)
            ):
                yield step[-1].effect

    def _standing_in(self, current: State, choice: Choice) -> Iterator[Choice]:
        """Candidates that could take the place of one that was found, by their linearisation."""
        if choice in self.problem.settled:
            return
        rest = [c for c in current.choices if c != choice]
        present = {*self.problem.included, *(c.effect for c in rest)}
        for rival in self.problem.choices:
            if changes_of(choice.spans):
                rival = replace(
                    rival, spans=choice.spans
                )  # a change is stood in for by one at the same moment
            if rival == choice or rival.effect in {c.effect for c in rest} or not self._acts(rival, present):
                continue
            if not all(self._acts(c, {*present, rival.effect}) for c in rest):
                continue
            if not self._cannot_stand_in(current, choice, rival):
                yield rival

    def _cannot_stand_in(self, current: State, choice: Choice, rival: Choice) -> bool:
        """Whether the linearised rival takes away so little of what the choice does that no fit need be made."""
        without = self.without(current, choice)
        lost = without.fit.sse - current.fit.sse
        unit = variance_per_independent_sample(self.problem, current.fit.residual)
        # with what acts only through it, and goes with it
        gone = [c for c in current.choices if c != choice and c not in without.choices]
        near = LINEARISED * self.problem.linearised_gain(without.fit, (rival, *gone))
        return near < lost and (lost - near) / unit > LINEARISED * STRONG_EVIDENCE

    # --- what is enough -------------------------------------------------------------------------------------

    def _acceptable(self, candidate: State, current: State, step: tuple[Choice, ...]) -> bool:
        return (
            gain(candidate, current) > MATERIAL_SHARE * len(step)
            and self.problem.matters(candidate, current, step)
            and all(candidate.fit.wald(c.effect) < self.significance for c in step)
            and self.evident(candidate, current)
            and all(plausible(candidate.fit, n) for n in candidate.names)
        )

    def evident(self, with_: State, without: State) -> bool:
        """Whether the evidence for `with_` pays for its further parameters (two each, as Akaike's criterion) and for
        the moments at which it changes: the likeliest of many is likely by chance."""
        price = self._price(with_) - self._price(without)
        return evidence(self.problem, with_.fit, without.fit) > STRONG_EVIDENCE + price

    def _price(self, state: State) -> float:
        changes = {t for c in state.choices for t in changes_of(c.spans)}
        return 2.0 * len(state.fit.free) + 2.0 * float(np.log(self.moments)) * len(changes)

    def score(self, state: State, beside: State) -> float:
        """What is left with a state, in squared errors worth one independent sample as it is `beside` another one, and
        the price of its numbers: the lowest is the best."""
        unit = variance_per_independent_sample(self.problem, beside.fit.residual)
        return state.fit.sse / unit + state.fit.prior_penalty + self._price(state)

    @cached_property
    def moments(self) -> float:
        """How many moments of a change can be told apart: one a second."""
        return max(2.0, sum(float(m.used.mean() * (m.t[-1] - m.t[0])) for m in self.problem.measurements))

    def _shows(self, candidate: State, choice: Choice) -> bool:
        """Whether the flight tells the effect from the simpler ones it may coincide with: at its typical size beyond
        them, or at its fitted size better than they do in its place."""
        problem = self.problem
        among = {*problem.included, *(c.effect for c in problem.choices)}
        simpler = [
            whole(problem.effects[n]) for n in problem.effects[choice.effect].generalises if n in among
        ]
        if not simpler:
            return True
        mine = problem.contribution(candidate.fit, choice).sum(axis=1)
        theirs = np.column_stack([problem.contribution(candidate.fit, c) for c in simpler])
        rest = mine - theirs @ np.linalg.lstsq(theirs, mine, rcond=None)[0]
        if self._power(candidate, float(np.sum(rest**2)), choice) > SURE_TO_SEE:
            return True
        if any(c.effect in {*candidate.names, *problem.included} for c in simpler):
            return False
        others = [c for c in candidate.choices if c != choice]
        return self.evident(candidate, self.state((*others, *simpler)))

    def excited(self, current: State, choice: Choice, through: str | None = None) -> bool:
        """Whether this flight would have shown the choice at its typical size, beside what is being fitted."""
        mine = self.problem.contribution(current.fit, choice, through).sum(axis=1)
        fitted = current.fit.jacobian.reshape(len(mine), -1)
        if fitted.shape[1]:
            mine = mine - fitted @ np.linalg.lstsq(fitted, mine, rcond=None)[0]
        energy = float(np.sum(mine**2))
        power = self._power(current, energy, choice)
        return bool(
            self.problem.visible(energy) and power > SURE_TO_SEE and energy > MATERIAL_SHARE * current.fit.sse
        )

    def _power(self, current: State, energy: float, choice: Choice) -> float:
        """Probability that the parameters are significant when what they change has this squared sum."""
        count = len(sizes(self.problem.effects[choice.effect], choice))
        threshold = special.chdtri(count, self.significance) * (current.fit.critical / 1.96) ** 2
        unit = variance_per_independent_sample(self.problem, current.fit.residual)
        return float(1.0 - special.chndtr(threshold, count, energy / unit))
