"""L1 adaptive control around the linear cascade.

A predictor of the velocity runs beside the flight, `v_hat' = A_zeta (phi, theta, T - m g) + sigma + A_s (v_hat - v)`,
with the cascade's own hover linearisation, so that what that leaves out is in `sigma` too; each tick the disturbance
`sigma` that takes its error away is found in closed form (piecewise constant adaptation), and a low-pass of it is taken
from what the cascade asks for. The adaptation is as fast as the ticks; how much of it is used, and how robust it is,
is the low-pass alone: which is what L1 is about.

Source: Wu, Cheng, Ackerman, Gahlawat, Lakshmanan, Zhao, Hovakimyan, "L1 adaptive augmentation for geometric tracking
control of quadrotors", ICRA 2022, equations (6) to (10), for the translation; Hovakimyan and Cao, "L1 Adaptive Control
Theory", SIAM 2010, section 3.3.
"""

from __future__ import annotations

import math

from trueflight.companion.law.control import ZERO, ControlLaw, ControlStep, State, Vector, euler
from trueflight.companion.law.outer_loop import LONGEST_STEP, ActingThrust, bounded, mixed
from trueflight.companion.law.steps import Preview, plain_step
from trueflight.models.vehicle import GRAVITY

PREDICTOR = 5.0
"""1/s, the decay rate of the predictor's error."""
FREQUENCY = 0.2
"""Hz of the low-pass."""


class L1Adaptive:
    """One flight of it."""

    def __init__(self, law: ControlLaw, frequency: float = FREQUENCY, predictor: float = PREDICTOR) -> None:
        self._law, self._rate, self._decay = law, 2.0 * math.pi * frequency, predictor
        self._thrust = ActingThrust(law)
        self._predicted: Vector | None = None
        self._used = ZERO

    def start(self) -> None:
        """Nothing: what it has learned still holds."""

    def stop(self) -> None:
        """Nothing."""

    def step(self, state: State, preview: Preview, dt: float) -> ControlStep:
        """One tick."""
        law, reference, zeta = self._law, preview(0.0), euler(state.quaternion)
        self._adapt(state, zeta, min(LONGEST_STEP, max(0.0, dt)))
        c, s = math.cos(zeta[2]), math.sin(zeta[2])
        x, y, z = self._used
        attitude = law.corrected(law.feedback(state, zeta[2], reference), (c * x + s * y, c * y - s * x, z))
        self._thrust.commanded(attitude.thrust)
        return plain_step(law, zeta, attitude, reference.yaw)

    def _adapt(self, state: State, zeta: Vector, dt: float) -> None:
        """The disturbance of the last tick, and how much of it is used, m/s², world."""
        c, s, (roll, pitch, _) = math.cos(zeta[2]), math.sin(zeta[2]), zeta
        ahead, aside = GRAVITY * pitch, -GRAVITY * roll
        acting = (c * ahead - s * aside, s * ahead + c * aside, self._thrust.step(dt))
        if self._predicted is None or dt <= 0.0:
            self._predicted = state.velocity
            return
        kept = math.exp(-self._decay * dt)
        gain = self._decay * kept / (1.0 - kept)  # -inv(Phi) exp(A_s dt)
        error = tuple(p - v for p, v in zip(self._predicted, state.velocity, strict=True))
        found = bounded((-gain * error[0], -gain * error[1], -gain * error[2]))
        self._used = mixed(self._used, found, 1.0 - math.exp(-self._rate * dt))
        u, v, w = found
        # exact over the tick for what is constant in it
        share = (1.0 - kept) / self._decay
        self._predicted = (
            state.velocity[0] + kept * error[0] + share * (acting[0] + u),
            state.velocity[1] + kept * error[1] + share * (acting[1] + v),
            state.velocity[2] + kept * error[2] + share * (acting[2] - GRAVITY + w),
        )
