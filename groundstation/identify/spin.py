"""How body rates answer what is sent to the vehicle: a model of the rotation that predicts, fitted to what it is for.

About each body axis `w' = -damping w + sum of gains times columns`: with motor commands or rotor speeds the columns are
the torque of the rotors' thrusts, all thrust (a trim: rotors that lean or differ) and the sideways speed (flapping);
without them the commanded body rate and a constant. It is a multi-step fit: the rates 0.1, 0.25 and 0.5 s after each
sample are what the columns in between make of the rates at it (Farina & Piroddi, Int. J. Control 84, 2011, simulation
error minimisation), so that an error that grows with time counts as it will in a prediction. For a given damping, delay
and lag that is linear least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trueflight.groundstation.reading import segments
from trueflight.models.flight import Flight
from trueflight.models.frames import rotate_inverse
from trueflight.models.lag import delayed, lagged
from trueflight.models.prediction import rotor_thrust
from trueflight.models.vehicle import Vehicle

STEPS = (0.1, 0.25, 0.5)
"""s over which the rates are predicted in the fit."""
LONGEST_LAG, LONGEST_DELAY, MOST_DAMPING = 0.25, 0.15, 60.0
"""s, s and 1/s within which they are looked for."""
MOTORS, COMMANDS = "motors", "commands"


@dataclass(frozen=True)
class Spin:
    """The rotation of one vehicle under its inputs, which are its "motors" or the "commands" of its body rates.

    `delay` and `lag` in s lie between input and torque; `damping` (3,) in 1/s, `gains` (3, C) of the columns about each
    axis; `left` (3,) is the mean error of the rates over the fit's windows, rad/s.
    """

    vehicle: Vehicle
    inputs: str
    delay: float
    lag: float
    damping: np.ndarray
    gains: np.ndarray
    left: np.ndarray

    def columns(self, flight: Flight) -> np.ndarray:
        """What drives the rates of `flight`, (N, 3, C), without what depends on its velocity."""
        return _driving(flight, self.inputs, self.delay, self.lag)

    def acceleration(self, driving: np.ndarray, rate: np.ndarray, body_velocity: np.ndarray) -> np.ndarray:
        """Angular acceleration (S, 3), rad/s², under columns (S, 3, C) at rates (S, 3), rad/s, and velocities (S, 3),
        body axes, m/s."""
        count = driving.shape[2]
        turning = np.einsum("sac,ac->sa", driving, self.gains[:, :count])
        if self.gains.shape[1] > count:  # flapping: rolled by sideways, pitched by forward speed
            turning = turning + self.gains[:, count] * body_velocity[:, [1, 0, 2]] * [1.0, 1.0, 0.0]
        return np.asarray(turning - self.damping * rate - _euler(self.vehicle, rate))


def inputs_of(flight: Flight) -> str:
    """What the rotation of `flight` can be predicted from; empty where nothing was logged."""
    if rotor_thrust(flight) is not None and len(flight.vehicle.rotor_positions) > 2:
        return MOTORS
    return COMMANDS if flight.has("body_rate_command") else ""


def fit_spin(flights: Sequence[Flight], inputs: str = "") -> Spin | None:
    """The rotation of `flights` of one vehicle, which have body rates; None where nothing that turns it was logged."""
    from scipy import optimize  # dear to load

    inputs = inputs or inputs_of(flights[0])
    if not inputs or any(f.angular_velocity is None for f in flights):
        return None
    pieces = [(f, part) for f in flights for part in _unbroken(f)]
    if not pieces:
        return None
    flapping = inputs == MOTORS and all(f.velocity is not None and f.quaternion is not None for f in flights)
    through_lag = inputs == COMMANDS or flights[0].rotor_speed is None
    itself = [-_euler(f.vehicle, f.column("angular_velocity"))[:, :, None] for f in flights]
    sideways = [_sideways(f) if flapping else None for f in flights]

    def solved(delay: float, lag: float, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows: list[list[np.ndarray]] = [[], [], []]
        wanted: list[list[np.ndarray]] = [[], [], []]
        for number, f in enumerate(flights):
            driving = _driving(f, inputs, delay, lag)
            if sideways[number] is not None:
                driving = np.concatenate([driving, sideways[number]], axis=2)
            for part in _unbroken(f):
                rate = f.column("angular_velocity")[part]
                for axis in range(3):
                    both = np.concatenate([driving[part, axis], itself[number][part, axis]], axis=1)
                    x, y = _windows(both, rate[:, axis], damping[axis], f.dt)
                    rows[axis].append(x[:, :-1])
                    wanted[axis].append(y - x[:, -1])
        gains, errors = [], []
        for axis in range(3):
            x, y = np.concatenate(rows[axis]), np.concatenate(wanted[axis])
            gain = _robust(x, y)
            gains.append(gain)
            errors.append(float(np.mean(np.abs(y - x @ gain))))
        return np.array(gains), np.array(errors)

    scale = solved(0.0, 0.02, np.full(3, 1.0))[1]

    def misfit(x: np.ndarray) -> float:
        return float(np.sum(solved(*_bounded(x, through_lag))[1] / scale))

    first = np.array([0.01, 0.03, 1.0, 1.0, 1.0])
    if inputs == COMMANDS:
        first[2:] = 15.0  # of a closed loop
    found = optimize.minimize(
        misfit, first, method="Nelder-Mead",
        options={"maxfev": 100, "xatol": 1e-3, "fatol": 1e-4, "initial_simplex": _simplex(first)},
    )  # fmt: skip
    delay, lag, damping = _bounded(found.x, through_lag)
    gains, errors = solved(delay, lag, damping)
    return Spin(flights[0].vehicle, inputs, delay, lag, damping, gains, errors)


def _robust(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Least absolute deviations of `y` (K,) on columns (K, C), by reweighting: the error told is a mean length, and a
    few turns as hard as the vehicle can do must not decide all."""
    size = np.maximum(np.linalg.norm(x, axis=0), 1e-12)
    weight = np.ones(len(y))
    for _ in range(4):
        scaled = x / size * weight[:, None]
        gram = scaled.T @ scaled
        gain = np.linalg.lstsq(gram, scaled.T @ (y * weight), rcond=1e-10)[0] / size
        left = np.abs(y - x @ gain)
        weight = 1.0 / np.sqrt(np.maximum(left, 0.3 * np.median(left) + 1e-12))
    return gain


def _bounded(x: np.ndarray, through_lag: bool) -> tuple[float, float, np.ndarray]:
    delay, lag = float(np.clip(x[0], 0.0, LONGEST_DELAY)), float(np.clip(x[1], 0.0, LONGEST_LAG))
    damping = np.clip(x[2:], 0.0, MOST_DAMPING)
    return (delay, lag, damping) if through_lag else (0.0, 0.0, damping)


def _simplex(first: np.ndarray) -> np.ndarray:
    steps = np.diag([0.015, 0.03, *(np.maximum(2.0, 0.5 * first[2:]))])
    return np.concatenate([first[None], first + steps])


def _driving(flight: Flight, inputs: str, delay: float, lag: float) -> np.ndarray:
    """Columns (N, 3, C) about each axis, as late as they act."""
    n, dt = len(flight), flight.dt
    if inputs == COMMANDS:
        late = [
            lagged(delayed(np.nan_to_num(c), delay, dt), lag, dt)
            for c in flight.column("body_rate_command").T
        ]
        return np.stack([np.stack(late, axis=1), np.ones((n, 3))], axis=2)
    thrust = rotor_thrust(flight)
    assert thrust is not None
    speed = np.sqrt(np.clip(thrust, 0.0, None))
    late = [lagged(delayed(c, delay, dt), lag, dt) ** 2 for c in speed.T]
    acting = np.stack(late, axis=1)
    x, y, _ = np.array(flight.vehicle.rotor_positions, dtype=float).T
    turns = np.array(flight.vehicle.rotor_directions, dtype=float)
    torque = np.stack([acting @ y, -acting @ x, -acting @ turns], axis=1)
    return np.stack([torque, np.repeat(acting.sum(axis=1)[:, None], 3, axis=1)], axis=2)


def _sideways(flight: Flight) -> np.ndarray:
    """Velocity that rolls and pitches, (N, 3, 1): sideways about x, forward about y."""
    body = rotate_inverse(flight.quaternion, flight.velocity)  # type: ignore[arg-type]
    return np.stack([body[:, 1], body[:, 0], np.zeros(len(flight))], axis=1)[:, :, None]


def _euler(vehicle: Vehicle, rate: np.ndarray) -> np.ndarray:
    """What the turning of the body itself adds, `w x I w / I` (N, 3), rad/s²; nothing where no inertia is told."""
    inertia = np.array(vehicle.inertia, dtype=float)
    if np.any(inertia <= 0.0):
        return np.zeros_like(rate)
    return np.asarray(np.cross(rate, rate * inertia) / inertia)


def _windows(
    columns: np.ndarray, rate: np.ndarray, damping: float, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """What the columns (N, C) in each window of `STEPS` make of a rate (N,): regressors (K, C), and what is left of the
    rate at its end, (K,)."""
    from scipy import signal  # dear to load

    rows, wanted = [np.zeros((0, columns.shape[1]))], [np.zeros(0)]
    decay = float(np.exp(-damping * dt))
    middle = 0.5 * (columns[1:] + columns[:-1])  # over each sample period
    grown = np.concatenate(
        [np.zeros((1, columns.shape[1])), signal.lfilter([dt], [1.0, -decay], middle, axis=0)]
    )
    for seconds in STEPS:
        steps = max(1, round(seconds / dt))
        if len(rate) > steps + 1:
            at = np.arange(0, len(rate) - steps, max(1, steps // 10))
            left = decay**steps
            rows.append(grown[at + steps] - left * grown[at])
            wanted.append(rate[at + steps] - left * rate[at])
    return np.concatenate(rows), np.concatenate(wanted)


def _unbroken(flight: Flight) -> list[slice]:
    """Stretches of flight without a gap, of a second and more."""
    found = []
    flying = np.ones(len(flight), bool) if flight.flying is None else flight.flying
    good = flying & np.all(np.isfinite(flight.column("angular_velocity")), axis=1)
    for part in segments(flight.t):
        inside = np.flatnonzero(np.diff(np.r_[0, good[part].astype(int), 0]))
        for start, stop in inside.reshape(-1, 2):
            if (stop - start) * flight.dt > 1.0:
                found.append(slice(part.start + int(start), part.start + int(stop)))
    return found
