"""Incremental nonlinear dynamic inversion of the acceleration: the measured one says what is missing.

`tau_c = tau_f + (a_c - a_f)`: the specific thrust asked for is the one that acts, plus the acceleration asked for less
the measured one, both filtered alike. Whatever pushes is in `a_f`, so no model of it is needed; what is late or noisy
is in `a_f` too, which bounds the filter's frequency.

Source: Smeur, Chu, de Croon, "Adaptive incremental nonlinear dynamic inversion for attitude control of micro air
vehicles", JGCD 39 (2016); for the outer loop Tal and Karaman, "Accurate tracking of aggressive quadrotor trajectories
using incremental nonlinear dynamic inversion and differential flatness", IEEE TCST 29 (2021), equations (17) to (19).
"""

from __future__ import annotations

from trueflight.companion.law.control import (
    ZERO,
    ControlLaw,
    ControlStep,
    State,
    Vector,
    euler,
    world_from_body,
)
from trueflight.companion.law.outer_loop import ActingThrust, LowPass, OuterLoop, bounded
from trueflight.companion.law.steps import Preview, plain_step

FREQUENCY = 32.0
"""Hz of both filters."""


class Indi:
    """One flight of it. Without an accelerometer nothing is measured, and it is the design with exact rotation."""

    def __init__(self, law: ControlLaw, frequency: float = FREQUENCY) -> None:
        self._law, self._loop = law, OuterLoop(law)
        self._thrust = ActingThrust(law)
        self._acceleration, self._acting = LowPass(frequency), LowPass(frequency)

    def start(self) -> None:
        """Nothing: what it has measured still holds."""

    def stop(self) -> None:
        """Nothing."""

    def step(self, state: State, preview: Preview, dt: float) -> ControlStep:
        """One tick."""
        reference, zeta = preview(0.0), euler(state.quaternion)
        acting = world_from_body(state.quaternion, (0.0, 0.0, self._thrust.step(dt)))
        pushed = bounded(self._pushed(state, acting, dt))
        wanted = self._loop.wanted(state, zeta[2], reference)
        asked = (wanted[0] - pushed[0], wanted[1] - pushed[1], wanted[2] - pushed[2])
        attitude = self._loop.attitude(asked, zeta[2])
        self._thrust.commanded(attitude.thrust)
        return plain_step(self._law, zeta, attitude, reference.yaw)

    def _pushed(self, state: State, acting: Vector, dt: float) -> Vector:
        """Acceleration (m/s², world) that is not the commanded thrust's."""
        if state.specific_force is None:
            return ZERO
        x, y, z = self._acceleration.step(world_from_body(state.quaternion, state.specific_force), dt)
        u, v, w = self._acting.step(acting, dt)
        return x - u, y - v, z - w
