"""Faults that logs are known for, each with the columns as they would be right and the mapping that mends it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from trueflight.groundstation.reading.uniform import continuous_quaternion
from trueflight.models.frames import enu_flu_from_ned_frd, rotate
from trueflight.models.vehicle import GRAVITY

Columns = dict[str, np.ndarray]

SIGNED: tuple[np.ndarray, ...] = tuple(
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
)
"""The 48 ways to exchange and mirror three axes, (3, 3) each; the first leaves them as they are."""

ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])
CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
LATER = [3, 0, 1, 2]  # w, x, y, z out of x, y, z, w


@dataclass(frozen=True)
class Fault:
    """Something a log may have wrong: what it is, the lines of a mapping that mend it, and the columns as they would be
    right.

    `rank` orders faults that mend alike, the commoner first. `angle` in rad where the fault is a turn. Where vectors
    are in other axes, `axes` (3, 3) takes the columns `names` to their own.
    """

    cause: str
    mapping: str
    mend: Callable[[Columns], Columns]
    rank: int = 0
    angle: float = float("nan")
    names: tuple[str, ...] = ()
    axes: np.ndarray | None = None


def single_faults(columns: Columns, only_mirrored: bool = False) -> Iterator[Fault]:
    """All faults of one column, or of columns from one source, that need no angle; the commonest first. `only_mirrored`
    leaves those that no clean log has unless an axis hardly moves."""
    if not only_mirrored:
        yield from _of_the_quaternion(columns)
        yield from _of_the_frame(columns)
        yield from _of_units(columns)
    yield from _of_body_axes(columns)
    yield from _of_exchanged_axes(columns, only_mirrored)


def turned(cause: str, angle: float, names: tuple[str, ...], rank: int = 0) -> Fault:
    """Vectors turned about z by `angle` rad; `cause` has braces where the angle is told."""
    mapping = "\n".join(f"{n}.turned = {np.degrees(angle):.0f}" for n in names)
    told = cause.format(f"{np.degrees(angle):.0f} degrees")
    axes = about_z(-angle)
    return Fault(told, mapping, partial(_by_axes, names=names, axes=axes), rank, angle, names, axes)


def _by_axes(columns: Columns, names: tuple[str, ...], axes: np.ndarray) -> Columns:
    return {**columns, **{n: columns[n] @ axes.T for n in names}}


def _by_factor(columns: Columns, name: str, factor: float) -> Columns:
    return {**columns, name: factor * columns[name]}


def _by_quaternion(columns: Columns, mend: Callable[[np.ndarray], np.ndarray]) -> Columns:
    return {**columns, "quaternion": continuous_quaternion(mend(columns["quaternion"]))}


def _by_attitude(columns: Columns, axes: np.ndarray) -> Columns:
    return {**columns, "velocity": rotate(columns["quaternion"], columns["velocity"] @ axes.T)}


def _from_frd_body(quaternion: np.ndarray) -> np.ndarray:
    return np.asarray(quaternion * [1.0, 1.0, -1.0, -1.0])


def _all_from_ned(columns: Columns) -> Columns:
    out = dict(columns)
    for name in ("position", "velocity"):
        if name in out:
            out[name] = out[name] @ ENU_FROM_NED.T
    for name in ("angular_velocity", "specific_force"):
        if name in out:
            out[name] = out[name] @ FLU_FROM_FRD.T
    return _by_quaternion(out, enu_flu_from_ned_frd)


def _of_the_quaternion(columns: Columns) -> Iterator[Fault]:
    if "quaternion" not in columns:
        return
    order, inverse = 'quaternion.order = "xyzw"', "quaternion.inverse = true"
    ways: tuple[tuple[str, str, Callable[[np.ndarray], np.ndarray]], ...] = (
        ("the quaternion's columns are in the order x, y, z, w", order, lambda q: q[:, LATER]),
        ("the quaternion is world to body", inverse, lambda q: q * CONJUGATE),
        (
            "the quaternion is in the order x, y, z, w and world to body",
            f"{order}\n{inverse}",
            lambda q: q[:, LATER] * CONJUGATE,
        ),
        ("the quaternion is in NED and FRD axes", 'quaternion.frame = "ned_frd"', enu_flu_from_ned_frd),
        ("the quaternion's body is in FRD axes", 'quaternion.body = "frd"', _from_frd_body),
    )
    for cause, mapping, mend in ways:
        yield Fault(cause, mapping, partial(_by_quaternion, mend=mend))


def _of_the_frame(columns: Columns) -> Iterator[Fault]:
    if "quaternion" in columns:
        yield Fault("all of the log is in NED and FRD axes", 'frame = "ned_frd"', _all_from_ned)


def _of_units(columns: Columns) -> Iterator[Fault]:
    units = {
        "angular_velocity": ("the gyroscope", (("deg/s", np.pi / 180), ("mdeg/s", np.pi / 180000))),
        "velocity": ("the velocity", (("cm/s", 1e-2), ("mm/s", 1e-3), ("km/h", 1 / 3.6))),
        "position": ("the position", (("cm", 1e-2), ("mm", 1e-3))),
        "specific_force": ("the accelerometer", (("g", GRAVITY), ("mg", 1e-3 * GRAVITY))),
    }
    for name, (words, choices) in units.items():
        if name in columns:
            for unit, factor in choices:
                mend = partial(_by_factor, name=name, factor=factor)
                yield Fault(f"{words} is in {unit}", f'{name}.unit = "{unit}"', mend)


def _of_body_axes(columns: Columns) -> Iterator[Fault]:
    if {"velocity", "quaternion"} <= set(columns):
        told, mapping = "the velocity is in body axes{}, not in the world's", 'velocity.axes = "body"'
        yield Fault(told.format(""), mapping, partial(_by_attitude, axes=np.eye(3)))
        frd = partial(_by_attitude, axes=FLU_FROM_FRD)
        yield Fault(told.format(" (FRD)"), f'{mapping}\nvelocity.frame = "ned_frd"', frd, 1)


def _of_exchanged_axes(columns: Columns, only_mirrored: bool) -> Iterator[Fault]:
    groups = (
        (("position", "velocity"), "position and velocity are", "their", ENU_FROM_NED, "NED"),
        (("velocity",), "the velocity is", "its", ENU_FROM_NED, "NED"),
        (("position",), "the position is", "its", ENU_FROM_NED, "NED"),
        (("angular_velocity", "specific_force"), "the IMU is", "its", FLU_FROM_FRD, "FRD"),
        (("angular_velocity",), "the gyroscope is", "its", FLU_FROM_FRD, "FRD"),
        (("specific_force",), "the accelerometer is", "its", FLU_FROM_FRD, "FRD"),
    )
    for names, what, whose, usual, frame in groups:
        if not all(n in columns for n in names):
            continue
        for axes in SIGNED[1:8] if only_mirrored else SIGNED[1:]:
            mend = partial(_by_axes, names=names, axes=axes)
            if np.array_equal(axes, usual):
                mapping = "\n".join(f'{n}.frame = "ned_frd"' for n in names)
                yield Fault(f"{what} in {frame} axes", mapping, mend, 1, names=names, axes=axes)
                continue
            named = [f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.argmax(np.abs(row)))]}" for row in axes]
            listed = ", ".join(f'"{axis}"' for axis in named)
            cause = f"{what} in other axes: x, y, z are {whose} {', '.join(named)}"
            mapping = "\n".join(f"{n}.axes = [{listed}]" for n in names)
            mirrored = np.linalg.det(axes) < 0  # what is mounted otherwise is turned
            yield Fault(cause, mapping, mend, 5 if mirrored else 4, names=names, axes=axes)


def turned_about_z(quaternion: np.ndarray, angle: float) -> np.ndarray:
    """Attitudes (N, 4) turned about the world's z axis, rad."""
    c, s = np.cos(0.5 * angle), np.sin(0.5 * angle)
    w, x, y, z = quaternion.T
    return np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], -1)


def turn_between(right: np.ndarray, turned: np.ndarray) -> float:
    """The turn about z (rad, anticlockwise) that takes `right` (M, 2 or 3) nearest to `turned`."""
    cross = np.sum(right[:, 0] * turned[:, 1] - right[:, 1] * turned[:, 0])
    return float(np.arctan2(cross, np.sum(right[:, :2] * turned[:, :2])))


def about_z(angle: float) -> np.ndarray:
    """The turn about z by `angle` rad, (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
