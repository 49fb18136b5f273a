"""How often the autopilot's messages come, and what to set in PX4 where that is too rarely."""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import dataclass
from itertools import pairwise

_COUNTED = ("HIGHRES_IMU", "BATTERY_STATUS", "ESC_STATUS", "MODE")
_ONBOARD_RATE = (
    80_000  # bytes/s: odometry and accelerometer for 100 Hz of control beside an onboard link's other streams
)


@dataclass(frozen=True)
class Rates:
    """What arrives: messages a second of the vehicle's clock (odometry), and of ours (the others).

    `mode` counts both messages that tell the flight mode. `longest_gap` in s of the vehicle's clock between two
    odometry messages, `duration` of the measurement in s.
    """

    odometry: float
    imu: float
    battery: float
    esc: float
    longest_gap: float
    duration: float
    mode: float = math.inf

    def describe(self) -> dict[str, float]:
        """For the status."""
        return {"odometry": round(self.odometry, 1), "imu": round(self.imu, 1)}


class MessageCounter:
    """Counts what arrives, on MAVSDK's thread; any thread may measure, one at a time."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(_COUNTED, 0)
        self._times: deque[int] = deque(maxlen=4096)

    def count(self, name: str) -> None:
        """One more; raises `KeyError` for a message that is not counted."""
        self._counts[name] += 1

    def odometry(self, time_us: int) -> None:
        """One more odometry message, with its time by the vehicle's clock."""
        self._times.append(time_us)

    def measure(self, duration: float) -> Rates:
        """Count for `duration` s."""
        before = dict(self._counts)
        self._times.clear()
        begin = time.monotonic()
        time.sleep(duration)
        elapsed = time.monotonic() - begin
        times = list(self._times)
        count = {name: (self._counts[name] - before[name]) / elapsed for name in before}
        gaps = [1e-6 * (b - a) for a, b in pairwise(times)]
        span = 1e-6 * (times[-1] - times[0]) if len(times) > 1 else 0.0
        return Rates(
            odometry=(len(times) - 1) / span if span > 0.0 else 0.0,
            imu=count["HIGHRES_IMU"],
            battery=count["BATTERY_STATUS"],
            esc=count["ESC_STATUS"],
            longest_gap=max(gaps, default=math.inf),
            duration=elapsed,
            mode=count["MODE"],
        )


def odometry_too_low(rates: Rates, wanted: float, share: float = 0.75) -> str:
    """'' where odometry arrives at `share` of what is `wanted` (Hz) at least, otherwise what to set."""
    if rates.odometry >= share * wanted:
        return ""
    told = f"odometry arrives at {rates.odometry:.0f} Hz, {wanted:.0f} Hz were asked for"
    if rates.odometry == 0.0:
        return f"{told}: set the link's MAV_x_MODE to 2 (Onboard) in PX4; its estimator may still be starting"
    period = int(1e6 / wanted) // 1000 * 1000 or 1000
    estimator = f"EKF2_PREDICT_US to {period} and restart it, or " if wanted > 100.0 else ""
    return (
        f"{told}: lower --rate, or set in PX4 {estimator}the link's MAV_x_RATE to {_ONBOARD_RATE} "
        "and its baud rate (SER_x_BAUD) to 921600"
    )


def link_too_slow(message: str) -> str:
    """What to set where a message is too rare because the link is too slow."""
    return f"{message} is too rare: set the link's MAV_x_RATE to {_ONBOARD_RATE} and SER_x_BAUD to 921600"
