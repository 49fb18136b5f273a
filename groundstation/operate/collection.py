"""One flight of a training database, flown by a companion and fetched."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from trueflight.groundstation.operate.link import Link
from trueflight.models.database import Sortie


def fly_sortie(
    link: Link, sortie: Sortie, controller: str, patience: float, record: Path, tell: Callable[[str], None]
) -> tuple[dict[str, Any], str]:
    """Fly one and fetch its record; its entry and '', or nothing and the reason why it was not flown to its end."""
    voltage = link.status()["battery_voltage"]
    request = {"trajectory": sortie.trajectory, "parameters": sortie.parameters, "controller": controller}
    answer, reason = _requested(link, request, patience, tell)
    if reason:
        return {}, reason

    def tell_status(status: dict[str, Any], entry: dict[str, Any]) -> None:
        tell(f"{status['phase']}, {status['battery_voltage']:.1f} V")

    ended = link.end_of(answer["mission"], tell_status, idle=True)
    if ended["state"] != "finished":
        return {}, f"{sortie.trajectory} was {ended['state']}: {ended['reason']}"
    if not ended["record"]:
        return {}, f"{sortie.trajectory} was flown without a record; look at the companion's disk"
    tell("fetching the record")
    link.fetch_record(ended["record"], record.parent).replace(record)
    entry = {
        "trajectory": sortie.trajectory,
        "parameters": sortie.parameters,
        "outcome": ended["state"],
        "seconds": sortie.path.duration,
        "voltage": voltage,
        "on_board": ended["record"],
    }
    return entry, ""


def _requested(
    link: Link, request: dict[str, Any], patience: float, tell: Callable[[str], None]
) -> tuple[dict[str, Any], str]:
    """The answer to a mission that was accepted, or the reason why it was refused for all of `patience` s.

    A battery that rests after a flight recovers a little, and rates are measured again on the ground.
    """
    end = time.monotonic() + patience
    while True:
        answer = link.ask("mission", request)
        if answer.get("accepted"):
            return answer, ""
        reason = str(answer.get("reason", "no reason given"))
        if time.monotonic() > end:
            return {}, f"the companion refused {request['trajectory']}: {reason}"
        tell(f"waiting: {reason}")
        time.sleep(1.0)
