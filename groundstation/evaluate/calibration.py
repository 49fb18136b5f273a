"""How often the diagnosis is right, and whether it is as sure as it says: tallies over flights of known truth.

Pure counting: what was hidden in each flight and what the diagnosis said of it go in, shares with binomial intervals
(Wilson's) come out. Flying and diagnosing are in `groundstation.study.calibration_study`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy import stats

MISSING, POSSIBLE, NOT_EXCITED, ABSENT = "missing", "possible", "not_excited", "not_supported"
MINOR = "minor"
"""Seen and told as too small to matter: it counts as found in a group."""
OUTCOMES = (MISSING, POSSIBLE, NOT_EXCITED, ABSENT)
"""What may become of a hidden effect: named, in a group that contains it, told to be out of this flight's reach, or
denied."""
NOTHING = "nothing"
"""The row of the confusion matrix for what was named beside all that is true."""
SURE = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 0.999, 1.0)
"""Edges of the bins of the reliability diagram."""
CALLED_SURE = 0.95
ON_TIME = 2.0
"""s within which the moment of a change is told rightly."""


@dataclass(frozen=True)
class Estimated:
    """A parameter with its 95 % interval and, where it has one, its true value."""

    name: str
    value: float
    low: float
    high: float
    truth: float | None = None

    @property
    def inside(self) -> bool:
        """Whether the interval holds the truth."""
        return self.truth is not None and self.low <= self.truth <= self.high

    @property
    def miss(self) -> float:
        """Distance from the truth over the interval's half width: above 1 outside."""
        if self.truth is None:
            return math.nan
        half = 0.5 * (self.high - self.low)
        return abs(self.value - self.truth) / half if half > 0.0 else math.inf


@dataclass(frozen=True)
class Said:
    """What the diagnosis said of one effect of one flight; `moments` are those at which it changes, s."""

    name: str
    verdict: str
    rank: int | None
    share: float
    p_value: float
    group: tuple[str, ...] = ()
    estimates: tuple[Estimated, ...] = ()
    seen_in: str = "acceleration"
    confidence: float | None = None
    moments: tuple[float, ...] = ()

    @property
    def error(self) -> float | None:
        """Distance of the estimate from the truth over the size of the truth, over all parameters that have one."""
        known = [e for e in self.estimates if e.truth is not None]
        size = math.hypot(*(e.truth for e in known if e.truth is not None))
        if not known or size == 0.0:
            return None
        return math.hypot(*(e.value - e.truth for e in known if e.truth is not None)) / size


@dataclass(frozen=True)
class Case:
    """One flight of known truth: `truth` the names of what was hidden, `said` the verdict on each effect.

    RMS in m/s² (rad/s² in the rotation). `error` says why there is no diagnosis, and is empty where there is one.
    `begins` tells when an effect begins that does so in flight, s; `strength` is the factor on the usual sizes, `late`
    the lag of the estimate, s, and `rate` the log's, Hz.
    """

    number: int
    kind: str
    seconds: float
    noise: float
    rotor_speeds: bool
    truth: tuple[str, ...]
    said: tuple[Said, ...] = ()
    rms: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    rotational: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    unexplained: bool = False
    diagnosis_seconds: float = math.nan
    error: str = ""
    controller: str = ""
    vehicle: str = ""
    begins: dict[str, float] = field(default_factory=dict)
    strength: float = 1.0
    late: float = 0.0
    rate: float = 100.0

    def of(self, name: str) -> Said | None:
        """What was said of one effect."""
        return next((s for s in self.said if s.name == name), None)

    def outcome(self, name: str) -> str:
        """What became of a hidden effect, one of `OUTCOMES`."""
        told = self.of(name)
        if told is not None and told.verdict == MISSING:
            return MISSING
        if (told is not None and told.verdict in (POSSIBLE, MINOR)) or any(
            name in s.group for s in self.named()
        ):
            return POSSIBLE
        return NOT_EXCITED if told is None or told.verdict == NOT_EXCITED else ABSENT

    def named(self) -> tuple[Said, ...]:
        """The effects that the diagnosis put into its model."""
        return tuple(s for s in self.said if s.verdict in (MISSING, POSSIBLE) and s.rank is not None)

    def stands(self, said: Said) -> bool:
        """Whether a named effect is true, or its group holds a true one that is not named itself."""
        if said.name in self.truth:
            return True
        named = {s.name for s in self.named()}
        return any(name in self.truth and name not in named for name in said.group)

    def false(self, verdict: str) -> tuple[str, ...]:
        """Effects named with this verdict that neither are true nor stand for what is."""
        return tuple(s.name for s in self.named() if s.verdict == verdict and not self.stands(s))

    def untimed(self) -> tuple[str, ...]:
        """Effects that begin in flight, named without the moment (within `ON_TIME`).

        Of those that begin together one tells the moment of all: where drag begins, there was no wind to be felt
        before.
        """
        named = {s.name: s.moments for s in self.named() if s.name in self.begins}
        told = {
            begun
            for begun in self.begins.values()
            for name, moments in named.items()
            if self.begins[name] == begun and any(abs(moment - begun) <= ON_TIME for moment in moments)
        }
        return tuple(name for name in self.begins if name in named and self.begins[name] not in told)

    @property
    def wrong(self) -> bool:
        """Whether the explanation is wrong or incomplete: something false is called missing, something hidden denied,
        or named without the moment at which it begins."""
        return not self.honest or bool(self.untimed())

    @property
    def flagged(self) -> bool:
        """Whether the diagnosis says that its explanation is not all there is: something is unexplained or only
        possible."""
        return self.unexplained or any(s.verdict == POSSIBLE for s in self.said)

    def excitation(self, said: Said) -> float:
        """What the effect changes, RMS, over the noise floor of where it is seen."""
        before, _, floor = self.rotational if said.seen_in == "rotation" else self.rms
        return math.sqrt(max(said.share, 0.0)) * before / floor

    @property
    def exact(self) -> bool:
        """Whether the effects called missing are those hidden, and nothing else is named."""
        missing = {s.name for s in self.said if s.verdict == MISSING}
        return missing == set(self.truth) and not self.false(POSSIBLE)

    @property
    def right(self) -> bool:
        """Whether all that is hidden is named or in a group, and nothing false is called missing."""
        return not self.false(MISSING) and all(self.outcome(n) in (MISSING, POSSIBLE) for n in self.truth)

    @property
    def honest(self) -> bool:
        """Whether nothing said is wrong: as `right`, where a hidden effect may also be told to be out of reach."""
        return not self.false(MISSING) and all(self.outcome(n) != ABSENT for n in self.truth)


@dataclass(frozen=True)
class Proportion:
    """`count` of `of`, with Wilson's 95 % interval; share and interval are NaN where `of` is 0."""

    count: int
    of: int
    share: float
    low: float
    high: float


def proportion(hits: Iterable[bool]) -> Proportion:
    """The share of what is true, with its interval."""
    found = list(hits)
    count, of = sum(map(bool, found)), len(found)
    if of == 0:
        return Proportion(0, 0, math.nan, math.nan, math.nan)
    interval = stats.binomtest(count, of).proportion_ci(method="wilson")
    return Proportion(count, of, count / of, float(interval.low), float(interval.high))


@dataclass(frozen=True)
class Row:
    """One row of the confusion matrix: how often `effect` was hidden, what became of it, and what was called missing
    in its place where it was not found itself."""

    effect: str
    hidden: int
    outcomes: dict[str, int]
    instead: dict[str, int]


@dataclass(frozen=True)
class Coverage:
    """How often 95 % intervals hold the truth: of one parameter, of one effect (`parameter` empty), or of all.

    `widen` is the factor on their widths at which 95 % would; `error` the median relative error.
    """

    effect: str
    parameter: str
    inside: Proportion
    widen: float
    error: float


@dataclass(frozen=True)
class Claim:
    """Something that a diagnosis says: that an effect is (or is not) there, how `sure` it is, and whether it is
    right."""

    number: int
    effect: str
    present: bool
    sure: float
    right: bool


@dataclass(frozen=True)
class Bin:
    """Claims that are about equally sure: their mean, and the share of them that is right."""

    low: float
    high: float
    sure: float
    right: Proportion


@dataclass(frozen=True)
class Reliability:
    """How sure verdicts are against how often they are right; `called_sure` those that say 95 % or more."""

    bins: tuple[Bin, ...]
    called_sure: Proportion
    brier: float
    """Mean squared difference between how sure a verdict is and whether it is right (1 or 0); NaN where there is
    none."""


@dataclass(frozen=True)
class Wrong:
    """One flight that the diagnosis got wrong, and how."""

    number: int
    truth: tuple[str, ...]
    said: str
    why: str


@dataclass(frozen=True)
class Calibration:
    """The result of a study."""

    flights: int
    not_flown: int
    failed: int
    exact: Proportion
    right: Proportion
    honest: Proportion
    by: dict[str, dict[str, Proportion]]
    """`right` by number of hidden effects, kind of flight, noise, rotor speeds and length."""
    false_alarm: Proportion
    """Flights with nothing hidden in which an effect is called missing."""
    doubt: Proportion
    """Flights with nothing hidden in which an effect is called missing or possible, or something is unexplained."""
    false_effects: Proportion
    """Flights of all kinds in which an effect that is not there is called missing."""
    unflagged: Proportion
    """Flights with a wrong or incomplete explanation in which nothing is unexplained or only possible."""
    timed: Proportion
    """Effects that begin in flight and are named, with the moment."""
    confusion: tuple[Row, ...]
    coverage: tuple[Coverage, ...]
    claims: int
    """Verdicts that say that an effect is, or is not, there."""
    present: Reliability
    absent: Reliability
    wrong: tuple[Wrong, ...]
    seconds: float = field(default=math.nan)
    """Median time of a diagnosis, s."""


def calibrate(cases: Sequence[Case]) -> Calibration:
    """Tally the flights."""
    good = [c for c in cases if c.said]
    empty = [c for c in good if not c.truth]
    claims = [claim for c in good for claim in claims_of(c)]
    return Calibration(
        flights=len(cases),
        not_flown=sum(not c.said and not c.error for c in cases),
        failed=sum(bool(c.error) for c in cases),
        exact=proportion(c.exact for c in good),
        right=proportion(c.right for c in good),
        honest=proportion(c.honest for c in good),
        by={name: _by(good, key) for name, key in GROUPS.items()},
        false_alarm=proportion(bool(c.false(MISSING)) for c in empty),
        doubt=proportion(bool(c.named()) or c.unexplained for c in empty),
        false_effects=proportion(bool(c.false(MISSING)) for c in good),
        unflagged=proportion(c.wrong and not c.flagged for c in good),
        timed=proportion(
            name not in c.untimed() for c in good for name in c.begins if name in {s.name for s in c.named()}
        ),
        confusion=confusion(good),
        coverage=coverage(good),
        claims=len(claims),
        present=reliability([c for c in claims if c.present]),
        absent=reliability([c for c in claims if not c.present]),
        wrong=tuple(wrong for c in cases for wrong in wrongs(c)),
        seconds=float(np.median([c.diagnosis_seconds for c in good])) if good else math.nan,
    )


GROUPS: dict[str, Callable[[Case], str]] = {
    "hidden effects": lambda c: str(len(c.truth)),
    "kind of flight": lambda c: c.kind,
    "noise": lambda c: f"{c.noise:g} times",
    "rotor speeds": lambda c: "with" if c.rotor_speeds else "without",
    "size": lambda c: f"{c.strength:g} of the usual" if c.truth else "nothing hidden",
    "begins in flight": lambda c: "one" if c.begins else "none",
    "estimate": lambda c: "late" if c.late else "in time",
    "log": lambda c: f"{c.rate:g} Hz",
}


def _by(cases: Sequence[Case], key: Callable[[Case], str]) -> dict[str, Proportion]:
    return {name: proportion(c.right for c in cases if key(c) == name) for name in sorted({*map(key, cases)})}


def confusion(cases: Sequence[Case]) -> tuple[Row, ...]:
    """What became of each effect wherever it was hidden, and last what was named beside all that is true.

    An effect that is not there and called missing is entered in the rows of the hidden effects that were not found in
    that flight; where all were found, in the row `NOTHING`.
    """
    rows = []
    for effect in sorted({name for c in cases for name in c.truth}):
        where = [c for c in cases if effect in c.truth]
        outcomes = {o: sum(c.outcome(effect) == o for c in where) for o in OUTCOMES}
        unfound = [c for c in where if c.outcome(effect) in (NOT_EXCITED, ABSENT)]
        rows.append(Row(effect, len(where), outcomes, _count(n for c in unfound for n in c.false(MISSING))))
    found = [c for c in cases if all(c.outcome(n) in (MISSING, POSSIBLE) for n in c.truth)]
    beside = _count(name for c in found for name in c.false(MISSING))
    clean = sum(not c.false(MISSING) for c in found)
    rows.append(Row(NOTHING, len(found), {ABSENT: clean}, beside))
    return tuple(rows)


def _count(names: Iterable[str]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for name in names:
        counts[name] = counts.get(name, 0) + 1
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def coverage(cases: Sequence[Case]) -> tuple[Coverage, ...]:
    """Coverage of all intervals of effects that were rightly named (first), then by effect and by parameter.

    Only flights in which all that is hidden was named, with the moment at which it begins: what is left out of a model
    bends the parameters of the rest.
    """
    cases = [
        c for c in cases if all(c.outcome(n) in (MISSING, POSSIBLE) for n in c.truth) and not c.untimed()
    ]
    found = [(s.name, e, s.error) for c in cases for s in c.named() if s.name in c.truth for e in s.estimates]
    known = [(name, e, error) for name, e, error in found if e.truth is not None]
    rows = [_covered("", "", known)] if known else []
    for effect in sorted({name for name, *_ in known}):
        mine = [k for k in known if k[0] == effect]
        rows.append(_covered(effect, "", mine))
        names = list(dict.fromkeys(e.name for _, e, _ in mine))
        if len(names) > 1:
            rows += [_covered(effect, name, [k for k in mine if k[1].name == name]) for name in names]
    return tuple(rows)


def _covered(effect: str, parameter: str, known: Sequence[tuple[str, Estimated, float | None]]) -> Coverage:
    misses = [e.miss for _, e, _ in known]
    errors = [error for *_, error in known if error is not None]
    return Coverage(
        effect,
        parameter,
        proportion(e.inside for _, e, _ in known),
        float(np.quantile(misses, 0.95, method="inverted_cdf")),
        float(np.median(errors)) if errors else math.nan,
    )


# --- how sure a verdict is ------------------------------------------------------------------------------------------


def posterior(p_value: float, odds: float) -> float:
    """Probability that an effect is there, by the p-value that it is not and the prior `odds` against it.

    A p-value is no such probability. The least factor that it can leave for the null hypothesis is -e p ln p (Sellke,
    Bayarri, Berger, "Calibration of p values for testing precise null hypotheses", The American Statistician 55, 2001):
    this is the most that a p-value can make sure of.
    """
    p = max(p_value, 1e-300)
    factor = -math.e * p * math.log(p) if p < 1.0 / math.e else 1.0
    return 1.0 / (1.0 + odds * factor)


def claims_of(case: Case) -> list[Claim]:
    """What a diagnosis says of its flight, and how sure it is.

    A verdict's own confidence is taken where it has one. Elsewhere it is the `posterior` by its p-value, with odds
    against any effect of the number of effects that were judged (one of them may be expected to be there). An effect of
    a group claims that one of the group is there.
    """
    judged = [s for s in case.said if s.verdict in (*OUTCOMES, MINOR)]
    odds = float(max(len(judged) - 1, 1))
    claims = []
    for s in judged:
        there = posterior(s.p_value, odds) if s.confidence is None else s.confidence
        if s.rank is not None and s.verdict in (MISSING, POSSIBLE):
            right = s.name in case.truth or any(n in case.truth for n in s.group)
            claims.append(Claim(case.number, s.name, True, there, right))
        elif s.verdict == MINOR and s.confidence is not None:
            claims.append(Claim(case.number, s.name, True, s.confidence, s.name in case.truth))
        elif s.verdict == ABSENT:
            sure = 1.0 - there if s.confidence is None else s.confidence
            claims.append(Claim(case.number, s.name, False, sure, s.name not in case.truth))
    return claims


def reliability(claims: Sequence[Claim]) -> Reliability:
    """The claims in bins of `SURE`; empty bins are left out."""
    bins = []
    for i, (low, high) in enumerate(pairwise(SURE)):
        last = i == len(SURE) - 2
        inside = [c for c in claims if low <= c.sure and (c.sure < high or last)]
        if inside:
            mean = float(np.mean([c.sure for c in inside]))
            bins.append(Bin(low, high, mean, proportion(c.right for c in inside)))
    brier = float(np.mean([(c.sure - c.right) ** 2 for c in claims])) if claims else math.nan
    return Reliability(tuple(bins), proportion(c.right for c in claims if c.sure >= CALLED_SURE), brier)


# --- what was wrong -------------------------------------------------------------------------------------------------


def wrongs(case: Case) -> list[Wrong]:
    """Everything that was wrong about one flight, in words."""
    if case.error:
        return [Wrong(case.number, case.truth, "no diagnosis", case.error)]
    said = ", ".join(f"{s.name}{' (possible)' if s.verdict == POSSIBLE else ''}" for s in case.named())
    said = said or "nothing"
    out = []

    def add(why: str) -> None:
        out.append(Wrong(case.number, case.truth, said, why))

    false = case.false(MISSING)
    lost = [n for n in case.truth if case.outcome(n) == ABSENT]
    unseen = [n for n in case.truth if case.outcome(n) == NOT_EXCITED]
    for name in false:
        where = lost or unseen
        add(f"{name} named instead of {', '.join(where)}" if where else f"false alarm: {name}")
    for name in case.false(POSSIBLE):
        add(f"false doubt: {name}")
    for name in lost:
        told = case.of(name)
        add(f"missed: {name}, said to be absent (p {told.p_value:.2g})" if told else f"missed: {name}")
    for name in case.untimed():
        told = case.of(name)
        said_when = ", ".join(f"{moment:.1f} s" for moment in told.moments) if told else ""
        add(f"moment: {name} begins at {case.begins[name]:g} s, told: {said_when or 'no moment'}")
    if case.wrong and not case.flagged:
        add("not flagged: wrong or incomplete, and nothing is unexplained or only possible")
    for s in case.named():
        if s.name not in case.truth:
            continue
        for e in s.estimates:
            if e.truth is not None and not e.inside:
                add(
                    f"interval: {s.name} {e.name} = {e.value:.4g} [{e.low:.4g}, {e.high:.4g}], true {e.truth:.4g} "
                    f"({e.miss:.1f} half widths)"
                )
    if not case.truth and case.unexplained:
        add("false alarm: unexplained structure")
    return out
