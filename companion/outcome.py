"""The phases of a flight, and what one tick of it decided; how one phase follows another tells `companion.phases`."""

from __future__ import annotations

from dataclasses import dataclass

from trueflight.companion.law.adaptation import Told
from trueflight.companion.law.control import ControlStep
from trueflight.models.trajectory import ReferenceSample

Vector = tuple[float, float, float]

IDLE, TAKEOFF, MISSION, LANDING, SILENT = "idle", "takeoff", "mission", "landing", "silent"


@dataclass(slots=True)
class Outcome:
    """What one tick decided: `step` and `reference` are None where nothing is sent.

    `model` is the live one's hash, whether it acts or not; `shadow` that of the model in the shadow, and
    `shadow_raw` what it returned (m/s², heading frame). `age` in s: from the moment of the odometry, by the vehicle's
    clock, to the answer. `learning` is what the live model learns in this flight, as it is now.
    """

    phase: str
    interval: float
    position: Vector
    step: ControlStep | None = None
    reference: ReferenceSample | None = None
    guard: str = "off"
    inference: float = 0.0
    controller: str = ""
    model: str = ""
    trajectory: str = ""
    shadow: str = ""
    shadow_raw: Vector = (0.0, 0.0, 0.0)
    age: float = 0.0
    learning: Told | None = None
