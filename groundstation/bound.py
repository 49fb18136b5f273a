"""The tube a flight must stay in: the paper's stability argument (section IV-C) in its Lyapunov form.

Around its reference the vehicle obeys `eta' = (A - B K) eta + (0, d)`, with `d` whatever its acceleration differs by
from what the ideal position loop (16) asks for. The paper bounds `eta' (A - B K) eta` by the least eigenvalue, which
does not hold for a matrix that is not symmetric. Instead, with `P` of a Lyapunov equation and `V = eta' P eta`,

    V' <= -2 alpha (V - d²),    so    V(t) <= V(0) exp(-2 alpha t) + radius²,

where radius² is the largest that the mean of d² gets when what is longer ago than t counts by exp(-2 alpha t): d over
the loop's own memory of 1 / (2 alpha). V decays to the ball `V <= radius²` and never leaves it again, as long as d
keeps its bounds; the radius is no greater than the largest |d|, and a short spike, or a sensor's noise, weighs as
little in it as it moves the vehicle. `P` is the inverse of `X` from

    (A - B K + alpha I) X + X (A - B K + alpha I)' + B B' / (2 alpha) = 0

(Boyd, El Ghaoui, Feron, Balakrishnan, "Linear Matrix Inequalities in System and Control Theory", SIAM 1994, section
6.1.3: states reachable with inputs of unit peak), the form `(A - B K + alpha I)' P + P (A - B K + alpha I) = -Q` with
the `Q = P B B' P / (2 alpha)` that makes the ball smallest; `alpha` is the one that makes its extent in position
smallest. So scaled, `V^(1/2)` is in m/s²: the constant |d| whose ball the state is on.

The same holds for the distance between two solutions, each with its own d. So the tube may stand around the reference
(eta and d as they are), or around the expected linear behaviour: how the linear design itself, with its attitude loop
(13), follows that reference. Then eta counts from there, and d from what the design's own attitude loop lags. That tube
is the sharper one and knows no jumps, and it is the claim: to fly as designed.

Where the gains decouple the axes, and treat x and y alike, this holds for each axis of the world on its own, whatever
the yaw.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np

from groundstation.expected import Reference, expected_behaviour
from groundstation.measurement import ACCELEROMETER_BANDWIDTH, DIFFERENTIATED_BANDWIDTH, measure
from groundstation.tracking import missions, reference_of
from models.design import Design, hover_input_matrix
from models.errors import InputError
from models.flight import Flight
from models.frames import euler_from_quaternion, rotate, world_from_heading
from models.vehicle import GRAVITY

Around = Literal["design", "reference"]

JUMP_POSITION, JUMP_VELOCITY = 1e-3, 1e-2
"""m and m/s: what a reference moves by more than its own velocity and acceleration explain is a jump."""
APART = 0.2
"""s inside the tube that tell two times of leaving it apart."""


@dataclass(frozen=True)
class Ball:
    """The ball of one axis: `P` (2, 2) of V = eta' P eta with eta = (m, m/s) and V^(1/2) in m/s², `decay` alpha in
    1/s, and its extent `position` (m) and `velocity` (m/s) for a bound on d of 1 m/s²."""

    P: np.ndarray
    decay: float
    position: float
    velocity: float

    def level(self, eta: np.ndarray) -> np.ndarray:
        """V^(1/2) (...) in m/s² of states (..., 2)."""
        return np.sqrt(np.einsum("...i,ij,...j->...", eta, self.P, eta))


Balls = tuple[Ball, Ball, Ball]


@dataclass(frozen=True)
class Disturbance:
    """By what the acceleration of a flight differed from what its ideal position loop asked for, over the M samples of
    its missions, at the rows `rows` (M,) of the flight; `around` the design, less the same of the design itself.

    `total` (M, 3) m/s², world ENU, is the sum of `model` (delta - delta_hat: error of the hover model (10), less the
    correction as applied) and `attitude` (A_zeta times the attitude not yet reached, and commands at their limits); all
    behind the same zero-phase low-pass of `bandwidth` Hz; `noise` (3,) is the RMS that the accelerometer's noise leaves
    in it, body axes. `stretches` are the slices of the M samples that one mission each has.
    """

    flight: Flight
    around: Around
    rows: np.ndarray
    stretches: tuple[slice, ...]
    total: np.ndarray
    model: np.ndarray
    attitude: np.ndarray
    bandwidth: float
    noise: np.ndarray

    def radius(self, balls: Balls, part: Literal["total", "model", "attitude"] = "total") -> np.ndarray:
        """Radius (3,) of the ball in m/s², per axis of the world, of d or of one part of it alone."""
        values = getattr(self, part)
        return np.array(
            [
                max(memory(values[rows, k], ball.decay, self.flight.dt).max() for rows in self.stretches)
                for k, ball in enumerate(balls)
            ]
        )


@dataclass(frozen=True)
class Leaving:
    """A stretch outside the tube on one axis of the world: s on the flight's clock; the largest `level` there against
    what was `allowed` then (m/s²)."""

    axis: str
    start: float
    end: float
    level: float
    allowed: float


@dataclass(frozen=True)
class Tube:
    """A flight in its predicted tube, over the M samples of its missions, axes x, y, z of the world.

    `balls` one an axis; `radius` (3,) and `bound` (3,) in m/s², of the mean of d over the loop's memory and of the
    largest |d|, both of the flight `bound_from`; `disturbance` is what really acted.
    `eta` (M, 3, 2) is the position and velocity error (m, m/s) to the reference, `centre` (M, 3, 2) where in it the
    tube has its middle: zero around the reference; around the design, what the linear design itself leaves. `level`
    (M, 3) is V^(1/2) of their difference and `predicted` (M, 3) what the tube allows (m/s²). `jumps` are the times at
    which the reference jumped, `starts` those at which the tube begins anew from the flown state (each mission).
    """

    flight: Flight
    label: str
    balls: Balls
    radius: np.ndarray
    bound: np.ndarray
    bound_from: str
    disturbance: Disturbance
    t: np.ndarray
    position: np.ndarray
    reference: np.ndarray
    eta: np.ndarray
    centre: np.ndarray
    level: np.ndarray
    predicted: np.ndarray
    jumps: np.ndarray
    starts: np.ndarray
    leavings: tuple[Leaving, ...]

    @property
    def inside(self) -> np.ndarray:
        """Share of time inside the tube, per axis (3,)."""
        return np.mean(_within(self.level, self.predicted), axis=0)

    @property
    def distance(self) -> np.ndarray:
        """From the middle of the tube, per axis, (M, 3, 2) in m and m/s."""
        return self.eta - self.centre

    @property
    def extent(self) -> np.ndarray:
        """Half width of the tube (M, 3, 2) in position (m) and velocity (m/s)."""
        sizes = np.array([[ball.position, ball.velocity] for ball in self.balls])
        return self.predicted[:, :, None] * sizes

    @property
    def ball(self) -> np.ndarray:
        """Half width (3, 2) of the tube once it has settled: position (m) and velocity (m/s)."""
        return self.radius[:, None] * np.array([[ball.position, ball.velocity] for ball in self.balls])


def balls_of(design: Design) -> Balls:
    """The balls of the axes x, y, z. Raises `InputError` where the gains couple the axes or tell x from y."""
    a_zeta = hover_input_matrix(design.mass)
    gains = a_zeta @ np.array(design.K_eta)
    position, velocity = np.diag(gains[:, :3]), np.diag(gains[:, 3:])
    rest = gains - np.hstack([np.diag(position), np.diag(velocity)])
    if np.abs(rest).max() > 1e-6 * np.abs(gains).max() or not (
        np.isclose(position[0], position[1]) and np.isclose(velocity[0], velocity[1])
    ):
        raise InputError(
            "bound: K_eta couples the axes, or treats x and y differently; give a design with axes of their own "
            "(`groundstation design`)"
        )
    horizontal, vertical = (smallest_ball(position[k], velocity[k]) for k in (0, 2))
    return horizontal, horizontal, vertical


def smallest_ball(p: float, v: float) -> Ball:
    """The ball of `e'' = -p e' - v e + d` with the least extent in position, p in 1/s² and v in 1/s, both positive."""
    import control
    from scipy.optimize import minimize_scalar

    a, b = np.array([[0.0, 1.0], [-p, -v]]), np.array([[0.0], [1.0]])
    fastest = float(-np.linalg.eigvals(a).real.max())

    def reachable(alpha: float) -> np.ndarray:
        return np.asarray(control.lyap(a + alpha * np.eye(2), b @ b.T / (2.0 * alpha)))

    found = minimize_scalar(
        lambda share: reachable(share * fastest)[0, 0], bounds=(0.01, 0.99), method="bounded"
    )
    alpha = float(found.x) * fastest
    x = reachable(alpha)
    return Ball(np.linalg.inv(x), alpha, float(np.sqrt(x[0, 0])), float(np.sqrt(x[1, 1])))


def memory(d: np.ndarray, decay: float, dt: float) -> np.ndarray:
    """Square root of the fading mean (N,) of d² (N,) in m/s², the weight of what was falling by exp(-2 decay t)."""
    from scipy import signal

    keep = np.exp(-2.0 * decay * dt)
    return np.sqrt(signal.lfilter([1.0 - keep], [1.0, -keep], np.asarray(d) ** 2))


def tube(
    ball: Ball, radius: float, bound: float, t: np.ndarray, start: float, jumps: np.ndarray
) -> np.ndarray:
    """What V^(1/2) (N,) may at most be at times `t` (N,) s, from `start` at the first, in m/s².

    As long as |d| <= `bound` and its fading mean (`memory`) stays below `radius`. `jumps` (N, 2) is by what the
    reference jumps at each sample (m, m/s). There eta jumps by as much, and V^(1/2), a norm, by no more than the jump's
    own.
    """
    size = ball.level(jumps)
    out = np.empty(len(t))
    edges = [0, *np.flatnonzero(size[1:] > 0.0) + 1, len(t)]
    level = start
    for begin, end in itertools.pairwise(edges):
        fading = np.exp(-2.0 * ball.decay * (t[begin : end + 1] - t[begin]))
        allowed = np.sqrt(level**2 * fading + np.minimum(radius**2, bound**2 * (1.0 - fading)))
        out[begin:end] = allowed[: end - begin]
        if end < len(t):
            level = float(allowed[-1] + size[end])
    return out


def jumps_of(t: np.ndarray, reference: Reference) -> np.ndarray:
    """Jumps (N, 3, 2) of a reference: by what position (m) and velocity (m/s) change from the sample before, beyond
    what velocity and acceleration at both explain; zero where they explain it."""
    dt = np.diff(t)[:, None]
    out = np.zeros((len(t), 3, 2))
    for k, (value, slope, least) in enumerate(
        (
            (reference.position, reference.velocity, JUMP_POSITION),
            (reference.velocity, reference.acceleration, JUMP_VELOCITY),
        )
    ):
        change = np.diff(value, axis=0) - 0.5 * dt * (slope[1:] + slope[:-1])
        # Where the slope itself jumps between the samples, its mean is uncertain by that much.
        unsure = 0.5 * dt * np.abs(np.diff(slope, axis=0))
        out[1:, :, k] = np.where(np.abs(change) > unsure + least, change, 0.0)
    return out


def disturbance(
    flight: Flight, design: Design, around: Around = "design", bandwidth: float | None = None
) -> Disturbance:
    """What disturbed the position loop of a flight. Raises `InputError` where it lacks what that needs.

    Measured by the accelerometer, otherwise by differentiated velocity. The low-pass is there because the
    accelerometer's noise is no acceleration, and it hides little: 1 m/s² at 20 Hz moves by 0.06 mm and 8 mm/s.
    """
    velocity, quaternion = flight.column("velocity"), flight.column("quaternion")
    noise = measure(flight, bandwidth, thin=False).noise
    zeta = euler_from_quaternion(quaternion)
    thrust = flight.vehicle.thrust(flight.column("thrust_command"))
    hover = np.stack([zeta[:, 0], zeta[:, 1], thrust - flight.vehicle.weight], -1)
    linear = _accelerations(design, hover, zeta[:, 2])
    correction = flight.extra.get("correction", np.zeros((len(flight), 3)))
    corrected = world_from_heading(np.nan_to_num(correction), zeta[:, 2])
    if flight.specific_force is not None:
        acceleration = rotate(quaternion, flight.specific_force) - [0.0, 0.0, GRAVITY]
        default = ACCELEROMETER_BANDWIDTH if flight.accelerometer else flight.bandwidth
    else:
        acceleration, default = np.gradient(velocity, flight.t, axis=0), DIFFERENTIATED_BANDWIDTH
    bandwidth = min(bandwidth or default or DIFFERENTIATED_BANDWIDTH, 0.4 / flight.dt)
    stretches, total, model = missions(flight), [], []
    for rows in stretches:
        reference = reference_of(flight, rows)
        whole = acceleration[rows] - _asked(design, reference, _eta(flight, rows, reference))
        if around == "design":
            whole = whole - _of_the_design(flight, design, rows, reference)[1]
        part = acceleration[rows] - linear[rows] - corrected[rows]
        jumps = np.flatnonzero(np.any(jumps_of(flight.t[rows], reference) != 0.0, axis=(1, 2)))
        total.append(_low_pass(whole, jumps, bandwidth, flight.dt))
        model.append(_low_pass(part, jumps, bandwidth, flight.dt))
    d, of_model = np.concatenate(total), np.concatenate(model)
    edges = np.cumsum([0, *(len(rows) for rows in stretches)]).tolist()
    return Disturbance(
        flight=flight,
        around=around,
        rows=np.concatenate(stretches),
        stretches=tuple(slice(a, b) for a, b in itertools.pairwise(edges)),
        total=d,
        model=of_model,
        attitude=d - of_model,
        bandwidth=bandwidth,
        noise=noise,
    )


def predict_tube(
    flight: Flight,
    design: Design,
    label: str = "",
    around: Around = "design",
    bound_from: Flight | None = None,
    bandwidth: float | None = None,
) -> Tube:
    """The tube of a flight, from the bound on d that the flight `bound_from` shows, otherwise the flight itself.

    Each mission's tube begins at the flown state; from there on it knows the reference and the bound, and nothing of
    the flight. Raises `InputError`.
    """
    balls = balls_of(design)
    own = disturbance(flight, design, around, bandwidth)
    source = own if bound_from is None else disturbance(bound_from, design, around, bandwidth)
    radius, bound = source.radius(balls), np.abs(source.total).max(axis=0)
    parts = []
    for rows in missions(flight):
        t, reference = flight.t[rows], reference_of(flight, rows)
        eta, jumps = _eta(flight, rows, reference), jumps_of(t, reference)
        centre = np.zeros_like(eta)
        if around == "design":  # both solutions jump with the reference: their distance does not
            centre, _ = _of_the_design(flight, design, rows, reference)
            jumps = np.zeros_like(jumps)
        level = np.stack([ball.level((eta - centre)[:, k]) for k, ball in enumerate(balls)], -1)
        predicted = np.stack(
            [tube(ball, radius[k], bound[k], t, level[0, k], jumps[:, k]) for k, ball in enumerate(balls)],
            -1,
        )
        jumped = t[np.any(jumps != 0.0, axis=(1, 2))]
        parts.append((t, reference.position, eta, centre, level, predicted, jumped, t[:1]))
    t, wanted, eta, centre, level, predicted, jumped, starts = (
        np.concatenate(columns) for columns in zip(*parts, strict=True)
    )
    return Tube(
        flight=flight,
        label=label or flight.name,
        balls=balls,
        radius=radius,
        bound=bound,
        bound_from=source.flight.origin or source.flight.name,
        disturbance=own,
        t=t,
        position=flight.column("position")[own.rows],
        reference=wanted,
        eta=eta,
        centre=centre,
        level=level,
        predicted=predicted,
        jumps=jumped,
        starts=starts,
        leavings=_leavings(t, level, predicted),
    )


def _of_the_design(
    flight: Flight, design: Design, rows: np.ndarray, reference: Reference
) -> tuple[np.ndarray, np.ndarray]:
    """What the linear design itself leaves on this reference from the flown start: eta (M, 3, 2), and its d (M, 3)."""
    zeta = euler_from_quaternion(flight.column("quaternion")[rows[:1]])[0]
    start = (flight.column("position")[rows[0]], flight.column("velocity")[rows[0]], zeta)
    behaviour = expected_behaviour(design, flight.t[rows], reference, start)
    eta = np.stack([behaviour.position - reference.position, behaviour.velocity - reference.velocity], -1)
    asked = _asked(design, reference, eta)
    attitude = np.stack([behaviour.zeta[:, 0], behaviour.zeta[:, 1], np.zeros(len(rows))], -1)
    reached = _accelerations(design, attitude, behaviour.zeta[:, 2])
    reached[:, 2] = asked[:, 2]  # thrust acts at once in the linear design
    return eta, reached - asked


def _asked(design: Design, reference: Reference, eta: np.ndarray) -> np.ndarray:
    """Acceleration (M, 3), world ENU, that the ideal position loop (16) asks for at errors eta (M, 3, 2)."""
    gains = hover_input_matrix(design.mass) @ np.array(design.K_eta)
    p, v = np.diag(gains[:, :3]), np.diag(gains[:, 3:])
    return reference.acceleration - p * eta[:, :, 0] - v * eta[:, :, 1]


def _accelerations(design: Design, hover: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """World accelerations (N, 3) of (phi, theta, T - m g) (N, 3) in the hover linearisation (9)."""
    return world_from_heading(hover @ hover_input_matrix(design.mass).T, yaw)


def _eta(flight: Flight, rows: np.ndarray, reference: Reference) -> np.ndarray:
    """Position and velocity error (M, 3, 2), world ENU."""
    position, velocity = flight.column("position")[rows], flight.column("velocity")[rows]
    return np.stack([position - reference.position, velocity - reference.velocity], -1)


def _low_pass(values: np.ndarray, jumps: np.ndarray, bandwidth: float, dt: float) -> np.ndarray:
    """Values (M, 3) behind a zero-phase low-pass that does not reach across the jumps, given as rows."""
    from scipy import signal

    sos = signal.butter(4, bandwidth, fs=1.0 / dt, output="sos")
    out = values.copy()
    edges = [0, *jumps.tolist(), len(values)]
    for begin, end in itertools.pairwise(edges):
        if end - begin > 3:
            padding = min(end - begin - 1, int(1.0 / dt))
            out[begin:end] = signal.sosfiltfilt(sos, values[begin:end], axis=0, padlen=padding)
    return out


def _within(level: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    return level <= predicted * (1.0 + 1e-9) + 1e-12


def _leavings(t: np.ndarray, level: np.ndarray, predicted: np.ndarray) -> tuple[Leaving, ...]:
    found = []
    for k, axis in enumerate("xyz"):
        outside = np.flatnonzero(~_within(level[:, k], predicted[:, k]))
        if outside.size == 0:
            continue
        for rows in np.split(outside, np.flatnonzero(np.diff(t[outside]) > APART) + 1):
            worst = rows[np.argmax(level[rows, k] / predicted[rows, k])]
            found.append(
                Leaving(
                    axis,
                    float(t[rows[0]]),
                    float(t[rows[-1]]),
                    float(level[worst, k]),
                    float(predicted[worst, k]),
                )
            )
    return tuple(sorted(found, key=lambda leaving: leaving.start))
