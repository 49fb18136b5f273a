"""Turbulent wind as a sum of sines: a function of time alone, so that it is the same however a flight goes."""

from __future__ import annotations

import math
import random

import numpy as np

LONGEST, SHORTEST = 40.0, 0.25
"""s: periods of the slowest and the fastest sine; what is slower is steady wind within a flight, what is faster moves
a quadrotor by millimetres."""
SINES = 24
CORRELATION = 3.0
"""s. Dryden's length over the speed of the mean wind: 15 m at 2 m above the ground, by MIL-F-8785C, in 5 m/s."""
VERTICAL = 0.5
"""Of the horizontal standard deviation: MIL-F-8785C, close to the ground."""


class Turbulence:
    """Velocity of the air beside its mean, m/s, world axes, with a standard deviation of `deviation` along x and y.

    The sines have the amplitudes of Dryden's longitudinal spectrum, 1 / (1 + (w T)²), and phases drawn by `seed`.
    Source: MIL-F-8785C, 1980, section 3.7; sums of sines: Shinozuka, JASA 49 (1971).
    """

    def __init__(self, deviation: float, seed: int, dt: float) -> None:
        edges = np.geomspace(2.0 * math.pi / LONGEST, 2.0 * math.pi / SHORTEST, SINES + 1)
        rates = np.sqrt(edges[1:] * edges[:-1])
        power = np.diff(edges) / (1.0 + (CORRELATION * rates) ** 2)
        amplitude = deviation * np.sqrt(2.0 * power / power.sum())
        generator = random.Random(f"trueflight gusts {seed}")
        self._amplitude = np.stack([amplitude, amplitude, VERTICAL * amplitude])
        self._phase = np.array(
            [[generator.uniform(0.0, 2.0 * math.pi) for _ in range(SINES)] for _ in range(3)]
        )
        self._rate = rates * dt
        self._steps = 0

    def step(self) -> tuple[float, float, float]:
        """The velocity of the air in the next step."""
        x, y, z = (self._amplitude * np.sin(self._rate * self._steps + self._phase)).sum(axis=1).tolist()
        self._steps += 1
        return x, y, z
