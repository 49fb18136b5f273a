"""One model against one flight: residuals, noise floor, and open-loop prediction."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from trueflight.groundstation.identify.fitting import with_clock
from trueflight.groundstation.measured.measurement import Measurement, measure
from trueflight.groundstation.results import AxisError, Comparison, HorizonError, WaterfallStep
from trueflight.models.effect import Motion
from trueflight.models.flight import Flight
from trueflight.models.frames import euler_from_quaternion, heading_from_world, world_from_heading
from trueflight.models.model import Model, linear_model
from trueflight.models.prediction import Chain, acceleration, apply_effects, motion_of_flight, specific_force
from trueflight.models.vehicle import GRAVITY

HORIZONS = (0.1, 0.5, 1.0)
"""s after which the open-loop prediction is compared with the flight."""
RESTART = 0.25
"""s between two starts of an open-loop prediction."""


def compare(
    flight: Flight, model: Model, bandwidth: float | None = None, horizons: bool = True
) -> Comparison:
    """Compare the acceleration that `model` predicts with the measured one, heading frame, same low-pass on both.

    Raises `InputError` where the flight lacks what a comparison needs.
    """
    measurement = measure(flight, bandwidth, thin=False)
    motion = motion_of_flight(flight)
    thinned = measure(flight, bandwidth)
    chain = with_clock(thinned, model.chain())
    measured = heading_acceleration(motion, measurement.value)
    predicted = _predicted(measurement, motion, chain)
    linear = _predicted(measurement, motion, with_clock(thinned, linear_model(flight.vehicle).chain()))
    residual = measured - predicted
    used = measurement.used & np.isfinite(residual[:, measurement.axes[-1]])
    mse, mse_linear = (np.mean(r[used] ** 2, axis=0) for r in (residual, measured - linear))
    # noise cannot leave more than what is left: a vibration is stronger beyond the pass band than in it
    floor = np.minimum(heading_noise(measurement, motion), np.sqrt(mse))
    axes = tuple(
        AxisError(
            "xyz"[i], float(np.sqrt(mse[i])), float(floor[i]), _share(mse[i], mse_linear[i], floor[i] ** 2)
        )
        for i in measurement.axes
    )
    chosen = list(measurement.axes)
    return Comparison(
        flight=flight,
        label=model.label,
        measured=measured,
        predicted=predicted,
        residual=residual,
        used=used,
        bandwidth=measurement.bandwidth,
        axes=axes,
        horizons=_horizons(flight, motion, chain, measurement.used) if horizons else (),
        rms=float(np.sqrt(np.mean(mse[chosen]))),
        noise_floor=float(np.sqrt(np.mean(floor[chosen] ** 2))),
    )


def waterfall(
    fitted: Flight, held_out: Flight | None, versions: list[Model], bandwidth: float | None = None
) -> tuple[WaterfallStep, ...]:
    """Residual RMS of each model version on the fitted and on the held-out flight.

    Each is named by what it has beyond the one before it.
    """
    steps = []
    for k, model in enumerate(versions):
        here = compare(fitted, model, bandwidth, horizons=False)
        there = None if held_out is None else compare(held_out, model, bandwidth, horizons=False).rms
        steps.append(WaterfallStep(_step(model, versions[max(k - 1, 0)]), here.rms, there, here.noise_floor))
    return tuple(steps)


def _step(model: Model, before: Model) -> str:
    added = [name for name in model.names() if name not in before.names()]
    if model.network is not None or len(added) < 2:
        return model.label
    told = added if len(added) < 4 else [*added[:2], f"{len(added) - 2} more"]
    return f"{f'v{model.version} ' if model.version else ''}{' '.join(f'+ {name}' for name in told)}"


def _predicted(measurement: Measurement, motion: Motion, chain: Chain) -> np.ndarray:
    return heading_acceleration(motion, measurement.see(specific_force(apply_effects(motion, chain))))


def heading_acceleration(motion: Motion, force: np.ndarray) -> np.ndarray:
    """Acceleration (N, 3), heading frame, of a specific force (N, 3), body; only z, unrotated, without attitude."""
    if motion.rotation is None:
        out = np.full_like(force, np.nan)
        out[:, 2] = force[:, 2] - GRAVITY
        return out
    return np.einsum("nij,nj->ni", motion.rotation, force) - [0.0, 0.0, GRAVITY]


def heading_noise(measurement: Measurement, motion: Motion) -> np.ndarray:
    """Noise RMS (3,), heading frame, of each axis by itself: that of the body's axes, turned by roll and pitch."""
    if motion.rotation is None:
        return measurement.noise
    turned = np.asarray(motion.rotation)[measurement.rows][measurement.used] ** 2
    return np.asarray(np.sqrt(np.einsum("nij,j->i", turned, measurement.noise**2) / max(len(turned), 1)))


def _share(mse: float, mse_linear: float, floor: float) -> float:
    """Part of the linear model's squared error above the floor that is explained, 0 to 1."""
    above = mse_linear - floor
    return float(np.clip(1.0 - (mse - floor) / above, 0.0, 1.0)) if above > 0.05 * floor else 1.0


def _horizons(flight: Flight, motion: Motion, chain: Chain, used: np.ndarray) -> tuple[HorizonError, ...]:
    """Open-loop prediction of velocity and position: commands and measured attitude go in, nothing is corrected.

    Restarts whose window is mostly left out of the comparison (saturated rotors) are left out here too.
    """
    flown, speed, attitude = flight.position, flight.velocity, flight.quaternion
    if flown is None or speed is None or attitude is None:
        return ()
    dt, n = flight.dt, len(flight)
    longest = round(HORIZONS[-1] / dt)
    flying = np.ones(n, dtype=bool) if flight.flying is None else flight.flying
    good = flying & np.r_[True, np.diff(flight.t) < 3.0 * dt]
    starts = np.arange(0, n - longest - 1, max(1, round(RESTART / dt)))
    inside = np.cumsum(~good)
    starts = starts[inside[starts + longest] == inside[starts]]
    unused = np.cumsum(~used)
    starts = starts[unused[starts + longest] - unused[starts] <= 0.1 * longest]
    if len(starts) < 3:
        return ()
    acting = apply_effects(motion, [(e, v) for e, v in chain if e.stage == 0])
    base = motion.with_(command=acting.command, thrust=acting.command, tau=0.0, delay=0.0)
    rest = [(e, v) for e, v in chain if e.stage != 0]
    yaw = euler_from_quaternion(attitude)[:, 2]

    def world_acceleration(k: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        at = _rows(base, k).with_(height=position[:, 2], air_velocity=heading_from_world(velocity, yaw[k]))
        return world_from_heading(np.asarray(acceleration(apply_effects(at, rest))), yaw[k])

    position, velocity = flown[starts].copy(), speed[starts].copy()
    now = world_acceleration(starts, position, velocity)
    marks = {round(h / dt): h for h in HORIZONS}
    errors = []
    for step in range(1, longest + 1):
        k = starts + step
        following = world_acceleration(k, position + dt * velocity, velocity + dt * now)
        position = position + dt * velocity + dt * dt * (2.0 * now + following) / 6.0
        velocity = velocity + 0.5 * dt * (now + following)
        now = following
        if step in marks:
            p = np.sqrt(np.mean((position - flown[k]) ** 2, axis=0))
            v = np.sqrt(np.mean((velocity - speed[k]) ** 2, axis=0))
            errors.append(HorizonError(marks[step], _three(p), _three(v), len(starts)))
    return tuple(errors)


def _three(x: np.ndarray) -> tuple[float, float, float]:
    return float(x[0]), float(x[1]), float(x[2])


def _rows(motion: Motion, k: np.ndarray) -> Motion:
    """The motion at some of its samples."""
    columns = {f.name: getattr(motion, f.name) for f in fields(motion)}
    changes: dict[str, Any] = {n: x[k] for n, x in columns.items() if isinstance(x, np.ndarray)}
    if motion.euler is not None:
        changes["euler"] = (motion.euler[0][k], motion.euler[1][k])
    return motion.with_(**changes)
