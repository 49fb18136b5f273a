"""What the autopilot's estimator says of itself (ESTIMATOR_STATUS), and whether that is a position to fly by.

PX4 sends odometry whether or not its estimator has a position, so this message alone tells. Two of its flags say
the same in every release from 1.14 to 1.18: the horizontal position is valid, relative or absolute. Two other
fields look as if they told something, and mislead:

* constant position (128): up to 1.15 "no horizontal velocity", since 1.16 also "the vehicle stands still", which
  a vehicle with the best GPS does before every flight. Where there is no position neither of the two is set, in
  old and new releases alike, so nothing is lost by leaving this flag alone.
* the accuracy: a vehicle without any position that stands still is held by a made-up one, and tells 0.3 m (1.14) or
  0.01 to 0.02 m (since 1.16). It counts only where a position is valid.

When GPS is lost the two fall after EKF2_NOAID_TOUT (5 s) since 1.16, after 7 s before; until then the accuracy
grows. The flags of predicted positions fall no earlier.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_POSITION = 8 | 16  # ESTIMATOR_POS_HORIZ_REL or _ABS
_FLAGS = (
    (1, "attitude"),
    (2, "horizontal velocity"),
    (4, "vertical velocity"),
    (8, "relative position"),
    (16, "absolute position"),
    (32, "height"),
    (64, "height above ground"),
    (128, "constant position (at rest, or held without a sensor)"),
    (256, "predicted relative position"),
    (512, "predicted absolute position"),
    (1024, "GPS glitch"),
    (2048, "accelerometer error"),
)


@dataclass(frozen=True)
class EstimatorStatus:
    """One ESTIMATOR_STATUS: its `flags`, and the horizontal `accuracy` in m (infinite where none was told)."""

    flags: int
    accuracy: float

    @property
    def has_position(self) -> bool:
        """Whether the estimator calls its horizontal position valid."""
        return bool(self.flags & _POSITION)

    @property
    def position_accuracy(self) -> float:
        """Accuracy of the horizontal position, m; infinite where there is none, whatever the message says."""
        return self.accuracy if self.has_position else math.inf

    @property
    def words(self) -> str:
        """What was received, flags in words and accuracy: for every line that refuses something by it."""
        known = sum(bit for bit, _ in _FLAGS)
        flags = [word for bit, word in _FLAGS if self.flags & bit]
        if self.flags & ~known:
            flags.append(f"unknown flags {self.flags & ~known:#x}")
        accuracy = f"{self.accuracy:.2f} m" if math.isfinite(self.accuracy) else "no accuracy"
        return f"{', '.join(flags) or 'no flag'}; {accuracy}"

    def describe(self) -> dict[str, Any]:
        """For the status: whether there is a position, how good it is (m, None where not told), and `words`."""
        accuracy = self.position_accuracy
        known = round(accuracy, 3) if math.isfinite(accuracy) else None
        return {"valid": self.has_position, "accuracy": known, "received": self.words}

    def refusal(self, most: float) -> str:
        """'' where the position is valid and known to `most` m or better, otherwise why not: received, wanted."""
        if self.position_accuracy <= most:
            return ""
        told = (
            f"knows the position to {self.accuracy:.1f} m only"
            if self.has_position and math.isfinite(self.accuracy)
            else "does not tell how well it knows the position"
            if self.has_position
            else "has no position"
        )
        return (
            f"the autopilot's estimator {told} (received: {self.words}; wanted: relative or absolute position, "
            f"known to {most:g} m); wait for GPS, or give it mocap (EKF2_EV_CTRL)"
        )


def estimator_status(fields: Mapping[str, Any]) -> EstimatorStatus:
    """An ESTIMATOR_STATUS as on the wire; a missing or infinite accuracy, as MAVSDK's JSON has it, is None.

    Raises `KeyError`, `TypeError` or `ValueError` for fields that are none of that message.
    """
    accuracy = fields["pos_horiz_accuracy"]
    known = accuracy is not None and math.isfinite(accuracy) and accuracy >= 0.0
    return EstimatorStatus(int(fields["flags"]), float(accuracy) if known else math.inf)
