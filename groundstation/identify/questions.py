"""What a flight left open: the explanations that another flight is to tell apart, and the questions between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from trueflight.groundstation.results import Diagnosis
from trueflight.models.effect import Effect
from trueflight.models.effects import EXACT_ROTATION, catalogue
from trueflight.models.errors import InputError
from trueflight.models.model import Term

Pair = tuple[int, int | None]
"""Two candidates by number, the first of them taken to be true; None: nothing but what is known."""


@dataclass(frozen=True)
class Candidate:
    """An explanation: the effects it adds, in order, with the values it is planned for."""

    names: tuple[str, ...]
    values: tuple[dict[str, float], ...]


@dataclass(frozen=True)
class OpenQuestions:
    """What is to be told apart: `candidates`, and the `pairs` of them that are questions.

    `known` are all effects by name, `settled` the terms that are there whichever candidate is true; `left_out` says why
    an effect could not be planned for.
    """

    known: Mapping[str, Effect]
    settled: tuple[Term, ...]
    candidates: tuple[Candidate, ...]
    pairs: tuple[Pair, ...]
    left_out: dict[str, str]

    @property
    def all_pairs(self) -> list[Pair]:
        """Every question, and for each candidate whether it is there at all."""
        alone: list[Pair] = [(i, None) for i in range(len(self.candidates))]
        return [*self.pairs, *(pair for pair in alone if pair not in self.pairs)]


def open_questions(
    diagnosis: Diagnosis | None,
    between: Sequence[str],
    effects_directory: str | None,
    told: Mapping[str, str] | None = None,
) -> OpenQuestions:
    """The effects of `between` against one another; without them, what `diagnosis` left open but for what
    is `told`, with the reason.

    Raises `InputError` where nothing is open.
    """
    known = catalogue(effects_directory)
    terms = (Term(EXACT_ROTATION.name, {}),) if diagnosis is None else diagnosis.model.terms
    asked = list(between) or _left_open(diagnosis, known)
    left_out = {
        n: "it is seen in the rotation, which this plan does not predict"
        for n in asked
        if known[n].rotational or not known[n].parameters
    } | dict(told or {})
    names = tuple(n for n in dict.fromkeys(asked) if n not in left_out)
    if not names:
        reasons = "; ".join(f"{n}: {why}" for n, why in left_out.items())
        raise InputError(
            "nothing is left open that a flight could tell" + (f" ({reasons})" if reasons else "")
            + "; name what to tell apart with --between"
        )  # fmt: skip
    settled = tuple(t for t in terms if t.effect not in asked and not known[t.effect].rotational)
    settled += _carriers(known, settled, names, diagnosis)
    candidates = tuple(_candidate(known, settled, names, n, diagnosis) for n in names)
    return OpenQuestions(known, settled, candidates, _pairs(names, diagnosis, bool(between)), left_out)


def _left_open(diagnosis: Diagnosis | None, known: Mapping[str, Effect]) -> list[str]:
    """What a diagnosis left open: the rivals, or else what the flight could not have shown."""
    if diagnosis is None:
        raise InputError(
            "name the effects to tell apart with --between (twice or more), or pass a flight that left some open"
        )
    rivals = list(diagnosis.named("possible"))
    return rivals or [n for n in diagnosis.named("not_excited") if n in known]


def _carriers(
    known: Mapping[str, Effect],
    settled: Sequence[Term],
    names: Sequence[str],
    diagnosis: Diagnosis | None,
) -> tuple[Term, ...]:
    """What the candidates act through and is neither known nor in question: it may be there whichever is true."""
    present = {t.effect for t in settled} | set(names)
    found: dict[str, Term] = {}
    for name in names:
        needed = known[name].acts_through
        if needed and not (present | set(found)) & set(needed):
            found[needed[0]] = Term(needed[0], _size(known[needed[0]], diagnosis))
    return tuple(found.values())


def _candidate(
    known: Mapping[str, Effect],
    settled: Sequence[Term],
    names: Sequence[str],
    name: str,
    diagnosis: Diagnosis | None,
) -> Candidate:
    """The effect, with the one it acts through where none of these is there anyhow."""
    needed = known[name].acts_through
    added: tuple[str, ...] = (name,)
    if needed and not {t.effect for t in settled} & set(needed):
        added = (next((n for n in needed if n in names), needed[0]), name)
    return Candidate(added, tuple(_size(known[n], diagnosis) for n in added))


def _size(effect: Effect, diagnosis: Diagnosis | None) -> dict[str, float]:
    """The size the diagnosis estimated where it was a possible cause, else the typical one."""
    sizes = {p.name: p.typical for p in effect.parameters}
    if diagnosis is None:
        return sizes
    ranges = {p.name: (p.low, p.high) for p in effect.parameters}
    for verdict in diagnosis.effects:
        if verdict.name == effect.name and verdict.verdict in ("possible", "missing"):
            found = {p.name: p.value for p in verdict.parameters if np.isfinite(p.value)}
            sizes |= {k: float(np.clip(v, *ranges[k])) for k, v in found.items()}
    return sizes


def _pairs(names: Sequence[str], diagnosis: Diagnosis | None, asked: bool) -> tuple[Pair, ...]:
    """The questions: rivals against one another, and where there are none each candidate against nothing."""
    count = len(names)
    rivals = asked or (diagnosis is not None and bool(diagnosis.named("possible")))
    if not rivals or count == 1:
        return tuple((i, None) for i in range(count))
    told: dict[str, set[str]] = {}
    if diagnosis is not None and not asked:
        told = {e.name: set(e.indistinguishable_from) for e in diagnosis.effects}
    return tuple(
        (i, j)
        for i in range(count)
        for j in range(count)
        if i != j and (asked or names[j] in told[names[i]] or names[i] in told[names[j]])
    )
