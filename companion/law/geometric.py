"""Geometric tracking with an adaptive term for a constant force.

The thrust vector points where the wanted acceleration does, its size is that vector's part along the body's own z
axis, so that a vehicle that is still turning does not push aside. The adaptive term grows with `e_v + c e_x` and is
projected to what it may be.

Source: Lee, Leok, McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)", CDC 2010, equations (12), (15);
Goodarzi, Lee, Lee, "Geometric adaptive tracking control of a quadrotor unmanned aerial vehicle on SE(3) for agile
maneuvers", ASME JDSMC 137 (2015), equations (17), (21), with the disturbance itself as the parameter.
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
from trueflight.companion.law.outer_loop import LONGEST_STEP, OuterLoop, bounded, errors
from trueflight.companion.law.steps import Preview, plain_step
from trueflight.models.vehicle import GRAVITY

ADAPTATION = 8.0
"""1/s, of the error in velocity; `c` is what makes both errors of a settled loop weigh alike."""


class Geometric:
    """One flight of it."""

    def __init__(self, law: ControlLaw, adaptation: float = ADAPTATION) -> None:
        self._law, self._loop, self._rate = law, OuterLoop(law), adaptation
        (a, b, d), (e, f, g) = self._loop.stiffness, self._loop.damping
        # c < damping / (1 + damping² / (4 stiffness)), the paper's bound for a positive definite Lyapunov function
        self._c = 0.5 * min(v / (1.0 + v * v / (4.0 * k)) for k, v in ((a, e), (b, f), (d, g)))
        self._force = ZERO  # m/s², world

    def start(self) -> None:
        """Nothing: what it has learned still holds."""

    def stop(self) -> None:
        """Nothing."""

    def step(self, state: State, preview: Preview, dt: float) -> ControlStep:
        """One tick; it does not adapt while tilt or thrust are at their limits."""
        reference, zeta = preview(0.0), euler(state.quaternion)
        wanted, force = self._loop.wanted(state, zeta[2], reference), self._force
        asked = (wanted[0] - force[0], wanted[1] - force[1], wanted[2] - force[2])
        attitude = self._loop.attitude(asked, zeta[2])
        if not self._law.at_limit(attitude):
            self._adapt(errors(state, reference), min(LONGEST_STEP, max(0.0, dt)))
        x, y, z = world_from_body(state.quaternion, (0.0, 0.0, 1.0))
        along = self._law.vehicle.mass * (x * asked[0] + y * asked[1] + z * (asked[2] + GRAVITY))
        attitude = self._law.limited(attitude.roll, attitude.pitch, along)
        return plain_step(self._law, zeta, attitude, reference.yaw)

    def _adapt(self, error: tuple[Vector, Vector], dt: float) -> None:
        (ex, ey, ez), (dx, dy, dz) = error
        x, y, z = self._force
        k, c = self._rate * dt, self._c
        self._force = bounded((x + k * (dx + c * ex), y + k * (dy + c * ey), z + k * (dz + c * ez)))
