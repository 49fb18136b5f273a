"""What a vehicle is seen to do beyond what it is taken to do: the residual acceleration, and the observer that takes
it for a disturbance.

The accelerometer tells at once what pushes, with a bias; the autopilot's velocity tells slowly, without one. A filter
with both (`MeasuredAcceleration`) has the first above its frequency and the second below. Less the linear model and
the learned one, at the attitude and the thrust that act, it leaves what neither knows: a disturbance observer (Ohnishi,
"A new servo method in mechatronics", 1987; Chen, Yang, Guo and Li, "Disturbance-observer-based control and related
methods", IEEE TIE 63, 2016) with the learned model as its nominal one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from trueflight.companion.law.actuation import Actuation, Pair
from trueflight.companion.law.control import ZERO, ControlLaw, State, Vector, world_from_body
from trueflight.companion.law.outer_loop import LONGEST_STEP, ActingThrust, LowPass, bounded
from trueflight.models.vehicle import GRAVITY

BIAS_BANDWIDTH = 1.0
"""rad/s up to which velocity tells the acceleration, and above which the accelerometer does."""
BELIEVED, DISBELIEVED = 0.5, 1.0
"""m/s by which the velocity told may differ from the accelerometer's, wholly believed and not at all. An estimator that
is 80 ms late differs by 0.4 m/s where it turns with 5 m/s²."""
STUCK = 0.25
"""s without any change after which an accelerometer is stuck: its noise alone changes it with every sample."""


@dataclass(frozen=True)
class ObserverLimits:
    """The fast disturbance observer of `corrected`: it removes what pushes and no model knows.

    `frequency` in Hz is that of its low-pass, two equal poles; `authority` in m/s² per axis of the world. `frequency` 0
    switches it off. Below `ground` m above the ground the lift that it may take away runs down to nothing: what holds a
    vehicle up there may be the ground itself.
    """

    frequency: float = field(default=3.0, metadata={"zero": "switches it off"})
    authority: float = 6.0
    ground: float = 0.5


class MeasuredAcceleration:
    """Acceleration in the world by the accelerometer, without its bias.

    `v' = R (f - b) - g + 2 w (v_told - v)`, `b' = -w² R' (v_told - v)`: two equal poles at `bandwidth` w, rad/s. A bias
    or a tilted sensor is gone after a few 1 / w; what is faster is the accelerometer's alone.
    """

    def __init__(self, bandwidth: float) -> None:
        self._bandwidth = bandwidth
        self._velocity: Vector | None = None  # m/s, world
        self.trust = 0.0
        """Share to which the accelerometer is believed: as far as the velocity told agrees with it."""
        self._bias, self._force, self._same = ZERO, ZERO, 0.0

    def step(self, state: State, dt: float) -> Vector:
        """Acceleration in m/s², world; nothing where there is no accelerometer that can be believed."""
        force, told = state.specific_force, state.velocity
        self._same = self._same + dt if force == self._force else 0.0
        if force is None or self._same > STUCK:
            self._velocity, self.trust = None, 0.0
            return ZERO
        self._force = force
        (f, g, h), (a, b, c) = force, self._bias
        x, y, z = world_from_body(state.quaternion, (f - a, g - b, h - c))
        z -= GRAVITY
        if self._velocity is None:
            self._velocity, self.trust, self._bias = told, 0.0, ZERO
            return ZERO
        dt = min(LONGEST_STEP, max(0.0, dt))
        u, v, w = self._velocity
        # Exact in the limit of small w dt, and stable for every dt up to the longest step.
        ex, ey, ez = told[0] - u - dt * x, told[1] - v - dt * y, told[2] - w - dt * z
        keep = math.exp(-self._bandwidth * dt)
        gain, learn = 1.0 - keep * keep, (1.0 - keep) * (1.0 - keep) / dt if dt > 0.0 else 0.0
        self._velocity = u + dt * x + gain * ex, v + dt * y + gain * ey, w + dt * z + gain * ez
        q = state.quaternion
        i, j, k = world_from_body((q[0], -q[1], -q[2], -q[3]), (ex, ey, ez))
        self._bias = a - learn * i, b - learn * j, c - learn * k
        off = math.sqrt(ex * ex + ey * ey + ez * ez)
        self.trust = trust = min(1.0, max(0.0, (DISBELIEVED - off) / (DISBELIEVED - BELIEVED)))
        return trust * x, trust * y, trust * z


class DisturbanceObserver:
    """One flight's: what is measured beyond the models, and of it what acts as a disturbance. Accelerations in m/s²,
    heading frame."""

    def __init__(self, law: ControlLaw, limits: ObserverLimits) -> None:
        self._limits = limits
        self._measured, self._acting = MeasuredAcceleration(BIAS_BANDWIDTH), ActingThrust(law)
        self._mass = law.vehicle.mass
        self._low_pass = LowPass(limits.frequency, ZERO)
        self._thrust = law.vehicle.weight
        self._acceleration, self._lift = ZERO, 0.0
        self.pushed = ZERO
        """What of it acts, as of the last tick."""

    def reset(self) -> None:
        """Nothing is seen."""
        self._low_pass = LowPass(self._limits.frequency, ZERO)
        self.pushed = ZERO

    def look(self, state: State, actuation: Actuation, dt: float) -> tuple[Vector, float]:
        """The acceleration now (world), as far as one is measured that can be believed, and the thrust that acts now,
        N, after the delay and lag of an `actuation`, or of the vehicle file where it has none."""
        self._acceleration = self._measured.step(state, dt)
        self._lift = self._limits.authority * min(1.0, max(0.0, state.height / self._limits.ground))
        acting = self._acting
        if actuation.thrust_delay or actuation.thrust_lag:
            acting.delay, acting.lag = actuation.thrust_delay, actuation.thrust_lag
        self._thrust = self._mass * acting.step(dt)
        return self._acceleration, self._thrust

    def beyond_linear(self, zeta: Vector) -> Vector | None:
        """Error acceleration (10) now: what is measured beyond the hover linearisation at attitude `zeta` (roll, pitch,
        yaw in rad) and at the thrust that acts; None where nothing is measured that is wholly believed."""
        return self._beyond(zeta) if self._measured.trust == 1.0 else None

    def commanded(self, thrust: float) -> None:
        """A thrust (N) goes out now."""
        self._acting.commanded(thrust)

    def step(self, zeta: Vector, modelled: Vector, dt: float) -> tuple[Vector, Pair]:
        """What pushes, and how fast that changes along x and y (m/s³); `modelled` is what the learned model says of
        the moment of the last look, `zeta` roll, pitch, yaw in rad."""
        if not self._limits.frequency:
            return ZERO, (0.0, 0.0)
        (x, y, z), trust = self._beyond(zeta), self._measured.trust
        u, v, w = modelled
        x, y, z = bounded((x - trust * u, y - trust * v, z - trust * w), self._limits.authority)
        # Of what pushes most stands still in the world, so that is where it is filtered.
        c, s = math.cos(zeta[2]), math.sin(zeta[2])
        u, v, w = self._low_pass.step((c * x - s * y, s * x + c * y, z), dt)
        self.pushed = pushed = (c * u + s * v, c * v - s * u, min(w, self._lift))
        u, v, _ = self._low_pass.slope
        return pushed, (c * u + s * v, c * v - s * u)

    def _beyond(self, zeta: Vector) -> Vector:
        """What is measured beyond the hover linearisation, as far as it is believed."""
        (x, y, z), trust = self._acceleration, self._measured.trust
        c, s = math.cos(zeta[2]), math.sin(zeta[2])
        return (
            c * x + s * y - trust * GRAVITY * zeta[1],
            c * y - s * x + trust * GRAVITY * zeta[0],
            z - trust * (self._thrust / self._mass - GRAVITY),
        )
