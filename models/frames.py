"""Frames and rotations: ENU/NED, FLU/FRD, quaternions (w, x, y, z; body to world), Z-Y-X Euler angles.

Everything is vectorised over leading dimensions. Source for the conventions: Diebel, "Representing Attitude"
(2006), with PX4's frame definitions for NED and FRD.
"""

from __future__ import annotations

import numpy as np

BLOCK = 8192
"""Rows that are turned at once: what is computed between stays in the processor's cache."""


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3), body to world, of unit quaternions: `quaternion` (..., 4), w, x, y, z."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=float), -1, 0)
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Body vectors `vector` (..., 3) expressed in the world, with `quaternion` (..., 4) body to world."""
    return _turned(quaternion, vector, 1.0)


def rotate_inverse(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """World vectors `vector` (..., 3) expressed in the body, with `quaternion` (..., 4) body to world."""
    return _turned(quaternion, vector, -1.0)


def _turned(quaternion: np.ndarray, vector: np.ndarray, sign: float) -> np.ndarray:
    """v + 2 u x (u x v + w v): `rotation_matrix` times v (`sign` 1) or its transpose (-1), without the matrices."""
    quaternion, vector = np.asarray(quaternion, dtype=float), np.asarray(vector, dtype=float)
    if quaternion.ndim == vector.ndim == 2 and BLOCK < len(quaternion) == len(vector):
        out = np.empty(vector.shape)
        for first in range(0, len(out), BLOCK):
            rows = slice(first, first + BLOCK)
            out[rows] = _turned(quaternion[rows], vector[rows], sign)
        return out
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    a, b, c = np.moveaxis(vector, -1, 0)
    w = sign * w
    p, q, r = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return np.stack([a + w * p + y * r - z * q, b + w * q + z * p - x * r, c + w * r + x * q - y * p], -1)


def euler_from_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """Roll phi, pitch theta, yaw psi (..., 3) in rad, Z-Y-X, with pitch in [-pi/2, pi/2], of `quaternion` (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=float), -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack([roll, pitch, yaw], -1)


def quaternion_from_euler(euler: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4) of `euler` (..., 3): roll, pitch, yaw in rad, Z-Y-X."""
    half = 0.5 * np.asarray(euler, dtype=float)
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(np.cos(half), -1, 0), np.moveaxis(np.sin(half), -1, 0)
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        -1,
    )


def heading_from_world(vector: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """World vectors `vector` (..., 3) expressed in the heading frame: the world turned by `yaw` (...) rad about z."""
    x, y, z = np.moveaxis(np.asarray(vector, dtype=float), -1, 0)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * x + s * y, -s * x + c * y, z + 0.0 * c], -1)


def world_from_heading(vector: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Heading-frame vectors `vector` (..., 3) expressed in the world, which is turned back by `yaw` (...) rad."""
    return heading_from_world(vector, -np.asarray(yaw))


def wrap_angle(angle: np.ndarray) -> np.ndarray:
    """Angles `angle` (...) in rad wrapped to [-pi, pi)."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def enu_from_ned(vector: np.ndarray) -> np.ndarray:
    """NED vectors `vector` (..., 3) in ENU. The map is its own inverse."""
    return np.asarray(vector, dtype=float)[..., [1, 0, 2]] * np.array([1.0, 1.0, -1.0])


def flu_from_frd(vector: np.ndarray) -> np.ndarray:
    """FRD body vectors `vector` (..., 3) in FLU. The map is its own inverse."""
    return np.asarray(vector, dtype=float) * np.array([1.0, -1.0, -1.0])


def enu_flu_from_ned_frd(quaternion: np.ndarray) -> np.ndarray:
    """Attitude (..., 4), FLU body to ENU world, of `quaternion` (..., 4), FRD body to NED world. Its own inverse."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=float), -1, 0)
    # q_enu_flu = q_ned->enu * q * q_flu->frd, with q_ned->enu = (0, 1, 1, 0)/sqrt(2) and q_flu->frd = (0, 1, 0, 0)
    r = np.sqrt(0.5)
    out = np.stack([r * (w + z), r * (x + y), r * (x - y), r * (w - z)], -1)
    return np.where(out[..., :1] < 0, -out, out)
