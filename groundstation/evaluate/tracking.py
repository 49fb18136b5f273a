"""How far a flight was from its linear design: mean squared error per axis against the expected linear
behaviour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from trueflight.groundstation.design.linear_response import Reference, expected_behaviour
from trueflight.groundstation.reading import read_flight, segments
from trueflight.groundstation.reading.mapping import Given
from trueflight.groundstation.reading.ros_bag import is_ros_bag
from trueflight.models.design import Design, load_design
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.frames import euler_from_quaternion, wrap_angle

SHORTEST = 2.0  # s


@dataclass(frozen=True)
class Tracking:
    """A flight beside the linear behaviour expected of it, over the M samples of its missions.

    `t` (M,) in s; `position`, `expected`, `reference` (M, 3) in m, world ENU; `zeta`, `expected_zeta` (M, 3)
    in rad; `mse` (3,) in m² of the position and `mse_zeta` (3,) in rad² of the attitude, per axis.
    """

    flight: Flight
    label: str
    t: np.ndarray
    position: np.ndarray
    expected: np.ndarray
    reference: np.ndarray
    zeta: np.ndarray
    expected_zeta: np.ndarray
    mse: tuple[float, float, float]
    mse_zeta: tuple[float, float, float]

    @property
    def rms(self) -> float:
        """Root of the mean squared distance to the expected position, m."""
        return float(np.sqrt(sum(self.mse)))


def read_designed(
    path: Path, design: Path | None = None, vehicle: Path | None = None, mapping: Given = None
) -> tuple[Flight, Design, str]:
    """A flight, the design it is measured against (that of the record unless given) and its label.

    Raises `InputError`.
    """
    label = path.stem
    flight = read_flight(path, vehicle, mapping)
    if path.suffix.lower() == ".mcap" and not is_ros_bag(path):
        from trueflight.models.record import read_record

        record = read_record(path, ticks=False)
        controller = record.metadata.get("controller", "")
        label = f"{record.metadata.get('trajectory', path.stem)} {controller}".strip()
        if design is None and record.design is not None:
            return flight, record.design, label
    if design is None:
        raise InputError(
            f"{path}: the flight carries no design; pass --design FILE (`groundstation design` makes one)"
        )
    return flight, load_design(design, flight.vehicle), label


def track_file(
    path: Path, design: Path | None = None, vehicle: Path | None = None, mapping: Given = None
) -> Tracking:
    """Read a flight and track it; the design is that of the record unless given. Raises `InputError`."""
    return track(*read_designed(path, design, vehicle, mapping))


def told_apart(tracked: Sequence[Tracking]) -> list[Tracking]:
    """The same flights, labelled by their files too where labels would be equal, and by numbers where those are."""
    labels = [t.label for t in tracked]
    named = [f"{t.flight.name}: {t.label}" if labels.count(t.label) > 1 else t.label for t in tracked]
    return [
        replace(t, label=f"{name} ({number})" if named.count(name) > 1 else name)
        for number, (t, name) in enumerate(zip(tracked, named, strict=True), 1)
    ]


def track(flight: Flight, design: Design, label: str = "") -> Tracking:
    """Fly the flight's reference by its linear design, from where it was, and compare.

    Where the flight tells when a mission was flown, only that counts, each stretch from its own start. Raises
    `InputError` where references or states are missing, or nothing lasts long enough.
    """
    position, velocity = flight.column("position"), flight.column("velocity")
    zeta = euler_from_quaternion(flight.column("quaternion"))
    wanted = flight.column("position_reference")
    n = len(flight)
    expected, angles = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    flown = missions(flight)
    for rows in flown:
        behaviour = expected_behaviour(
            design,
            flight.t[rows],
            reference_of(flight, rows),
            (position[rows[0]], velocity[rows[0]], zeta[rows[0]]),
        )
        expected[rows], angles[rows] = behaviour.position, behaviour.zeta
    rows = np.concatenate(flown)
    miss = position[rows] - expected[rows]
    turn = wrap_angle(zeta[rows] - angles[rows])
    return Tracking(
        flight,
        label or flight.name,
        flight.t[rows],
        position[rows],
        expected[rows],
        wanted[rows],
        zeta[rows],
        angles[rows],
        _mean_square(miss),
        _mean_square(turn),
    )


def missions(flight: Flight) -> list[np.ndarray]:
    """Row numbers of each unbroken stretch that counts: in the air, on a mission where the flight tells.

    Raises `InputError` where none lasts `SHORTEST` s.
    """
    counts = np.ones(len(flight), bool) if flight.flying is None else flight.flying.copy()
    if "mission" in flight.extra:
        counts &= flight.extra["mission"] > 0.5
    out = []
    for part in segments(flight.t):
        inside = np.concatenate([[0], counts[part].astype(np.int8), [0]])
        edges = np.flatnonzero(np.diff(inside)) + part.start
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            if flight.t[b - 1] - flight.t[a] >= SHORTEST:
                out.append(np.arange(a, b))
    if not out:
        raise InputError(
            f"{flight.origin}: no mission of {SHORTEST:g} s in it; fly a trajectory (`groundstation fly`)"
        )
    return out


def reference_of(flight: Flight, rows: np.ndarray) -> Reference:
    """The reference over the rows of one stretch; what the flight does not tell is differentiated, yaw is 0."""
    t, position = flight.t[rows], flight.column("position_reference")[rows]
    velocity, acceleration, yaw = (
        flight.velocity_reference,
        flight.acceleration_reference,
        flight.yaw_reference,
    )
    speed = velocity[rows] if velocity is not None else np.gradient(position, t, axis=0)
    change = acceleration[rows] if acceleration is not None else np.gradient(speed, t, axis=0)
    return Reference(position, speed, change, yaw[rows] if yaw is not None else np.zeros(len(rows)))


def _mean_square(error: np.ndarray) -> tuple[float, float, float]:
    x, y, z = np.mean(error**2, axis=0)
    return float(x), float(y), float(z)
