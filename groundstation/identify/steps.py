"""Does an effect change in flight, when, and in one step or by and by: one effect's size over time beside a fit.

The normal equations of the linearised effect are summed over short bins of the flight, and what is fitted beside it is
projected out. From these sums the gain of a change at every moment follows at once (the sup-Wald test of Andrews,
Econometrica 61, 1993, over all moments), of further ones beside those known (Bai & Perron, J. Appl. Econometrics 18,
2003), and the likelihood of an effect that wanders (a random walk, or one that comes back to its mean: Ornstein &
Uhlenbeck), with its course. The interval of a moment inverts the likelihood ratio: Hansen, Econometrica 68, 2000.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from trueflight.groundstation.identify.fitting import HAC_LAG, Fit, Measured, variance_per_independent_sample

FINEST = 1.0
"""s of a bin at least: a step between two is found to a sample later."""
MOST_BINS = 120
SHORTEST = 3.0 * HAC_LAG
"""s that each side of a change lasts at least: less is a gust or a bump, and holds too few independent samples."""
EDGE = 0.05
"""Part of the flight that each side of a change lasts at least."""
MOMENT = 7.35
"""Likelihood ratio up to which a moment is within the 95 % interval: (1 - exp(-x / 2))² = 0.95 (Hansen 2000)."""
WANDERS = 10.0 ** np.arange(-2.0, 0.8, 0.2)
"""Sizes of a wander over the flight that are tried, in typical sizes of the effect."""


@dataclass(frozen=True)
class Wander:
    """An effect that changes by and by: `gain` is twice the log likelihood ratio against a constant one; at `times`
    (B,) s, `course` (B, p) is what it is beyond its mean and `spread` (B, p) the standard deviation, in typical
    sizes."""

    gain: float
    times: np.ndarray
    course: np.ndarray
    spread: np.ndarray


class Course:
    """The course of an effect over a flight, beside what is fitted `here`.

    `columns` (K A, p) is what each of its numbers changes at its typical size, at the K used samples of the flight. The
    effect itself, of one size, is always fitted.
    """

    def __init__(self, problem: Measured, here: Fit, columns: np.ndarray) -> None:
        self.problem, self.residual = problem, here.residual
        k, a = here.residual.shape
        self.t = np.concatenate([m.t[m.used] for m in problem.measurements])
        self.columns = columns.reshape(k, a, -1)
        beside = np.concatenate([here.jacobian, self.columns], axis=2)
        scale = np.sqrt(np.sum(beside**2, axis=(0, 1)))
        self._beside = beside[:, :, scale > 0.0] / scale[scale > 0.0]
        flat = self._beside.reshape(k * a, -1)
        # what is fitted is collinear with the effect where it is among it
        self._inverse = np.linalg.pinv(flat.T @ flat, rcond=1e-9, hermitian=True)
        step = self._inverse @ (flat.T @ self.residual.ravel())
        self.left = self.residual - (flat @ step).reshape(k, a)
        self.static_gain = float(np.sum(self.residual**2) - np.sum(self.left**2))
        width = max(FINEST, float(self.t[-1] - self.t[0]) / MOST_BINS)
        number = ((self.t - self.t[0]) / width).astype(int)
        _, self._bin = np.unique(number, return_inverse=True)
        self._starts = np.searchsorted(self._bin, np.arange(self._bin[-1] + 1))
        self.times = self.t[self._starts]
        self._sum_bins()

    def _sum_bins(self) -> None:
        c, b = self.columns, self._beside
        p, n = c.shape[2], len(self._starts)

        def binned(x: np.ndarray) -> np.ndarray:
            return np.add.reduceat(x, self._starts, axis=0)

        own = binned(np.einsum("kap,kaq->kpq", c, c))
        cross = binned(np.einsum("kap,kaj->kpj", c, b)).reshape(n * p, -1)
        gram = -cross @ self._inverse @ cross.T
        for i in range(n):
            gram[i * p : (i + 1) * p, i * p : (i + 1) * p] += own[i]
        self.gram = gram.reshape(n, p, n, p)
        self.score = binned(np.einsum("kap,ka->kp", c, self.left))

    @property
    def count(self) -> int:
        """Moments that can be told apart."""
        return len(self.times)

    # --- steps ----------------------------------------------------------------------------------------------

    def steps(self, known: Sequence[float] = ()) -> tuple[np.ndarray, np.ndarray]:
        """Gain (B,) in squared error of a further change at the beginning of each bin, beside changes at the `known`
        moments, and the change (B, p) there; 0 where a side would be too short."""
        p = self.score.shape[1]
        gram = self.gram[::-1].cumsum(axis=0)[::-1][:, :, ::-1].cumsum(axis=2)[:, :, ::-1]
        score = self.score[::-1].cumsum(axis=0)[::-1]
        at = np.unique([int(np.argmin(np.abs(self.times - t))) for t in known]).astype(int)
        gram, score = _without(gram, score, at)
        inner = np.einsum("bpbq->bpq", gram)
        size = np.einsum("bpp->bp", inner)
        whole = np.maximum(np.einsum("bpbp->bp", self.gram).sum(axis=0), 1e-30)
        ridge = 1e-9 * whole[None, :] + 1e-30
        change = np.linalg.solve(inner + ridge[:, :, None] * np.eye(p), score[:, :, None])[:, :, 0]
        change = np.where(size > 1e-6 * whole, change, 0.0)
        gained = np.sum(change * score, axis=1)
        edges = [self.t[0], self.t[-1], *known]
        near = np.min(np.abs(self.times[:, None] - np.array(edges)[None, :]), axis=1) < max(
            SHORTEST, EDGE * float(self.t[-1] - self.t[0])
        )
        return np.where(near, 0.0, np.maximum(gained, 0.0)), change

    def segmented(self, known: Sequence[float], chance: float, most: int) -> list[float]:
        """Moments of changes, the `known` ones included, as long as a further one gains more than `chance`, in squared
        errors worth one independent sample, and there are no more than `most` in all."""
        found = sorted(known)
        while len(found) < most:
            gains, _ = self.steps(found)
            near = float(self.times[np.argmax(gains)])
            change, left = self.fitted((*found, near))
            if gains.max() <= chance * self.unit(change, left):
                break
            found.append(self.moment(near, found)[0])
            for k in range(len(found) - 1 if len(found) > 1 else 0):
                others = [t for i, t in enumerate(found) if i != k]
                gains, _ = self.steps(others)
                found[k] = self.moment(float(self.times[np.argmax(gains)]), others)[0]
        return sorted(found)

    def unit(self, change: np.ndarray, left: np.ndarray) -> float:
        """Squared error worth one independent sample on the axes and at the times at which `change` (K, A) acts, where
        `left` (K, A) remains."""
        seen = np.sum(change * left, axis=1)
        energy = float(np.mean(np.sum(change**2, axis=1)))
        # an effect that does nothing here has no unit: any will do but none
        return max(variance_per_independent_sample(self.problem, seen[:, None]), 1e-30) / max(energy, 1e-30)

    def fitted(self, moments: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """What changes at exactly these moments add (K, A), by least squares, and what remains (K, A)."""
        k, a = self.residual.shape
        stepped = [np.where(self.t[:, None, None] >= t, self.columns, 0.0) for t in moments]
        matrix = np.concatenate(stepped, axis=2).reshape(k * a, -1)
        flat = self._beside.reshape(k * a, -1)
        own = matrix - flat @ (self._inverse @ (flat.T @ matrix))
        x = np.linalg.lstsq(own.T @ own, own.T @ self.left.ravel(), rcond=1e-9)[0]
        return (matrix @ x).reshape(k, a), self.left - (own @ x).reshape(k, a)

    def moment(self, near: float, others: Sequence[float] = ()) -> tuple[float, float, float]:
        """The moment of a change that was found `near` one, and its 95 % interval, s."""
        width = float(np.median(np.diff(self.times)))
        asked = self.t[np.abs(self.t - near) <= 1.5 * width]
        gains = self._gains(asked, others)
        best = float(asked[np.argmax(gains)])
        change, left = self.fitted((*others, best))
        unit = self.unit(change, left)
        edges = [self.t[0], *[x for x in others if x < best]], [self.t[-1], *[x for x in others if x > best]]
        low, high = max(edges[0]) + FINEST, min(edges[1]) - FINEST
        asked = self.t[(self.t > low) & (self.t < high)]
        every = max(1, len(asked) // 2000)
        asked = np.union1d(asked[::every], self.t[np.abs(self.t - best) <= 1.5 * width])
        gains = self._gains(asked, others)
        within = asked[gains >= gains.max() - MOMENT * unit]
        period = float(np.median(np.diff(self.t)))
        # it may have been anywhere since the sample before
        before = float(self.t[max(int(np.searchsorted(self.t, within[0])) - 1, 0)])
        return best, before, float(within[-1] + period)

    def _gains(self, asked: np.ndarray, others: Sequence[float]) -> np.ndarray:
        """Gain of a change at each of the moments `asked`, by cumulative sums over samples."""
        k, a = self.residual.shape
        beside, left = self._beside, self.left
        if others:
            stepped = [np.where(self.t[:, None, None] >= t, self.columns, 0.0) for t in others]
            beside = np.concatenate([beside, *stepped], axis=2)
        flat = beside.reshape(k * a, -1)
        inverse = np.linalg.pinv(flat.T @ flat, rcond=1e-9, hermitian=True)
        left = self.residual - (flat @ (inverse @ (flat.T @ self.residual.ravel()))).reshape(k, a)

        def after(x: np.ndarray) -> np.ndarray:
            at = np.searchsorted(self.t, asked)
            sums = np.concatenate([np.cumsum(x[::-1], axis=0)[::-1], np.zeros((1, *x.shape[1:]))])
            return sums[at]

        c = self.columns
        own = after(np.einsum("kap,kaq->kpq", c, c))
        cross = after(np.einsum("kap,kaj->kpj", c, beside))
        score = after(np.einsum("kap,ka->kp", c, left))
        inner = own - np.einsum("npj,ji,nqi->npq", cross, inverse, cross)
        whole = np.einsum("npp->np", own).max(axis=0)
        inner = inner + (1e-9 * whole + 1e-30) * np.eye(c.shape[2])
        return np.einsum("np,np->n", score, np.linalg.solve(inner, score[:, :, None])[:, :, 0])

    # --- by and by ------------------------------------------------------------------------------------------

    def wander(self, unit: float, correlation: float = np.inf) -> Wander:
        """The effect as a random walk, or one with a `correlation` time in s: the likeliest size of it, with squared
        error in units of one independent sample."""
        n, p = self.score.shape
        duration = float(self.times[-1] - self.times[0])
        middle = self.times + 0.5 * float(np.median(np.diff(self.times)))
        lag = np.abs(middle[:, None] - middle[None, :])
        if np.isfinite(correlation):
            prior = np.exp(-lag / correlation)
        else:
            prior = np.minimum(middle[:, None], middle[None, :]) - middle[0]
            prior = prior / max(duration, 1e-9)
        root = np.linalg.cholesky(prior + 1e-9 * np.eye(n))
        rooted = np.kron(root, np.eye(p))
        values, vectors = linalg.eigh(rooted.T @ self.gram.reshape(n * p, n * p) @ rooted / unit)
        values = np.maximum(values, 0.0)
        turned = vectors.T @ (rooted.T @ self.score.ravel()) / unit
        best, size = -np.inf, 0.0
        for s in WANDERS**2:
            gain = float(np.sum(s * turned**2 / (1.0 + s * values)) - np.sum(np.log1p(s * values)))
            if gain > best:
                best, size = gain, float(s)
        shrunk = size / (1.0 + size * values)
        back = rooted @ vectors
        course = (back @ (shrunk * turned)).reshape(n, p)
        # what is told is the course about its mean: the constant part is fitted
        back = (back.reshape(n, p, -1) - back.reshape(n, p, -1).mean(axis=0)).reshape(n * p, -1)
        course = course - course.mean(axis=0)
        variance = np.sum(back**2 * shrunk, axis=1).reshape(n, p)
        return Wander(best, middle, course, np.sqrt(variance))

    def added(self, course: np.ndarray) -> np.ndarray:
        """What a course (B, p) of the effect adds to the prediction (K, A)."""
        return np.einsum("kap,kp->ka", self.columns, course[self._bin])

    def wandering(self, course: np.ndarray) -> np.ndarray:
        """What remains (K, A) beside a course (B, p) of the effect."""
        k, a = self.residual.shape
        added = self.added(course)
        flat = self._beside.reshape(k * a, -1)
        own = added.ravel() - flat @ (self._inverse @ (flat.T @ added.ravel()))
        return np.asarray(self.left - own.reshape(k, a))


def _without(gram: np.ndarray, score: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations (B, p, B, p), (B, p) with the steps of the bins `at` projected out."""
    if not len(at):
        return gram, score
    n, p = score.shape
    index = (at[:, None] * p + np.arange(p)).ravel()
    flat, s = gram.reshape(n * p, n * p), score.ravel()
    inverse = np.linalg.pinv(flat[np.ix_(index, index)], rcond=1e-9, hermitian=True)
    cross = flat[:, index] @ inverse
    return (flat - cross @ flat[index]).reshape(n, p, n, p), (s - cross @ s[index]).reshape(n, p)
