"""A mission as it is asked for: checked on the ground first, so that a typing error needs no vehicle."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trueflight.models.contract import too_large
from trueflight.models.controllers import check_controller
from trueflight.models.errors import InputError
from trueflight.models.reference import check_duration, trajectory_from_csv
from trueflight.models.reference import trajectory as named


def mission_of(
    trajectory: str, controller: str, assignments: Sequence[str] = (), repeat: int = 1
) -> dict[str, Any]:
    """The request for a mission: a trajectory by name with `assignments` NAME=VALUE, or a CSV of setpoints.

    Raises `InputError` for whatever a companion would refuse of it, as far as that can be known here.
    """
    check_controller(controller, "--controller")
    flown = _flown(trajectory, assignments, repeat)
    mission = {**flown, "controller": controller, "repeat": repeat}
    if reason := too_large("mission", len(json.dumps(mission))):
        raise InputError(f"{trajectory}: {reason}; split the file")
    return mission


def _flown(trajectory: str, parameters: Sequence[str], repeat: int) -> dict[str, Any]:
    """What is to be flown, checked."""
    if trajectory.lower().endswith(".csv"):
        try:
            reason = too_large("mission", Path(trajectory).stat().st_size)
            if reason:
                raise InputError(f"{trajectory}: {reason}; split the file")
            text = Path(trajectory).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{trajectory}: cannot read the setpoints ({error}); check the path") from None
        if parameters:
            raise InputError(f"{trajectory}: a table of setpoints has no parameters; leave --set out")
        path = trajectory_from_csv(text, trajectory)
        check_duration(path.duration * repeat, f"{trajectory}, {repeat} times,")
        return {"setpoints": text}
    values: dict[str, float | str] = {}
    for pair in parameters:
        key, equals, value = pair.partition("=")
        if not equals:
            raise InputError(f"--set '{pair}': write NAME=VALUE, such as speed=2")
        try:
            values[key.strip()] = float(value)
        except ValueError:
            values[key.strip()] = value.strip()
    path = named(trajectory, **values)
    check_duration(path.duration * repeat, f"trajectory '{trajectory}', {repeat} times,")
    return {"trajectory": trajectory, "parameters": values}
