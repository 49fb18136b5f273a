"""What a search found, in verdicts: missing, possible, minor, not supported, not excited; with the advice that goes
with each, and how sure it is.

`identify.search` finds; here it is judged what was not found, and said in words.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from trueflight.groundstation.identify.doubt import Weighed, Weighing
from trueflight.groundstation.identify.fitting import Fit, variance_per_independent_sample
from trueflight.groundstation.identify.order import answers
from trueflight.groundstation.identify.search import Choice, Problem, Search, State
from trueflight.groundstation.results import EffectVerdict, ParameterEstimate
from trueflight.models.effect import Effect

MISSING, POSSIBLE, MINOR, NOT_SUPPORTED, NOT_EXCITED, INCLUDED = (
    "missing", "possible", "minor", "not_supported", "not_excited", "included",
)  # fmt: skip


ANSWERS = 0.25
"""Confidence that is left of what comes after what it explains: in seeded hovers in gusts none of it was there."""


@dataclass(frozen=True)
class Scale:
    """What shares are shares of: the squared error `before` over all samples, of the model as it was.

    `told` puts a share into words, in the unit of what is measured; `seen_in` as in `EffectVerdict`.
    """

    before: float
    told: Callable[[float], str]
    seen_in: str = "acceleration"


def judge(
    search: Search,
    current: State,
    figures: Fit,
    scale: Scale,
    also: Callable[[str], tuple[str, ...]] = lambda _: (),
    doubt: Weighing | None = None,
    entire: Problem | None = None,
) -> tuple[list[EffectVerdict], list[EffectVerdict]]:
    """Verdicts on what was found, the largest first, and on the other candidates, in the order of the catalogue.

    `figures` is the fit that values and p-values are taken from, `also` names what else an effect may stand for. With
    `doubt`, where more is left than noise, an effect is only called missing that is of one size throughout. `entire`
    is what `figures` were fitted to, where the search saw only parts of it.
    """
    fitted_to = search.problem if entire is None else entire
    rivals = {c: search.rivals(current, c) for c in current.choices}
    lost = {c: search.without(current, c).fit.sse - current.fit.sse for c in current.choices}
    ranked = sorted(((size / scale.before, choice) for choice, size in lost.items()), reverse=True)
    found = []
    for rank, (share, choice) in enumerate(ranked, 1):
        effect, same = search.problem.effects[choice.effect], rivals[choice]
        weighed = None if doubt is None else doubt.of(effect.name)
        if doubt is not None and doubt.quiet and weighed is not None and weighed.steady:
            weighed = None
        after = answers(fitted_to, figures, effect.name) if scale.seen_in != "rotation" else None
        sure = not same and (weighed is None or weighed.holds) and _somewhere(figures, effect.name)
        sure = sure and after is None
        small = sure and not search.problem.visible(lost[choice])
        found.append(
            EffectVerdict(
                effect.name,
                MINOR if small else MISSING if sure else POSSIBLE,
                rank,
                float(np.clip(share, 0.0, 1.0)),
                figures.wald(effect.name),
                _either(estimates(figures, effect.name), figures, effect.name, weighed),
                (*same, *effect.aliases, *also(effect.name)),
                _small(scale, share) if small else _add(effect) if sure else _tell(same, effect),
                scale.seen_in,
                ("" if weighed is None else weighed.told) if after is None else _answered(after),
                confidence=_there(search, current.fit, search.without(current, choice).fit)
                * (1.0 if weighed is None else weighed.trust)
                * (1.0 if after is None else ANSWERS),
            )
        )
    # nobody grants the rotation the slow error that every acceleration has: what is small in it is sure of nothing
    doubtful = doubt is not None or scale.seen_in == "rotation"
    absent = dict.fromkeys(c.effect for c in search.problem.choices if c.effect not in current.names)
    stood_for = {n: [c.effect for c, same in rivals.items() if n in same] for n in absent}
    looked = [_absent(search, current, scale, n, stood_for[n], doubtful) for n in absent]
    found = [_over(v, fits) for v, fits in ((v, _left_open(search, current, rivals, v.name)) for v in found)]
    return found, _sharing([v for v, _ in looked], [change for _, change in looked])


def _law(name: str) -> str:
    return (
        f"it does less than a tenth of what {name} does, and may be the difference between the law of {name} here and "
        "the vehicle's"
    )


def _small(scale: Scale, share: float) -> str:
    return f"seen, but too small to matter here{scale.told(share)}"


def _answered(seconds: float) -> str:
    return (
        f"it comes {seconds:.2g} s after what it is to explain: the commands answer the motion there, as a controller "
        "answers a gust; a flight that is led through the same tells"
    )


def _either(
    told: tuple[ParameterEstimate, ...], figures: Fit, name: str, weighed: Weighed | None
) -> tuple[ParameterEstimate, ...]:
    """Estimates whose intervals hold what the weighted estimate says, too, where more is left than noise."""
    if weighed is None:
        return told
    other = {}
    for i, size, spread in zip(figures.sizes(name), weighed.size, weighed.spread, strict=True):
        middle, half = figures.free[i].neutral + size, figures.critical * spread
        other[i] = (middle - half, middle + half)
    return tuple(
        replace(p, low=min(p.low, other[i][0]), high=max(p.high, other[i][1])) if i in other else p
        for i, p in zip(_told(figures, name), told, strict=True)
    )


def _left_open(
    search: Search, current: State, rivals: Mapping[Choice, tuple[str, ...]], name: str
) -> list[Fit]:
    """The fits of sets that explain the flight nearly as well and hold the effect."""
    sets = [s for s in search.near(current) if name in s.names]
    for choice, same in rivals.items():
        if choice.effect == name:
            continue
        rest = [c for c in current.choices if c != choice]
        for rival in (c for c in search.problem.choices if c.effect in same):
            if not search.problem.effects[rival.effect].acts_through:
                sets.append(search.state((*rest, rival)))
    return [s.fit for s in sets]


def _over(verdict: EffectVerdict, fits: Sequence[Fit]) -> EffectVerdict:
    """The verdict with intervals that hold those of all `fits`: what is left open counts."""
    others = [{p.name: p for p in estimates(f, verdict.name)} for f in fits]
    parameters = tuple(
        replace(
            p,
            low=min([p.low, *(o[p.name].low for o in others if p.name in o)]),
            high=max([p.high, *(o[p.name].high for o in others if p.name in o)]),
        )
        for p in verdict.parameters
    )
    return replace(verdict, parameters=parameters) if fits else verdict


def _sharing(verdicts: Sequence[EffectVerdict], changes: Sequence[np.ndarray | None]) -> list[EffectVerdict]:
    """Verdicts in which effects that are minor, and change the same, share the confidence that one of them is there.

    What an approximate law leaves is as small: it has a share as well.
    """
    minor = [
        i
        for i, v in enumerate(verdicts)
        if v.verdict == MINOR and v.confidence is not None and changes[i] is not None
    ]
    out = list(verdicts)
    for i in minor:
        odds = 1.0  # of a law's error
        for j in minor:
            a, b = changes[i], changes[j]
            assert a is not None and b is not None
            size = float(np.sum(a * a)) * float(np.sum(b * b))
            alike = float(np.sum(a * b)) ** 2 / max(size, 1e-30)
            # by the part of the error that each takes away
            odds += alike * verdicts[j].variance_share / max(verdicts[i].variance_share, 1e-30)
        out[i] = replace(verdicts[i], confidence=(verdicts[i].confidence or 0.0) / odds)
    return out


def _there(search: Search, with_: Fit, without: Fit) -> float:
    """Probability of what one fit has beyond another: the evidence, less two for each number, against odds of the
    number of candidates (one of them may be expected to be there). The slow error that every flight is granted
    is counted, so that what is below it is never sure."""
    unit = max(variance_per_independent_sample(search.problem, with_.residual), search.problem.unit())
    price = 2.0 * (len(with_.free) - len(without.free)) + with_.prior_penalty - without.prior_penalty
    log_odds = 0.5 * ((without.sse - with_.sse) / unit - price)
    return float(special.expit(log_odds - np.log(max(len(search.problem.choices), 1))))


def _somewhere(figures: Fit, name: str) -> bool:
    """Whether the interval of one parameter excludes "no effect": several may be significant together alone."""
    own = figures.sizes(name)
    return not own or any(
        not figures.interval(i)[0] <= figures.free[i].neutral <= figures.interval(i)[1] for i in own
    )


def _absent(
    search: Search, current: State, scale: Scale, name: str, stands_for: Sequence[str], doubtful: bool
) -> tuple[EffectVerdict, np.ndarray | None]:
    """The verdict on an effect that was not found, and what it would change."""
    problem = search.problem
    effect, own = problem.effects[name], [c for c in problem.choices if c.effect == name]
    present, through = {*problem.included, *current.names}, None
    carried: tuple[Choice, ...] = ()
    if effect.acts_through and not present & set(effect.acts_through):
        carriers = [c for n in effect.acts_through for c in problem.choices if c.effect == n]
        if not carriers:
            return unmeasured(effect, ()), None
        through, carried = carriers[0].effect, (carriers[0],)
        tried = [search.state((*current.choices, carriers[0], c)).fit for c in own]
    else:
        tried = [problem.beside(current.fit, c) or search.state((*current.choices, c)).fit for c in own]
    extended = min(tried, key=lambda f: f.sse)
    share, p = (current.fit.sse - extended.sse) / scale.before, extended.wald(name)

    there = _there(search, extended, current.fit)

    def verdict(
        word: str, figures: Fit, rivals: Sequence[str], advice: str
    ) -> tuple[EffectVerdict, np.ndarray | None]:
        told = estimates(figures, name)
        sure = {MINOR: there, NOT_SUPPORTED: 1.0 - there}.get(word)
        if name in search.dropped or (doubtful and there > 0.5):
            sure = None  # what is left, or another flight, speaks against what is seen
        said = EffectVerdict(
            name, word, None, share, p, told, tuple(rivals), advice, scale.seen_in, confidence=sure
        )
        return said, figures.residual - current.fit.residual

    if stands_for:
        # as a stand-in for the effect found, not beside it
        whole_sets = [s.fit for s in search.near(current) if name in s.names and stands_for[0] not in s.names]
        swapped = whole_sets or [
            search.state([x for n in current.choices for x in _in_place(n, stands_for[0], carried, c)]).fit
            for c in own
        ]
        return verdict(POSSIBLE, min(swapped, key=lambda f: f.sse), stands_for, _tell(stands_for, effect))
    if not all(search.excited(current, c, through) for c in own):
        return verdict(NOT_EXCITED, extended, (), f"to see it, fly {effect.manoeuvre}")
    if other := search.of_another_law.get(name):
        told, change = verdict(POSSIBLE, extended, (other,), _tell((other,), effect))
        return replace(told, rests_on=_law(other), confidence=0.5 * there), change
    if name in search.dropped:
        return verdict(MINOR, extended, (), "it takes nothing away from the error on the held-out flight")
    seen = p < search.significance and share > 0.0
    small = _small(scale, share)
    minor = seen and there > 0.5 and not doubtful
    return verdict(MINOR if minor else NOT_SUPPORTED, extended, (), small if seen else "")


def _in_place(present: Choice, of: str, carried: tuple[Choice, ...], choice: Choice) -> tuple[Choice, ...]:
    """What stands where `present` does, with `choice`, and what it acts through, in place of the effect `of`."""
    return (*carried, choice) if present.effect == of else (present,)


def by_weight(verdicts: Sequence[EffectVerdict]) -> list[EffectVerdict]:
    """Verdicts on what was not found: the possible first, then the most significant."""
    return sorted(verdicts, key=lambda v: (v.verdict != POSSIBLE, v.p_value))


def included(name: str) -> EffectVerdict:
    """The verdict on an effect of the model itself."""
    return EffectVerdict(name, INCLUDED, None, 0.0, 0.0, (), (), "")


def unmeasured(effect: Effect, missing: Sequence[str]) -> EffectVerdict:
    """The verdict on an effect whose measurements the flight lacks."""
    needed = ", ".join(missing) or ("a flight that turns" if effect.rotational else "measurements")
    through = f" and one of {', '.join(effect.acts_through)} in the model" if effect.acts_through else ""
    hidden = (
        "; without them the rate controller's integral hides its torque"
        if effect.rotational and effect.needs_any
        else ""
    )
    advice = f"needs {needed}{through}{hidden}; record it, and fly {effect.manoeuvre}"
    seen_in = "rotation" if effect.rotational else "acceleration"
    return EffectVerdict(effect.name, NOT_EXCITED, None, 0.0, 1.0, (), (), advice, seen_in)


def also_possible(verdict: EffectVerdict, rivals: tuple[str, ...]) -> EffectVerdict:
    """A verdict where effects that this flight could not show would look the same."""
    advice = f"{verdict.advice}; to tell it from {', '.join(rivals)}, fly quick vertical steps as well"
    return replace(verdict, verdict=POSSIBLE, indistinguishable_from=rivals, advice=advice)


def estimates(fitted: Fit, name: str) -> tuple[ParameterEstimate, ...]:
    """The parameters of an effect with their intervals; an axis that the flight does not measure has none. Of several
    flights, one that holds for a single one has its number; of those that change in flight, the last."""
    return tuple(estimate(fitted, i) for i in _told(fitted, name))


def _told(fitted: Fit, name: str) -> list[int]:
    """Columns of the numbers of an effect that are told."""
    last = {(fitted.free[i].parameter.name, fitted.free[i].span.flight): i for i in fitted.of(name)}
    return [i for i in last.values() if np.any(fitted.jacobian[:, :, i])]


def estimate(fitted: Fit, index: int) -> ParameterEstimate:
    """One free number with its interval; one that has run into its bounds is not known, and may be nothing."""
    free, value = fitted.free[index], float(fitted.estimate[index])
    p, flight = free.parameter, "" if free.span.flight is None else str(free.span.flight)
    low, high = fitted.interval(index)
    if not p.structural and not free.low < value < free.high:
        low, high = min(low, free.neutral), max(high, free.neutral)
    return ParameterEstimate(p.name, value, low, high, p.unit, flight)


def _tell(others: Sequence[str], effect: Effect) -> str:
    if not others:
        return f"more is left than noise, which it may stand in for; to see it alone, fly {effect.manoeuvre}"
    return f"to tell it from {', '.join(others)}, fly {effect.manoeuvre}"


def _add(effect: Effect) -> str:
    alias = f"; no flight can tell it from {', '.join(effect.aliases)}" if effect.aliases else ""
    return f"add it to the model{alias}"
