"""The last of everything that the autopilot tells beside its odometry."""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import dataclass, field

from trueflight.companion.batteries import Batteries
from trueflight.companion.estimator import EstimatorStatus
from trueflight.companion.odometry import ImuSample, Vector, imu_from_wire

_RECENT = 2.0  # s
_MODES = {
    (1, 0): "MANUAL",
    (2, 0): "ALTCTL",
    (3, 0): "POSCTL",
    (4, 1): "READY",
    (4, 2): "TAKEOFF",
    (4, 3): "HOLD",
    (4, 4): "MISSION",
    (4, 5): "RETURN_TO_LAUNCH",
    (4, 6): "LAND",
    (4, 8): "FOLLOW_ME",
    (5, 0): "ACRO",
    (6, 0): "OFFBOARD",
    (7, 0): "STABILIZED",
    (8, 0): "RATTITUDE",
    (10, 0): "TERMINATION",
}


@dataclass
class Latest:
    """The last of everything that arrives beside the odometry; written by MAVSDK's thread, read by any.

    `battery_voltage` V (0 unknown) is that of the flight's battery, `batteries` has all of them.
    `rotor_speed` rad/s (empty unknown). `imu` is HIGHRES_IMU as it came, not yet read: it arrives just before the
    odometry, and what it takes to read it would delay the setpoint. `mode_time_us` is when mode and arming were told
    last, by the vehicle's clock: the stamp of the odometry that came before it, however late either was read.
    `killed` while the motors are cut (kill switch, termination), `failsafe` where the mode is one that the
    autopilot's failsafe chose, `unhealthy` what SYS_STATUS says is not well, `notices` what it told of failsafes,
    switches and failed checks (monotonic s, text). `estimator` is what the estimator says of itself, None before it
    said anything. PX4 sends odometry whether or not that is a position.
    """

    battery_voltage: float = 0.0
    batteries: Batteries = field(default_factory=Batteries)
    rotor_speed: tuple[float, ...] = ()
    flight_mode: str = "UNKNOWN"
    mode_time_us: int | None = None
    armed: bool = False
    landed: str = "unknown"
    heartbeat: float = -math.inf
    texts: deque[str] = field(default_factory=lambda: deque(maxlen=20))
    imu: str = ""
    killed: bool = False
    failsafe: bool = False
    unhealthy: tuple[str, ...] = ()
    estimator: EstimatorStatus | None = None
    notices: deque[tuple[float, str]] = field(default_factory=lambda: deque(maxlen=4))
    _read: tuple[str, ImuSample | None] = ("", None)

    @property
    def why(self) -> str:
        """What the autopilot told in the last seconds, in plain words; '' where nothing."""
        now = time.monotonic()
        return "; ".join(text for told, text in tuple(self.notices) if now - told < _RECENT)

    @property
    def imu_sample(self) -> ImuSample | None:
        """What HIGHRES_IMU said last; None before the first message and for one with a number missing. Read once."""
        text, sample = self._read
        if text is not self.imu:
            text = self.imu
            sample = imu_from_wire(text)
            self._read = text, sample
        return sample

    @property
    def specific_force(self) -> Vector | None:
        """Specific force of the accelerometer, m/s² FLU; None where `imu_sample` is None."""
        sample = self.imu_sample
        return sample.specific_force if sample is not None else None


def mode_name(custom_mode: int) -> str:
    """PX4's flight mode of a heartbeat, as MAVSDK names it."""
    main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    return _MODES.get((main, sub), _MODES.get((main, 0), "UNKNOWN"))
