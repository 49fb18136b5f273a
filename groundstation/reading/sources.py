"""Which of several things a flight is read from: a vehicle's namespace, a topic for a quantity, a mapping.

    vehicle_namespace = "/uav1"

    [topics]
    position = "/vrpn_mocap/drone/pose"       # a topic of a ROS 2 recording
    battery_voltage = "battery_status:1"      # an instance of a ULog's topic

Both stand in a mapping, and are the options `--vehicle-namespace` and `--topic QUANTITY=NAME`.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from trueflight.models.errors import InputError
from trueflight.models.outside import shown

ATTITUDE = ("vehicle_attitude", "estimator_attitude", "vehicle_odometry")
POSITION = ("vehicle_local_position", "estimator_local_position", "vehicle_odometry")
COLLECTIVE = (
    "vehicle_thrust_setpoint",
    "actuator_controls_0",
    "vehicle_rates_setpoint",
    "vehicle_attitude_setpoint",
    "actuator_motors",
    "actuator_outputs",
    "esc_status",
)
FROM: dict[str, tuple[str, ...]] = {
    "position": POSITION,
    "velocity": POSITION,
    "quaternion": ATTITUDE,
    "angular_velocity": ("vehicle_angular_velocity", "sensor_combined", "sensor_gyro"),
    "specific_force": ("sensor_combined", "vehicle_acceleration", "sensor_accel"),
    "thrust_command": COLLECTIVE,
    "body_rate_command": ("vehicle_rates_setpoint",),
    "battery_voltage": ("battery_status",),
    "position_reference": ("trajectory_setpoint", "vehicle_local_position_setpoint"),
    "motor_command": ("actuator_motors", "actuator_outputs"),
    "rotor_speed": ("esc_status",),
}
"""The quantities for which a topic can be chosen, and the topics of PX4 that may hold each."""


@dataclass(frozen=True)
class Sources:
    """What a flight is to be read from: a vehicle's `namespace`, a topic for each quantity."""

    namespace: str | None = None
    topics: tuple[tuple[str, str], ...] = ()

    def over(self, other: Sources) -> Sources:
        """These over `other`, one by one."""
        namespace = other.namespace if self.namespace is None else self.namespace
        return Sources(namespace, tuple({**dict(other.topics), **dict(self.topics)}.items()))


def sources_in(table: dict[str, object], source: str) -> Sources:
    """What the table of a mapping says of sources; taken out of it. Raises `InputError` for what it cannot be."""
    namespace, topics = table.pop("vehicle_namespace", None), table.pop("topics", {})
    if namespace is not None and not isinstance(namespace, str):
        raise InputError(f'{source}: vehicle_namespace must be a text like "/uav1", not {shown(namespace)}')
    if not isinstance(topics, dict) or not all(isinstance(name, str) for name in topics.values()):
        raise InputError(f'{source}: [topics] must hold lines like position = "/vrpn_mocap/drone/pose"')
    checked = _checked(f"{source}: [topics]", [(str(k), str(v)) for k, v in topics.items()])
    return Sources(namespace, tuple(checked))


def as_lines(namespace: str | None, topics: Iterable[str]) -> list[str]:
    """`--vehicle-namespace` and `--topic QUANTITY=NAME` as the lines of a mapping that they are. Raises `InputError`
    for a topic that is not written so."""
    pairs = []
    for given in topics:
        quantity, equals, name = given.partition("=")
        if not equals or not name.strip():
            raise InputError(
                f"--topic {given}: it must be QUANTITY=NAME, as in --topic position=/vrpn_mocap/drone/pose"
            )
        pairs.append((quantity.strip(), name.strip()))
    lines = [] if namespace is None else [f"vehicle_namespace = {json.dumps(namespace)}"]
    return lines + [
        f"topics.{quantity} = {json.dumps(name)}" for quantity, name in _checked("--topic", pairs)
    ]


def refuse_topics(sources: Sources, path: Path) -> None:
    """Raise `InputError` where topics are chosen of a file that has none."""
    if sources != Sources():
        raise InputError(
            f"{path}: --topic and --vehicle-namespace choose topics of ROS 2 recordings and PX4 ULogs, and this file "
            "has none; name columns in a mapping (--mapping)"
        )


def _checked(where: str, pairs: Iterable[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    seen: dict[str, str] = {}
    for asked, name in pairs:
        quantity = "quaternion" if asked == "attitude" else asked
        if quantity not in FROM:
            close = difflib.get_close_matches(quantity, FROM, 1)
            hint = f"did you mean '{close[0]}'?" if close else f"it must be one of {', '.join(FROM)}"
            raise InputError(f"{where}: unknown quantity '{asked}'; {hint}")
        if seen.setdefault(quantity, name) != name:
            raise InputError(f"{where}: {asked} is to come from {seen[quantity]} and from {name}; choose one")
        yield quantity, name
