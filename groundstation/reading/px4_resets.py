"""Resets that a PX4 estimator counted: when, of what, by how much."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from trueflight.groundstation.reading.px4_airborne import Airborne
from trueflight.groundstation.reading.px4_log import Log, Topic

COUNTED = (
    # quantity, topic, counter, what it counts, by how much (fields of the same topic)
    ("quaternion", "vehicle_attitude", "quat_reset_counter", "heading", tuple(f"delta_q_reset[{i}]" for i in range(4))),
    ("position", "vehicle_local_position", "heading_reset_counter", "heading", ("delta_heading",)),
    ("position", "vehicle_local_position", "xy_reset_counter", "position", ("delta_xy[0]", "delta_xy[1]")),
    ("position", "vehicle_local_position", "z_reset_counter", "height", ("delta_z",)),
    ("position", "vehicle_local_position", "vxy_reset_counter", "velocity", ("delta_vxy[0]", "delta_vxy[1]")),
    ("position", "vehicle_local_position", "vz_reset_counter", "climb", ("delta_vz",)),
)  # fmt: skip
STANDS_IN = ("position", "vehicle_odometry", "reset_counter", "estimate", ())
"""What counts resets where `vehicle_odometry` stands in for the local position."""
UNITS = {"heading": "degrees", "position": "m", "height": "m", "velocity": "m/s", "climb": "m/s"}
TOGETHER = 0.1
"""s within which resets of one thing that two topics count are one."""
NAMED = 3
"""Resets that are told one by one, the largest ones."""


@dataclass(frozen=True)
class Reset:
    """A reset between two messages, at times `before` and `after` (s of the log's clock).

    It changed `what` by `size` (m, m/s, degrees; NaN where the log does not tell).
    """

    what: str
    before: float
    after: float
    size: float
    counter: str


def without_resets(log: Log, air: Airborne) -> tuple[np.ndarray, list[str]]:
    """Where (N,) the estimate was not being reset, and what to say of the resets in the air: nothing is computed across
    them."""
    clean = np.ones(len(air.clock), dtype=bool)
    flown: list[Reset] = []
    for reset in _resets(log):
        within = slice(*np.searchsorted(air.clock, [reset.before, reset.after]))
        clean[max(within.start - 1, 0) : within.stop + 1] = False
        known = any(r.what == reset.what and abs(r.after - reset.after) < TOGETHER for r in flown)
        if np.any(air.in_air[within]) and not known:
            flown.append(reset)
    return clean, _told(flown, float(air.clock[0]))


def _told(resets: list[Reset], start: float) -> list[str]:
    if not resets:
        return []
    largest = sorted(resets, key=lambda r: -np.nan_to_num(r.size))[:NAMED]
    words = [
        f"{r.what}{'' if np.isnan(r.size) else f' by {r.size:.2g} {UNITS[r.what]}'} at t = {r.after - start:.2f} s "
        f"({r.counter})"
        for r in sorted(largest, key=lambda r: r.after)
    ]
    more = f" and {len(resets) - NAMED} smaller ones" if len(resets) > NAMED else ""
    return [f"the estimator reset its {', its '.join(words)}{more}: nothing is computed across"]


def _resets(log: Log) -> Iterator[Reset]:
    local = log.of("position").topic("vehicle_local_position") is not None
    for quantity, name, counter, what, change in COUNTED if local else (COUNTED[0], STANDS_IN):
        topic = log.of(quantity).topic(name, counter)
        if topic is None:
            continue
        for row in np.flatnonzero(np.diff(np.asarray(topic.fields[counter], dtype=float)) != 0):
            size = _size(topic, int(row) + 1, change)
            yield Reset(what, float(topic.t[row]), float(topic.t[row + 1]), size, counter)


def _size(topic: Topic, row: int, change: tuple[str, ...]) -> float:
    """By how much a reset changed what it reset, from the message that tells it; degrees about z of a turn."""
    if not change or not topic.has(*change):
        return float("nan")
    values = np.array([float(topic.fields[name][row]) for name in change])
    if len(values) == 4:
        w, x, y, z = values
        return abs(float(np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))))
    size = float(np.linalg.norm(values))
    return float(np.degrees(size)) if change == ("delta_heading",) else size
