"""How often the autopilot's messages come, and what to set in PX4 where that is too rarely."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
