"""The corrections that the benchmarks of the companion fly with, exported as `groundstation model export` does.

They are there to be timed: numbers of the size that fits give, a network of the size that the paper has (10-32-32-3)
with small random weights. Needs torch, so that it runs in a process of its own and leaves files:

    python benchmarks/correction_models.py FOLDER
"""

from __future__ import annotations

import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np

from trueflight.groundstation.reading.flight_file import read_flight
from trueflight.models.contract import FEATURES
from trueflight.models.design import load_design
from trueflight.models.export import export_onnx
from trueflight.models.flight import Flight
from trueflight.models.model import Model, Term
from trueflight.models.network import Network
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import Vehicle, load_vehicle
from trueflight.sim_bridge.in_process import record
from trueflight.sim_bridge.plan import Plan

VEHICLE = Path(__file__).parents[1] / "models" / "vehicles" / "quad5" / "vehicle.toml"
EFFECTS = (
    Term("rigid_body", {}),
    Term("thrust_gain", {"gain": 0.97}),
    Term("battery_sag", {"exponent": 1.2}),
    Term("rotor_drag", {"x": 0.2, "y": 0.25}),
    Term("ground_effect", {"rho": 1.2}),
    Term("parasitic_drag", {"x": 0.02, "y": 0.02, "z": 0.02}),
)
"""Five effects that most vehicles have, and exact rotation."""
KINDS = ("effects", "network", "both")


def _network(flight: Flight) -> Network:
    """Two hidden layers of 32, small weights, the training range of a wide flight."""
    names, draw = tuple(FEATURES), np.random.default_rng(0)
    low = np.array([0.0, 0.7, -0.7, 0.7, -0.7, -4.0, -4.0, -3.0, 13.0, 1.0], dtype=np.float32)
    high = np.array([6.0, 1.0, 0.7, 1.0, 0.7, 4.0, 4.0, 3.0, 17.0, 16.0], dtype=np.float32)
    sizes = (len(names), 32, 32, 3)
    layers = tuple(
        (
            (draw.normal(size=(b, a)) / a**0.5).astype(np.float32),
            (0.1 * draw.normal(size=b)).astype(np.float32),
        )
        for a, b in pairwise(sizes)
    )
    scale = np.full(3, 0.2, dtype=np.float32)
    return Network(
        names, 0.5 * (low + high), 0.5 * (high - low), layers, scale, low, high, flight.data_hash,
        margin=0.5 * (high - low),
    )  # fmt: skip


def correction_models(folder: Path) -> dict[str, bytes]:
    """The ONNX files of `KINDS`; `folder` takes the flight that they are exported with."""
    vehicle = load_vehicle(VEHICLE)
    flight = _flight(vehicle, folder)
    network = _network(flight)
    exact = EFFECTS[:1]
    return {
        "effects": export_onnx(Model(vehicle, EFFECTS, "effects", 1), flight),
        "network": export_onnx(Model(vehicle, exact, "network", 1, network=network), flight),
        "both": export_onnx(Model(vehicle, EFFECTS, "both", 1, network=network), flight),
    }


def _flight(vehicle: Vehicle, folder: Path) -> Flight:
    design = load_design(VEHICLE.with_name("design.json"), vehicle)
    path = folder / "flight.mcap"
    record(Plan(vehicle, design, trajectory("excitation"), seed=1), path)
    return read_flight(path, vehicle)


def main() -> None:
    target = Path(sys.argv[1])
    with tempfile.TemporaryDirectory() as folder:
        for name, onnx in correction_models(Path(folder)).items():
            (target / f"{name}.onnx").write_bytes(onnx)


if __name__ == "__main__":
    main()
