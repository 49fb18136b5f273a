"""What a flight tells of the path from command to motion: the numbers that the corrected controller undoes.

The rate loop is fitted as the PI controller behind a delay that `companion.law.actuation` runs beside the real one:
`w' = (c - w) / lag + i`, `i' = integral (c - w) / lag`, c the commanded body rate `delay` ago. It is an
output-error fit (Ljung, "System Identification", 2nd edition, section 10.2), so noise of the gyroscope does not
bias it, and both sides pass the same low-pass filter: only what an attitude loop can use has to be right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from trueflight.groundstation.measured.low_pass import low_pass
from trueflight.groundstation.reading import segments
from trueflight.models.contract import ACTUATION_LIMITS
from trueflight.models.flight import Flight
from trueflight.models.model import Model

BANDWIDTH = 3.0
"""Hz up to which the rate loop's model has to be right: more than twice the attitude loop's bandwidth."""
_LEAST_RATE = 0.05  # rad/s RMS of commanded rates below which a flight says nothing of the rate loop
_MOST_UNEXPLAINED = 0.25  # share of the rates' variance; with more the loop is not what the model says it is
_SHORTEST = 5.0  # s
_MOST_SECONDS = 300.0  # of flight; more teaches nothing about three numbers
_STARTS = ((0.01, 0.03, 1.0), (0.03, 0.06, 5.0))  # s, s, 1/s


@dataclass(frozen=True)
class RateLoop:
    """Delay (s), lag (s) and integral rate (1/s) of the roll and pitch rate loop.

    `unexplained` is the share of the rates' variance that the fit leaves, `seconds` the flight that it saw.
    """

    delay: float
    lag: float
    integral: float
    unexplained: float
    seconds: float


def fit_rate_loop(flights: Sequence[Flight]) -> RateLoop | None:
    """The rate loop of these flights; None where they lack the columns, do not turn, or do not fit the model."""
    from scipy import optimize

    pieces = _pieces(flights)
    if not pieces:
        return None
    filtered = []
    for command, rate, dt in pieces:
        filtered.append((command, _smooth(rate, dt), dt))
    total = float(np.concatenate([rate.ravel() for _, rate, _ in filtered]).var())

    def misfit(x: np.ndarray) -> np.ndarray:
        out = []
        for command, rate, dt in filtered:
            skip = int(0.5 / dt)  # the model starts at rest, the vehicle does not
            out.append((_smooth(respond(command, dt, *x), dt) - rate)[skip:].ravel())
        return np.concatenate(out)

    most = [ACTUATION_LIMITS[name] for name in ("rate_delay", "rate_lag", "rate_integral")]
    fits = [
        optimize.least_squares(misfit, start, bounds=([0.0, 0.003, 0.0], most), x_scale=[0.01, 0.02, 1.0])
        for start in _STARTS
    ]
    best = min(fits, key=lambda fit: fit.cost)
    unexplained = float(np.mean(best.fun**2)) / total
    if unexplained > _MOST_UNEXPLAINED:
        return None
    delay, lag, integral = (float(x) for x in best.x)
    seconds = sum(len(rate) * dt for _, rate, dt in filtered)
    return RateLoop(delay, lag, integral, unexplained, seconds)


def rate_loop_sensitivity(flight: Flight, loop: RateLoop) -> tuple[np.ndarray, float]:
    """Covariance (3, 3) of lag, delay and integral of `loop` as `flight` shows it, and its factor for 95 %.

    Newey-West over `groundstation.identify.fitting.HAC_LAG` s, for the residual of rates is far from white.
    """
    from trueflight.groundstation.identify.fitting import HAC_LAG, bartlett_sum, critical_value

    bread, meat, seconds = np.zeros((3, 3)), np.zeros((3, 3)), 0.0
    x = np.array([loop.lag, loop.delay, loop.integral])
    steps = np.array([1e-3, 1e-3, 0.05])
    for command, rate, dt in _pieces([flight]):
        skip, thin = int(0.5 / dt), max(1, int(0.1 / (BANDWIDTH * dt)))

        def seen(
            x: np.ndarray,
            command: np.ndarray = command,
            dt: float = dt,
            rows: slice = slice(skip, None, thin),
        ) -> np.ndarray:
            return _smooth(respond(command, dt, x[1], x[0], x[2]), dt)[rows]

        here = seen(x)
        jacobian = np.stack([(seen(x + h) - here) / h.sum() for h in np.diag(steps)], axis=2)
        residual = _smooth(rate, dt)[skip::thin] - here
        bread += np.einsum("kap,kaq->pq", jacobian, jacobian)
        scores = np.einsum("kap,ka->kp", jacobian, residual)
        meat += bartlett_sum(scores, max(1, round(HAC_LAG / (thin * dt))))
        seconds += len(rate) * dt
    inverse = np.linalg.pinv(bread, hermitian=True)
    return inverse @ meat @ inverse, critical_value(seconds)


def _smooth(rate: np.ndarray, dt: float) -> np.ndarray:
    """Body rates (N, k) below `BANDWIDTH`, without delay."""
    return low_pass(rate, min(BANDWIDTH, 0.4 / dt), 1.0 / dt, order=2)


def respond(command: np.ndarray, dt: float, delay: float, lag: float, integral: float) -> np.ndarray:
    """Body rates (N, k) of the rate loop at rest under commanded rates (N, k), held between samples of `dt` s.

    The loop is `(s + integral) / (lag s^2 + s + integral)`; what each sample's command adds is the difference of its
    step response between two samples.
    """
    n = np.arange(len(command), dtype=float)
    late = np.stack([np.interp(n - delay / dt, n, column) for column in command.T], axis=1)
    adds = np.diff(_step_response(dt * np.arange(len(command)), lag, integral), prepend=0.0)
    size = fft.next_fast_len(2 * len(command), real=True)
    answer = fft.rfft(late, size, axis=0) * fft.rfft(adds, size)[:, None]
    return np.asarray(fft.irfft(answer, size, axis=0)[: len(command)])


def _step_response(t: np.ndarray, lag: float, integral: float) -> np.ndarray:
    """The rate loop's answer (N,) at times `t` in s to a rate of one that is commanded from 0 on, by its two poles."""
    quick = 1.0 / lag
    apart = np.sqrt(complex(quick**2 - 4.0 * integral * quick))
    if abs(apart) < 1e-4 * quick:  # a double pole is that of two next to each other
        apart = complex(1e-4 * quick)
    first = -0.5 * (quick + apart)
    second = integral * quick / first  # their product, which their difference would lose
    out = np.ones(len(t), dtype=complex)
    for pole, other in ((first, second), (second, first)):
        if abs(pole) > 1e-9 * quick:  # a slower one is that of no integral, and adds nothing
            out += quick * (pole + integral) / (pole * (pole - other)) * np.exp(pole * t)
    return np.asarray(out.real)


def actuation_of(model: Model, flights: Sequence[Flight]) -> dict[str, float]:
    """The numbers of `models.contract.ACTUATION_LIMITS` for a model to be deployed.

    Thrust by the model's own delay and lag (or the vehicle file's), rates by what the flights show; what they do
    not show stays 0 and is not undone.
    """
    numbers = _thrust(model)
    loop = fit_rate_loop(flights)
    if loop is not None:
        numbers |= {"rate_delay": loop.delay, "rate_lag": loop.lag, "rate_integral": loop.integral}
    return {name: round(min(ACTUATION_LIMITS[name], value), 6) for name, value in numbers.items()}


def _thrust(model: Model) -> dict[str, float]:
    vehicle = model.vehicle
    numbers = {"thrust_delay": vehicle.command_delay, "thrust_lag": vehicle.motor_time_constant}
    for effect, values in model.effect_chain():
        numbers |= {p.actuation: values[p.name] for p in effect.parameters if p.actuation in numbers}
    return numbers


def _pieces(flights: Sequence[Flight]) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Commanded and measured roll and pitch rates (N, 2) of unbroken flight, the liveliest first."""
    found = []
    for flight in flights:
        if not flight.has("body_rate_command", "angular_velocity"):
            continue
        command = flight.column("body_rate_command")[:, :2]
        rate = flight.column("angular_velocity")[:, :2]
        for part in segments(flight.t):
            rows = np.arange(part.start, part.stop)
            if flight.flying is not None:
                rows = rows[flight.flying[rows]]
                if len(rows) and rows[-1] - rows[0] + 1 != len(rows):
                    longest = max(np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1), key=len)
                    rows = longest
            if len(rows) * flight.dt < _SHORTEST:
                continue
            c, w = command[rows], rate[rows]
            if np.all(np.isfinite(c)) and np.all(np.isfinite(w)) and float(c.std()) > _LEAST_RATE:
                found.append((c, w, flight.dt))
    found.sort(key=lambda piece: -float(piece[0].std()))
    kept, seconds = [], 0.0
    for piece in found:
        if seconds < _MOST_SECONDS:
            kept.append(piece)
            seconds += len(piece[0]) * piece[2]
    return kept
