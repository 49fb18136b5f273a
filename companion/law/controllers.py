"""The controllers that a mission can choose: each turns a state and the reference ahead into one command a tick.

* `lqr`: the linear cascade alone.
* `lqr_integral`: the cascade with an integral in the position loop, the paper's third controller.
* `corrected`: the cascade with the learned correction (22), the inverse of the known actuation, a
  disturbance observer and a slow trim.
* `corrected_adaptive`: the same, with a model whose numbers are learnt anew in flight.
* `indi`, `l1_adaptive`, `geometric`, `px4_cascade`: after other papers, to compare with; each in its own module.

The correction has to arrive as an acceleration, so what lies between command and acceleration is undone where
it is known. Thrust acts after the motors' delay and lag, tilt in addition only through the attitude loop. So the
cascade is evaluated for the moment at which its command will act, the rate loop's lag is inverted, and the
attitude asked for the correction c is led by the attitude loop itself: `zeta_ref = u* + c + c_dot / K_zeta` makes
`zeta - c` follow `u*` as the linear design does. The model is asked at the attitude that the vehicle will have,
which is what it was fitted to, not at the one asked for; that also leaves no equation to be solved for u. Of the
height it is told the expected one: see `Corrected._ahead`. What the model does not know is seen by a disturbance
observer and, more slowly, by the trim.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from trueflight.companion.law.actuation import Actuation, LagInverse, RateModel
from trueflight.companion.law.adaptation import Learning
from trueflight.companion.law.behaviour import LinearBehaviour
from trueflight.companion.law.control import (
    ZERO,
    Attitude,
    ControlLaw,
    ControlStep,
    State,
    Vector,
    euler,
    features,
)
from trueflight.companion.law.geometric import Geometric
from trueflight.companion.law.guard import Correction
from trueflight.companion.law.indi import Indi
from trueflight.companion.law.l1_adaptive import L1Adaptive
from trueflight.companion.law.outer_loop import LONGEST_STEP
from trueflight.companion.law.px4_cascade import Px4Cascade
from trueflight.companion.law.residual import DisturbanceObserver, ObserverLimits
from trueflight.companion.law.steps import Controller, Preview
from trueflight.models.contract import (
    GEOMETRIC,
    INDI,
    L1_ADAPTIVE,
    LQR,
    LQR_INTEGRAL,
    PX4_CASCADE,
    WITH_MODEL,
)
from trueflight.models.controllers import check_controller, plug_ins
from trueflight.models.errors import InputError
from trueflight.models.trajectory import ReferenceSample
from trueflight.models.vehicle import GRAVITY

AHEAD = 0.02
"""s over which the correction's rate of change is taken, where no lag asks for more."""
BLIND = (LQR, LQR_INTEGRAL)
"""Those that do not look at the accelerometer, which takes time to read."""
INTEGRAL_AUTHORITY = 3.0  # m/s², the most that the integral of `lqr_integral` may ask for per axis


class Corrector(Protocol):
    """What stands between learned models and the command: `companion.law.guard.Guard`."""

    wants_yaw: bool

    @property
    def applied(self) -> Vector:
        """The correction of the previous tick, as applied, m/s², heading frame."""
        ...

    @property
    def learning(self) -> Learning | None:
        """What the live model learns in this flight; None where it learns nothing."""
        ...

    @property
    def engaged(self) -> float:
        """Share, 0 to 1, to which models act now."""
        ...

    @property
    def actuation(self) -> Actuation:
        """What is known of the path from command to motion."""
        ...

    def learn(self, row: Sequence[float], measured: Vector | None, dt: float, waits: str) -> None:
        """Let the live model learn, where it does: features of now with the thrust that acts, the error acceleration
        measured there (None where it cannot be believed), and why nothing may be learnt now, in words."""
        ...

    def step(
        self, rows: Sequence[list[float]], ahead: float, dt: float, height: float, measured: Vector | None
    ) -> Correction:
        """The correction for four rows of features: when tilt acts, `ahead` s later, when thrust acts, and now.

        `height` above the ground, m, is the measured one, `measured` the error acceleration as for `learn`.
        """
        ...


@dataclass(frozen=True)
class TrimLimits:
    """The slow trim of `corrected`: it removes what is left between the flight and its linear behaviour.

    The integral of the distance to the expected linear behaviour: `bandwidth` in rad/s is its gain over the
    position loop's stiffness, a fifth of that loop's natural frequency, so that it takes little of its phase;
    `authority` in m/s² per axis. `bandwidth` 0 switches it off.
    """

    bandwidth: float = field(default=0.4, metadata={"zero": "switches it off"})
    authority: float = 2.0


def make_controller(
    name: str,
    law: ControlLaw,
    corrector: Corrector | None = None,
    trim: TrimLimits | None = None,
    observer: ObserverLimits | None = None,
) -> Controller:
    """The controller of this name; raises `InputError` for an unknown one or one that lacks what it needs."""
    if name in WITH_MODEL:
        if corrector is None:
            raise InputError(f"controller '{name}' needs a deployed model")
        return Corrected(law, corrector, trim or TrimLimits(), observer or ObserverLimits())
    check_controller(name)
    return _ALONE[name](law) if name in _ALONE else _plugged(name, law)


def _plugged(name: str, law: ControlLaw) -> Controller:
    """A controller of an installed package; whatever fails there is told in one line."""
    entry = plug_ins()[name]
    try:
        made = entry.load()(law)
    except InputError:
        raise
    except Exception as error:  # noqa: BLE001 - somebody else's code may fail in any way
        raise InputError(f"controller '{name}' of {entry.value}: {type(error).__name__}: {error}") from None
    if not all(callable(getattr(made, part, None)) for part in ("step", "start", "stop")):
        raise InputError(f"controller '{name}' of {entry.value}: it lacks step, start or stop")
    controller: Controller = made
    return controller


class Lqr:
    """The linear cascade alone."""

    def __init__(self, law: ControlLaw) -> None:
        self._law = law

    def start(self) -> None:
        """Nothing: it has no memory."""

    def stop(self) -> None:
        """Nothing: it has no memory."""

    def step(self, state: State, preview: Preview, dt: float) -> ControlStep:
        """One tick of the cascade."""
        return self._law.step(state, preview(0.0))


class LqrIntegral:
    """The cascade with an integral of the position error in the position loop."""

    def __init__(self, law: ControlLaw) -> None:
        gains = law.design.integral
        if gains is None:
            raise InputError(
                f"design of '{law.design.vehicle}': it has no gains for lqr_integral; "
                "run `groundstation design` again"
            )
        self._law, self._gains = law, gains
        self._integral = ZERO  # m s, world
        mass = law.vehicle.mass
        per_axis = (GRAVITY * abs(gains.K_i[1][0]), GRAVITY * abs(gains.K_i[0][1]), gains.K_i[2][2] / mass)
        self._most = [INTEGRAL_AUTHORITY / k if k > 0.0 else 0.0 for k in per_axis]

    def start(self) -> None:
        """Keep the integral: what it has learned in the climb still holds."""

    def stop(self) -> None:
        """Keep the integral."""

    def step(self, state: State, preview: Preview, dt: float) -> ControlStep:
        """One tick; the integral does not grow while tilt or thrust are at their limits."""
        law, k = self._law, self._gains.K_i
        reference = preview(0.0)
        zeta = euler(state.quaternion)
        c, s = math.cos(zeta[2]), math.sin(zeta[2])
        dt = min(LONGEST_STEP, max(0.0, dt))
        grown = tuple(
            min(most, max(-most, i + dt * (p - r)))
            for i, p, r, most in zip(
                self._integral, state.position, reference.position, self._most, strict=True
            )
        )
        x, y, z = c * grown[0] + s * grown[1], c * grown[1] - s * grown[0], grown[2]
        more = (
            -(k[0][0] * x + k[0][1] * y + k[0][2] * z),
            -(k[1][0] * x + k[1][1] * y + k[1][2] * z),
            -(k[2][0] * x + k[2][1] * y + k[2][2] * z),
        )
        attitude = law.feedback(state, zeta[2], reference, self._gains.K_eta, more)
        if not law.at_limit(attitude):
            self._integral = (grown[0], grown[1], grown[2])
        command = law.command(zeta, attitude, reference.yaw)
        return ControlStep(command, ZERO, ZERO, command, law.normalised(command.thrust))


class Corrected:
    """The cascade with the learned correction, the inverse of the actuation, the disturbance observer and the trim.

    All four fade with the corrector's `engaged`: with nothing engaged it is the cascade, tick for tick.
    """

    def __init__(
        self, law: ControlLaw, corrector: Corrector, limits: TrimLimits, observer: ObserverLimits
    ) -> None:
        self._law, self._corrector, self._limits = law, corrector, limits
        k_eta, k_zeta = law.design.K_eta, law.design.K_zeta
        self._tilt_gain = 0.5 * (k_zeta[0][0] + k_zeta[1][1])
        stiffness = (GRAVITY * k_eta[1][0], -GRAVITY * k_eta[0][1], k_eta[2][2] / law.vehicle.mass)
        self._trim_gain = [limits.bandwidth * k for k in stiffness]
        self._running = False
        self._behaviour: LinearBehaviour | None = None
        self._trim = ZERO  # m/s², world
        self._share = 0.0
        self._at_limit = False
        self._command = ZERO
        self._rates, self._inverse = RateModel(corrector.actuation), LagInverse()
        self._observer = DisturbanceObserver(law, observer)

    def start(self) -> None:
        """Expect the linear behaviour from the next tick's state on; what the trim has learned stays."""
        self._running, self._behaviour = True, None

    def stop(self) -> None:
        """Expect nothing any more; the trim stays as it is until the correction has faded out."""
        self._running, self._behaviour = False, None

    def step(self, state: State, preview: Preview, dt: float) -> ControlStep:
        """One tick."""
        law, corrector = self._law, self._corrector
        zeta = euler(state.quaternion)
        yaw = zeta[2]
        now = preview(0.0)
        plain = law.command(zeta, law.feedback(state, yaw, now), now.yaw)
        self._rates.actuation = actuation = corrector.actuation
        self._rates.advance(self._command[:2], dt)
        share = self._faded(corrector.engaged, dt)
        trim = self._trimmed(state, zeta, now, share, dt)
        acceleration, acting = self._observer.look(state, actuation, dt)
        if share == 0.0 and not self._running and corrector.applied == ZERO:
            self._inverse.reset()
            self._observer.reset()
            self._observer.commanded(plain.thrust)
            self._command = plain.body_rate
            return ControlStep(plain, ZERO, ZERO, plain, law.normalised(plain.thrust))

        known = actuation if share == 1.0 else actuation.scaled(share)
        (turned_x, turned_y), (more_p, more_q) = self._rates.on_its_way(share)
        p, q, r = state.angular_velocity
        rates = _euler_rates(zeta, (p + more_p, q + more_q, r))
        turned = _euler_rates(zeta, (turned_x, turned_y, 0.0))
        tilted = (zeta[0] + turned[0], zeta[1] + turned[1], yaw)

        # Four moments: when a rate commanded now acts, a little later, when a thrust commanded now acts, and now.
        ahead = max(known.rate_lag, AHEAD)
        lift = known.thrust_delay + known.thrust_lag
        early = self._ahead(state, acceleration, known.rate_delay)
        late = self._ahead(state, acceleration, known.rate_delay + ahead)
        lifted = self._ahead(state, acceleration, lift)
        reference = preview(known.rate_delay) if known.rate_delay else now
        tilt = law.feedback(early, yaw, reference)
        tilt_late = law.feedback(late, yaw, preview(known.rate_delay + ahead))
        thrust = law.feedback(lifted, yaw, preview(lift)).thrust

        before = corrector.applied[2] + trim[2] + share * self._observer.pushed[2]
        asked = law.corrected(Attitude(0.0, 0.0, thrust), (0.0, 0.0, before)).thrust
        voltage = state.battery_voltage if state.battery_voltage > 0.0 else law.vehicle.nominal_voltage
        roll, pitch = tilted[0] + ahead * rates[0], tilted[1] + ahead * rates[1]
        moments = (
            (early, Attitude(tilted[0], tilted[1], asked)),
            (late, Attitude(roll, pitch, asked)),
            (lifted, Attitude(zeta[0] + lift * rates[0], zeta[1] + lift * rates[1], asked)),
            (state, Attitude(zeta[0], zeta[1], acting)),
        )
        rows = [features(then, yaw, attitude, voltage, corrector.wants_yaw) for then, attitude in moments]
        measured = self._observer.beyond_linear(zeta)
        if corrector.learning is not None:
            corrector.learn(rows[3], measured, dt, self._why_not_learn())
        correction = corrector.step(rows, ahead, dt, state.height, measured)
        (u, v, w), (pushing_x, pushing_y) = self._observer.step(zeta, correction.now, dt)
        trim = (trim[0] + share * u, trim[1] + share * v, trim[2] + share * w)
        x, y, z = correction.applied
        x, y, z = x + trim[0], y + trim[1], z + trim[2]
        slope_x, slope_y = correction.rate[0] + pushing_x, correction.rate[1] + pushing_y
        # The attitude loop takes 1 / K to follow: lead the correction by that much.
        led = (x + share * slope_x / self._tilt_gain, y + share * slope_y / self._tilt_gain)
        lifted_thrust = law.corrected(Attitude(0.0, 0.0, thrust), (0.0, 0.0, z)).thrust
        attitude = law.corrected(Attitude(tilt.roll, tilt.pitch, lifted_thrust), (led[0], led[1], 0.0))
        later = law.corrected(
            Attitude(tilt_late.roll, tilt_late.pitch, lifted_thrust),
            (led[0] + ahead * slope_x, led[1] + ahead * slope_y, 0.0),
        )
        self._at_limit = law.at_limit(attitude)
        wanted = law.euler_rates(tilted, attitude, reference.yaw)
        soon = law.euler_rates((roll, pitch, yaw), later, reference.yaw)
        slope = ((soon[0] - wanted[0]) / ahead, (soon[1] - wanted[1]) / ahead)
        added = self._inverse.step(slope, known.rate_lag, known.rate_integral, dt)
        command = law.turning(zeta, (wanted[0] + added[0], wanted[1] + added[1], wanted[2]), attitude.thrust)
        self._command = command.body_rate
        self._observer.commanded(command.thrust)
        return ControlStep(plain, (x, y, z), correction.raw, command, law.normalised(command.thrust), trim)

    def _why_not_learn(self) -> str:
        """Why nothing can be learnt from this tick, in words; empty where it can."""
        return "the trajectory is over" if not self._running else "at the limits" if self._at_limit else ""

    def _ahead(self, state: State, acceleration: Vector, h: float) -> State:
        """The state `h` s later at this acceleration (m/s², world), attitude as it is.

        Its height is that of the linear behaviour, where one is expected. Ground effect holds a vehicle up; a
        correction of the measured height's ground effect takes that away, and a little too much of it lets the vehicle
        sink. At the expected height the correction is the same along the way, and what the ground does to a deviation
        is left to help.
        """
        (x, y, z), (u, v, w), (a, b, c) = state.position, state.velocity, acceleration
        half, behaviour = 0.5 * h * h, self._behaviour
        if behaviour is None:
            height = state.height + h * w + half * c
        else:
            height = state.height - (z - behaviour.position[2]) + h * behaviour.velocity[2]
        return State(
            (x + h * u + half * a, y + h * v + half * b, z + h * w + half * c),
            (u + h * a, v + h * b, w + h * c),
            state.quaternion,
            height,
            state.battery_voltage,
            state.angular_velocity,
            state.specific_force,
        )

    def _faded(self, engaged: float, dt: float) -> float:
        """The share of look-ahead and trim: follows what is engaged, at the pace of a fade at most."""
        change = min(LONGEST_STEP, max(0.0, dt))
        self._share = min(self._share + change, max(self._share - change, engaged))
        return self._share

    def _trimmed(
        self, state: State, zeta: Vector, reference: ReferenceSample, share: float, dt: float
    ) -> Vector:
        """The trim (m/s², heading frame) after this tick's distance to the linear behaviour."""
        if self._running and self._behaviour is None:
            self._behaviour = LinearBehaviour(
                self._law.design, state.position, state.velocity, zeta, reference
            )
        elif self._behaviour is not None:
            self._behaviour.step(reference, dt)
            if not self._at_limit:  # what is missing there is not the correction
                self._grow(state.position, self._behaviour.position, zeta[2], share * min(LONGEST_STEP, dt))
        c, s = math.cos(zeta[2]), math.sin(zeta[2])
        x, y, z = self._trim
        x, y, z = share * x, share * y, share * z
        return c * x + s * y, c * y - s * x, z

    def _grow(self, position: Vector, expected: Vector, yaw: float, dt: float) -> None:
        x, y, z = position[0] - expected[0], position[1] - expected[1], position[2] - expected[2]
        c, s = math.cos(yaw), math.sin(yaw)
        a, b, d = self._trim_gain
        # Gains belong to the heading frame, the disturbance to the world.
        along, across = dt * a * (c * x + s * y), dt * b * (c * y - s * x)
        u, v, w = self._trim
        u, v, w = u + c * along - s * across, v + s * along + c * across, w + dt * d * z
        most = self._limits.authority
        self._trim = min(most, max(-most, u)), min(most, max(-most, v)), min(most, max(-most, w))


def _euler_rates(zeta: Vector, body: Vector) -> Vector:
    """Rates of roll, pitch, yaw of body rates (rad/s): Diebel 2006, equation 76."""
    roll, pitch, _ = zeta
    p, q, r = body
    sr, cr = math.sin(roll), math.cos(roll)
    cp = max(0.2, math.cos(pitch))
    turning = (sr * q + cr * r) / cp
    return p + math.sin(pitch) * turning, cr * q - sr * r, turning


_ALONE: dict[str, Callable[[ControlLaw], Controller]] = {
    LQR: Lqr,
    LQR_INTEGRAL: LqrIntegral,
    INDI: Indi,
    L1_ADAPTIVE: L1Adaptive,
    GEOMETRIC: Geometric,
    PX4_CASCADE: Px4Cascade,
}
"""Those that need no model."""
