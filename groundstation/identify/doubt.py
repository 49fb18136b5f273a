"""How far what was found can be believed while more is left than noise.

Least squares takes what is left for noise that averages out. A misfit does not: a payload that falls bends a thrust
curve. Here every parameter is estimated a second time with each frequency weighted by what is left at it (Whittle
1953), so that a slow misfit leaves the quick part of the flight to speak. An effect that is there has the same size at
every frequency (a specification test: Hausman, Econometrica 46, 1978), in every part of the flight (Chow,
Econometrica 28, 1960), and where the thrust's scale may wander; one that stands in for something else has not. And what
does less than what is left at its own frequencies and axes may be a part of that (a discrepancy in the sense of Kennedy
& O'Hagan, J. R. Stat. Soc. B 63, 2001, knows no bounds but its size).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage, special

from trueflight.groundstation.identify.fitting import Fit, variance_per_independent_sample
from trueflight.groundstation.identify.search import Problem

SMOOTHING = 0.3
"""Width of the band over which the spectrum of what is left is averaged, as a part of its frequency."""
NARROWEST = 2
"""Frequencies of a flight on either side that are averaged at least."""
SAME = 0.25
"""Part of what an effect does by which frequencies or parts of the flight may differ: lags of some ms, and a law that
is not quite that of the vehicle, make less."""
MASTERED = 0.5
"""Most that may be left at an effect's own frequencies, over what it does, both RMS: what does not twice outweigh a
discrepancy may be made of it."""
HALF_TRUSTED = 0.5
"""Variation at which an effect is as often right as wrong."""
LEAST_TRUST = 0.05
"""Trust that is left however much varies: no study says less than one in twenty."""
PARTS = 8
"""Parts of a flight in which an effect is to have the same size."""
ALPHA = 0.01
"""Probability that an effect that is there is said to have two sizes."""
CHANCE = 5e-4
"""Probability that chance is called an effect: 0.01 over twenty candidates."""


@dataclass(frozen=True)
class Weighed:
    """An effect weighed with the spectrum of what is left.

    `size` and `spread` are the estimate of each of its numbers, less "no effect", and its standard deviation. By
    `moved` of its size it differs from the plain estimate, by `varies` over the parts of the flight; 0 where chance
    makes as much; by `shared` it changes where each part of the flight has a scale of thrust of its own. `beside` is
    what is left beyond the noise where the effect acts, over what the effect does there, in squares. `p_value` is that
    of no effect.
    """

    size: np.ndarray
    spread: np.ndarray
    moved: float
    varies: float
    shared: float
    beside: float
    p_value: float

    @property
    def steady(self) -> bool:
        """Whether it is of one size at every frequency and throughout the flight."""
        return max(self.moved, self.varies, self.shared) < SAME

    @property
    def holds(self) -> bool:
        """Whether it is there whatever else is."""
        return self.steady and self.p_value < CHANCE and self.beside < MASTERED**2

    @property
    def trust(self) -> float:
        """Probability that what is there is this effect and not what is left: in seeded flights with falling payloads,
        swinging loads and gusts 27 of 29 effects were right that vary by less than a third, and 3 of 16 that go by more
        with frequency or the scale of thrust. That parts of the flight differ speaks against its constancy alone."""
        worst = max(self.moved, self.shared)
        doubt = max(worst / HALF_TRUSTED, np.sqrt(self.beside) / (1.5 * MASTERED))
        return max(float(1.0 / (1.0 + doubt**3)), LEAST_TRUST) if self.p_value < CHANCE else 0.5

    @property
    def told(self) -> str:
        """What a verdict on it rests on."""
        if self.p_value >= CHANCE:
            return "weighed with the spectrum of what is left, it may be nothing"
        if self.beside >= MASTERED**2:
            return "it does less than twice what is left unexplained at the same frequencies"
        if self.steady:
            return "of one size at every frequency and throughout the flight, beside what is left unexplained"
        worst, why = max(
            (self.moved, "quick and slow motion differ on its size by {:.0%}"),
            (
                self.varies,
                "parts of the flight differ on its size by {:.0%}: it may have begun or changed in flight",
            ),
            (self.shared, "{:.0%} of it goes where the scale of thrust may change in flight"),
        )
        return why.format(min(worst, 9.99)).replace("%", " %")


class Weighing:
    """The fit `here` of flights measured at `measurements`, estimated again with each frequency weighted by what is
    left at it; `floor` (A,) is the noise of each axis, RMS. Where it is `quiet`, nothing is said of what is steady."""

    def __init__(self, problem: Problem, here: Fit, floor: np.ndarray, quiet: bool = False) -> None:
        self.quiet = quiet
        self.here, self.problem, measurements = here, problem, problem.measurements
        count = len(here.free)
        normal = np.zeros((count, count))  # of least squares
        meat, weighted = normal.copy(), normal.copy()
        pull, at = np.zeros(count), 0
        self._seen: list[tuple[np.ndarray, np.ndarray]] = []  # beyond the noise, and the Jacobian, by axis
        for m in measurements:
            rows = slice(at, at + int(m.used.sum()))
            at = rows.stop
            size = len(m.t)
            placed = np.zeros((size, here.residual.shape[1]))
            placed[m.used] = here.residual[rows]
            columns = np.zeros((size, *here.jacobian.shape[1:]))
            columns[m.used] = here.jacobian[rows]
            r, j = np.fft.rfft(placed, axis=0), np.fft.rfft(columns, axis=0)
            for axis in range(r.shape[1]):
                density = np.maximum(
                    _smoothed(np.abs(r[:, axis]) ** 2), float(m.used.sum()) * floor[axis] ** 2 * 1e-3
                )
                outer = 2.0 * np.real(np.einsum("fp,fq->fpq", np.conj(j[:, axis]), j[:, axis]))
                noise = float(m.used.sum()) * floor[axis] ** 2
                self._seen.append((np.maximum(density - noise, 0.0), j[:, axis]))
                normal += outer.sum(axis=0)
                meat += np.einsum("f,fpq->pq", density, outer)
                weighted += np.einsum("f,fpq->pq", 1.0 / density, outer)
                pull += 2.0 * np.real(np.conj(j[:, axis]).T @ (r[:, axis] / density))
        prior = np.diag([0.0 if f.flat else f.spread**-2.0 for f in here.free])
        bread = np.linalg.pinv(normal, hermitian=True)
        self.plain = bread @ meat @ bread
        self.covariance = np.linalg.pinv(weighted + prior, hermitian=True)
        self.step = -self.covariance @ pull

    def of(self, effect: str) -> Weighed | None:
        """The effect as the weighted estimate has it; None where it has no number that says how much of it there is."""
        own = self.here.sizes(effect)
        if not own:
            return None
        plain = self.here.estimate[own] - [self.here.free[i].neutral for i in own]
        step, covariance = self.step[own], self.covariance[np.ix_(own, own)]
        # what both estimates differ by is uncertain by the difference of their covariances
        apart = self.plain[np.ix_(own, own)] - covariance
        values, vectors = np.linalg.eigh(apart)
        least = np.diag(vectors.T @ covariance @ vectors)
        along = (vectors.T @ step) ** 2 / np.maximum(values, 0.1 * least)
        p_apart = float(special.chdtrc(len(own), along.sum()))
        size = plain + step
        statistic = float(size @ np.linalg.pinv(covariance, hermitian=True) @ size)
        return Weighed(
            size,
            np.sqrt(np.maximum(np.diag(covariance), 0.0)),
            self._moved(own, step, plain) if p_apart < ALPHA else 0.0,
            self._varies(own, plain),
            self._shared(effect, own, plain),
            self._beside(own, plain),
            # the density of what is left is itself known from a few frequencies only
            float(special.fdtrc(len(own), 2 * (2 * NARROWEST + 1), max(statistic, 0.0) / len(own))),
        )

    def _moved(self, own: list[int], step: np.ndarray, plain: np.ndarray) -> float:
        """What a step of its numbers changes, over what the effect does, both RMS."""
        flat = self.here.jacobian[:, :, own].reshape(-1, len(own))
        gram = flat.T @ flat
        return float(np.sqrt(max(step @ gram @ step, 0.0) / max(plain @ gram @ plain, 1e-30)))

    def _varies(self, own: list[int], plain: np.ndarray) -> float:
        """How much the parts of the flight differ on what the effect does, over what it does, both RMS; 0 where chance
        makes as much."""
        part = self._parts()
        jacobian, residual = self.here.jacobian[:, :, own], self.here.residual
        gained = done = 0.0
        for p in np.unique(part):
            flat = jacobian[part == p].reshape(-1, len(own))
            gram, slope = flat.T @ flat, flat.T @ residual[part == p].ravel()
            gained += float(slope @ np.linalg.pinv(gram, hermitian=True) @ slope)
            done += float(plain @ gram @ plain)
        chance = special.chdtri(len(own) * (int(part.max()) + 1), ALPHA)
        unit = variance_per_independent_sample(self.problem, residual)
        return float(np.sqrt(gained / max(done, 1e-30))) if gained > chance * unit else 0.0

    def _shared(self, effect: str, own: list[int], plain: np.ndarray) -> float:
        """How much of the effect goes, by its RMS, where the scale of thrust may differ between parts of the flight."""
        scale = self.problem.scale_of_thrust(self.here)
        if scale is None or effect in scale[0]:
            return 0.0
        part = np.repeat(self._parts(), self.here.residual.shape[1])
        wandering = np.column_stack([np.where(part == p, scale[1], 0.0) for p in np.unique(part)])
        count = len(self.here.free)
        flat = np.column_stack([self.here.jacobian.reshape(-1, count), wandering])
        size = np.maximum(np.linalg.norm(flat, axis=0), 1e-30)
        flat = flat / size
        step = -np.linalg.pinv(flat.T @ flat, rcond=1e-9, hermitian=True) @ (
            flat.T @ self.here.residual.ravel()
        )
        return self._moved(own, (step / size)[own], plain)

    def _beside(self, own: list[int], plain: np.ndarray) -> float:
        """What is left beyond the noise over what the effect does, both squared, at the frequencies and on the axes at
        which it acts."""
        done = [np.abs(j[:, own] @ plain) ** 2 for _, j in self._seen]
        left = sum(float(np.sum(e * beyond)) for e, (beyond, _) in zip(done, self._seen, strict=True))
        return left / max(sum(float(np.sum(e * e)) for e in done), 1e-30)

    def _parts(self) -> np.ndarray:
        """Which part of the flights each used sample is of, (K,)."""
        count = len(self.here.residual)
        return np.minimum(PARTS * np.arange(count) // max(count, 1), PARTS - 1)


def _smoothed(power: np.ndarray) -> np.ndarray:
    """Power (F,) averaged over a band that widens with the frequency."""
    sums = np.concatenate([[0.0], np.cumsum(power)])
    k = np.arange(len(power))
    half = np.maximum(NARROWEST, (0.5 * SMOOTHING * k).astype(int))
    low, high = np.maximum(k - half, 0), np.minimum(k + half + 1, len(power))
    return np.asarray(ndimage.uniform_filter1d((sums[high] - sums[low]) / (high - low), 3, mode="nearest"))
