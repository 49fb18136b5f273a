"""PX4's flight modes as MAVLink carries them: `custom_mode` with a main and a sub mode."""

from __future__ import annotations

from enum import Enum


class Mode(Enum):
    """A flight mode: (main mode, sub mode) of PX4's custom mode (px4_custom_mode.h)."""

    MANUAL = (1, 0)
    ALTCTL = (2, 0)
    POSCTL = (3, 0)
    ACRO = (5, 0)
    OFFBOARD = (6, 0)
    STABILIZED = (7, 0)
    READY = (4, 1)
    TAKEOFF = (4, 2)
    HOLD = (4, 3)
    MISSION = (4, 4)
    RTL = (4, 5)
    LAND = (4, 6)

    @property
    def custom_mode(self) -> int:
        """The number in HEARTBEAT.custom_mode."""
        main, sub = self.value
        return main << 16 | sub << 24

    @property
    def by_pilot(self) -> bool:
        """Whether the mode needs a pilot's sticks."""
        return self in (Mode.MANUAL, Mode.ALTCTL, Mode.POSCTL, Mode.ACRO, Mode.STABILIZED)

    @classmethod
    def of(cls, main: int, sub: int) -> Mode | None:
        """The mode of a main and a sub mode; the sub mode counts in AUTO only. None where there is no such
        mode.
        """
        for mode in cls:
            if mode.value[0] == main and (main != 4 or mode.value[1] == sub):
                return mode
        return None
