"""Whose topic is it? Vehicles in a ROS 2 recording by their namespaces, and topics that measure nothing."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

Fields = dict[str, np.ndarray]

TARGETS = {
    "setpoint", "setpoints", "sp", "target", "targets", "cmd", "cmds", "command", "commands",
    "commanded", "reference", "references", "ref", "refs", "desired", "des", "goal", "goals",
    "waypoint", "waypoints", "planned", "plan", "planner", "trajectory", "traj", "wanted", "demand",
    "demanded",
}  # fmt: skip
"""Words in a topic's name that tell what is wanted, not what is."""
PLAIN = TARGETS | {
    "fmu", "in", "out", "mavros", "imu", "imus", "data", "raw", "filtered", "local", "global",
    "position", "odom", "odometry", "pose", "poses", "stamped", "cov", "covariance", "velocity",
    "body", "state", "extended", "battery", "batteries", "status", "attitude", "orientation",
    "vision", "mocap", "rates", "thrust", "sensor", "sensors",
}  # fmt: skip
"""Words that name a quantity; what stands before them in a topic's name is whose it is."""
BRIDGES = ("mavros", "fmu")
"""Segments of a name that only an autopilot's bridge has."""
COMMANDS = (
    "vehicle_rates_setpoint",
    "vehicle_thrust_setpoint",
    "vehicle_attitude_setpoint",
    "actuator_motors",
    "actuator_outputs",
)
ALIKE = 0.1
"""Share by which numbers of messages differ that count as equal."""


@dataclass(frozen=True)
class Source:
    """A topic of a recording: times `t` (M,) in s, and the PX4 topics that it makes, each with fields (M,) by name."""

    topic: str
    kind: str
    t: np.ndarray
    parts: dict[str, Fields] = field(repr=False)

    @property
    def px4(self) -> bool:
        """Whether PX4 itself sent or received it."""
        return self.kind.startswith("px4_msgs/")

    @property
    def bridged(self) -> bool:
        """Whether it comes from an autopilot's bridge."""
        return any(segment in BRIDGES for segment in self.topic.split("/"))

    @property
    def target(self) -> bool:
        """Whether its name says that it tells what is wanted."""
        return bool(TARGETS & set(re.findall(r"[a-z]+", self.topic.lower())))

    @property
    def namespace(self) -> str:
        """What stands before the words that name a quantity: "/uav1" of "/uav1/mavros/imu/data"."""
        if self.px4 and "/fmu/" in self.topic:
            return self.topic.rpartition("/fmu/")[0]
        segments = self.topic.strip("/").split("/")[: -1 if self.px4 else None]
        while segments and (words := re.findall(r"[a-z]+", segments[-1].lower())) and set(words) <= PLAIN:
            segments.pop()
        return "".join(f"/{segment}" for segment in segments)


def vehicles_of(sources: Sequence[Source]) -> list[str]:
    """Namespaces of the vehicles, the one to read first: of most quantities, then of most messages in its slowest one,
    then by name. A vehicle is what has an autopilot's bridge; where there is none, what is commanded."""
    bridged = {s.namespace for s in sources if s.bridged}
    named = bridged or {s.namespace for s in sources if any(name in COMMANDS for name in s.parts)}
    whole = {n for n in named if not any(m and n.startswith(f"{m}/") for m in named)}
    short = {_distinct(n, whole) for n in whole}
    score: dict[str, tuple[int, int]] = {}
    for vehicle in short:
        counts = _counts([s for s in sources if owner(s, vehicle, short) == vehicle])
        score[vehicle] = len(counts), min(counts.values(), default=0)
    most = max((score[v] for v in short), default=(0, 0))
    return sorted(
        short,
        key=lambda v: (
            -score[v][0],
            0 if score[v][1] >= (1 - ALIKE) * most[1] else 1,
            v if score[v][1] >= (1 - ALIKE) * most[1] else "",
            -score[v][1],
            v,
        ),
    )


def owner(source: Source, vehicle: str, vehicles: set[str]) -> str | None:
    """Whose of `vehicles` a topic is: by its namespace, or because a body is named as the vehicle is; None where
    nothing tells. A name that differs from `vehicle`'s in its number only is another vehicle's, and returned."""
    space = source.namespace
    longest = max((v for v in vehicles if v and f"{space}/".startswith(f"{v}/")), key=len, default=None)
    if longest is not None:
        return longest
    segments = space.split("/")[1:]
    for known in vehicles:
        if known and known.rpartition("/")[2] in segments:
            return known
    last = vehicle.rpartition("/")[2]
    for segment in segments:
        if segment != last and re.search(r"\d", last) and _stem(segment) == _stem(last):
            return f"/{segment}"
    return "" if "" in vehicles and (space == "" or source.bridged) else None


def _counts(sources: Sequence[Source]) -> dict[str, int]:
    """Messages of each quantity, of the topic that has most."""
    kinds = {
        "vehicle_local_position": "motion",
        "vehicle_odometry": "motion",
        "vehicle_attitude": "attitude",
        "sensor_combined": "inertial",
        "vehicle_angular_velocity": "inertial",
    } | dict.fromkeys(COMMANDS, "command")
    counts: dict[str, int] = {}
    for source in sources:
        for name in source.parts:
            if name in kinds and not (source.target and kinds[name] != "command"):
                counts[kinds[name]] = max(counts.get(kinds[name], 0), len(source.t))
    return counts


def _distinct(space: str, others: set[str]) -> str:
    """The beginning of a namespace by which it differs from the others."""
    segments = space.split("/")[1:]
    for count in range(1, len(segments) + 1):
        start = "".join(f"/{s}" for s in segments[:count])
        if not any(o != space and f"{o}/".startswith(f"{start}/") for o in others):
            return start
    return space


def _stem(word: str) -> str:
    return re.sub(r"\d+", "#", word)
