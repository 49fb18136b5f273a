"""What every controller takes and gives each tick."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from trueflight.companion.law.control import ZERO, Attitude, ControlLaw, ControlStep, State, Vector
from trueflight.models.trajectory import ReferenceSample

Preview = Callable[[float], ReferenceSample]
"""The reference so many seconds from now; it holds still after its end."""


class Controller(Protocol):
    """One controller during one flight; it belongs to the control thread."""

    def step(self, state: State, preview: Preview, dt: float) -> ControlStep:
        """One tick; `dt` s since the previous one."""
        ...

    def start(self) -> None:
        """The correction, or the mission's trajectory, begins with the next tick."""
        ...

    def stop(self) -> None:
        """The correction is over."""
        ...


def plain_step(law: ControlLaw, zeta: Vector, attitude: Attitude, yaw: float) -> ControlStep:
    """The step of a controller without correction: the design's attitude loop turns to an `attitude` and `yaw` (rad)
    from roll, pitch, yaw `zeta`."""
    command = law.command(zeta, attitude, yaw)
    return ControlStep(command, ZERO, ZERO, command, law.normalised(command.thrust))
