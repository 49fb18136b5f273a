"""A mission as the ground asks for it: what may stand in the message, and how it becomes a trajectory.

A short message is read here and now. A long one (a table of setpoints) would hold the interpreter, and with it
the control thread, while it is parsed; a child reads it (`companion.child`), and what comes back are plain
arrays.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from trueflight.companion.child import ask_child, begin_child
from trueflight.companion.confined import confine, leave_network
from trueflight.models.errors import InputError, shown
from trueflight.models.reference import KINDS, Trajectory, check_duration, trajectory, trajectory_from_csv
from trueflight.models.trajectory import SetpointTable

SMALL = 8 << 10
"""Bytes of a message that are parsed in less than a tenth of a control tick."""
CHILD = (sys.executable, "-m", "trueflight.companion.mission_request")
PATIENCE, PROCESSOR_TIME, MEMORY = 20.0, 10, 192 << 20
_KEYS = ("trajectory", "parameters", "setpoints", "controller", "repeat")


@dataclass(frozen=True)
class MissionRequest:
    """What was asked for: a trajectory (home frame), flown so often with this controller."""

    path: Trajectory
    controller: str
    repeat: int


def read_json(payload: bytes) -> dict[str, Any]:
    """The JSON object of a request; `{}` for none. Raises `InputError` for anything else."""
    try:
        value = json.loads(payload.decode()) if payload else {}
    except RecursionError:
        raise InputError("the request is nested too deeply") from None
    except ValueError as error:
        raise InputError(f"the request is no JSON ({str(error)[:80]})") from None
    if not isinstance(value, dict):
        raise InputError("the request must be a JSON object")
    return value


def read_request(payload: bytes) -> dict[str, Any]:
    """The object of a mission's message, its table of setpoints already a `Trajectory`.

    Blocks for a child where the message is long. Raises `InputError` with the reason for what cannot be used.
    """
    if len(payload) > SMALL:
        return _read_in_child(payload)
    request = read_json(payload)
    if "setpoints" in request:
        request["setpoints"] = _table(request["setpoints"])
    return request


def mission_request(request: dict[str, Any]) -> MissionRequest:
    """The mission of a message; `setpoints` may be a table's text or what `read_request` made of it.

    Raises `InputError` for a key or value that does not fit.
    """
    for key in request:
        if key not in _KEYS:
            raise InputError(f"unknown key {shown(key)} in the mission; known: {', '.join(_KEYS)}")
    path = _trajectory(request)
    repeat = request.get("repeat", 1)
    if type(repeat) is not int or not 1 <= repeat <= 100:
        raise InputError(f"repeat must be a whole number from 1 to 100, not {shown(repeat)}")
    check_duration(path.duration * repeat, f"trajectory '{path.name}', {repeat} times,")
    controller = request.get("controller", "lqr")
    if not isinstance(controller, str) or len(controller) > 40:
        raise InputError(f"'controller' must be a name, not {shown(controller)}")
    return MissionRequest(path, controller, repeat)


def _trajectory(request: dict[str, Any]) -> Trajectory:
    if "setpoints" in request:
        if "trajectory" in request:
            raise InputError("give either a trajectory or setpoints, not both")
        return _table(request["setpoints"])
    name, parameters = request.get("trajectory"), request.get("parameters", {})
    if not isinstance(name, str):
        raise InputError(f"'trajectory' must be one of {', '.join(KINDS)}")
    if not isinstance(parameters, dict):
        raise InputError("'parameters' must be an object of names and values")
    return trajectory(name, **parameters)


def _table(setpoints: object) -> Trajectory:
    if isinstance(setpoints, Trajectory):
        return setpoints
    if not isinstance(setpoints, str):
        raise InputError(f"'setpoints' must be the text of a table, not {shown(setpoints)}")
    return trajectory_from_csv(setpoints)


def _read_in_child(payload: bytes) -> dict[str, Any]:
    out, end = ask_child(CHILD, payload, PATIENCE, PROCESSOR_TIME)
    line, _, numbers = out.partition(b"\n")
    try:
        answer = json.loads(line) if len(line) <= SMALL else {}
    except ValueError:
        answer = {}
    if "reason" in answer:
        raise InputError(str(answer["reason"]))
    if "request" not in answer:
        raise InputError(f"the mission could not be read: {end}")
    request: dict[str, Any] = answer["request"]
    if "rows" in answer:
        table = np.frombuffer(numbers).reshape(-1, 25)
        low, high, speed, acceleration = answer["extent"]
        request["setpoints"] = Trajectory(
            "setpoints",
            SetpointTable(table[:, 0], table[:, 1:].reshape(-1, 4, 6)),
            {"rows": float(answer["rows"])},
            (tuple(low), tuple(high), speed, acceleration),
        )
    return request


def _main() -> None:
    """The child: a message on standard input; a line of JSON, then 25 numbers a segment, on standard output."""
    leave_network()
    descriptor, payload = begin_child()
    _ = trajectory_from_csv("t,x,y,z\n0,0,0,1\n1,0,0,1").extent  # loads what is loaded on first use
    confine(MEMORY, PROCESSOR_TIME)
    numbers = b""
    try:
        request = read_json(payload)
        answer: dict[str, Any] = {"request": request}
        if "setpoints" in request:
            path = _table(request.pop("setpoints"))
            answer |= {"rows": path.parameters["rows"], "extent": path.extent}
            durations = np.array([segment.duration for segment in path.segments])
            coefficients = np.array([segment.coefficients for segment in path.segments])  # type: ignore[union-attr]
            numbers = np.column_stack([durations, coefficients.reshape(-1, 24)]).tobytes()
        line = json.dumps(answer)
        if len(line) > SMALL:
            answer = {"reason": f"the mission holds {len(payload)} bytes beside its setpoints; keep it short"}
    except InputError as error:
        answer = {"reason": str(error)[:1000]}
    except MemoryError:
        answer = {"reason": "it needs too much memory"}
    except Exception as error:  # noqa: BLE001 - what no check foresaw is refused as well
        answer = {"reason": f"the mission could not be read ({type(error).__name__})"}
    if "reason" in answer:
        numbers = b""
    with os.fdopen(descriptor, "wb") as out:
        out.write(json.dumps(answer).encode() + b"\n" + numbers)


if __name__ == "__main__":
    _main()
