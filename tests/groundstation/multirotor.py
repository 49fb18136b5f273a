"""Flights of vehicles with any number of rotors, by plain vector algebra: each rotor's force and drag torque, one rigid
body, an attitude controller that knows nothing of what is wrong with the vehicle."""

from __future__ import annotations

import numpy as np

from trueflight.models.flight import Flight
from trueflight.models.vehicle import GRAVITY, Vehicle

RATE = 200
"""Hz of integration; every second step is logged."""
TORQUE_CONSTANT = 0.016
"""m, of a rotor's drag torque over its thrust."""


def vehicle(rotors: int, arm: float = 0.25) -> Vehicle:
    """Rotors evenly spaced on a circle, turning by turns to the left and to the right."""
    at = (np.arange(rotors) + 0.5) * 2.0 * np.pi / rotors
    return Vehicle(
        f"{rotors}-rotors", 1.5, 0.5, (0.02, 0.02, 0.035), 0.1,
        tuple((arm * float(np.cos(a)), arm * float(np.sin(a)), 0.0) for a in at),
        tuple(1 if i % 2 == 0 else -1 for i in range(rotors)),
    )  # fmt: skip


def flown(
    craft: Vehicle,
    seconds: float = 40.0,
    seed: int = 0,
    losses: dict[int, float] | None = None,
    centre: tuple[float, float] = (0.0, 0.0),
    payload: float = 0.0,
    swing: float = 0.3,
    lag: float = 0.0,
    inertia: tuple[float, float, float] | None = None,
    noise: float = 0.002,
) -> Flight:
    """A flight about one place that rolls, pitches and yaws by `swing` rad, with thrust up and down.

    `losses` are parts of their thrust that rotors lack, by number from 1; `centre` of mass in m and `payload` in kg are
    what the vehicle file does not know; motor commands act on the square of the speed through a first-order `lag`, s.
    """
    draw = np.random.default_rng(seed)
    place, turns = np.array(craft.rotor_positions), np.array(craft.rotor_directions, float)
    count, dt, n = len(place), 1.0 / RATE, int(seconds * RATE)
    mass, moment = craft.mass + payload, np.array(inertia or craft.inertia)
    strength = np.ones(count)
    for rotor, loss in (losses or {}).items():
        strength[rotor - 1] -= loss
    allocation = np.stack([np.ones(count), place[:, 1], -place[:, 0], -TORQUE_CONSTANT * turns])
    mixer = np.linalg.pinv(allocation)
    # torque of each rotor per N about the true centre of mass: r x F, and the drag of its turning
    torque_of = np.cross(place - [*centre, 0.0], [0.0, 0.0, 1.0]).T
    torque_of[2] -= TORQUE_CONSTANT * turns
    t = np.arange(n) * dt
    frequencies, phases = draw.uniform(0.1, 1.2, (4, 5)), draw.uniform(0.0, 6.28, (4, 5))
    wanted = np.sin(2.0 * np.pi * frequencies[:, :, None] * t + phases[:, :, None]).mean(axis=1).T
    believed = np.array(craft.inertia)
    rotation, rate, integral = np.eye(3), np.zeros(3), np.zeros(3)
    speed = np.full(count, np.sqrt(mass * GRAVITY / count))
    log: dict[str, list[np.ndarray]] = {k: [] for k in ("quaternion", "rate", "command", "speed", "force")}
    for k in range(n):
        tilt = np.array([rotation[2, 1], -rotation[2, 0], rotation[1, 0]])
        error = swing * wanted[k, :3] - tilt
        integral += error * dt
        torque = believed * (60.0 * error + 25.0 * integral - 14.0 * rate)
        collective = mass * GRAVITY * (1.0 + swing * wanted[k, 3])
        command = np.clip(mixer @ np.array([collective, *torque]), 1e-3, None)
        thrust = strength * speed**2
        acting = torque_of @ thrust
        if k % 2 == 0:
            log["quaternion"].append(_quaternion(rotation))
            log["rate"].append(rate.copy())
            log["command"].append(command)
            log["speed"].append(speed.copy())
            log["force"].append(np.array([0.0, 0.0, thrust.sum() / mass]))
        speed = speed + (np.sqrt(command) - speed) * (1.0 if lag == 0.0 else 1.0 - np.exp(-dt / lag))
        p, q, r = rate  # w x I w, written out
        euler = np.array(
            [
                q * r * (moment[2] - moment[1]),
                p * r * (moment[0] - moment[2]),
                p * q * (moment[1] - moment[0]),
            ]
        )
        rate = rate + dt * (acting - euler) / moment
        rotation = rotation @ _turn(rate * dt)
    columns = {name: np.array(rows) for name, rows in log.items()}
    m = len(columns["rate"])
    per_unit = craft.weight / craft.hover_thrust / count
    return Flight(
        name=f"made-{seed}",
        vehicle=craft,
        t=np.arange(m) * 2.0 * dt,
        velocity=np.zeros((m, 3)),
        quaternion=columns["quaternion"],
        angular_velocity=columns["rate"] + noise * draw.standard_normal((m, 3)),
        specific_force=columns["force"] + 0.02 * draw.standard_normal((m, 3)),
        thrust_command=columns["command"].sum(axis=1) / (count * per_unit),
        rotor_speed=400.0 * columns["speed"],
        motor_command=columns["command"] / per_unit,
    )


def _turn(vector: np.ndarray) -> np.ndarray:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion w, x, y, z of a rotation matrix that is less than 180 degrees."""
    w = 0.5 * np.sqrt(max(1e-12, 1.0 + np.trace(rotation)))
    r = rotation
    return np.array([w, *(np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / (4.0 * w))])
