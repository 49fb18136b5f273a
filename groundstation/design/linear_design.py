"""The linear cascade: gains from `control.lqr`, what the closed loop does, and whether the vehicle can do it.

Source: Carvalho et al., ICUAS 2022, equations (9), (13) and (16); weights after Bryson's rule (Bryson and Ho,
"Applied Optimal Control", 1975, section 5.2): each weight is one over the square of the greatest value
wanted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trueflight.models.design import Design, hover_input_matrix
from trueflight.models.errors import InputError
from trueflight.models.vehicle import GRAVITY, Vehicle

POSITION_BANDWIDTH = 0.35
"""Hz, natural frequency of the horizontal position loop: 2.2 rad/s, a step of 1 m settles in about 2 s."""
ATTITUDE_BANDWIDTH = 1.3
"""Hz, of the roll and pitch loop: 8.2 rad/s, a quarter of what a lag of 30 ms allows."""
VERTICAL_RATIO = 1.4  # height answers thrust directly, without turning first
YAW_RATIO = 0.3  # yaw torque is weak: differential drag, not thrust
ACCELERATION = 2.0  # m/s², greatest horizontal and vertical acceleration asked for
TILT_ERROR = 0.2  # rad
SEPARATION = 2.5
"""Least ratio of attitude to position bandwidth; closer together the cascade is no cascade."""
PHASE_MARGIN = 40.0
"""Degrees that every loop must keep with the vehicle's delay, lag and a control period."""
ASSUMED_DELAY = 0.01  # s, where the vehicle file tells none
ASSUMED_LAG = 0.03  # s


@dataclass(frozen=True)
class Loop:
    """One loop of the design as it closes on the real actuation: poles (1/s) of the ideal loop, and the
    margins with delay and lag. `rise_time` (s, 10 to 90 %), `settling_time` (s, to 2 %) and `overshoot` (1)
    are of a step of the reference in the ideal loop."""

    name: str
    poles: tuple[complex, ...]
    crossover: float  # rad/s
    phase_margin: float  # deg
    rise_time: float
    settling_time: float
    overshoot: float


def make_design(
    vehicle: Vehicle,
    bandwidth: float = POSITION_BANDWIDTH,
    attitude_bandwidth: float = ATTITUDE_BANDWIDTH,
    rate: float = 100.0,
) -> Design:
    """Gains of the cascade for `vehicle`, by LQR with weights that give the wanted bandwidths (Hz).

    With Bryson's weights the position loop of acceleration a, position p and velocity v (their greatest
    values) has the natural frequency sqrt(a / p) and, with v = sqrt(a p), the damping 0.87; so p follows from
    the bandwidth. Raises `InputError` where the vehicle's delay and lag, or the separation of both loops,
    forbid it.
    """
    import control

    _check_bandwidths(bandwidth, attitude_bandwidth)
    turn = 2 * math.pi * attitude_bandwidth
    q_zeta = np.diag([TILT_ERROR**-2.0] * 2 + [TILT_ERROR**-2.0])
    r_zeta = np.diag([(TILT_ERROR * turn) ** -2.0] * 2 + [(TILT_ERROR * turn * YAW_RATIO) ** -2.0])
    k_zeta, _, _ = control.lqr(np.zeros((3, 3)), np.eye(3), q_zeta, r_zeta)

    speed = 2 * math.pi * bandwidth * np.array([1.0, 1.0, VERTICAL_RATIO])
    position, velocity = ACCELERATION / speed**2, ACCELERATION / speed
    tilt = ACCELERATION / GRAVITY
    q_eta = np.diag(np.concatenate([position, velocity]) ** -2.0)
    r_eta = np.diag([tilt**-2.0, tilt**-2.0, (vehicle.mass * ACCELERATION) ** -2.0])
    a, b = translation(vehicle.mass)
    k_eta, _, _ = control.lqr(a, b, q_eta, r_eta)
    # lqr leaves numerical dust where the axes do not couple; the file should not carry it.
    k_eta = np.where(np.abs(k_eta) < 1e-9 * np.abs(k_eta).max(), 0.0, k_eta)
    k_zeta = np.where(np.abs(k_zeta) < 1e-9 * np.abs(k_zeta).max(), 0.0, k_zeta)
    design = Design(
        vehicle=vehicle.name,
        mass=vehicle.mass,
        K_zeta=_rows(k_zeta),
        K_eta=_rows(k_eta),
        weights={
            "Q_zeta": np.diag(q_zeta).tolist(),
            "R_zeta": np.diag(r_zeta).tolist(),
            "Q_eta": np.diag(q_eta).tolist(),
            "R_eta": np.diag(r_eta).tolist(),
        },
        rate=rate,
        created_by=f"groundstation design, {bandwidth:g} Hz position, {attitude_bandwidth:g} Hz attitude",
    )
    _check_margins(design, vehicle)
    return design


def _check_bandwidths(position: float, attitude: float) -> None:
    """Raise `InputError` for bandwidths (Hz) that no vehicle flies, or that lie too close together."""
    for name, value in (("bandwidth", position), ("attitude bandwidth", attitude)):
        if not 0.01 <= value <= 20.0:
            raise InputError(
                f"design: {name} {value:g} Hz is outside 0.01 to 20 Hz; choose one that a vehicle can fly"
            )
    if attitude < SEPARATION * position:
        raise InputError(
            f"design: attitude bandwidth {attitude:g} Hz is less than {SEPARATION:g} times the position "
            f"bandwidth {position:g} Hz; raise --attitude-bandwidth or lower --bandwidth"
        )


def _check_margins(design: Design, vehicle: Vehicle) -> None:
    """Raise `InputError` where the vehicle's delay and lag leave a loop too little phase."""
    for loop in loops(design, vehicle):
        if loop.phase_margin < PHASE_MARGIN:
            delay, lag = actuation(vehicle, design.rate)
            raise InputError(
                f"design: the {loop.name} loop keeps only {loop.phase_margin:.0f} degrees of phase margin with "
                f"{1e3 * delay:.0f} ms delay and {1e3 * lag:.0f} ms lag of '{vehicle.name}' (at least "
                f"{PHASE_MARGIN:.0f}); lower --attitude-bandwidth and --bandwidth"
            )


def translation(mass: float) -> tuple[np.ndarray, np.ndarray]:
    """State matrices (6, 6) and (6, 3) of eta = (xi, v) under (phi, theta, T), heading frame."""
    a = np.zeros((6, 6))
    a[:3, 3:] = np.eye(3)
    return a, np.vstack([np.zeros((3, 3)), hover_input_matrix(mass)])


def actuation(vehicle: Vehicle, rate: float) -> tuple[float, float]:
    """Delay (s, with one control period) and lag (s) from command to thrust; assumed where the file tells
    none."""
    return (vehicle.command_delay or ASSUMED_DELAY) + 1.0 / rate, vehicle.motor_time_constant or ASSUMED_LAG


def loops(design: Design, vehicle: Vehicle) -> tuple[Loop, ...]:
    """The loops of a design: attitude, yaw, horizontal, vertical, with their margins on this vehicle.

    Roll and pitch see delay and lag; yaw too; the horizontal loop sees the closed attitude loop behind delay
    and lag; the vertical loop delay and lag alone.
    """
    k_zeta, k_eta = np.array(design.K_zeta), np.array(design.K_eta)
    delay, lag = actuation(vehicle, design.rate)
    w = np.geomspace(0.02, 300.0, 6000)
    s = 1j * w
    late = np.exp(-s * delay) / (1 + s * lag)
    inner = k_zeta[0, 0] / s * late
    # Inputs of K_eta in accelerations: g for pitch on x, 1/m for thrust on z.
    p_x, v_x = GRAVITY * k_eta[1, 0], GRAVITY * k_eta[1, 3]
    p_z, v_z = k_eta[2, 2] / design.mass, k_eta[2, 5] / design.mass
    open_loops = {
        "attitude": inner,
        "yaw": k_zeta[2, 2] / s * late,
        "horizontal": (p_x + v_x * s) / s**2 * inner / (1 + inner),
        "vertical": (p_z + v_z * s) / s**2 * late,
    }
    ideal = {
        "attitude": ([k_zeta[0, 0]], [1.0, k_zeta[0, 0]]),
        "yaw": ([k_zeta[2, 2]], [1.0, k_zeta[2, 2]]),
        # x = a_theta / s², a_theta = k/(s + k) (p (r - x) - v s x): the position step meets velocity feedback
        # only
        "horizontal": (
            [k_zeta[0, 0] * p_x],
            [1.0, k_zeta[0, 0], k_zeta[0, 0] * v_x, k_zeta[0, 0] * p_x],
        ),
        "vertical": ([p_z], [1.0, v_z, p_z]),
    }
    return tuple(loop_figures(name, w, open_loops[name], *ideal[name]) for name in open_loops)


def loop_figures(
    name: str, w: np.ndarray, gain: np.ndarray, numerator: list[float], denominator: list[float]
) -> Loop:
    """A loop from its open-loop response `gain` (W,), complex, at `w` (W,) rad/s with delay and lag, and the transfer
    function from reference to position of the ideal closed one."""
    from scipy import signal

    size = np.abs(gain)
    last = int(np.flatnonzero(size >= 1.0)[-1]) if np.any(size >= 1.0) else 0
    phase = np.unwrap(np.angle(gain))
    slowest = float(np.min(np.abs(np.roots(denominator).real)))
    t, y = signal.step((numerator, denominator), T=np.linspace(0.0, 12.0 / slowest, 4000))
    y = y / y[-1]
    outside = np.flatnonzero(np.abs(y - 1.0) > 0.02)
    return Loop(
        name,
        tuple(complex(p) for p in np.roots(denominator)),
        float(w[last]),
        wrapped_margin(float(phase[last])),
        float(t[np.argmax(y >= 0.9)] - t[np.argmax(y >= 0.1)]),
        float(t[outside[-1]]) if outside.size else 0.0,
        float(max(0.0, y.max() - 1.0)),
    )


def wrapped_margin(phase: float) -> float:
    """Phase margin in degrees, -180 to 180, of the phase (rad, any number of turns) at the crossover."""
    return math.degrees(phase) % 360.0 - 180.0


def _rows(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(x) for x in row) for row in np.asarray(matrix))
