"""Things in space: the vehicle, its path, the ground."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.views.colour import Colour, of_error
from trueflight.groundstation.views.recording import TIME, thin
from trueflight.models.vehicle import Vehicle

DRAWN_SIZE = 0.03
"""Least share of the scene that the vehicle is drawn with, so that a small one far away is still seen."""
PATH_POINTS = 1500


def log_vehicle(stream: rr.RecordingStream, path: str, vehicle: Vehicle, scene: float) -> None:
    """The airframe as arms and rotors, body FLU; the front arms in red. `scene` is the size of the scene in
    m."""
    arms = np.array(vehicle.rotor_positions) if vehicle.rotor_positions else _cross(0.1)
    largest = float(np.abs(arms).max()) or 0.1
    scale = max(1.0, DRAWN_SIZE * scene / largest)
    arms, radius = scale * arms, scale * vehicle.rotor_radius
    around = np.linspace(0.0, 2 * np.pi, 25)
    rings = [arm + radius * np.stack([np.cos(around), np.sin(around), 0 * around], -1) for arm in arms]
    strips = [np.stack([np.zeros(3), arm]) for arm in arms] + rings
    front = [(220, 60, 50) if arm[0] > 0 else (140, 140, 140) for arm in arms]
    stream.log(path, rr.LineStrips3D(strips, colors=front * 2, radii=0.08 * radius), static=True)


def log_motion(
    stream: rr.RecordingStream, path: str, t: np.ndarray, position: np.ndarray, quaternion: np.ndarray
) -> None:
    """Move what is logged under `path`: position (N, 3) in m, quaternion (N, 4) as w, x, y, z."""
    step = thin(len(t))
    stream.send_columns(
        path,
        indexes=[rr.TimeColumn(TIME, duration=np.asarray(t[step], dtype=float))],
        columns=rr.Transform3D.columns(
            translation=position[step], quaternion=quaternion[step][:, [1, 2, 3, 0]]
        ),
    )


def log_line(
    stream: rr.RecordingStream, path: str, position: np.ndarray, colour: Colour, radius: float
) -> None:
    """A path (N, 3) in one colour."""
    points = position[thin(len(position), PATH_POINTS)]
    stream.log(path, rr.LineStrips3D([points], colors=[colour], radii=radius), static=True)


def log_error_line(
    stream: rr.RecordingStream,
    path: str,
    position: np.ndarray,
    error: np.ndarray,
    highest: float,
    radius: float,
) -> None:
    """A path (N, 3) coloured by error (N,), its lines thicker where it is large."""
    step = thin(len(position), PATH_POINTS)
    points, values = position[step], error[step]
    strips = np.stack([points[:-1], points[1:]], 1)
    value = 0.5 * (values[:-1] + values[1:])
    # Drawn in order, the largest errors last, so that they are not hidden where the path crosses itself.
    order = np.argsort(np.nan_to_num(value, nan=-1.0))
    size = radius * (0.6 + 1.2 * np.clip(np.nan_to_num(value[order]) / highest, 0, 1))
    stream.log(
        path, rr.LineStrips3D(strips[order], colors=of_error(value[order], highest), radii=size), static=True
    )


def extent(position: np.ndarray) -> float:
    """Size of the scene of a path (N, 3), m."""
    return float(max(1.0, np.max(np.ptp(position, axis=0))))


def eye(position: np.ndarray, distance: float = 0.8) -> rrb.EyeControls3D:
    """A view from the south-west, above, on the whole path (N, 3); `distance` in sizes of it."""
    low, high = np.quantile(position, 0.005, axis=0), np.quantile(position, 0.995, axis=0)
    middle = 0.5 * (low + high)
    away = distance * max(1.0, float(np.linalg.norm(high - low)))
    direction = np.array([-0.62, -0.62, 0.48])
    return rrb.EyeControls3D(position=middle + away * direction, look_target=middle, eye_up=[0.0, 0.0, 1.0])


def ground(height: float = 0.0) -> rrb.LineGrid3D:
    """The ground as a grid of 1 m."""
    return rrb.LineGrid3D(visible=True, spacing=1.0, plane=rr.components.Plane3D.XY.with_distance(height))


def _cross(arm: float) -> np.ndarray:
    return arm * np.array([[1, -1, 0], [-1, 1, 0], [1, 1, 0], [-1, -1, 0]], dtype=float)
