"""The truth of a flight as a CSV with the project's column names, to lay beside PX4's own log."""

from __future__ import annotations

import csv
from pathlib import Path
from types import TracebackType

from trueflight.models.flight import COLUMNS
from trueflight.models.whole_file import whole_file
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.sitl.sensors import specific_force

_COLUMNS = (
    *("position", "velocity", "quaternion", "angular_velocity", "specific_force"),
    *("battery_voltage", "rotor_speed", "motor_command"),
)


class TruthTable:
    """Writes one row a call: time (s, PX4's clock), and the true state in ENU and FLU, z 0 where the vehicle stands."""

    def __init__(self, path: Path, simulator: Simulator) -> None:
        self._simulator = simulator
        self._whole = whole_file(path, "the truth", "choose --truth FILE")
        self._stream = self._whole.__enter__().open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._stream)
        self._writer.writerow(["t"] + [name for column in _COLUMNS for name in COLUMNS[column][0]])

    def __enter__(self) -> TruthTable:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()  # however the flight ended, the truth of what was flown stays
        self._whole.__exit__(None, None, None)

    def row(self, time_us: int) -> None:
        """Write the present state."""
        simulator = self._simulator
        _, position, velocity, acceleration, rotation, voltage, speeds = simulator.moment()
        x, y, z = position[:3]
        values = (
            time_us * 1e-6,
            *(x, y, z - simulator.world.standing_height, *velocity[:3], *position[3:], *velocity[3:]),
            *(*specific_force(acceleration, rotation), voltage, *speeds, *simulator.motors),
        )
        self._writer.writerow([f"{value:.7g}" for value in values])
