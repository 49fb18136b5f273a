"""Flights of the simulator, in-process and read back as any other flight."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from trueflight.groundstation.reading import read_flight
from trueflight.models.design import load_design
from trueflight.models.flight import Flight
from trueflight.models.reference import trajectory
from trueflight.models.trajectory import Trajectory
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.in_process import record
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.truth.hidden import Hidden, choose
from trueflight.sim_bridge.truth.sensors import Noise

VEHICLE = Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml"


def fly(path: Path, hidden: tuple[str, ...], seed: int, flown: Trajectory) -> None:
    """Fly into the record `path`, with the sensors' noise."""
    fly_with(path, choose(list(hidden), load_vehicle(VEHICLE), seed), seed, flown)


def fly_with(path: Path, hidden: tuple[Hidden, ...], seed: int, flown: Trajectory) -> None:
    """Fly into the record `path` with effects of given numbers."""
    vehicle = load_vehicle(VEHICLE)
    design = load_design(VEHICLE.with_name("design.json"), vehicle)
    record(Plan(vehicle, design, flown, hidden, seed, noise=Noise()), path)


@cache
def simulated(seed: int, *hidden: str, kind: str = "excitation") -> Flight:
    """A flight of a named trajectory."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{kind}-{seed}.mcap"
        fly(path, hidden or ("none",), seed, trajectory(kind))
        return read_flight(path)
