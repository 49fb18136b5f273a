"""Structure that no known effect explains: found by a flexible regression on held-out blocks."""

from __future__ import annotations

import numpy as np

from groundstation.fitting import BLOCK
from groundstation.measurement import Measurement
from groundstation.results import Unexplained
from models.frames import euler_from_quaternion, rotate_inverse

SHARE = 0.10
"""Part of the remaining squared error that must be predictable on held-out blocks to be called structure."""
MATERIAL = 0.03
"""m/s² RMS of that part."""


def unexplained(measurement: Measurement, residual: np.ndarray) -> Unexplained:
    """Look for structure in `residual` (K, A), the used samples of `measurement`.

    Ridge regression on second-order polynomials of height, velocity, tilt, thrust, body rates and voltage,
    scored block by block on the blocks it did not see.
    """
    names, variables = _variables(measurement)
    linear = np.column_stack(variables)
    scale = linear.std(axis=0)
    keep = scale > 1e-6
    names = [n for n, k in zip(names, keep, strict=True) if k]
    linear = (linear[:, keep] - linear[:, keep].mean(0)) / scale[keep]
    i, j = np.triu_indices(linear.shape[1])
    features = np.clip(
        np.column_stack([np.ones(len(linear)), linear, linear[:, i] * linear[:, j]]), -9.0, 9.0
    )
    owners = [None, *[(k, k) for k in range(linear.shape[1])], *zip(i.tolist(), j.tolist(), strict=True)]
    block = ((measurement.t[measurement.used] - measurement.t[0]) / BLOCK).astype(int)
    total = float(np.sum(residual**2))
    explained = total - _held_out_error(features, residual, block)
    share = max(0.0, explained / total)
    found = share > SHARE and np.sqrt(explained / len(residual)) > MATERIAL
    where: list[str] = []
    if found:
        losses = []
        for v, name in enumerate(names):
            without = features[:, [o is None or v not in o for o in owners]]
            losses.append((_held_out_error(without, residual, block) - (total - explained), name))
        losses.sort(reverse=True)
        where = [
            f"{name} ({loss / total:.0%} of the remaining error goes with it)"
            for loss, name in losses[:3]
            if loss > 0
        ]
    return Unexplained(bool(found), float(share), tuple(where))


def _held_out_error(features: np.ndarray, residual: np.ndarray, block: np.ndarray) -> float:
    """Squared error of ridge regression, each block predicted from the others."""
    gram, moment = features.T @ features, features.T @ residual
    penalty = np.diag(np.r_[0.0, np.full(features.shape[1] - 1, 0.01 * len(features))])
    error = 0.0
    for b in np.unique(block):
        rows = block == b
        f, r = features[rows], residual[rows]
        weights = np.linalg.solve(gram - f.T @ f + penalty + 1e-9 * np.eye(len(gram)), moment - f.T @ r)
        error += float(np.sum((r - f @ weights) ** 2))
    return error


def _variables(m: Measurement) -> tuple[list[str], list[np.ndarray]]:
    flight, rows = m.flight, m.rows[m.used]
    names, values = ["thrust command"], [flight.column("thrust_command")[rows]]
    if flight.position is not None:
        height = flight.position[rows, 2]
        names += ["height", "nearness to the ground"]
        values += [height, 1.0 / np.maximum(height, 0.5 * flight.vehicle.rotor_radius)]
    if flight.quaternion is not None:
        euler = euler_from_quaternion(flight.quaternion[rows])
        names += ["roll", "pitch"]
        values += [euler[:, 0], euler[:, 1]]
        if flight.velocity is not None:
            body = rotate_inverse(flight.quaternion[rows], flight.velocity[rows])
            names += ["forward speed", "sideward speed", "climb speed"]
            values += [body[:, 0], body[:, 1], body[:, 2]]
    if flight.angular_velocity is not None:
        names += ["roll rate", "pitch rate", "yaw rate"]
        values += list(flight.angular_velocity[rows].T)
    if flight.battery_voltage is not None:
        names.append("battery voltage")
        values.append(flight.battery_voltage[rows])
    return names, values
