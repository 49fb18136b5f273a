"""Who else speaks on the autopilot's link: counted and told once each, and nothing they say is used."""

from __future__ import annotations

from collections.abc import Callable

_MOST = 32
"""Senders that are told apart; a router that goes wild, or somebody who means harm, may make up 65 000."""
_KINDS = (
    (1, 1, "autopilot"),
    (100, 105, "camera"),
    (140, 153, "servo"),
    (154, 154, "gimbal"),
    (156, 156, "transponder"),
    (158, 158, "peripheral"),
    (171, 175, "gimbal"),
    (180, 181, "battery"),
    (190, 190, "ground station"),
    (191, 194, "companion computer"),
    (195, 195, "path planner"),
    (196, 196, "obstacle avoidance"),
    (197, 197, "visual odometry"),
    (220, 221, "GPS"),
    (236, 238, "Open Drone ID"),
    (240, 243, "bridge"),
)


class Others:
    """Counts by MAVLink system and component; belongs to MAVSDK's thread, any thread may read."""

    def __init__(self) -> None:
        self._tell: Callable[[str], None] = lambda text: None
        self._counts: dict[tuple[int, int], int] = {}

    def tell(self, tell: Callable[[str], None]) -> None:
        """Call `tell` with each sender in words: now those that were heard already, later the new ones."""
        self._tell = tell
        for sender in tuple(self._counts):
            tell(_words(sender))

    def count(self, system: int, component: int) -> None:
        """One more message."""
        sender = (system, component)
        if sender not in self._counts and len(self._counts) >= _MOST:
            sender = (0, 0)  # no system has the number 0
        before = self._counts.get(sender, 0)
        self._counts[sender] = before + 1
        if not before:
            self._tell(_words(sender))

    def describe(self) -> dict[str, int]:
        """Messages by sender, in words; for the status."""
        return {sender_name(*sender): count for sender, count in sorted(self._counts.copy().items())}


def _words(sender: tuple[int, int]) -> str:
    return f"{sender_name(*sender)} is heard on this link as well; nothing that it says is used"


def sender_name(system: int, component: int) -> str:
    """Such as 'system 1, component 197 (visual odometry)'."""
    if not system:
        return "many others"
    kind = next((name for low, high, name in _KINDS if low <= component <= high), "")
    return f"system {system}, component {component}" + (f" ({kind})" if kind else "")
