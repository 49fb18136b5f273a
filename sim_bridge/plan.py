"""The plan of a flight in-process, and how its parts come from names and files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from trueflight.companion.law.controllers import TrimLimits
from trueflight.companion.law.residual import ObserverLimits
from trueflight.models.contract import CORRECTED, LQR, WITH_MODEL
from trueflight.models.design import Design, load_design
from trueflight.models.errors import InputError
from trueflight.models.reference import trajectory, trajectory_from_csv
from trueflight.models.trajectory import Trajectory, transfer
from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.settings import Settings
from trueflight.sim_bridge.truth.battery import FULL, BatteryState
from trueflight.sim_bridge.truth.hidden import Hidden
from trueflight.sim_bridge.truth.sensors import Noise
from trueflight.sim_bridge.world import PHYSICS_STEP

_BETWEEN_SPEED, _BETWEEN_ACCELERATION = 1.5, 2.0  # m/s, m/s²: from the end back to the start


@dataclass(frozen=True)
class Plan:
    """One flight: who flies what, with what hidden. `rate` of the control law in Hz, `model` an ONNX file's
    bytes.

    `controller` is one of `models.contract.CONTROLLERS`; `corrected` needs a `model`, the others take none.
    Where it is empty the vehicle flies `corrected` with a model and `lqr` without. For `settle` s the vehicle holds
    the start before the trajectory begins, as the companion does: a correction has faded in by then. The record has
    `rotor_speeds` where the vehicle's speed controllers report them.
    """

    vehicle: Vehicle
    design: Design
    trajectory: Trajectory
    hidden: tuple[Hidden, ...] = ()
    seed: int = 0
    repeat: int = 1
    rate: float = 100.0
    model: bytes | None = None
    noise: Noise | None = None
    battery: BatteryState = FULL
    controller: str = ""
    settle: float = 0.0
    trim: TrimLimits = field(default_factory=TrimLimits)
    observer: ObserverLimits = field(default_factory=ObserverLimits)
    rotor_speeds: bool = True

    def __post_init__(self) -> None:
        if not self.controller:
            object.__setattr__(self, "controller", LQR if self.model is None else CORRECTED)
        if (self.model is None) != (self.controller not in WITH_MODEL):
            raise InputError(
                "--controller corrected and corrected_adaptive need --model, and no other controller takes one"
            )

    @property
    def steps_per_tick(self) -> int:
        """Physics steps between two control ticks. Raises `InputError` where the rates do not divide."""
        steps = 1.0 / (self.rate * PHYSICS_STEP)
        if not math.isclose(steps, round(steps), rel_tol=1e-9) or round(steps) < 1:
            physics = round(1 / PHYSICS_STEP)
            raise InputError(
                f"--rate {self.rate:g}: must divide the physics rate of {physics} Hz (50, 100, 250, 500)"
            )
        return round(steps)


def legs_of(plan: Plan) -> list[Trajectory]:
    """What a flight flies after it has settled: the trajectory as often as asked, with a transfer from its end to its
    start between."""
    trajectory = plan.trajectory
    back = None
    if math.dist(trajectory.end, trajectory.start) > 1e-6:
        back = transfer(trajectory.end, trajectory.start, _BETWEEN_SPEED, _BETWEEN_ACCELERATION)
    legs = []
    for turn in range(plan.repeat):
        if turn and back is not None:
            legs.append(back)
        legs.append(trajectory)
    return legs


def design_of(settings: Settings, vehicle: Vehicle) -> Design:
    """The design that the settings name, or the one beside the vehicle file. Raises `InputError`."""
    named = Path(settings.design) if settings.design else Path(settings.vehicle).with_name("design.json")
    return load_design(named, vehicle)


def trajectory_of(name: str, assignments: Sequence[str]) -> Trajectory:
    """A trajectory by its name, with parameters as `NAME=VALUE`, or of a CSV file of setpoints. Raises `InputError`."""
    if name.endswith(".csv"):
        return trajectory_from_csv(bytes_of(Path(name)).decode("utf-8", "replace"), name)
    parameters: dict[str, float | str] = {}
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        if not equals:
            raise InputError(f"--set {assignment}: write NAME=VALUE")
        parameters[key] = value
    return trajectory(name, **parameters)


def bytes_of(path: Path) -> bytes:
    """All of a file. Raises `InputError` where it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read it ({error.strerror})") from None
