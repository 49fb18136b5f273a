"""The hover linearisation (9) of the paper, and the features (28) of its error.

Source: Carvalho et al., ICUAS 2022, equations (9), (10) and (28).
"""

from __future__ import annotations

import numpy as np
from array_api_compat import array_namespace

from models.effect import Array
from models.vehicle import GRAVITY


def input_matrix(mass: float) -> np.ndarray:
    """`A_zeta` (3, 3): heading-frame acceleration (m/s²) of (phi, theta, T - m g), rad and N."""
    return np.array([[0.0, GRAVITY, 0.0], [-GRAVITY, 0.0, 0.0], [0.0, 0.0, 1.0 / mass]])


def hover_acceleration(phi: Array, theta: Array, specific_thrust: Array) -> Array:
    """`A_zeta (phi, theta, T - m g)` (N, 3), heading frame, m/s².

    `phi`, `theta` (N,) in rad; `specific_thrust` (N,) is T / m in m/s².
    """
    xp = array_namespace(specific_thrust)
    return xp.stack([GRAVITY * theta, -GRAVITY * phi, specific_thrust - GRAVITY], axis=-1)


def hover_system() -> tuple[np.ndarray, np.ndarray]:
    """State matrices of the translation, `eta = (xi, v)` (6) driven by the acceleration (3), heading frame."""
    a = np.zeros((6, 6))
    a[:3, 3:] = np.eye(3)
    b = np.zeros((6, 3))
    b[3:] = np.eye(3)
    return a, b
