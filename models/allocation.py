"""How thrust and torque are shared out over the rotors of a vehicle."""

from __future__ import annotations

import numpy as np

from trueflight.models.vehicle import Vehicle

ROTORS = 4
"""Rotors of a vehicle whose file does not tell them."""


def leverage(vehicle: Vehicle) -> tuple[float, ...]:
    """How much of each rotor's own thrust the allocation makes good by that rotor: 1 where there are four, for nothing
    else can; with more, roll, pitch, yaw and thrust are shared out by the pseudo-inverse of their matrix B, and it is
    the diagonal of `pinv(B) B`.

    With the rotor's loss l the allocation asks for `1 / n l / (1 - h l)` more thrust than acts (Sherman-Morrison).
    """
    count = len(vehicle.rotor_positions)
    if not count:
        return (1.0,) * ROTORS
    x, y, _ = np.array(vehicle.rotor_positions, dtype=float).T
    allocation = np.stack([np.ones(count), y, -x, -np.array(vehicle.rotor_directions, dtype=float)])
    return tuple(float(h) for h in np.diag(np.linalg.pinv(allocation) @ allocation))
