"""Flights in which something changes: a flight of the simulator, and what effects of given courses add to its
accelerometer."""

from dataclasses import replace

import numpy as np
from scipy import signal

from trueflight.models.effects import effect_named
from trueflight.models.flight import Flight
from trueflight.models.frames import rotate_inverse
from trueflight.models.prediction import apply_effects, motion_of_flight, specific_force

Courses = dict[str, dict[str, object]]
"""Numbers of effects by effect and parameter, each the same throughout or one for every sample (N,)."""


def as_if(flight: Flight, courses: Courses) -> Flight:
    """The flight with these effects on what its accelerometer read."""
    motion, rigid = motion_of_flight(flight), (effect_named("rigid_body"), {})
    chain = [(effect_named(name), values) for name, values in courses.items()]
    more = specific_force(apply_effects(motion, [rigid, *chain]))
    assert flight.specific_force is not None
    felt = flight.specific_force + more - specific_force(apply_effects(motion, [rigid]))
    return replace(flight, specific_force=felt)


def step(flight: Flight, moment: float, before: float, after: float) -> np.ndarray:
    """A number (N,) that changes at a moment of the flight's clock, s."""
    return np.where(flight.t < moment, before, after)


def ramp(flight: Flight, first: float, last: float) -> np.ndarray:
    """A number (N,) that changes from the first sample to the last by and by."""
    return np.linspace(first, last, len(flight))


def gusty(flight: Flight, speed: float, time_constant: float, drag: float, seed: int = 0) -> Flight:
    """The flight in horizontal gusts of an RMS `speed`, m/s, for each axis of the world, and `time_constant` s, that
    act through a linear `drag`, 1/s."""
    rng = np.random.default_rng(seed)
    wind = np.zeros((len(flight), 3))
    wind[:, :2] = lagged_noise(rng, len(flight), flight.dt, speed, time_constant)
    assert flight.specific_force is not None and flight.quaternion is not None
    pushed = flight.specific_force + rotate_inverse(flight.quaternion, drag * wind)
    return replace(flight, specific_force=pushed)


def lagged_noise(
    rng: np.random.Generator, count: int, period: float, size: float, time_constant: float
) -> np.ndarray:
    """Two columns (count, 2) of noise through a first-order lag, RMS `size`, sampled every `period` s."""
    kept = np.exp(-period / time_constant)
    shocks = rng.normal(0.0, size * np.sqrt(1.0 - kept**2), (count, 2))
    shocks[0] = rng.normal(0.0, size, 2)
    return np.asarray(signal.lfilter([1.0], [1.0, -kept], shocks, axis=0))
