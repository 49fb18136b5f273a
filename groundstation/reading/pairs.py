"""Pairs of columns that physics ties together, compared over short windows of a flight."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from trueflight.groundstation.reading.faults import Columns, Fault, about_z, turn_between
from trueflight.groundstation.reading.plausible import body_rate
from trueflight.groundstation.reading.uniform import continuous_quaternion, segments, slopes
from trueflight.models.frames import rotate
from trueflight.models.vehicle import GRAVITY

TURN = 0.25
"""s over which attitude and gyroscope are compared: above the noise of both, below most manoeuvres."""
MOVE = 0.5
"""s over which position, velocity and acceleration are compared."""
TURNS, MOVES, GAINS = 0.05, 0.05, 0.3
"""RMS in rad/s, m/s and m/s² from which on a flight moves enough to know; below, biases and noise decide."""
MOST_DRAG = 1.0
"""1/s; what drag takes of a velocity, as an acceleration, at most."""
ENOUGH = 5.0
"""s of motion without which nothing is said."""

ROTATION = "attitude and gyroscope"
MOTION = "position and velocity"
FORCE = "velocity and accelerometer"
TILT = "velocity and tilt"


@dataclass(frozen=True)
class Pair:
    """Two sides of one motion, (M, k) each, in the same unit.

    They last `seconds`, in windows of `window` s. Below an RMS of `weak` they tell nothing (where one side alone moves:
    below three times that). `beside` (M, k) is the velocity, where `one` may lack a share of it.
    """

    name: str
    one: np.ndarray
    other: np.ndarray
    seconds: float
    window: float
    weak: float
    beside: np.ndarray | None = None

    @property
    def moves(self) -> bool:
        """Whether there is motion enough to compare."""
        if self.seconds < ENOUGH or not len(self.one):
            return False
        one, other = _rms(self.one), _rms(self.other)
        return min(one, other) > self.weak or max(one, other) > 3.0 * self.weak

    @property
    def left(self) -> float:
        """Share of the motion's energy by which the two differ, beyond what drag may take; 0 where they agree, 2 where
        they are strangers."""
        energy = 0.5 * (_squares(self.one) + _squares(self.other))
        differ = self.one - self.other
        if self.beside is not None:
            drag = -np.sum(differ * self.beside, axis=0) / np.maximum(np.sum(self.beside**2, axis=0), 1e-12)
            differ = differ + np.clip(drag, 0.0, MOST_DRAG) * self.beside
        return _squares(differ) / max(energy, 1e-12)

    def turned_back(self, angle: float) -> Pair:
        """The pair with `one` turned about z by `-angle` rad."""
        turn = about_z(-angle)[: self.one.shape[1], : self.one.shape[1]].T
        return replace(self, one=self.one @ turn, beside=None if self.beside is None else self.beside @ turn)

    def turn(self) -> float:
        """The turn of `one` about z against `other` that leaves least, rad. Drag across what a circle gains looks
        like a turn: both are fitted."""
        if self.beside is None:
            return turn_between(self.other, self.one)
        angles = np.radians(np.arange(-180.0, 180.0))
        return float(min(angles, key=lambda angle: self.turned_back(float(angle)).left))

    def likelihood(self, left: float) -> float:
        """Log likelihood that is gained where only the share `left` stays, every window counted once."""
        return self.gained(self.left, left)

    def gained(self, before: float, after: float) -> float:
        """Log likelihood that is gained where the share `after` stays instead of `before`."""
        count = self.one.shape[1] * self.seconds / self.window
        return float(0.5 * count * np.log(max(before, 1e-6) / max(after, 1e-6)))


class Windows:
    """The windows of one flight: clock `t` (N,), even within its stretches, and `flying` (N,).

    `rates` are the true rates in Hz of columns that were held: windows span three of their values at least.
    """

    def __init__(self, t: np.ndarray, flying: np.ndarray, rates: Mapping[str, float] | None = None) -> None:
        self.t, self.flying = t, flying
        self.dt = float(np.median(np.diff(t)))
        turning = [
            3.0 / rate for name, rate in (rates or {}).items() if name in ("quaternion", "angular_velocity")
        ]
        moving = [3.0 / rate for rate in (rates or {}).values()]
        self.turn = max(1, round(max(TURN, *turning, 0.0) / self.dt))
        self.move = max(1, round(max(MOVE, *moving, 0.0) / self.dt))
        self.parts = segments(t)
        self._rows: dict[tuple[int, int], np.ndarray] = {}
        self._means: dict[tuple[str, int, int], tuple[np.ndarray, np.ndarray]] = {}
        no = np.empty(0)
        # attitude and force, and the attitude, with what became of them
        self._turned: tuple[np.ndarray, np.ndarray, np.ndarray] = (no, no, no)
        self._leaned: tuple[np.ndarray, np.ndarray] = (no, no)

    def rows(self, width: int, reach: int = 0) -> np.ndarray:
        """First rows of windows of `width` samples in the air, with `reach` more on either side, a quarter apart."""
        if (width, reach) not in self._rows:
            starts = [np.arange(s.start + reach, s.stop - width - reach) for s in self.parts]
            rows = np.concatenate([*starts, np.array([], dtype=int)])
            ground = np.concatenate([[0], np.cumsum(~self.flying)])
            rows = rows[ground[rows + width + 1] == ground[rows]]
            self._rows[width, reach] = rows[:: max(1, width // 4)].copy()
        return self._rows[width, reach]

    def pairs(self, columns: Columns) -> list[Pair]:
        """The pairs that the columns allow."""
        return [self.pair(name, columns) for name in _possible(columns)]

    def pair(self, name: str, columns: Columns, shift: int = 0, reach: int = 0) -> Pair:
        """One pair, which the columns allow.

        Attitude and trajectory are read `shift` samples (at most `reach`) later than gyroscope and accelerometer;
        without these the trajectory later than the attitude.
        """
        width = self.turn if name == ROTATION else self.move
        rows = self.rows(width, reach)
        one = self._moved(name, columns, rows + shift)
        if name == ROTATION:
            turned = self._mean_of("angular_velocity", columns, rows, width, reach)
            return self._pair(name, one, turned, rows, width, TURNS)
        if name == MOTION:
            return self._pair(
                name, one, self._mean_of("velocity", columns, rows, width, reach), rows, width, MOVES
            )
        if name == FORCE:
            felt = rotate(columns["quaternion"], columns["specific_force"])
            return self._pair(name, one, self._felt(self.mean(felt, rows, width)), rows, width, GAINS)
        return self._tilted(one, columns, rows, shift)

    def later(self, pair: Pair, columns: Columns, shift: int, reach: int) -> Pair:
        """A pair that was made with this `reach`, with another `shift`."""
        if pair.name == TILT:
            return self.pair(pair.name, columns, shift, reach)
        rows = self.rows(self.turn if pair.name == ROTATION else self.move, reach)
        return replace(pair, one=self._moved(pair.name, columns, rows + shift))

    def _moved(self, name: str, columns: Columns, rows: np.ndarray) -> np.ndarray:
        """What attitude or trajectory did in the windows from `rows` on: turned (rad/s), moved (m/s), or gained (m/s²,
        without its mean, for a bias and a steady wind are no disagreement)."""
        if name == ROTATION:
            q = columns["quaternion"]
            return body_rate(q[rows], q[rows + self.turn], self.turn * self.dt)
        moved = columns["position"] if name == MOTION else self._velocity(columns)
        change = (moved[rows + self.move] - moved[rows]) / (self.move * self.dt)
        return change if name == MOTION or not len(rows) else np.asarray(change - change.mean(0))

    def _velocity(self, columns: Columns) -> np.ndarray:
        return columns["velocity"] if "velocity" in columns else slopes(self.t, columns["position"])

    def mended(self, columns: Columns, pairs: list[Pair], fault: Fault) -> list[Pair]:
        """`pairs` of these columns as they would be without the `fault`; quick where vectors stand in other axes."""
        if fault.axes is None or any(p.name == TILT for p in pairs):
            return self.pairs(fault.mend(columns))
        path = "velocity" if "velocity" in columns else "position"
        out = []
        for pair in pairs:
            one, other = pair.one, pair.other
            first, second = {
                ROTATION: ("", "angular_velocity"),
                MOTION: ("position", "velocity"),
                FORCE: (path, ""),
            }[pair.name]
            if first in fault.names:
                one = one @ fault.axes.T
            if second in fault.names:
                other = other @ fault.axes.T
            if pair.name == FORCE and "specific_force" in fault.names:
                other = self._felt(np.einsum("mijk,jk->mi", self._turned_force(columns), fault.axes))
            out.append(replace(pair, one=one, other=other))
        return out

    def _turned_force(self, columns: Columns) -> np.ndarray:
        """Mean over each window of each element of the rotation times each axis of the accelerometer, (M, 3, 3, 3)."""
        q, f = columns["quaternion"], columns["specific_force"]
        if self._turned[0] is not q or self._turned[1] is not f:
            rows = self.rows(self.move)
            means = np.empty((len(rows), 3, 3, 3))
            for j, axis in enumerate(np.eye(3)):
                turned = rotate(q, np.tile(axis, (len(q), 1)))
                for k in range(3):
                    means[:, :, j, k] = self.mean(turned * f[:, k : k + 1], rows, self.move)
            self._turned = (q, f, means)
        return self._turned[2]

    def _felt(self, force: np.ndarray) -> np.ndarray:
        """The acceleration (M, 3) that a specific force in the world tells, without its horizontal mean."""
        felt = force - [0.0, 0.0, GRAVITY]
        return np.asarray(felt - (np.where([True, True, False], felt.mean(0), 0.0) if len(felt) else 0.0))

    def _tilted(self, gained: np.ndarray, columns: Columns, rows: np.ndarray, shift: int) -> Pair:
        """What the velocity gains along the horizontal, and what a thrust along the body's z that carries the vehicle
        gives there, with the velocity beside."""
        q, velocity = columns["quaternion"], self._velocity(columns)
        if self._leaned[0] is not q:
            up = rotate(q, np.tile([0.0, 0.0, 1.0], (len(q), 1)))
            self._leaned = (q, up[:, :2] / np.where(np.abs(up[:, 2:]) < 0.1, 0.1, up[:, 2:]))
        felt = self.mean(self._leaned[1], rows, self.move) * (gained[:, 2:] + GRAVITY)
        flown = self.mean(velocity, rows + shift, self.move)[:, :2]
        centre = (lambda a: a - a.mean(0)) if len(rows) else (lambda a: a)
        pair = self._pair(TILT, gained[:, :2], centre(felt), rows, self.move, GAINS)
        return replace(pair, beside=centre(flown))

    def _pair(
        self, name: str, one: np.ndarray, other: np.ndarray, rows: np.ndarray, width: int, weak: float
    ) -> Pair:
        seconds = len(rows) * max(1, width // 4) * self.dt
        return Pair(name, one, other, seconds, width * self.dt, weak)

    def _mean_of(self, name: str, columns: Columns, rows: np.ndarray, width: int, reach: int) -> np.ndarray:
        """`mean` of a column by its name over the windows of `rows(width, reach)`; what it was is remembered."""
        column, mean = self._means.get((name, width, reach), (None, None))
        if column is not columns[name] or mean is None:
            mean = self.mean(columns[name], rows, width)
            self._means[name, width, reach] = (columns[name], mean)
        return mean

    def mean(self, column: np.ndarray, rows: np.ndarray, width: int) -> np.ndarray:
        """Mean of a column (N, k) over windows, (M, k), by trapezes."""
        out, ends = np.empty((len(rows), column.shape[1])), rows + width
        for k, axis in enumerate(
            column.T
        ):  # one after the other, for the cumulative sums of all take their time
            total = np.cumsum(axis)
            out[:, k] = (total[ends] - total[rows] + 0.5 * (axis[rows] - axis[ends])) / width
        return out

    def earlier(self, column: np.ndarray, late: float, unit_quaternion: bool = False) -> np.ndarray:
        """A column (N, k) as it would be without a delay of `late` s, within each stretch of the clock."""
        out = column.copy()
        source = continuous_quaternion(column) if unit_quaternion else column
        for part in self.parts:
            clock = self.t[part]
            out[part] = np.stack([np.interp(clock + late, clock, axis) for axis in source[part].T], -1)
        return out / np.linalg.norm(out, axis=1, keepdims=True) if unit_quaternion else out


def _possible(columns: Columns) -> list[str]:
    """Names of the pairs that the columns allow."""
    has = set(columns)
    names = []
    if {"quaternion", "angular_velocity"} <= has:
        names.append(ROTATION)
    if {"position", "velocity"} <= has:
        names.append(MOTION)
    if "quaternion" in has and has & {"position", "velocity"}:
        names.append(FORCE if "specific_force" in has else TILT)
    return names


def _squares(values: np.ndarray) -> float:
    return float(np.einsum("ij,ij->", values, values))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1)))) if len(values) else 0.0
