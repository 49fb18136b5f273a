"""A short flight in which a payload is dropped."""

from __future__ import annotations

from pathlib import Path

from trueflight.models.design import load_design
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.in_process import record
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.truth.hidden import Hidden

QUAD5 = Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml"
DROPPED = 12.0
"""s after take-off."""


def dropped_payload(path: Path, rate: float = 50.0) -> Path:
    """A record of 20 s that carries 12 % more than is believed, until that is dropped."""
    believed = load_vehicle(QUAD5)
    design = load_design(QUAD5.with_name("design.json"), believed)
    loads = tuple(
        Hidden("payload", {"mass_fraction": share, "time": t}) for share, t in ((0.12, 0.0), (0.0, DROPPED))
    )
    flown = trajectory("circle", laps=4.0)
    plan = Plan(believed, design, flown, loads, seed=5, rate=rate, rotor_speeds=False)
    assert record(plan, path).outcome == "finished"
    return path
