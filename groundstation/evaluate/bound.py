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

from trueflight.groundstation.design.linear_response import Behaviour, Reference, expected_behaviour
from trueflight.groundstation.evaluate.tracking import missions, reference_of
from trueflight.models.design import Design, hover_input_matrix
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.frames import euler_from_quaternion, rotate, world_from_heading
from trueflight.models.vehicle import GRAVITY

Around = Literal["design", "reference"]

BANDWIDTH = 5.0
"""Hz, of the low-pass on d and eta alike. The equation above is linear: what is filtered obeys it exactly, so the
filter hides nothing, and ten times the loop's own bandwidth lets pass all that moves the vehicle."""
AGREEMENT = 0.5
"""Hz below which position, velocity and acceleration are made to agree, where an estimator's velocity is not the slope
of its position, and an accelerometer has a bias. Both act on the vehicle as disturbances do: so they belong in d."""

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
    its missions; `around` the design, less the same of the design itself.

    `total` (M, 3) m/s², world ENU, is the sum of `model` (delta - delta_hat: error of the hover model (10), less the
    correction as applied) and `attitude` (A_zeta times the attitude not yet reached, and commands at their limits); all
    behind a zero-phase low-pass of `bandwidth` Hz. `stretches` are the slices of the M samples of each mission.
    """

    flight: Flight
    around: Around
    stretches: tuple[slice, ...]
    total: np.ndarray
    model: np.ndarray
    attitude: np.ndarray
    bandwidth: float

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
    largest |d|, both of the flight `bound_from`; `disturbance` is what really acted. `resolution` (3,) in m/s² is how
    far the measured error strays from the one that the measured d explains, the most that V^(1/2) owes to the sensors:
    only what is further out than that has left the tube.
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
    resolution: np.ndarray
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
        """Share of time inside the tube, as far as the sensors can tell, per axis (3,)."""
        return np.mean(self.level <= self.predicted + self.resolution, axis=0)

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
    gains = hover_input_matrix(design.mass) @ np.array(design.K_eta)
    position, velocity = _gains(design).T
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


def stability_tube(
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


def predict_tube(
    flight: Flight,
    design: Design,
    label: str = "",
    around: Around = "design",
    bound_from: Flight | None = None,
    bandwidth: float = BANDWIDTH,
) -> Tube:
    """The tube of a flight, from the bound on d that the flight `bound_from` shows, otherwise the flight itself.

    Each mission's tube begins at the flown state; from there on it knows the reference and the bound, and nothing of
    the flight. Raises `InputError` where a flight lacks what this needs.
    """
    balls = balls_of(design)
    flown = [_mission(flight, design, rows, around, bandwidth) for rows in missions(flight)]
    own = _disturbance(flight, around, flown, bandwidth)
    source = own if bound_from is None else disturbance(bound_from, design, around, bandwidth)
    radius, bound = source.radius(balls), np.abs(source.total).max(axis=0)
    resolution = np.max(
        [[ball.level(m.unexplained[:, k]).max() for k, ball in enumerate(balls)] for m in flown], axis=0
    )
    levels, tubes = [], []
    for mission in flown:
        away = mission.eta - mission.centre
        level = np.stack([ball.level(away[:, k]) for k, ball in enumerate(balls)], -1)
        levels.append(level)
        tubes.append(
            [
                stability_tube(ball, radius[k], bound[k], mission.t, level[0, k], mission.jumps[:, k])
                for k, ball in enumerate(balls)
            ]
        )
    t = np.concatenate([m.t for m in flown])
    level, predicted = np.concatenate(levels), np.concatenate([np.stack(each, -1) for each in tubes])
    return Tube(
        flight=flight,
        label=label or flight.name,
        balls=balls,
        radius=radius,
        bound=bound,
        bound_from=source.flight.origin or source.flight.name,
        resolution=resolution,
        disturbance=own,
        t=t,
        position=np.concatenate([m.position for m in flown]),
        reference=np.concatenate([m.reference for m in flown]),
        eta=np.concatenate([m.eta for m in flown]),
        centre=np.concatenate([m.centre for m in flown]),
        level=level,
        predicted=predicted,
        jumps=np.concatenate([m.t[np.any(m.jumps != 0.0, axis=(1, 2))] for m in flown]),
        starts=np.array([m.t[0] for m in flown]),
        leavings=_leavings(t, level, predicted, resolution),
    )


def disturbance(
    flight: Flight, design: Design, around: Around = "design", bandwidth: float = BANDWIDTH
) -> Disturbance:
    """What disturbed the position loop of a flight: measured by the accelerometer, else by differentiated velocity.

    Raises `InputError` where the flight lacks what that needs.
    """
    flown = [_mission(flight, design, rows, around, bandwidth) for rows in missions(flight)]
    return _disturbance(flight, around, flown, bandwidth)


@dataclass(frozen=True)
class _Mission:
    """One stretch of a flight, world ENU: `t`, flown and reference `position` (M, 3), `eta`, `centre` and `jumps`
    (M, 3, 2) as in `Tube`, `total` and `model` (M, 3) as in `Disturbance`; `unexplained` (M, 3, 2) is by what eta
    strays from the solution of its equation under `total`."""

    t: np.ndarray
    position: np.ndarray
    reference: np.ndarray
    eta: np.ndarray
    centre: np.ndarray
    jumps: np.ndarray
    total: np.ndarray
    model: np.ndarray
    unexplained: np.ndarray


def _mission(flight: Flight, design: Design, rows: np.ndarray, around: Around, bandwidth: float) -> _Mission:
    t, dt = flight.t[rows], flight.dt
    zeta = euler_from_quaternion(flight.column("quaternion")[rows])
    position, velocity, acceleration = _agreeing(flight, rows)
    reference = reference_of(flight, rows)
    behaviour = expected_behaviour(design, t, reference, (position[0], velocity[0], zeta[0]))
    centre = np.stack([behaviour.position - reference.position, behaviour.velocity - reference.velocity], -1)
    own = _own_disturbance(design, reference, behaviour, centre)
    eta = np.stack([position - reference.position, velocity - reference.velocity], -1)
    # The design's own flight is free of noise and jumps as the flown one does: only their distance is filtered.
    away = _low_pass(eta - centre, bandwidth, dt)
    total = _low_pass(acceleration - _asked(design, reference, eta) - own, bandwidth, dt)
    thrust = flight.vehicle.thrust(flight.column("thrust_command")[rows])
    hover = np.stack([zeta[:, 0], zeta[:, 1], thrust - flight.vehicle.weight], -1)
    correction = (
        flight.extra["correction"][rows] if "correction" in flight.extra else np.zeros((len(rows), 3))
    )
    corrected = world_from_heading(np.nan_to_num(correction), zeta[:, 2])
    model = _low_pass(acceleration - _accelerations(design, hover, zeta[:, 2]) - corrected, bandwidth, dt)
    jumps, middle = jumps_of(t, reference), centre
    unexplained = away - _solved(design, t - t[0], away[0], total)
    if around == "design":  # both solutions jump with the reference: their distance does not
        jumps = np.zeros_like(jumps)
    else:
        middle, total = np.zeros_like(centre), total + own
    return _Mission(t, position, reference.position, away + centre, middle, jumps, total, model, unexplained)


def _solved(design: Design, t: np.ndarray, start: np.ndarray, d: np.ndarray) -> np.ndarray:
    """eta (M, 3, 2) of the ideal position loop from `start` (3, 2) under d (M, 3), at even times `t` (M,) from 0."""
    from scipy import signal

    out = np.empty((len(t), 3, 2))
    for k, (p, v) in enumerate(_gains(design)):
        system = ([[0.0, 1.0], [-p, -v]], [[0.0], [1.0]], np.eye(2), np.zeros((2, 1)))
        even = np.linspace(0.0, t[-1], len(t))
        out[:, k] = signal.lsim(system, d[:, k], even, X0=start[k])[1]
    return out


def _disturbance(flight: Flight, around: Around, flown: list[_Mission], bandwidth: float) -> Disturbance:
    total, model = (np.concatenate(parts) for parts in zip(*((m.total, m.model) for m in flown), strict=True))
    edges = np.cumsum([0, *(len(m.t) for m in flown)]).tolist()
    return Disturbance(
        flight=flight,
        around=around,
        stretches=tuple(slice(a, b) for a, b in itertools.pairwise(edges)),
        total=total,
        model=model,
        attitude=total - model,
        bandwidth=bandwidth,
    )


def _agreeing(flight: Flight, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and acceleration (M, 3), world ENU, each the slope of the one before below `AGREEMENT` Hz."""
    t, dt = flight.t[rows], flight.dt
    position, velocity = flight.column("position")[rows], flight.column("velocity")[rows]

    def agreeing(values: np.ndarray, slope: np.ndarray) -> np.ndarray:
        # What is left of the values without the integral of their slope holds no motion, only error: it is smooth, and
        # a filter does it no harm where the flight begins and ends.
        steps = 0.5 * np.diff(t)[:, None] * (slope[1:] + slope[:-1])
        error = values - values[0] - np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        return slope + np.gradient(_low_pass(error, AGREEMENT, dt, 2), t, axis=0)

    velocity = agreeing(position, velocity)
    if flight.specific_force is None:
        return position, velocity, np.gradient(velocity, t, axis=0)
    quaternion = flight.column("quaternion")[rows]
    acceleration = rotate(quaternion, flight.specific_force[rows]) - [0.0, 0.0, GRAVITY]
    return position, velocity, agreeing(velocity, acceleration)


def _own_disturbance(
    design: Design, reference: Reference, behaviour: Behaviour, eta: np.ndarray
) -> np.ndarray:
    """d (M, 3) of the linear design itself, which its attitude loop (13) makes; thrust acts at once."""
    attitude = np.stack([behaviour.zeta[:, 0], behaviour.zeta[:, 1], np.zeros(len(eta))], -1)
    d = _accelerations(design, attitude, behaviour.zeta[:, 2]) - _asked(design, reference, eta)
    d[:, 2] = 0.0
    return d


def _gains(design: Design) -> np.ndarray:
    """Position and velocity gain (3, 2) of each axis, in 1/s² and 1/s."""
    gains = hover_input_matrix(design.mass) @ np.array(design.K_eta)
    return np.stack([np.diag(gains[:, :3]), np.diag(gains[:, 3:])], -1)


def _asked(design: Design, reference: Reference, eta: np.ndarray) -> np.ndarray:
    """Acceleration (M, 3), world ENU, that the ideal position loop (16) asks for at errors eta (M, 3, 2)."""
    return reference.acceleration - np.sum(_gains(design) * eta, axis=-1)


def _accelerations(design: Design, hover: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """World accelerations (N, 3) of (phi, theta, T - m g) (N, 3) in the hover linearisation (9)."""
    return world_from_heading(hover @ hover_input_matrix(design.mass).T, yaw)


def _low_pass(values: np.ndarray, bandwidth: float, dt: float, order: int = 4) -> np.ndarray:
    """Values (M, ...) behind a zero-phase low-pass."""
    from scipy import signal

    sos = signal.butter(order, min(bandwidth, 0.4 / dt), fs=1.0 / dt, output="sos")
    return signal.sosfiltfilt(sos, values, axis=0, padlen=min(len(values) - 1, int(1.0 / dt)))


def _leavings(
    t: np.ndarray, level: np.ndarray, predicted: np.ndarray, resolution: np.ndarray
) -> tuple[Leaving, ...]:
    found = []
    for k, axis in enumerate("xyz"):
        outside = np.flatnonzero(level[:, k] > predicted[:, k] + resolution[k])
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
