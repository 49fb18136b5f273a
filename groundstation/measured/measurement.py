"""What was measured, made comparable with what a model predicts: one filter and one mask for both sides."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from trueflight.groundstation.measured.attitude_rate import that_turns
from trueflight.groundstation.measured.low_pass import density, gain, low_pass
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.frames import rotate, rotate_inverse, rotation_matrix
from trueflight.models.prediction import derivative
from trueflight.models.vehicle import GRAVITY

ACCELEROMETER_BANDWIDTH = 20.0
"""Hz. Thrust and drag of a quadrotor live below it, most of the rotors' vibration above."""
DIFFERENTIATED_BANDWIDTH = 5.0
"""Hz, where acceleration comes from differentiated velocity, whose noise grows with frequency."""
RATE_ERROR_LIMIT = 1.0
"""rad/s between commanded and measured body rate: above it rotors are driven apart, and may saturate, to turn
the vehicle, so that the collective command no longer tells the thrust."""
SETTLING = 0.2
"""s around such a moment that are left out as well."""
ROTATION_BANDWIDTH = 5.0
"""Hz of angular acceleration, which is a differentiated gyroscope: commanded turns live below it."""
SHORTEST = 5.0
"""s of flight below which nothing is fitted."""


@dataclass(frozen=True)
class Measurement:
    """The measured side of a flight, ready to be compared.

    `value` (M, 3) is specific force in body axes, m/s², low-passed at `bandwidth` Hz and thinned to the rows
    `rows` of the flight; `used` (M,) marks the ones that count; `t` (M,) in s; `see` passes a predicted
    specific force (N, 3) through the same filter and thinning, `smooth` any other columns (N, k) through the
    low-pass; `noise` (3,) is the RMS that sensor noise alone leaves; `axes` the body axes that the flight measures.
    """

    flight: Flight
    t: np.ndarray
    rows: np.ndarray
    value: np.ndarray
    used: np.ndarray
    see: Callable[[np.ndarray], np.ndarray]
    smooth: Callable[[np.ndarray], np.ndarray]
    bandwidth: float
    noise: np.ndarray
    axes: tuple[int, ...]
    left_out: dict[str, float]


@dataclass(frozen=True)
class Rotation:
    """The measured rotation of a flight, ready to be compared.

    `value` (M, 3) is angular acceleration in body axes, rad/s², low-passed at `bandwidth` Hz and thinned to the rows
    `rows` of the flight; `used` (M,), `t` (M,) in s, `smooth`, `noise` (3,) and `axes` as in `Measurement`. `flight`
    has body rates in any case: `source` tells whether a "gyroscope" or the "attitude" gave them.
    """

    flight: Flight
    t: np.ndarray
    rows: np.ndarray
    value: np.ndarray
    used: np.ndarray
    smooth: Callable[[np.ndarray], np.ndarray]
    bandwidth: float
    noise: np.ndarray
    axes: tuple[int, ...] = (0, 1, 2)
    source: str = "gyroscope"


def measure_rotation(flight: Flight, bandwidth: float = ROTATION_BANDWIDTH) -> Rotation | None:
    """The angular acceleration of `flight` below `bandwidth` Hz, from its gyroscope or else from its attitude; None
    where it has neither or is too short.

    An attitude holds up to where its noise has the greater part, which is the bandwidth then.
    """
    if flight.duration < SHORTEST:
        return None
    fs = 1.0 / flight.dt
    pieces = _pieces(flight)
    bandwidth = min(bandwidth, 0.4 * fs)
    flight, from_attitude = that_turns(flight, pieces, bandwidth)
    if flight.angular_velocity is None:
        return None
    if from_attitude is not None:
        bandwidth = from_attitude.band
    rows = np.arange(0, len(flight), max(1, int(fs / (2.5 * bandwidth))))
    smooth = _filter(bandwidth, fs, pieces, rows)
    used = np.ones(len(flight), dtype=bool) if flight.flying is None else flight.flying.copy()
    edge = max(2, int(0.5 / bandwidth / flight.dt))
    for piece in pieces:
        used[piece.start : piece.start + edge] = False
        used[max(piece.stop - edge, piece.start) : piece.stop] = False
    if used.sum() * flight.dt < SHORTEST:
        return None
    return Rotation(
        flight=flight,
        t=flight.t[rows],
        rows=rows,
        value=smooth(derivative(flight.angular_velocity, flight.t)),
        used=used[rows],
        smooth=smooth,
        bandwidth=bandwidth,
        noise=_noise(
            flight.angular_velocity if from_attitude is None else from_attitude.rough,
            used,
            bandwidth,
            fs,
            True,
        ),
        # an angle that was made of accelerations is no attitude to differentiate
        axes=(0, 2) if from_attitude is not None and "pitch" in flight.unlogged else (0, 1, 2),
        source="gyroscope" if from_attitude is None else "attitude",
    )


def _filter(
    bandwidth: float, fs: float, pieces: list[slice], rows: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    """A low-pass of columns (N, k) at the `rows` of a flight that reaches across no gap between its `pieces`."""
    every = int(rows[1] - rows[0]) if len(rows) > 1 else 1

    def smooth(x: np.ndarray) -> np.ndarray:
        if len(pieces) == 1 and pieces[0] == slice(0, len(x)):
            return low_pass(x, bandwidth, fs, every)
        out = np.array(x, dtype=float)
        for piece in pieces:
            out[piece] = low_pass(x[piece], bandwidth, fs)
        return out[rows]

    return smooth


def measure(flight: Flight, bandwidth: float | None = None, thin: bool = True) -> Measurement:
    """The measured specific force of `flight`, from its accelerometer or else from its velocity.

    `thin` keeps no more rows than the bandwidth needs.

    Raises `InputError` where the flight has neither, or is too short.
    """
    fs = 1.0 / flight.dt
    if flight.duration < SHORTEST:
        raise InputError(
            f"{flight.origin or flight.name}: {flight.duration:.1f} s of flight are too short; give "
            f"{SHORTEST:g} s or more"
        )
    raw, differentiate, default = _sensed(flight)
    bandwidth = min(bandwidth or default, 0.4 * min(fs, flight.sensor_rate or fs))
    step = max(1, int(fs / (2.5 * bandwidth))) if thin else 1
    rows = np.arange(0, len(flight), step)
    pieces = _pieces(flight)

    smooth = _filter(bandwidth, fs, pieces, rows)
    if differentiate:
        quaternion = flight.quaternion[rows]  # type: ignore[index]

        def slope(v: np.ndarray) -> np.ndarray:
            out = np.empty_like(v)
            for piece in pieces:
                out[piece] = np.gradient(v[piece], flight.dt, axis=0)
            return out

        def see(force: np.ndarray) -> np.ndarray:
            world = rotate(flight.quaternion, force)  # type: ignore[arg-type]
            # a central difference averages acceleration over two periods: so does the model's side
            for piece in pieces:
                world[piece] = ndimage.correlate1d(world[piece], [0.25, 0.5, 0.25], axis=0, mode="nearest")
            return rotate_inverse(quaternion, smooth(world))

        value = rotate_inverse(quaternion, smooth(slope(raw)) + np.array([0.0, 0.0, GRAVITY]))
    else:

        def see(force: np.ndarray) -> np.ndarray:
            return smooth(force)

        value = see(raw)
    used, left_out = _used(flight, bandwidth)
    # of values that a log repeats, only the new ones tell the noise
    every = max(1, round(fs / flight.sensor_rate)) if flight.sensor_rate else 1
    its_own = min(bandwidth, 0.45 * fs / every)
    noise = _noise(raw[::every], used[::every], its_own, fs / every, differentiate)
    if differentiate:  # along the world's axes, while what is compared is along the body's
        turned = rotation_matrix(flight.quaternion[used]) ** 2  # type: ignore[index]
        noise = np.sqrt(np.einsum("nij,i->j", turned, noise**2) / max(len(turned), 1))
    return Measurement(
        flight=flight,
        t=flight.t[rows],
        rows=rows,
        value=value,
        used=used[rows],
        see=see,
        smooth=smooth,
        bandwidth=bandwidth,
        noise=noise,
        axes=(0, 1, 2) if flight.quaternion is not None else (2,),
        left_out=left_out,
    )


def _sensed(flight: Flight) -> tuple[np.ndarray, bool, float]:
    """The column (N, 3) that tells the acceleration, whether it is a velocity, and the usual bandwidth of it, Hz."""
    if flight.specific_force is not None:
        return flight.specific_force, False, ACCELEROMETER_BANDWIDTH
    if flight.velocity is not None and flight.quaternion is not None:
        return flight.velocity, True, DIFFERENTIATED_BANDWIDTH
    raise InputError(
        f"{flight.origin or flight.name}: neither an accelerometer nor velocity and attitude; add "
        "specific_force_x, _y, _z or velocity_* and quaternion_* (map yours with --mapping)"
    )


def _pieces(flight: Flight) -> list[slice]:
    """Stretches without a gap in time: filters must not reach across one."""
    breaks = np.flatnonzero(np.diff(flight.t) > 3.0 * flight.dt) + 1
    edges = [0, *breaks.tolist(), len(flight)]
    return [slice(a, b) for a, b in itertools.pairwise(edges) if b - a > 1]


def _used(flight: Flight, bandwidth: float) -> tuple[np.ndarray, dict[str, float]]:
    """Mask (N,) of the samples at which the collective command is believed to tell the thrust, and what went
    out."""
    n = len(flight)
    used = np.ones(n, dtype=bool) if flight.flying is None else flight.flying.copy()
    left_out = {"not flying": 1.0 - float(used.mean())}
    settling = max(1, int(SETTLING / flight.dt))
    command = flight.column("thrust_command")
    at_limit = (command <= max(0.05, 0.02 * flight.vehicle.hover_thrust)) | (command >= 0.97)
    out = ndimage.binary_dilation(at_limit, iterations=settling)
    left_out["thrust at its limit"] = float((out & used).mean())
    used &= ~out
    if flight.has("angular_velocity", "body_rate_command"):
        error = np.abs(flight.body_rate_command - flight.angular_velocity).max(axis=1)  # type: ignore[operator]
        # a vehicle whose rates never follow closely keeps its calmer half
        for limit in (RATE_ERROR_LIMIT, 2.0 * RATE_ERROR_LIMIT, 4.0 * RATE_ERROR_LIMIT, np.inf):
            out = ndimage.binary_dilation(error > limit, iterations=settling)
            if (used & ~out).sum() >= 0.5 * used.sum():
                break
        left_out["turning harder than commanded rates follow"] = float((out & used).mean())
        used &= ~out
    edge = max(2, int(0.5 / bandwidth / flight.dt))
    for piece in _pieces(flight):
        used[piece.start : piece.start + edge] = False
        used[max(piece.stop - edge, piece.start) : piece.stop] = False
    if used.sum() * flight.dt < SHORTEST:
        reasons = ", ".join(f"{v:.0%} {k}" for k, v in left_out.items() if v > 0.005)
        raise InputError(
            f"{flight.origin or flight.name}: only {used.sum() * flight.dt:.1f} s of the flight can be "
            "compared "
            f"({reasons or 'too few samples'}); give a longer or calmer flight"
        )
    return used, left_out


def _noise(raw: np.ndarray, used: np.ndarray, bandwidth: float, fs: float, differentiate: bool) -> np.ndarray:
    """RMS (3,) of sensor noise behind the filter, as if it were white there.

    The smaller of two estimates: from third differences of the raw signal, which motion leaves alone (the median makes
    it deaf to shocks), and from the spectrum above the pass band, where rotors' vibration at high frequency counts
    for nothing.
    """
    third = np.diff(raw, n=3, axis=0)[used[3:]] if used[3:].sum() > 50 else np.diff(raw, n=3, axis=0)
    sigma = np.median(np.abs(third), axis=0) / 0.6745 / np.sqrt(20.0)
    w = np.arange(512) * fs / 1024.0
    passed = gain(w, bandwidth, fs)
    edge = float(w[np.flatnonzero(passed > 0.5)[-1]])
    count = min(len(raw), round(2.0 * fs))
    frequency, power = density(raw, fs, count)
    beyond = (frequency > 1.25 * edge) & (frequency < min(2.5 * edge, 0.48 * fs))
    if beyond.sum() >= 4:
        sigma = np.minimum(sigma, np.sqrt(power[beyond].mean(axis=0) * 0.5 * fs))
    if differentiate:
        passed = passed * np.sin(2 * np.pi * w / fs) * fs
    return sigma * float(np.sqrt(np.mean(passed**2)))
