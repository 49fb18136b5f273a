"""When: effects that begin, end or change in flight, found beside those of one size throughout.

Every effect of the catalogue is a candidate for a change, those that were not found as well. From the set that was
found, and from each set with one effect less, for a curve may stand in for a change, the moments that promise most by
their linearisation (`identify.steps`) are fitted in full, and go on as any state of the search: by the same evidence,
less the price of the moment. An effect that changes by and by, and not at moments, is told as a drift.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from trueflight.groundstation.identify.fitting import Fit
from trueflight.groundstation.identify.search import (
    FAMILY,
    MATERIAL_SHARE,
    STRONG_EVIDENCE,
    Choice,
    Problem,
    Search,
    State,
    evidence,
    gain,
    plausible,
    sizes,
)
from trueflight.groundstation.identify.spans import Span, changes_of, split_at
from trueflight.groundstation.identify.steps import Course, Wander
from trueflight.groundstation.identify.verdicts import estimate
from trueflight.groundstation.results import (
    Change,
    EffectVerdict,
    OverTime,
    ParameterEstimate,
    Stretch,
)

MOST_CHANGES = 3
"""Of one effect; and effects that change, one after the other."""
FITTED = 3
"""Promising changes that are fitted in full at each step."""
SLOW = 8.0
"""Parts of the flight over which a drift keeps its course: what turns sooner is no drift but gusts."""

QUICK = 2.5
"""s: wander that forgets itself within so long, as gusts do, makes no change at a moment."""


@dataclass(frozen=True)
class Drift:
    """An effect of the found state that changes by and by: its `wander` is in typical sizes of its numbers; `rivals`
    could drift in its place."""

    choice: Choice
    course: Course
    wander: Wander
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True)
class InTime:
    """The state that was found, with spans where effects change at moments, and what drifts in it."""

    state: State
    drift: Drift | None = None


@dataclass(frozen=True)
class _Promise:
    """A change that may be fitted: the choices beside it, the squared error that is `left` and the `price` of its
    numbers in squared errors worth one independent sample, of which one is `unit`; a drift where it has one."""

    left: float
    price: float
    unit: float
    beside: tuple[Choice, ...]
    changed: Choice
    drift: Drift | None = None


def in_time(search: Search, found: State, drifts: bool = True, of: Collection[str] = ()) -> InTime:
    """`found`, or what changes in flight, where the evidence is for it; without `drifts` at moments alone. `of` are
    effects of `found` of which alone it is asked, everything else staying in it."""
    if not _one_flight(search):
        return InTime(found)
    for _ in range(MOST_CHANGES):
        better = _better(search, found, drifts, of)
        if better is None:
            break
        if better.drift is not None:
            return better
        found = better.state
    return InTime(found)


def _one_flight(search: Search) -> bool:
    """Whether the samples are of one flight, one after the other."""
    edges = [(float(m.t[0]), float(m.t[-1])) for m in search.problem.measurements]
    return all(a[1] < b[0] for a, b in itertools.pairwise(edges))


def _better(search: Search, found: State, drifts: bool, of: Collection[str]) -> InTime | None:
    """What explains the flight best with changes of one effect more, or a drift."""
    best: State | None = None
    tried: set[tuple[Choice, ...]] = set()
    promises = list(_promises(search, found, of))
    unit = min(promises, key=lambda p: p.left).unit if promises else 1.0

    def score(promise: _Promise) -> float:
        return promise.left / unit + promise.price

    for promise in sorted(promises, key=score):
        if promise.drift is not None:
            if best is not None or not drifts:
                break
            near = [
                p for p in promises if p.drift is not None and score(p) < score(promise) + STRONG_EVIDENCE
            ]
            rivals = dict.fromkeys(
                p.changed.effect for p in near if p.changed.effect != promise.changed.effect
            )
            drift = replace(promise.drift, rivals=tuple(rivals))
            return InTime(search.state((*promise.beside, promise.changed)), drift)
        choices = (*promise.beside, promise.changed)
        if choices in tried:
            continue
        if len(tried) == FITTED:
            break
        tried.add(choices)
        candidate = _plain(search, search.state(choices))
        if _holds(search, candidate, promise.changed, found) and (
            best is None or search.score(candidate, best) < search.score(best, best)
        ):
            best = candidate
    if best is None:
        return None
    grown = _refined(search, best if of else search.grown(best))
    # what is left of it may be no change at all
    kept = _count(grown) > _count(found)
    return InTime(grown) if kept and search.evident(grown, found) else None


def _count(state: State) -> int:
    return sum(len(changes_of(c.spans)) for c in state.choices)


def _holds(search: Search, candidate: State, changed: Choice, found: State) -> bool:
    """Whether the change is significant, matters, and explains the flight better than what was found."""
    now = next(c for c in candidate.choices if c.effect == changed.effect)
    return (
        search.evident(candidate, found)
        and gain(candidate, found) > MATERIAL_SHARE
        and search.problem.matters(candidate, found, (changed,))
        and p_of_change(candidate.fit, now) < FAMILY / (len(search.problem.choices) * search.moments)
        and plausible(candidate.fit, changed.effect)
    )


def p_of_change(fitted: Fit, choice: Choice) -> float:
    """p-value that the numbers of a choice are the same throughout the flight, from the robust covariance."""
    own = fitted.sizes(choice.effect)
    rows = []
    for name in sorted({fitted.free[i].parameter.name for i in own}):
        parts = sorted((fitted.free[i].span.start, i) for i in own if fitted.free[i].parameter.name == name)
        columns = [i for _, i in parts]
        if len(columns) == 1:  # there is none of it in another span
            return fitted.wald(choice.effect)
        for before, after in itertools.pairwise(columns):
            row = np.zeros(len(fitted.free))
            row[before], row[after] = -1.0, 1.0
            rows.append(row)
    turn = np.array(rows)
    step, covariance = turn @ fitted.estimate, turn @ fitted.covariance @ turn.T
    statistic = float(step @ np.linalg.pinv(covariance, hermitian=True) @ step)
    return float(
        special.chdtrc(np.linalg.matrix_rank(covariance), max(statistic, 0.0) * (1.96 / fitted.critical) ** 2)
    )


def _promises(search: Search, found: State, of: Collection[str]) -> Iterator[_Promise]:
    """Changes whose linearisation is significant and leaves less than what was found."""
    for base in (found,) if of else _bases(search, found):
        present = {*search.problem.included, *base.names}
        for choice in search.problem.choices:
            if of and choice.effect not in of:
                continue
            needed = search.problem.effects[choice.effect].acts_through
            if not needed or present & set(needed):
                now = next((c for c in base.choices if c.effect == choice.effect), choice)
                yield from _promise(search, base, found, now)


def _bases(search: Search, found: State) -> Iterator[State]:
    """Where changes are looked for beside: what was found, and that with one effect less."""
    yield found
    if search.problem.adequate(found.fit):
        return
    seen = {frozenset(found.choices)}
    for choice in found.choices:
        without = search.without(found, choice)
        if choice not in search.problem.settled and frozenset(without.choices) not in seen:
            seen.add(frozenset(without.choices))
            yield without


def _promise(search: Search, base: State, found: State, now: Choice) -> Iterator[_Promise]:
    """Changes of one effect at one moment more, at as many as pay, or by and by."""
    problem, plain, known = search.problem, replace(now, spans=()), changes_of(now.spans)
    course = Course(problem, base.fit, columns_of(problem, base.fit, plain))
    count = len(sizes(problem.effects[now.effect], plain))
    chance = special.chdtri(count, FAMILY / (len(problem.choices) * course.count))
    chance *= (base.fit.critical / 1.96) ** 2
    first = course.segmented(known, float(chance), len(known) + 1)
    if len(first) == len(known):
        return
    beside = tuple(c for c in base.choices if c.effect != now.effect)
    before = 2.0 * (len(base.fit.free) + count * (now not in base.choices))
    each = 2.0 * (np.log(course.count) + count)
    stepped: list[_Promise] = []
    for moments in (first, course.segmented(first, float(chance), len(known) + MOST_CHANGES)):
        change, left = course.fitted(moments)
        price = before + each * len(moments)
        changed = replace(plain, spans=split_at(moments))
        stepped.append(_Promise(float(np.sum(left**2)), price, course.unit(change, left), beside, changed))
    unit = stepped[-1].unit

    def matters(added: np.ndarray, left: float) -> bool:
        gained = found.fit.sse - left
        small = gained < STRONG_EVIDENCE * unit or gained < MATERIAL_SHARE * left
        return not small and problem.visible(float(np.sum(added**2)))

    if not matters(change, stepped[-1].left):
        return
    duration = float(course.t[-1] - course.t[0])
    slow, *quick = (course.wander(unit, tau) for tau in (np.inf, duration / SLOW, QUICK))
    best = min(p.left / unit + p.price for p in stepped)
    still = float(np.sum(course.left**2)) / unit + before + 2.0
    if still - slow.gain < best - STRONG_EVIDENCE:
        remains = float(np.sum(course.wandering(slow.course) ** 2))
        sways = course.added(slow.course)
        if max(w.gain for w in quick) < slow.gain + STRONG_EVIDENCE and matters(sways, remains):
            price = still - slow.gain - remains / unit
            yield _Promise(remains, price, unit, beside, plain, Drift(plain, course, slow))
    elif best < still - max(w.gain for w in quick):
        yield from stepped


def _refined(search: Search, found: State) -> State:
    """The state with each moment where it is likeliest beside all that was found."""
    for choice in found.choices:
        moments = list(changes_of(choice.spans))
        if not moments:
            continue
        course = _course(search.problem, found.fit, choice)
        for k, moment in enumerate(moments):
            moments[k] = course.moment(moment, [t for t in moments if t != moment])[0]
        spans = tuple(
            Span(s.flight, _moved(s.start, choice, moments), _moved(s.stop, choice, moments))
            for s in choice.spans
        )
        if spans != choice.spans and moments == sorted(moments):
            moved = search.state([replace(c, spans=spans) if c == choice else c for c in found.choices])
            found = moved if moved.fit.sse < found.fit.sse else found
    return found


def _moved(edge: float, choice: Choice, moments: Sequence[float]) -> float:
    return dict(zip(changes_of(choice.spans), moments, strict=True)).get(edge, edge)


def _course(problem: Problem, here: Fit, choice: Choice) -> Course:
    """The course of an effect that is fitted `here` in spans, beside all else that is."""
    own = here.sizes(choice.effect)
    rest = [i for i in range(len(here.free)) if i not in own]
    without = np.array([here.free[i].neutral for i in own]) - here.estimate[own]
    bare = replace(
        here,
        residual=here.residual + here.jacobian[:, :, own] @ without,
        jacobian=here.jacobian[:, :, rest],
    )
    return Course(problem, bare, columns_of(problem, here, replace(choice, spans=())))


def columns_of(problem: Problem, here: Fit, choice: Choice) -> np.ndarray:
    """What each number of an effect changes at its typical size, (K A, p), as the fit has it where it is in all of
    it."""
    own = here.sizes(choice.effect)
    spans = {here.free[i].span for i in own}
    if len(spans) != len(changes_of(spans)) + 1:  # it is absent, or absent in between
        return problem.contribution(here, choice)
    sized: dict[str, np.ndarray] = {}
    for i in own:
        f = here.free[i]
        column = (f.neutral - f.parameter.typical) * here.jacobian[:, :, i].ravel()
        sized[f.parameter.name] = sized.get(f.parameter.name, 0.0) + column
    return np.column_stack(list(sized.values()))


# --- told -----------------------------------------------------------------------------------------------


def over_time(problem: Problem, here: Fit, choice: Choice) -> OverTime | None:
    """When an effect that is fitted `here` in spans changes, and what it is in between; None for one without spans."""
    moments = changes_of(choice.spans)
    if not moments:
        return None
    course = _course(problem, here, choice)
    changes = []
    for moment in moments:
        _, low, high = course.moment(moment, [t for t in moments if t != moment])
        changes.append(Change(moment, min(low, moment), max(high, moment)))
    numbers = {here.free[i].parameter.name: here.free[i] for i in here.sizes(choice.effect)}
    none = tuple(
        ParameterEstimate(name, f.neutral, f.neutral, f.neutral, f.parameter.unit)
        for name, f in numbers.items()
    )
    t = course.t
    edges, stretches = [float(t[0]), *moments, float(t[-1])], []
    for start, stop in itertools.pairwise(edges):
        own = [i for i in here.of(choice.effect) if here.free[i].span.holds(0, max(start, float(t[0])))]
        sized = [i for i in own if not here.free[i].parameter.structural]
        told = tuple(estimate(here, i) for i in own if np.any(here.jacobian[:, :, i])) if sized else none
        stretches.append(Stretch(start, stop, told, not sized))
    return OverTime(tuple(stretches), tuple(changes))


def in_words(verdicts: Sequence[EffectVerdict], times: Mapping[str, OverTime]) -> list[EffectVerdict]:
    """Verdicts on effects that change in flight with their course, and advice that goes with it."""
    out = []
    for v in verdicts:
        told = times.get(v.name)
        if told is None:
            out.append(v)
            continue
        parameters, advice = v.parameters, v.advice
        if told.drift:
            parameters = tuple(
                ParameterEstimate(d.name, float(d.value[-1]), float(d.low[-1]), float(d.high[-1]), d.unit)
                for d in told.drift
            )
        elif told.ended:
            advice = f"it ended at {told.changes[-1].time:.1f} s: there is nothing to add for the vehicle now"
            parameters = next(s.parameters for s in reversed(told.stretches) if not s.absent)
        else:
            parameters = told.stretches[-1].parameters
            advice += f"; it is what holds since {told.changes[-1].time:.1f} s"
        out.append(replace(v, over_time=told, parameters=parameters, advice=advice))
    return out


def _plain(search: Search, found: State) -> State:
    """The state in which an effect is said to be absent in a span where it may as well be."""
    for choice in found.choices:
        now = choice
        for span in choice.spans:
            rest = tuple(s for s in now.spans if s != span)
            if not rest:
                continue
            other = search.state([replace(c, spans=rest) if c == now else c for c in found.choices])
            if evidence(search.problem, found.fit, other.fit) < STRONG_EVIDENCE:
                found, now = other, replace(now, spans=rest)
    return found
