"""The whole state of a vehicle predicted from what was sent to it: position, velocity, attitude and body rates.

From each moment of a flight on, motor commands (or rotor speeds, or collective and body rate commands) alone go in, and
nothing is corrected. The errors are those of IDSIA's nano-drone benchmark (Busetto, Cereda, Forgione, Maroni, Piga,
Palossi, "Nonlinear system identification for a nano-drone benchmark", Control Engineering Practice 172, 2026): after
each time, the mean over all starts of the length of the error of position, velocity and body rates, and of the angle
between predicted and true attitude.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from trueflight.groundstation.evaluate.compare import HORIZONS
from trueflight.groundstation.identify.fitting import with_clock
from trueflight.groundstation.identify.spin import Spin
from trueflight.groundstation.measured.measurement import measure, measure_rotation
from trueflight.groundstation.results import FullState, StateError
from trueflight.models.effect import Motion
from trueflight.models.flight import Flight
from trueflight.models.frames import (
    euler_from_quaternion,
    heading_from_world,
    rotate_inverse,
    rotation_matrix,
)
from trueflight.models.frames import world_from_heading as to_world
from trueflight.models.model import Model
from trueflight.models.prediction import Chain, acceleration, apply_effects, motion_of_flight

STEP = 0.01
"""s of the prediction; faster logs are read at about this step."""
MOST_STARTS = 3000
"""Starts, evenly spread over what is flown."""


def with_rates(flight: Flight) -> Flight | None:
    """The flight with body rates, from its attitude where it has no gyroscope; None where neither tells."""
    if flight.angular_velocity is not None:
        return flight
    rotation = measure_rotation(flight)
    return None if rotation is None else rotation.flight


def predict(flight: Flight, model: Model, spin: Spin) -> FullState | None:
    """The errors of the full state after `HORIZONS`: thrust and forces by `model`, the rotation by `spin`; None where
    the flight lacks position, velocity, attitude or body rates, or a second of flight without a gap.
    """
    if not flight.has("position", "velocity", "quaternion", "angular_velocity"):
        return None
    driving, base, rest = spin.columns(flight), *_thrust(flight, model)
    every = max(1, round(STEP / flight.dt))
    keep = np.arange(0, len(flight), every)
    flown, dt = flight.part(keep), every * flight.dt
    driving, base = driving[keep], _rows(base, keep)
    starts, longest = _starts(flown, dt)
    if len(starts) < 3:
        return None
    marks = {round(h / dt): h for h in HORIZONS}
    state = [x[starts].copy() for x in _columns(flown)]
    now = _slopes(state, starts, driving, base, rest, spin)
    errors = []
    for step in range(1, longest + 1):
        k = starts + step
        ahead = _moved(state, now, dt)
        later = _slopes(ahead, k, driving, base, rest, spin)
        state = _moved(state, [0.5 * (a + b) for a, b in zip(now, later, strict=True)], dt)
        now = later
        if step in marks:
            errors.append(_error(marks[step], state, flown, k))
    return FullState(flight.name, model.label, spin.inputs, tuple(errors))


def _thrust(flight: Flight, model: Model) -> tuple[Motion, Chain]:
    """The flight with its thrust as late as it acts, and the effects that act after that."""
    chain = with_clock(measure(flight), model.chain())
    motion = motion_of_flight(flight)
    acting = apply_effects(motion, [(e, v) for e, v in chain if e.stage == 0])
    base = motion.with_(command=acting.command, thrust=acting.command, tau=0.0, delay=0.0)
    return base, [(e, v) for e, v in chain if e.stage != 0 and not e.rotational]


def _columns(flight: Flight) -> list[np.ndarray]:
    return [flight.column(n) for n in ("position", "velocity", "quaternion", "angular_velocity")]


def _starts(flight: Flight, dt: float) -> tuple[np.ndarray, int]:
    """Samples from which the longest horizon is flown without a gap, and its number of steps."""
    n, longest = len(flight), round(HORIZONS[-1] / dt)
    flying = np.ones(n, dtype=bool) if flight.flying is None else flight.flying
    finite = np.all([np.all(np.isfinite(c), axis=1) for c in _columns(flight)], axis=0)
    bad = np.cumsum(~(flying & finite & np.r_[True, np.diff(flight.t) < 2.5 * dt]))
    starts = np.arange(0, max(n - longest - 1, 0))
    starts = starts[bad[starts + longest] == bad[starts]]
    return starts[:: max(1, len(starts) // MOST_STARTS)], longest


def _slopes(
    state: list[np.ndarray], k: np.ndarray, driving: np.ndarray, base: Motion, rest: Chain, spin: Spin
) -> list[np.ndarray]:
    """Velocity, acceleration, body rate and angular acceleration of states at samples `k`."""
    position, velocity, quaternion, rate = state
    body_to_world = rotation_matrix(quaternion)
    euler = euler_from_quaternion(quaternion)
    yaw = euler[:, 2]
    c, s = np.cos(yaw), np.sin(yaw)
    rotation = body_to_world.copy()
    rotation[:, 0] = c[:, None] * body_to_world[:, 0] + s[:, None] * body_to_world[:, 1]
    rotation[:, 1] = -s[:, None] * body_to_world[:, 0] + c[:, None] * body_to_world[:, 1]
    at = _rows(base, k).with_(
        rotation=rotation,
        euler=(euler[:, 0], euler[:, 1]),
        cos_yaw=c,
        sin_yaw=s,
        height=position[:, 2],
        air_velocity=heading_from_world(velocity, yaw),
        body_rate=rate,
    )
    moving = to_world(np.asarray(acceleration(apply_effects(at, rest))), yaw)
    turning = spin.acceleration(driving[k], rate, rotate_inverse(quaternion, velocity))
    return [velocity, moving, rate, turning]


def _moved(state: list[np.ndarray], slopes: list[np.ndarray], dt: float) -> list[np.ndarray]:
    """The states a step later; the attitude by the exact rotation of a constant body rate."""
    position, velocity, quaternion, rate = state
    turned = _turned(quaternion, dt * slopes[2])
    return [position + dt * slopes[0], velocity + dt * slopes[1], turned, rate + dt * slopes[3]]


def _turned(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Attitudes (S, 4) after rotation vectors (S, 3) about the body's axes."""
    angle = np.linalg.norm(vector, axis=1)
    half = 0.5 * angle
    scale = np.where(angle > 1e-9, np.sin(half) / np.maximum(angle, 1e-9), 0.5)
    w, v = np.cos(half), vector * scale[:, None]
    a, b = quaternion[:, 0], quaternion[:, 1:]
    return np.column_stack([a * w - np.sum(b * v, axis=1), a[:, None] * v + w[:, None] * b + np.cross(b, v)])


def _error(horizon: float, state: list[np.ndarray], flown: Flight, k: np.ndarray) -> StateError:
    position, velocity, quaternion, rate = (column[k] for column in _columns(flown))
    cosine = np.abs(np.sum(state[2] * quaternion, axis=1)) / np.linalg.norm(quaternion, axis=1)
    angle = 2.0 * np.arccos(np.clip(cosine, 0.0, 1.0))

    def mean(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.mean(np.linalg.norm(a - b, axis=1)))

    return StateError(
        horizon, mean(state[0], position), mean(state[1], velocity), float(np.mean(angle)),
        mean(state[3], rate), len(k),
    )  # fmt: skip


def _rows(motion: Motion, k: np.ndarray) -> Motion:
    """The motion at some of its samples."""
    columns = {f.name: getattr(motion, f.name) for f in fields(motion)}
    changes: dict[str, Any] = {n: x[k] for n, x in columns.items() if isinstance(x, np.ndarray)}
    if motion.euler is not None:
        changes["euler"] = (motion.euler[0][k], motion.euler[1][k])
    return motion.with_(**changes)
