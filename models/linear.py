"""The hover linearisation (9) of the paper, and the features (28) of its error.

Source: Carvalho et al., ICUAS 2022, equations (9), (10) and (28).
"""

from __future__ import annotations

from array_api_compat import array_namespace

from trueflight.models.effect import Array
from trueflight.models.vehicle import GRAVITY


def hover_acceleration(phi: Array, theta: Array, specific_thrust: Array) -> Array:
    """`A_zeta (phi, theta, T - m g)` (N, 3), heading frame, m/s².

    `phi`, `theta` (N,) in rad; `specific_thrust` (N,) is T / m in m/s².
    """
    xp = array_namespace(specific_thrust)
    return xp.stack([GRAVITY * theta, -GRAVITY * phi, specific_thrust - GRAVITY], axis=-1)
