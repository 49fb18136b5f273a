"""The expected linear behaviour: how the vehicle would fly if it were its linear design.

The nine states (xi, v, zeta) of the hover linearisation (9) under the attitude loop (13) and the position
loop (16) of the paper follow the same reference from the same start. Every tracking figure is measured
against it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trueflight.models.design import Design, hover_input_matrix
from trueflight.models.errors import InputError
from trueflight.models.frames import heading_from_world, wrap_angle
from trueflight.models.vehicle import GRAVITY


@dataclass(frozen=True)
class Reference:
    """A reference over time: `position`, `velocity`, `acceleration` (N, 3) in m, m/s, m/s², world ENU; `yaw`
    (N,) in rad."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    yaw: np.ndarray


@dataclass(frozen=True)
class Behaviour:
    """Positions and velocities (N, 3), world ENU, and Euler angles `zeta` (N, 3) in rad of the linear closed
    loop."""

    position: np.ndarray
    velocity: np.ndarray
    zeta: np.ndarray


def expected_behaviour(
    design: Design, t: np.ndarray, reference: Reference, start: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> Behaviour:
    """Fly `reference` at the even times `t` (N,) from `start` = (position, velocity, zeta) by the linear
    design.

    Discretised exactly: between samples the reference runs linearly, the state by the matrix exponential. The
    linear model stands in the heading frame; yaw is solved first and held at its mean over each step, which
    is exact where yaw stands still. Raises `InputError` for uneven times.
    """
    steps = np.diff(t)
    dt = float(np.median(steps))
    if np.any(np.abs(steps - dt) > 0.3 * dt):
        raise InputError("expected behaviour: the times are uneven; pass one segment of a flight at a time")
    yaw = _yaw(design, dt, reference.yaw, float(start[2][2]))
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    state_step, now_step, next_step = _steps(design, dt)
    n = len(t)
    position, velocity, zeta = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    position[0], velocity[0] = start[0], start[1]
    zeta[:, 2] = yaw
    zeta[0, :2] = start[2][:2]
    # References in the heading frame of each step, at its beginning and its end: (n - 1, 9).
    columns = (reference.position, reference.velocity, reference.acceleration)
    begin = np.concatenate([heading_from_world(c[:-1], middle) for c in columns], -1)
    end = np.concatenate([heading_from_world(c[1:], middle) for c in columns], -1)
    drive = begin @ now_step.T + end @ next_step.T
    for k in range(n - 1):
        c, s = np.cos(middle[k]), np.sin(middle[k])
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        state = np.concatenate([turn @ position[k], turn @ velocity[k], zeta[k, :2]])
        state = state_step @ state + drive[k]
        position[k + 1], velocity[k + 1] = turn.T @ state[:3], turn.T @ state[3:6]
        zeta[k + 1, :2] = state[6:]
    return Behaviour(position, velocity, zeta)


def closed_loop(design: Design) -> tuple[np.ndarray, np.ndarray]:
    """Matrices (8, 8) and (8, 9) of the state (xi, v, phi, theta) driven by (xi_ref, v_ref, a_ref), heading
    frame.

    Thrust acts at once: `T - m g` is the third row of the position loop.
    """
    k_eta, k_zeta = np.array(design.K_eta), np.array(design.K_zeta)[:2, :2]
    a_zeta = hover_input_matrix(design.mass)
    wanted_state = -k_eta  # (phi, theta, T - m g) of (xi, v)
    wanted_reference = np.hstack([k_eta, np.linalg.inv(a_zeta)])  # of (xi_ref, v_ref, a_ref)
    a, b = np.zeros((8, 8)), np.zeros((8, 9))
    a[:3, 3:6] = np.eye(3)
    a[3, 7], a[4, 6] = GRAVITY, -GRAVITY
    a[5, :6] = wanted_state[2] / design.mass
    b[5] = wanted_reference[2] / design.mass
    a[6:, :6], a[6:, 6:] = k_zeta @ wanted_state[:2], -k_zeta
    b[6:] = k_zeta @ wanted_reference[:2]
    return a, b


def _steps(design: Design, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State, begin and end matrices of one step with a reference that runs linearly (first-order hold)."""
    from scipy.linalg import expm

    a, b = closed_loop(design)
    # Franklin, Powell, Workman, "Digital Control of Dynamic Systems", section 6.3.2: augmented exponential.
    block = np.zeros((8 + 18, 8 + 18))
    block[:8, :8], block[:8, 8:17] = a * dt, b * dt
    block[8:17, 17:] = np.eye(9)
    exponential = expm(block)
    state, both, end = exponential[:8, :8], exponential[:8, 8:17], exponential[:8, 17:]
    return state, both - end, end


def _yaw(design: Design, dt: float, reference: np.ndarray, start: float) -> np.ndarray:
    """Yaw (N,) of the loop psi' = -k (psi - psi_ref), error wrapped, psi_ref linear between samples."""
    k = float(np.array(design.K_zeta)[2, 2])
    unwrapped = np.unwrap(reference)
    yaw = np.empty(len(reference))
    yaw[0] = unwrapped[0] + wrap_angle(np.array(start - unwrapped[0]))
    decay = np.exp(-k * dt)
    for i in range(len(reference) - 1):
        slope = (unwrapped[i + 1] - unwrapped[i]) / dt
        # The steady error behind a ramp is slope / k.
        error = yaw[i] - unwrapped[i] + slope / k
        yaw[i + 1] = unwrapped[i + 1] - slope / k + decay * error
    return yaw
