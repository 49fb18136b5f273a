"""A pose from outside, of motion capture or vision, as it travels to the companion over Zenoh.

Key `trueflight/<vehicle>/pose` (`models.contract.key`), payload JSON in one object:

    {"time_ns": 1763802000123456789, "position": [x, y, z], "quaternion": [w, x, y, z],
     "position_std": 0.002, "attitude_std": 0.01}

`time_ns` is when the picture was taken, nanoseconds since 1970 by the sender's clock. `position` is in m, world ENU:
x and y level, z up; without a compass any level x will do for east. `quaternion` turns body FLU to that world. The
two standard deviations (m, rad) may be left out, and so may `time_ns`, where the sender knows it no better than by
its arrival.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

from trueflight.models.errors import shown

_FARTHEST = 1e5
"""m: farther than motion capture and vision see, and small enough for what the autopilot is sent."""
_UNIT = 0.02
"""How far from one the quaternion's square may be: rounding, but not another convention."""


@dataclass(frozen=True)
class Pose:
    """Where the vehicle is: world ENU in m, body FLU to world, quaternion wxyz.

    `time_ns` since 1970 by the sender's clock, 0 unknown; standard deviations in m and rad, NaN unknown.
    """

    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    time_ns: int = 0
    position_std: float = math.nan
    attitude_std: float = math.nan


def pose_to_json(pose: Pose) -> bytes:
    """The payload that carries a pose."""
    out: dict[str, Any] = {"position": list(pose.position), "quaternion": list(pose.quaternion)}
    if pose.time_ns:
        out["time_ns"] = pose.time_ns
    for name in ("position_std", "attitude_std"):
        if math.isfinite(getattr(pose, name)):
            out[name] = getattr(pose, name)
    return json.dumps(out).encode()


def pose_from_json(payload: bytes) -> Pose:
    """The pose of a payload; the quaternion comes back with length one.

    Raises `ValueError` with the reason for a payload of another form and for numbers that are no pose.
    """
    try:
        table = json.loads(payload)
        position, quaternion = table["position"], table["quaternion"]
    except (ValueError, TypeError, KeyError, RecursionError):
        raise ValueError("it is no JSON object with 'position' and 'quaternion'") from None
    numbers = _numbers("position", position, 3) + _numbers("quaternion", quaternion, 4)
    size = sum(x * x for x in numbers[3:])
    if not abs(size - 1.0) < _UNIT:
        raise ValueError(f"its quaternion has length {math.sqrt(size):.3g}, not 1")
    time_ns = table.get("time_ns", 0)
    if type(time_ns) is not int or not 0 <= time_ns < 1 << 63:
        raise ValueError("its 'time_ns' is no whole number of nanoseconds since 1970")
    spread = [
        _numbers(name, [table.get(name, math.nan)], 1, True)[0] for name in ("position_std", "attitude_std")
    ]
    x, y, z, *turned = numbers
    w, i, j, k = (q / math.sqrt(size) for q in turned)
    return Pose((x, y, z), (w, i, j, k), time_ns, *spread)


def _numbers(name: str, values: Any, count: int, may_be_unknown: bool = False) -> list[float]:
    if not isinstance(values, list) or len(values) != count:
        raise ValueError(f"its '{name}' is no list of {count} numbers")
    numbers = []
    for value in values:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"its '{name}' holds {shown(value)}, which is no number")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if may_be_unknown and math.isnan(number):
            numbers.append(number)
        elif not abs(number) <= _FARTHEST:
            raise ValueError(
                f"its '{name}' holds {shown(value)}, which is not finite or beyond {_FARTHEST:g}"
            )
        elif may_be_unknown and number < 0.0:
            raise ValueError(f"its '{name}' is {shown(value)}; a deviation is not negative")
        else:
            numbers.append(number)
    return numbers
