"""A simulated vehicle, the companion that flies it and a man in the middle, for one fault after the other."""

from __future__ import annotations

import signal
import socket
from pathlib import Path
from types import TracebackType
from typing import Any

from mitm import ManInTheMiddle, nothing
from pymavlink.dialects.v20 import common as mav
from rig import Bridge, Companion, wait_for

LOSS_TIME = 0.5
"""s: COM_OF_LOSS_T of the vehicle, which then lands by itself."""
FOREVER = {"trajectory": "hover", "parameters": {"duration": 3600.0, "height": 1.2}}

Place = tuple[float, float, float, float]
"""Time (monotonic s), north, east, down in m, as the vehicle itself tells it."""


class Scene:
    """Real processes on loopback in real time. Use as a context; `folder` keeps records and models over restarts."""

    def __init__(self, folder: Path, before: str = "", settings: str = "") -> None:
        self.folder, self._before, self._settings = folder, before, settings
        self.middle = ManInTheMiddle()
        # how hard it comes down is promised: it lands as PX4 does of itself, not as quickly as tests of other things
        landing = ("MPC_LAND_SPEED=0.7", "COM_DISARM_LAND=2")
        parameters = (f"COM_OF_LOSS_T={LOSS_TIME}", "COM_OBL_RC_ACT=4", *landing)
        try:
            self.bridge = Bridge(self.middle.port, *(x for p in parameters for x in ("--param", p)))
        except BaseException:
            self.middle.close()
            raise
        self.mission = ""
        try:
            self.companion = self._started()
        except BaseException:
            self.bridge.end(signal.SIGKILL)
            self.middle.close()
            raise

    def __enter__(self) -> Scene:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End all of it."""
        self.companion.end(signal.SIGKILL)
        self.bridge.end(signal.SIGKILL)
        self.middle.close()

    def restart(self) -> None:
        """Another companion in place of one that is gone, with what that left on the disk."""
        self.companion.end(signal.SIGKILL)
        self.companion = self._started()

    def fly(self, mission: dict[str, Any] = FOREVER) -> None:
        """Begin a mission, and come back when the vehicle is in it."""
        self.mission = self.companion.fly(**mission)

        def begun() -> bool:
            if self.companion.ticks[-1].phase == "mission":
                return True
            missions = self.companion.ask("status")["missions"]
            this = next(m for m in missions if m["mission"] == self.mission)
            told = [f"{event.kind}: {event.text}" for event in list(self.companion.events)[-4:]]
            assert this["state"] in ("queued", "flying"), f"{this['state']}: {this['reason']} ({told})"
            return False

        wait_for(begun, "the mission")

    def land(self) -> dict[str, Any]:
        """Whatever flies comes down where it is, with no fault any more; the mission's last status."""
        self.middle.fault = nothing
        if self.companion.ticks[-1].phase != "idle":
            self.companion.ask("mission", {"command": "abort"})
        if self.middle.armed and self.middle.mode not in ("OFFBOARD", "LAND"):
            self.bridge.pilot("LAND")
        self.down()
        wait_for(lambda: "missions" in self.companion.ask("status"), "an answer to a status")
        return self.companion.done(self.mission)

    def down(self) -> None:
        """Wait until the vehicle has landed and is disarmed."""
        wait_for(lambda: not self.middle.armed, "landed and disarmed")

    def command_mode(self, main: int, sub: int) -> None:
        """A ground station chooses a mode of PX4's, on the vehicle's own port."""
        ground = mav.MAVLink(None, srcSystem=255, srcComponent=190)
        order = ground.command_long_encode(1, 1, mav.MAV_CMD_DO_SET_MODE, 0, 1, main, sub, 0, 0, 0, 0)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.sendto(order.pack(ground), ("127.0.0.1", self.bridge.port))

    def places(self, begin: float, end: float = float("inf")) -> list[Place]:
        """Where the vehicle truly was between two times."""
        return [row for row in list(self.middle.seen) if begin <= row[0] <= end]

    def unanswered(self, begin: float, end: float) -> tuple[int, float]:
        """How many odometry messages had no setpoint, and the longest time without one (s)."""
        sent = [t for t in list(self.middle.setpoints) if begin <= t <= end]
        gaps = [b - a for a, b in zip([begin, *sent], [*sent, end], strict=True)]
        return max(len(self.places(begin, end)) - len(sent), 0), max(gaps)

    def _started(self) -> Companion:
        return Companion(
            self.folder, self.middle.companion_port, before=self._before, settings=self._settings
        )
