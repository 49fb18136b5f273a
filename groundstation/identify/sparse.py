"""A short formula for what no effect explains, and the effect file that it becomes.

Orthogonal forward selection (Chen, Billings & Luo 1989) over a library of physical terms, each on each body axis. A
term stays if it explains more than the best of all terms explains of made-up residuals (`identify.surrogates`),
and if it makes held-out blocks better. (STLSQ, PySINDy's default, keeps terms by the size of their coefficient, which
says nothing under correlated residuals.)
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from scipy import special

from trueflight.groundstation.identify.fitting import BLOCK
from trueflight.groundstation.identify.surrogates import BURST, random_phases, random_signs
from trueflight.groundstation.measured.bins import bins
from trueflight.groundstation.measured.measurement import Measurement
from trueflight.groundstation.results import FormulaTerm, SparseFormula
from trueflight.models.effect import Motion
from trueflight.models.prediction import motion_of_flight

ALPHA = 0.01
"""Probability that any term at all is taken from a residual without structure."""
SURROGATES = 199
HELD_OUT_GAIN = 0.01
"""Smallest part of the remaining squared error that a term must take away on held-out blocks."""
MOST_TERMS = 4
MOST_ROWS = 6000
"""Rows that are looked at; those of longer flights are averages."""


@dataclass(frozen=True)
class Symbol:
    """A letter of the formulas: `code` computes it from a `Motion`, in m^`length` s^`time`; it reads `needs`."""

    letter: str
    code: str
    length: int
    time: int
    needs: tuple[str, ...]
    meaning: str
    static: bool = True


_AIR = ("quaternion", "velocity")
SYMBOLS = {
    s.letter: s
    for s in (
        Symbol("u", "motion.body_velocity[0]", 1, -1, _AIR, "air speed along body x"),
        Symbol("v", "motion.body_velocity[1]", 1, -1, _AIR, "air speed along body y"),
        Symbol("w", "motion.body_velocity[2]", 1, -1, _AIR, "air speed along body z"),
        Symbol("T", "motion.thrust", 1, -2, (), "thrust over mass"),
        Symbol("h", "xp.clip(motion.height, 0.05, None)", 1, 0, ("position",), "height"),
        Symbol("p", "motion.body_rate[:, 0]", 0, -1, ("angular_velocity",), "roll rate", False),
        Symbol("q", "motion.body_rate[:, 1]", 0, -1, ("angular_velocity",), "pitch rate", False),
        Symbol("r", "motion.body_rate[:, 2]", 0, -1, ("angular_velocity",), "yaw rate", False),
    )
}
TERMS = (
    *("u", "v", "w", "u |u|", "v |v|", "w |w|", "u u", "v v", "w w", "u v", "u w", "v w", "|u|", "|v|", "|w|"),
    *("u |v|", "v |u|", "w |u|", "w |v|", "u |w|", "v |w|", "T u", "T v", "T w", "T u u", "T v v", "T T"),
    *("h", "1/h", "1/h 1/h", "u 1/h", "v 1/h", "w 1/h", "T 1/h", "T 1/h 1/h"),
    *("p", "q", "r", "p q", "p r", "q r", "p p", "q q", "r r", "u p", "u q", "u r", "v p", "v q", "v r", "w p", "w q"),
    *("w r", "T p", "T q", "T r"),
)  # fmt: skip
"""Products that are tried, simple ones first: factors are letters of `SYMBOLS`, |letter| and 1/letter."""


def _letters(term: str) -> list[str]:
    return re.findall(r"[a-zA-Z]", term)


def unit_of(term: str) -> str:
    """Unit of the coefficient that makes `term` an acceleration."""
    length, time = 1, -2
    for factor in term.split():
        sign = -1 if factor.startswith("1/") else 1
        symbol = SYMBOLS[_letters(factor)[0]]
        length, time = length - sign * symbol.length, time - sign * symbol.time
    up = [_power("m", length)] if length > 0 else []
    up += [_power("s", time)] if time > 0 else []
    down = [_power("m", -length)] if length < 0 else []
    down += [_power("s", -time)] if time < 0 else []
    return ("*".join(up) or "1") + "".join(f"/{d}" for d in down)


def _power(unit: str, exponent: int) -> str:
    return unit if exponent == 1 else f"{unit}^{exponent}"


def written(term: str) -> str:
    """The term as people write it: u u is u², 1/h 1/h is 1/h²."""
    return re.sub(r"(\S+) \1(?= |$)", r"\1²", term)


def code_of(term: str) -> str:
    """The term in Python, over its letters."""
    shapes = {"|": "xp.abs({})", "1": "(1.0 / {})"}
    factors = (shapes.get(f[0], "{}").format(_letters(f)[0]) for f in term.split())
    return " * ".join(factors)


def _columns(motion: Motion, known: set[str]) -> tuple[list[str], np.ndarray]:
    """The terms that the flight can tell, and their columns (N, L)."""
    values: dict[str, np.ndarray] = {}
    for letter, symbol in SYMBOLS.items():
        if set(symbol.needs) <= known:
            values[letter] = eval(symbol.code, {"xp": np, "motion": motion})
    names = [term for term in TERMS if set(_letters(term)) <= set(values)]
    return names, np.column_stack([eval(code_of(t), {"xp": np, **values}) for t in names])


def sparse_formula(measurement: Measurement, residual: np.ndarray) -> SparseFormula | None:
    """A formula of up to four terms for `residual` (K, A), the used samples of `measurement`; None where none holds."""
    m = measurement
    motion = motion_of_flight(m.flight)
    if motion.rotation is None:
        return None
    known = {n for n in ("quaternion", "velocity", "position", "angular_velocity") if m.flight.has(n)}
    names, columns = _columns(motion, known)
    library, t = m.smooth(columns)[m.used], m.t[m.used]
    whole = float(np.mean(residual**2))
    if len(t) > MOST_ROWS:
        t, average = bins(t, len(t) / MOST_ROWS * float(np.median(np.diff(m.t))))
        library, residual = average(library), average(residual)
    _, block = np.unique(((t - t[0]) / BLOCK).astype(int), return_inverse=True)
    total = float(np.sum(residual**2))
    burst = ((t - t[0]) / BURST).astype(int)
    # every axis has its mean in the fit: a constant is no structure
    chosen: list[tuple[int, int]] = []  # (axis column, term)
    error = total
    for _ in range(MOST_TERMS):
        best = _next(library, residual, burst, chosen)
        if best is None:
            break
        held_out = _held_out(library, residual, block, [*chosen, best])
        if error - held_out < HELD_OUT_GAIN * total:
            break
        chosen.append(best)
        error = held_out
    if not chosen:
        return None
    estimates = _jackknife(library, residual, block, chosen)
    factor = float(special.stdtrit(max(int(block.max()), 1), 0.975))
    terms = tuple(
        FormulaTerm(
            "xyz"[m.axes[a]], names[k], c, c - factor * s, c + factor * s, unit_of(names[k])
        )
        for (a, k), (c, s) in zip(chosen, estimates, strict=True)
    )  # fmt: skip
    return SparseFormula(formula_text(terms), terms, max(0.0, total - error) / (whole * residual.size))


def formula_text(terms: tuple[FormulaTerm, ...]) -> str:
    """The formula as people write it, one axis after the other."""
    axes = sorted({t.axis for t in terms})
    sides = (
        f"a_{axis} = " + " + ".join(f"{t.coefficient:.3g} {written(t.term)}" for t in terms if t.axis == axis)
        for axis in axes
    )
    return "; ".join(sides).replace("+ -", "- ")


def _next(
    library: np.ndarray, residual: np.ndarray, burst: np.ndarray, chosen: list[tuple[int, int]]
) -> tuple[int, int] | None:
    """The term that explains most beside the chosen ones; None where chance explains as much."""
    rng = np.random.default_rng(3)
    bases = []
    for a in range(residual.shape[1]):
        base = np.column_stack([np.ones(len(library)), *(library[:, k] for axis, k in chosen if axis == a)])
        bases.append(np.linalg.qr(base)[0])
    left = np.column_stack([residual[:, a] - q @ (q.T @ residual[:, a]) for a, q in enumerate(bases)])
    made = [make(left, burst, SURROGATES, rng) for make in (random_phases, random_signs)]
    scores: dict[tuple[int, int], float] = {}
    by_chance = np.zeros((2, SURROGATES))
    for a, q in enumerate(bases):
        free = library - q @ (q.T @ library)
        size = np.sqrt(np.sum(free**2, axis=0))
        free = free / np.where(size > 1e-6 * np.sqrt(np.sum(library**2, axis=0)) + 1e-12, size, np.inf)
        for kind, columns in enumerate(made):
            by_chance[kind] = np.maximum(by_chance[kind], np.max((free.T @ columns[:, :, a]) ** 2, axis=0))
        for k, score in enumerate((free.T @ left[:, a]) ** 2):
            scores[(a, k)] = float(score)
    best = max(scores, key=lambda key: scores[key])
    p = np.max(1 + np.sum(by_chance >= scores[best], axis=1)) / (1 + SURROGATES)
    return best if p <= ALPHA else None


def _blocks(
    library: np.ndarray, target: np.ndarray, block: np.ndarray, terms: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of each block (B, P + 2, P + 2): a constant, the terms, the target."""
    rows = np.column_stack([np.ones(len(library)), *(library[:, k] for k in terms), target])
    count = int(block.max()) + 1
    grams = np.stack([rows[block == b].T @ rows[block == b] for b in range(count)])
    return grams, grams.sum(axis=0)


def _held_out(
    library: np.ndarray, residual: np.ndarray, block: np.ndarray, chosen: list[tuple[int, int]]
) -> float:
    """Squared error of the formula on each block, fitted to the others; an axis without terms stays as it is."""
    error = 0.0
    for a in range(residual.shape[1]):
        terms = [k for axis, k in chosen if axis == a]
        if not terms:
            error += float(np.sum(residual[:, a] ** 2))
            continue
        grams, total = _blocks(library, residual[:, a], block, terms)
        for gram in grams:
            rest = total - gram
            weights = np.append(-np.linalg.lstsq(rest[:-1, :-1], rest[:-1, -1], rcond=None)[0], 1.0)
            error += float(weights @ gram @ weights)
    return error


def _jackknife(
    library: np.ndarray, residual: np.ndarray, block: np.ndarray, chosen: list[tuple[int, int]]
) -> list[tuple[float, float]]:
    """Coefficient and standard error of each chosen term, by leaving out one block at a time."""
    found: dict[tuple[int, int], tuple[float, float]] = {}
    for a in {axis for axis, _ in chosen}:
        terms = [k for axis, k in chosen if axis == a]
        grams, total = _blocks(library, residual[:, a], block, terms)
        all_of_it = np.linalg.lstsq(total[:-1, :-1], total[:-1, -1], rcond=None)[0]
        rests = (total - gram for gram in grams)
        without = np.array([np.linalg.lstsq(r[:-1, :-1], r[:-1, -1], rcond=None)[0] for r in rests])
        n = len(without)
        spread = np.sqrt((n - 1) / n * np.sum((without - without.mean(axis=0)) ** 2, axis=0))
        for i, k in enumerate(terms, 1):
            found[(a, k)] = (float(all_of_it[i]), float(spread[i]))
    return [found[key] for key in chosen]


def effect_source(formula: SparseFormula, name: str, flight: str, data_hash: str) -> str:
    """The effect file of a formula."""
    letters = sorted({letter for t in formula.terms for letter in _letters(t.term)})
    symbols = [SYMBOLS[letter] for letter in letters]
    names = [f"c{i}" for i in range(1, len(formula.terms) + 1)]
    axes = {axis: ["0.0 * motion.thrust"] for axis in "xyz"}
    for parameter, t in zip(names, formula.terms, strict=True):
        axes[t.axis].append(f"{parameter} * {code_of(t.term)}")
    said = "; ".join(
        f"a_{axis} = "
        + " + ".join(
            f"{c} {written(t.term)}" for c, t in zip(names, formula.terms, strict=True) if t.axis == axis
        )
        for axis in sorted({t.axis for t in formula.terms})
    )
    parameters = "\n".join(
        f'        Parameter("{c}", "{t.unit}", "of {written(t.term)} along body {t.axis}", 0.0, {t.coefficient:.4g}, '
        f"{-10 * abs(t.coefficient):.4g}, {10 * abs(t.coefficient):.4g}),"
        for c, t in zip(names, formula.terms, strict=True)
    )
    needs = sorted({n for s in symbols for n in s.needs} | {"quaternion", "thrust_command"})
    assigned = "\n".join(f"    {s.letter} = {s.code}" for s in symbols)
    meanings = ", ".join(f"{s.letter} {s.meaning}" for s in symbols)
    stacked = ",\n            ".join(" + ".join(axes[axis]) for axis in "xyz")
    return f'''"""{name}: what no effect of the catalogue explains, as a short formula found in a flight."""

from array_api_compat import array_namespace

from trueflight.models.effect import Array, Effect, Motion, Parameter, Stage


def formula(motion: Motion, *, {", ".join(f"{c}: Array" for c in names)}) -> Motion:
    """`{said}`, body axes, m/s²: {meanings}."""
    xp = array_namespace(motion.thrust)
{assigned}
    force = xp.stack(
        [
            {stacked},
        ],
        axis=-1,
    )
    return motion.with_(force=motion.force + force)


EFFECT = Effect(
    name="{name}",
    title="found in a flight: {said}",
    stage=Stage.FORCE,
    formula=formula,
    parameters=(
{parameters}
    ),
    needs=({", ".join(f'"{n}"' for n in needs)}{"," if len(needs) == 1 else ""}),
    manoeuvre="the flight it was found in, and one that varies {", ".join(s.meaning for s in symbols)} on their own",
    citation="fitted to {flight} (sha256 {data_hash[:16] or "unknown"}); a regularity of these data, not a law: it "
    "takes {formula.variance_share:.0%} of what varies in the error that the catalogue left there",
    exports={all(s.static for s in symbols)},
)
'''
