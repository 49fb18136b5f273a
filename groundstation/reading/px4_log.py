"""What a PX4 vehicle logged: topics by instance, parameters, drop-outs; loaded from a ULog.

Topics and fields: the message definitions of PX4 1.11 to today. A topic that changed its name or its fields keeps
what it was called when it was logged; `px4_flight` knows the names.
"""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from trueflight.groundstation.reading.rows import as_us, possible
from trueflight.groundstation.reading.sources import FROM, Sources
from trueflight.models.errors import InputError
from trueflight.models.outside import unreadable

TOPICS = (
    "actuator_armed",
    "actuator_controls_0",
    "actuator_motors",
    "actuator_outputs",
    "battery_status",
    "esc_status",
    "estimator_attitude",
    "estimator_local_position",
    "estimator_selector_status",
    "hover_thrust_estimate",
    "sensor_combined",
    "trajectory_setpoint",
    "vehicle_acceleration",
    "vehicle_angular_velocity",
    "vehicle_attitude",
    "vehicle_attitude_setpoint",
    "vehicle_land_detected",
    "vehicle_local_position",
    "vehicle_local_position_setpoint",
    "vehicle_odometry",
    "vehicle_rates_setpoint",
    "vehicle_status",
    "vehicle_thrust_setpoint",
)
Fields = dict[str, np.ndarray]
"""Columns (M,) of a topic by name, `timestamp` in us among them."""
MODES = {0: "manual", 1: "altitude", 2: "position", 3: "mission", 4: "hold", 5: "return", 6: "position slow",
         10: "acro", 12: "descend", 13: "termination", 14: "offboard", 15: "stabilized", 17: "takeoff", 18: "land",
         19: "follow", 20: "precision land", 21: "orbit"}  # fmt: skip
"""PX4's `vehicle_status.nav_state` by name."""
DAY = 86_400_000_000  # us
BETWEEN_FLIGHTS = 5.0
"""s without a sample from which on a topic was not recorded, rather than slow."""
SANE = {
    "vehicle_thrust_setpoint": 2.0,
    "vehicle_rates_setpoint": 200.0,
    "vehicle_attitude_setpoint": 200.0,
    "actuator_controls_0": 2.0,
    "actuator_motors": 2.0,
    "vehicle_angular_velocity": 200.0,
    "sensor_combined": 2000.0,
    "sensor_accel": 2000.0,
    "sensor_gyro": 200.0,
    "vehicle_acceleration": 2000.0,
}
"""Magnitudes that no sample of a topic reaches (normalised, rad/s, m/s²): more is damage, not flight."""
MEASURED = ("xyz", "control", "thrust_body", "roll", "pitch", "yaw", "gyro_rad", "accelerometer_m_s2")


@dataclass(frozen=True)
class Topic:
    """One instance of a topic: `t` (M,) in s of the log's clock, strictly increasing, and its fields (M,) by
    name."""

    name: str
    t: np.ndarray
    fields: dict[str, np.ndarray]
    instance: int = 0

    @property
    def rate(self) -> float:
        """Usual rate, Hz: pauses do not lower it."""
        return 1.0 / float(np.median(np.diff(self.t)))

    def rate_within(self, first: float, last: float) -> float:
        """Samples per second between two times, Hz; what lies between flights, unrecorded, does not lower it."""
        inside = np.searchsorted(self.t, [first, last])
        pauses = np.diff(self.t[slice(*inside)])
        unrecorded = float(pauses[pauses > BETWEEN_FLIGHTS].sum())
        return float(inside[1] - inside[0]) / max(last - first - unrecorded, 1e-9)

    def stack(self, *names: str) -> np.ndarray:
        """Fields as columns (M, k)."""
        with np.errstate(invalid="ignore"):  # a damaged file holds what is no number
            return np.stack([np.asarray(self.fields[name], dtype=float) for name in names], -1)

    def has(self, *names: str) -> bool:
        """Whether the topic has all of these fields."""
        return all(name in self.fields for name in names)

    def first_of(self, *choices: tuple[str, ...]) -> np.ndarray | None:
        """The first group of fields that the topic has, as columns (M, k)."""
        return next((self.stack(*names) for names in choices if self.has(*names)), None)


@dataclass(frozen=True)
class Frame:
    """The rotors of a vehicle: how many, by which parameters, and where those tell it: `places` in FLU in proportions
    (arms of one), and `turns`, 1 for counter-clockwise from above."""

    count: int
    source: str
    places: tuple[tuple[float, ...], ...] = ()
    turns: tuple[int, ...] = ()


@dataclass(frozen=True)
class Log:
    """A log: the instances of each topic by name, parameters at its start, their later changes (time in s, name,
    value), and what the file itself had to tell. `advice` says how to record what is missing, `faster` how to record
    more of it. `chosen` are the topics that were asked for, by quantity.

    The log of another autopilot is brought to PX4's topics: `autopilot` and its flight `modes` by number, `names` of
    what it calls these topics, its `frame`, and whether its sensors were `filtered` before they were logged, so that
    slower samples of them alias nothing.
    """

    origin: str
    topics: dict[str, tuple[Topic, ...]]
    parameters: dict[str, float] = field(default_factory=dict)
    changes: tuple[tuple[float, str, float], ...] = ()
    version: str = ""
    hardware: str = ""
    notes: tuple[str, ...] = ()
    advice: str = "log with PX4's default profile (SDLOG_PROFILE 1)"
    faster: str = "SDLOG_PROFILE 3 logs manoeuvres faster"
    chosen: dict[str, Topic] = field(default_factory=dict)
    autopilot: str = "PX4"
    modes: dict[int, str] = field(default_factory=lambda: MODES)
    names: dict[str, str] = field(default_factory=dict)
    frame: Frame | None = None
    filtered: bool = False

    def name_of(self, topic: str) -> str:
        """What the log itself calls a topic of PX4."""
        return self.names.get(topic, topic)

    def of(self, quantity: str) -> Log:
        """The log as a quantity is to be read from it: where a topic was chosen for it, without those that compete."""
        topic = self.chosen.get(quantity)
        if topic is None:
            return self
        left = {name: topics for name, topics in self.topics.items() if name not in FROM[quantity]}
        return replace(self, topics={**left, topic.name: (topic,)})

    def topic(self, name: str, *needed: str) -> Topic | None:
        """The first instance of a topic that has the needed fields."""
        return next((t for t in self.topics.get(name, ()) if t.has(*needed)), None)

    def parameter(self, *names: str) -> float | None:
        """The value of the first of these parameters that the log holds."""
        return next((self.parameters[name] for name in names if name in self.parameters), None)

    def parameters_at(self, t: float) -> dict[str, float]:
        """The parameters as they were at a time (s)."""
        return self.parameters | {name: value for when, name, value in self.changes if when <= t}


def load_ulog(path: Path, sources: Sources | None = None) -> Log:
    """Read a ULog, also one that is cut short or damaged, with the topics that `sources` choose. Raises `InputError`
    for a file that is no ULog, or a topic that it has not."""
    with unreadable(path, "the log", "copy it from the vehicle's card again", "not a whole ULog"):
        return _loaded(path, sources or Sources())


ON_DEMAND = ("sensor_accel", "sensor_gyro")
"""Topics that are large, and are read only where they are chosen."""


def _loaded(path: Path, sources: Sources) -> Log:
    from pyulog import ULog

    # pyulog prints what it meets in a damaged file; we tell it ourselves.
    with contextlib.redirect_stdout(io.StringIO()), io.FileIO(path) as file:
        log = ULog(_Stream(file), message_name_filter_list=[*TOPICS, *(ON_DEMAND if sources.topics else ())])
    notes = []
    if log.dropouts:
        lost = sum(d.duration for d in log.dropouts) / 1000
        notes.append(f"the logger dropped data {_times(len(log.dropouts))}, {lost:.1f} s in all")
    if log.file_corruption:
        notes.append("parts of the log are damaged and were skipped")
    release = log.get_version_info()
    every = collect((d.name, int(d.multi_id), dict(d.data)) for d in log.data_list)
    chosen = {quantity: _asked_for(path, every, quantity, name) for quantity, name in sources.topics}
    notes += [f"{quantity} is from {name}, as chosen" for quantity, name in sources.topics]
    topics, said = _selected({name: every[name] for name in every if name not in ON_DEMAND})
    notes += said
    return Log(
        str(path),
        topics,
        {name: float(value) for name, value in log.initial_parameters.items() if _is_number(value)},
        tuple(
            (1e-6 * t, name, float(value)) for t, name, value in log.changed_parameters if _is_number(value)
        ),
        _version(release),
        "".join(c for c in str(log.msg_info_dict.get("ver_hw", ""))[:40] if c.isprintable()),
        tuple(notes),
        chosen=chosen,
    )


def _asked_for(path: Path, topics: dict[str, tuple[Topic, ...]], quantity: str, asked: str) -> Topic:
    """The topic that was chosen for a quantity, `NAME` or `NAME:INSTANCE`, under the name by which PX4's choice is
    read. Raises `InputError` with the list for one that the log has not."""
    offered = {f"{t.name}:{t.instance}": t for name in FROM[quantity] for t in topics.get(name, ())}
    wanted = offered.get(asked if ":" in asked else f"{asked}:0")
    if wanted is None:
        has = ", ".join(name.removesuffix(":0") for name in offered) or "nothing that could be it"
        raise InputError(f"{path}: no topic '{asked}' for {quantity} in the log; it has {has}")
    return _renamed(wanted)


def _renamed(topic: Topic) -> Topic:
    """An estimator's or a sensor's topic as PX4's own choice among them would be named."""
    estimated = {
        "estimator_attitude": "vehicle_attitude",
        "estimator_local_position": "vehicle_local_position",
        "sensor_accel": "vehicle_acceleration",
        "sensor_gyro": "vehicle_angular_velocity",
    }
    fields = dict(topic.fields)
    if topic.name in ON_DEMAND:
        fields |= {f"xyz[{i}]": topic.fields[axis] for i, axis in enumerate("xyz") if axis in topic.fields}
    return Topic(estimated.get(topic.name, topic.name), topic.t, fields, topic.instance)


_READ = io.BufferedReader.read  # asked for several times a message: `super()` alone is a tenth of the reading


class _Stream(io.BufferedReader):
    """A file in which a step back after a read that met the end is as long as what was read.

    pyulog (1.3) steps back by what it asked for. In a damaged file that is cut as well it then never ends.
    """

    missing = 0

    def read(self, size: int | None = -1, /) -> bytes:
        """Bytes from here on; how many of those asked for were missing is remembered."""
        data = _READ(self, size)
        if len(data) != size:
            self.missing = max(0, (size or 0) - len(data))
        elif self.missing:
            self.missing = 0
        return data

    def seek(self, target: int, whence: int = 0, /) -> int:
        """Go to a position; backwards from here no further than was read."""
        if whence == io.SEEK_CUR and target < 0:
            target, self.missing = min(0, target + self.missing), 0
        return super().seek(target, whence)


def collect(parts: Iterable[tuple[str, int, dict[str, Any]]]) -> dict[str, tuple[Topic, ...]]:
    """Topics by name, instances in order, of parts (name, instance, fields with `timestamp` in us).

    A topic that was subscribed twice comes in two parts; they are one. Samples whose times cannot be true (a damaged
    file) are left out.
    """
    joined: dict[tuple[str, int], list[dict[str, np.ndarray]]] = {}
    for name, instance, fields in parts:
        joined.setdefault((name, instance), []).append(fields)
    topics: dict[str, list[Topic]] = {}
    for (name, instance), pieces in sorted(joined.items(), key=lambda item: item[0]):
        shared = set.intersection(*(set(piece) for piece in pieces))
        fields = {
            key: possible(np.concatenate([np.asarray(p[key]) for p in pieces]))
            for key in pieces[0]
            if key in shared
        }
        if len(pieces) > 1:
            order = np.argsort(fields["timestamp"], kind="stable")
            fields = {key: values[order] for key, values in fields.items()}
        topic = _topic(name, instance, fields)
        if topic is not None:
            topics.setdefault(name, []).append(topic)
    return {name: tuple(instances) for name, instances in topics.items()}


def _selected(topics: dict[str, tuple[Topic, ...]]) -> tuple[dict[str, tuple[Topic, ...]], list[str]]:
    """Of several estimators the one that PX4 flew by, where its own choice (`vehicle_*`) was not logged."""
    notes: list[str] = []
    selector = topics.get("estimator_selector_status", ())
    primary = 0
    if selector and selector[0].has("primary_instance"):
        primary = int(np.median(selector[0].fields["primary_instance"]))
    for wanted, estimated in (
        ("vehicle_attitude", "estimator_attitude"),
        ("vehicle_local_position", "estimator_local_position"),
    ):
        instances = topics.get(estimated, ())
        if wanted in topics or not instances:
            continue
        chosen = next((topic for topic in instances if topic.instance == primary), instances[0])
        topics = {**topics, wanted: (Topic(wanted, chosen.t, chosen.fields),)}
        notes.append(f"{wanted} is that of {estimated} {chosen.instance}, the estimator in use")
    return topics, notes


def _topic(name: str, instance: int, fields: dict[str, np.ndarray]) -> Topic | None:
    stamp, sample = (
        as_us(t) if t.dtype.kind == "f" else t.astype(np.int64)
        for t in (fields["timestamp"], fields.get("timestamp_sample", np.zeros(len(fields["timestamp"]))))
    )
    # The time of measurement, where it is known and sane; the time of publication otherwise.
    if np.all(sample > 0) and np.max(np.abs(stamp - sample), initial=0) < 1_000_000:
        stamp = sample
    rows = _in_order(stamp)
    if name in SANE:
        with np.errstate(invalid="ignore"):
            wild = [
                np.abs(v[rows]) > SANE[name] for key, v in fields.items() if key.split("[")[0] in MEASURED
            ]
        rows = rows[~np.any(wild, axis=0)] if wild else rows
    if len(rows) < 2:
        return None
    return Topic(name, stamp[rows] * 1e-6, {key: values[rows] for key, values in fields.items()}, instance)


def _in_order(stamp: np.ndarray) -> np.ndarray:
    """Rows of strictly increasing times. Of times that contradict each other the fewer are wrong: one time far in
    the future must not cost all that follow, nor one in the past all that went before."""
    if not len(stamp):
        return np.array([], dtype=int)
    rows = np.flatnonzero(np.abs(stamp - np.median(stamp)) < DAY)
    times = stamp[rows]
    below_all_later = times <= np.minimum.accumulate(times[::-1])[::-1]
    above_all_earlier = times >= np.maximum.accumulate(times)
    rows = rows[below_all_later if below_all_later.sum() >= above_all_earlier.sum() else above_all_earlier]
    return rows[np.concatenate([[True], np.diff(stamp[rows]) > 0])] if len(rows) else rows


def _version(release: tuple[int, int, int, int] | None) -> str:
    """As in "1.15.0" or "1.16.0 alpha"; empty where the log does not tell."""
    if release is None:
        return ""
    major, minor, patch, kind = release
    word = {0: "dev", 64: "alpha", 128: "beta", 192: "rc"}.get(kind & 0xC0 if kind < 255 else 255, "")
    return f"{major}.{minor}.{patch}{' ' + word if word else ''}"


def _is_number(value: object) -> bool:
    """Whether the value of a parameter can be used; in a damaged file it can be anything."""
    return isinstance(value, int | float) and math.isfinite(value)


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
