"""None of these: what is left beyond the noise (`identify.adequacy`), and structure that no known effect explains,
found by a flexible learner on held-out blocks.

The learner is ridge regression on an additive spline basis, all products of two variables, and a smooth map of the
place (random Fourier features, Rahimi & Recht 2007), scored block by block on what it did not see. Being linear in its
targets, it learns two hundred made-up residuals nearly as fast as one: residuals of the same spectrum with random
phases, which know nothing of the variables however slowly they wander, and residuals whose sign changes at random,
which keep bursts where they are. Structure counts only where the real residual is predicted better than all but one in
a hundred of each kind.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import special
from scipy.linalg import cho_factor, cho_solve

from trueflight.groundstation.identify.adequacy import excess, misfits
from trueflight.groundstation.identify.fitting import BLOCK
from trueflight.groundstation.identify.sparse import sparse_formula
from trueflight.groundstation.identify.spectrum import spectral_lines
from trueflight.groundstation.identify.surrogates import BURST, random_phases, random_signs
from trueflight.groundstation.measured.bins import bins
from trueflight.groundstation.measured.measurement import Measurement
from trueflight.groundstation.results import SparseFormula, Unexplained
from trueflight.models.frames import euler_from_quaternion, rotate_inverse

SHARE = 0.05
"""Part of the remaining squared error that must be predictable on held-out blocks to be called structure."""
MATERIAL = 0.03
"""m/s² RMS of that part."""
CONSTANT = 0.1
"""m/s² from which a constant is told: a MEMS accelerometer's zero comes back to 10 mg from one day to the next."""
ALPHA = 0.01
"""Probability that a residual without structure is said to have some."""
SURROGATES = 199
"""Made-up residuals of each kind."""
FOLDS = 20
"""Most parts that are held out in turn; of longer flights each part is several blocks."""
BIN = 0.05
"""s over which the residual is averaged before it is learnt: what is faster than 10 Hz is left to the spectrum."""
MOST_BINS = 6000
PENALTIES = (0.003, 0.03, 0.3)
"""Of the ridge, in units of the features' own variance; the best is taken, for made-up residuals as well."""
PLACE_FEATURES = 40


def unexplained(measurement: Measurement, residual: np.ndarray) -> Unexplained:
    """Look for structure in `residual` (K, A), the used samples of `measurement`; the same every time.

    What is beyond the noise, a constant, lines of the spectrum, and what the flight's variables predict are looked for
    one beside the other.
    """
    beyond = misfits(measurement, residual)
    total = float(np.sum(residual**2))
    constant = _constant(measurement, residual)
    lines = spectral_lines(measurement, residual)
    heard = [
        line
        for line in lines
        if line.in_band
        and _material(len(residual) * line.rms**2 / total, residual)
        and not any(x.held and x.low <= line.frequency <= x.high for x in beyond)
    ]
    swinging = residual - residual.mean(axis=0)
    study = _study(measurement, swinging)
    learnt = max(0.0, study.explained / total)
    formula = sparse_formula(measurement, swinging)
    if formula is not None and not _material(formula.variance_share, swinging):
        formula = None
    # a formula has been tested against made-up residuals already
    p = ALPHA if formula is not None else study.p_value() if _material(learnt, residual) else 1.0
    structure = p <= ALPHA
    # what varies has a mean as well: a constant is only told where it is more than that
    steady = sum(c.share for c in constant)
    where = [c.text for c in constant] if not structure or steady > learnt else []
    variables: dict[str, float] = {}
    if structure:
        learnt = max(learnt, 0.0 if formula is None else formula.variance_share * np.sum(swinging**2) / total)
        if formula is not None:
            where.append(f"{formula.text} takes {formula.variance_share:.0%} of what varies")
        variables = study.importance()
        where += [
            f"{name} ({part:.0%} of the remaining error goes with it{study.at(name)})"
            for name, part in list(variables.items())[:3]
            if part > 0.01
        ]
    where += [f"{h.frequency:.1f} Hz on body {h.axis} ({h.rms:.2f} m/s² RMS): {h.text}" for h in heard]
    share = float((learnt if structure else 0.0) + sum(c.share for c in constant))
    courses = [x.text for x in beyond if not (constant and "a constant" in x.text)]
    # what can be predicted comes first where it is most of what is left
    where = [*where, *courses] if share > 0.5 else [*courses, *where]
    advice = ""
    if structure:
        advice = _advice(learnt, variables, formula)
    elif constant:
        advice = (
            "a constant has many causes: fly what groundstation plan-flight FLIGHT designs, to tell which"
        )
    elif heard:
        advice = (
            f"no static effect swings at {heard[0].frequency:.1f} Hz: look at mounting, rotors and loop gains"
        )
    elif beyond:
        advice = (
            "nothing that was logged goes with it: look what changed or moved in flight (battery, payload, propellers, "
            "gusts, the estimator), and fly again to see whether it comes back"
        )
    return Unexplained(
        verdict=bool(structure or constant or heard or beyond),
        variance_share=max(share, excess(measurement, residual) if beyond else 0.0),
        where=tuple(where),
        p_value=float(min([p, *(c.p_value for c in constant), *(h.p_value for h in heard)])),
        variables=variables,
        axes=study.axes() if structure else {},
        moments=study.moments() if structure else (),
        lines=lines,
        formula=formula,
        advice=advice,
        misfit=beyond,
    )


def how_much_is_left(measurement: Measurement, residual: np.ndarray) -> Unexplained:
    """Whether `residual` (K, A) is above the noise, alone: what it goes with is not asked."""
    beyond = misfits(measurement, residual)
    share = excess(measurement, residual) if beyond else 0.0
    return Unexplained(bool(beyond), share, tuple(x.text for x in beyond), misfit=beyond)


@dataclass(frozen=True)
class _Constant:
    text: str
    share: float
    p_value: float


def _constant(m: Measurement, residual: np.ndarray) -> list[_Constant]:
    """Axes on which the residual has a mean, by a t-test over blocks."""
    block = ((m.t[m.used] - m.t[0]) / BLOCK).astype(int)
    _, block = np.unique(block, return_inverse=True)
    count = np.bincount(block)
    if len(count) < 3:
        return []
    found = []
    for column, axis in enumerate(m.axes):
        means = np.bincount(block, weights=residual[:, column]) / count
        mean = float(np.mean(residual[:, column]))
        t = float(np.mean(means) / max(np.std(means, ddof=1) / np.sqrt(len(means)), 1e-30))
        p = 2.0 * float(special.stdtr(len(means) - 1, -abs(t))) * len(m.axes)
        share = len(residual) * mean**2 / float(np.sum(residual**2))
        if p < ALPHA and abs(mean) > CONSTANT and _material(share, residual):
            text = f"a constant {mean:.2f} m/s² on body {'xyz'[axis]} ({share:.0%} of the remaining error)"
            found.append(_Constant(text, share, p))
    return found


def _material(share: float, residual: np.ndarray) -> bool:
    """Whether a share of the remaining squared error is worth telling."""
    return share > SHARE and bool(np.sqrt(share * np.sum(residual**2) / len(residual)) > MATERIAL)


def _advice(share: float, variables: dict[str, float], formula: SparseFormula | None) -> str:
    """What to do about structure that no effect explains."""
    if next(iter(variables), "") in ("east", "north"):
        return (
            "it goes with the place and not with the vehicle: look what is there (a fan, a wall, a draught)"
        )
    if formula is not None and formula.variance_share > 0.5 * share:
        return (
            "write the formula as an effect of your own: groundstation remainder FLIGHT --write DIR; or let a network "
            "learn it: groundstation train FLIGHT"
        )
    return "no short formula holds it; let a network learn it: groundstation train FLIGHT"


@dataclass(frozen=True)
class _Study:
    """A residual in M bins, (M, A), with the `variables` (M, V) it may depend on, and what is learnt of it.

    `count` samples went into each bin; `fold` (M,) numbers the held-out parts, `block` (M,) the blocks; `t` (M,) in s.
    """

    t: np.ndarray
    residual: np.ndarray
    count: float
    block: np.ndarray
    fold: np.ndarray
    names: tuple[str, ...]
    variables: np.ndarray
    features: np.ndarray
    penalty: float
    explained: float
    axes_measured: tuple[int, ...]
    prediction: np.ndarray
    total: float

    def p_value(self) -> float:
        """Share of made-up residuals that are predicted as well, of the kind that is predicted best.

        It stops where a share of `ALPHA` is out of reach (Besag & Clifford 1991).
        """
        rng = np.random.default_rng(0)
        burst = ((self.t - self.t[0]) / BURST).astype(int)
        worst = 0.0
        for make in (random_phases, random_signs):
            as_good, tried = 0, 0
            for count in (19, SURROGATES - 19):
                made = make(self.residual, burst, count, rng)
                gains = _gains(self.features, made.reshape(len(made), -1), self.fold)
                best = gains.reshape(len(PENALTIES), count, -1).sum(axis=-1).max(axis=0)
                as_good, tried = as_good + int(np.sum(best * self.count >= self.explained)), tried + count
                if 1 + as_good > ALPHA * (1 + SURROGATES):
                    break
            worst = max(worst, (1 + as_good) / (1 + tried))
            if worst > ALPHA:
                break
        return worst

    def importance(self) -> dict[str, float]:
        """By variable, the share of the remaining error that comes back when the variable's blocks are exchanged
        (permutation importance on held-out parts), most first."""
        weights = {f: w for f, _, w in _weights(self.features, self.residual, self.fold, self.penalty)}
        right = float(np.sum((self.residual - self.prediction) ** 2))
        rng = np.random.default_rng(1)
        found = {}
        for v, name in enumerate(self.names):
            worse = []
            for _ in range(3):
                moved = self.variables.copy()
                shift = int(rng.integers(len(moved) // 10, max(len(moved) // 10 + 1, len(moved) * 9 // 10)))
                moved[:, v] = np.roll(moved[:, v], shift)
                features = _features(self.names, moved, self.variables)
                error = sum(
                    float(np.sum((self.residual[rows] - features[rows] @ weights[f]) ** 2))
                    for f in weights
                    for rows in (self.fold == f,)
                )
                worse.append(error - right)
            found[name] = float(np.mean(worse)) * self.count / self.total
        return dict(
            sorted(((n, min(x, 1.0)) for n, x in found.items() if x > 0.0), key=lambda pair: -pair[1])
        )

    def axes(self) -> dict[str, float]:
        """Share of the structure on each body axis."""
        gain = np.sum(self.residual**2 - (self.residual - self.prediction) ** 2, axis=0)
        gain = np.maximum(gain, 0.0) / max(float(np.maximum(gain, 0.0).sum()), 1e-30)
        return {"xyz"[a]: float(g) for a, g in zip(self.axes_measured, gain, strict=True)}

    def moments(self) -> tuple[tuple[float, float, float], ...]:
        """The three blocks that hold most of the structure: start, end in s, share."""
        size = np.bincount(self.block, weights=np.sum(self.prediction**2, axis=1))
        size = size / max(size.sum(), 1e-30)
        best = np.argsort(-size)[:3]
        rows = [self.t[self.block == b] for b in best]
        return tuple((float(r[0]), float(r[-1]), float(size[b])) for b, r in zip(best, rows, strict=True))

    def at(self, name: str) -> str:
        """The third of the variable's range, by time, that holds most of the structure, where one does."""
        x = self.variables[:, self.names.index(name)]
        energy = np.sum(self.prediction**2, axis=1)
        low, high = np.quantile(x, [1 / 3, 2 / 3])
        shares = [energy[part].sum() / max(energy.sum(), 1e-30) for part in (x < low, x > high)]
        side = int(np.argmax(shares))
        if shares[side] < 0.5:
            return ""
        bound = f"below {low:.3g}" if side == 0 else f"above {high:.3g}"
        return f", {shares[side]:.0%} of it {bound}"


def _study(m: Measurement, residual: np.ndarray) -> _Study:
    t = m.t[m.used]
    period = float(np.median(np.diff(m.t)))
    width = max(BIN, period, len(t) * period / MOST_BINS)
    begin, binned = bins(t, width)
    names, values = _variables(m)
    variables = binned(values)
    scale = variables.std(axis=0)
    keep = scale > 1e-3 * np.maximum(1.0, np.abs(variables).mean(axis=0))
    names = tuple(n for n, k in zip(names, keep, strict=True) if k)
    variables = variables[:, keep]
    averaged = binned(residual)
    _, block = np.unique(((begin - t[0]) / BLOCK).astype(int), return_inverse=True)
    fold = block * min(FOLDS, int(block.max()) + 1) // (int(block.max()) + 1)
    features = _features(names, variables, variables)
    gains = _gains(features, averaged, fold).sum(axis=1)
    best = int(np.argmax(gains))
    prediction = np.zeros_like(averaged)
    for _, rows, weights in _weights(features, averaged, fold, PENALTIES[best]):
        prediction[rows] = features[rows] @ weights
    count = len(t) / len(averaged)
    return _Study(
        t=begin,
        residual=averaged,
        count=count,
        block=block,
        fold=fold,
        names=names,
        variables=variables,
        features=features,
        penalty=PENALTIES[best],
        explained=float(gains[best]) * count,
        axes_measured=m.axes,
        prediction=prediction,
        total=float(np.sum(residual**2)),
    )


def _features(names: tuple[str, ...], variables: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Features (M, F) of `variables` (M, V), scaled by those the learner knows: hinges, products and a map."""
    low, high = np.quantile(known, [0.005, 0.995], axis=0)
    centre, scale = known.mean(axis=0), np.maximum(known.std(axis=0), 1e-9)
    # beyond what was flown nothing is known: everything is held at its edge
    x = (np.clip(variables, low, high) - centre) / scale
    edges = (np.quantile(known, [0.2, 0.4, 0.6, 0.8], axis=0) - centre) / scale
    hinges = [np.maximum(x - edge, 0.0) for edge in edges]
    i, j = np.triu_indices(x.shape[1])
    columns = [x, *hinges, np.clip(x[:, i] * x[:, j], -9.0, 9.0)]
    place = [names.index(n) for n in ("east", "north", "height") if n in names]
    if len(place) > 1:
        rng = np.random.default_rng(2)
        frequency = rng.normal(0.0, 1.5, (len(place), PLACE_FEATURES))
        columns.append(np.cos(x[:, place] @ frequency + rng.uniform(0, 2 * np.pi, PLACE_FEATURES)))
    features = np.concatenate(columns, axis=1)
    return np.concatenate([np.ones((len(x), 1)), features], axis=1)


def _weights(
    features: np.ndarray, targets: np.ndarray, fold: np.ndarray, penalty: float
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """For each held-out part its number, rows and the weights (F, R) learnt from all others."""
    gram, moment = features.T @ features, features.T @ targets
    ridge = _ridge(gram, penalty, len(features))
    for f in np.unique(fold):
        rows = fold == f
        part = features[rows]
        inner = gram - part.T @ part
        inner[np.diag_indices_from(inner)] += ridge
        yield f, rows, np.linalg.solve(inner, moment - part.T @ targets[rows])


def _gains(features: np.ndarray, targets: np.ndarray, fold: np.ndarray) -> np.ndarray:
    """Squared error that learning takes away on held-out parts, for each penalty and target (P, R).

    What a held-out part leaves is `(1 - H)^-1` times what the fit to everything leaves there, with that part's own
    block of the hat matrix H (Allen 1974, PRESS, by blocks): one factorisation serves all parts and targets.
    """
    gains = np.zeros((len(PENALTIES), targets.shape[1]))
    gram, before = features.T @ features, np.sum(targets**2, axis=0)
    for p, penalty in enumerate(PENALTIES):
        ridge = _ridge(gram, penalty, len(features))
        factor = cho_factor(gram + np.diag(ridge))
        left = targets - features @ cho_solve(factor, features.T @ targets)
        after = np.zeros(targets.shape[1])
        for f in np.unique(fold):
            part = features[fold == f]
            inner = np.eye(len(part)) - part @ cho_solve(factor, part.T)
            after += np.sum(cho_solve(cho_factor(inner), left[fold == f]) ** 2, axis=0)
        gains[p] = before - after
    return gains


def _ridge(gram: np.ndarray, penalty: float, rows: int) -> np.ndarray:
    # a hinge beyond the range that a fold holds is a column of zeros
    ridge = penalty * np.maximum(np.diag(gram), 1e-6 * rows)
    ridge[0] = 1e-9 * rows  # a constant is free
    return ridge


def _variables(m: Measurement) -> tuple[tuple[str, ...], np.ndarray]:
    """What the residual may depend on: names and columns (K, V) of the used samples."""
    flight, rows = m.flight, m.rows[m.used]
    thrust = flight.column("thrust_command")
    columns = {"thrust command": thrust[rows], "time": flight.t[rows]}
    if flight.position is not None:
        height = flight.position[rows, 2]
        columns["height"] = height
        columns["nearness to the ground"] = 1.0 / np.maximum(height, 0.5 * flight.vehicle.rotor_radius)
        columns["east"], columns["north"] = flight.position[rows, 0], flight.position[rows, 1]
    if flight.quaternion is not None:
        euler = euler_from_quaternion(flight.quaternion[rows])
        columns["roll"], columns["pitch"] = euler[:, 0], euler[:, 1]
        columns["heading east"], columns["heading north"] = np.cos(euler[:, 2]), np.sin(euler[:, 2])
        if flight.velocity is not None:
            body = rotate_inverse(flight.quaternion[rows], flight.velocity[rows])
            columns["forward speed"], columns["sideward speed"], columns["climb speed"] = body.T
            columns["speed"] = np.linalg.norm(flight.velocity[rows], axis=1)
    if flight.angular_velocity is not None:
        columns |= dict(
            zip(("roll rate", "pitch rate", "yaw rate"), flight.angular_velocity[rows].T, strict=True)
        )
    if flight.battery_voltage is not None:
        columns["battery voltage"] = flight.battery_voltage[rows]
    return tuple(columns), np.column_stack(list(columns.values()))
