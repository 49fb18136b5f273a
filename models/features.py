"""The features (28) of a flight: what a correction sees on the vehicle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from trueflight.models.contract import FEATURES, YAW_FEATURES
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.frames import euler_from_quaternion, heading_from_world
from trueflight.models.model import Model


def feature_names(model: Model) -> tuple[str, ...]:
    """Names of the features of a model; yaw only where an effect needs it."""
    yaw = YAW_FEATURES if any(effect.needs_yaw for effect, _ in model.effect_chain()) else {}
    return (*FEATURES, *yaw)


def features_of_flight(flight: Flight, rows: np.ndarray | slice = slice(None)) -> dict[str, np.ndarray]:
    """Every feature (N,) of the flight's `rows`, units as in `models.contract`. Voltage is nominal where none was
    recorded.

    Raises `InputError` where position, velocity, attitude or command is missing.
    """
    euler = euler_from_quaternion(flight.column("quaternion")[rows])
    velocity = heading_from_world(flight.column("velocity")[rows], euler[:, 2])
    vehicle = flight.vehicle
    voltage = flight.battery_voltage
    return {
        "z": flight.column("position")[rows, 2],
        "cos_phi": np.cos(euler[:, 0]),
        "sin_phi": np.sin(euler[:, 0]),
        "cos_theta": np.cos(euler[:, 1]),
        "sin_theta": np.sin(euler[:, 1]),
        "vx": velocity[:, 0],
        "vy": velocity[:, 1],
        "vz": velocity[:, 2],
        "u_batt": np.full(len(euler), vehicle.nominal_voltage) if voltage is None else voltage[rows],
        "T": vehicle.thrust(flight.column("thrust_command")[rows]),
        "cos_psi": np.cos(euler[:, 2]),
        "sin_psi": np.sin(euler[:, 2]),
    }


def feature_matrix(columns: Mapping[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    """The features `columns`, each (N,), as float32 (N, F) in the order of `names`."""
    unknown = [n for n in names if n not in columns]
    if unknown:
        raise InputError(f"unknown features {', '.join(unknown)}; known: {', '.join(columns)}")
    return np.stack([columns[n] for n in names], axis=1).astype(np.float32)
