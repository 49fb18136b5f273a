"""The corrected cascades of many vehicles: `companion.law.controllers.Corrected` for one of them has the reasons."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trueflight.companion.law.control import ControlLaw
from trueflight.companion.law.controllers import AHEAD
from trueflight.companion.law.outer_loop import LONGEST_STEP
from trueflight.models.vehicle import GRAVITY
from trueflight.sim_bridge.many.actuation import LagInverses, RateModels
from trueflight.sim_bridge.many.behaviours import Behaviours
from trueflight.sim_bridge.many.cascade import Cascades, States, Steps, euler, to_heading
from trueflight.sim_bridge.many.courses import Courses, References
from trueflight.sim_bridge.many.guards import Guards
from trueflight.sim_bridge.many.observers import Observers
from trueflight.sim_bridge.plan import Plan

Heading = tuple[np.ndarray, np.ndarray]
"""Cosine and sine of the yaws (N,)."""


class ManyCorrected:
    """The cascade with the learned correction, the inverse of the actuation, the disturbance observer and the trim,
    from the first tick on."""

    def __init__(self, laws: Sequence[ControlLaw], plans: Sequence[Plan], period: float) -> None:
        count = len(plans)
        self._law = law = Cascades(laws)
        self._guards = Guards(plans)
        self._courses = Courses(plans, period)
        self.inference = self._guards.inference
        k_eta, k_zeta = law.k_eta, law.k_zeta
        self._tilt_gain = 0.5 * (k_zeta[0, 0] + k_zeta[1, 1])
        stiffness = np.array([GRAVITY * k_eta[1, 0], -GRAVITY * k_eta[0, 1], k_eta[2, 2] / law.mass])
        self._trim_gain = np.array([plan.trim.bandwidth for plan in plans]) * stiffness
        self._most_trim = np.array([plan.trim.authority for plan in plans])
        self._nominal = np.array([plan.vehicle.nominal_voltage for plan in plans])
        self._fresh = np.zeros(count, dtype=bool)
        self._behaviours = Behaviours(law, count)
        self._trim, self._share = np.zeros((3, count)), np.zeros(count)
        self._at_limit = np.zeros(count, dtype=bool)
        self._command = np.zeros((3, count))
        self._rates, self._inverses = RateModels(count, period), LagInverses(count)
        self._observers = Observers(laws, plans)

    def start(self, which: np.ndarray) -> None:
        """Some (N,) expect the linear behaviour from the next tick's state on."""
        self._fresh = self._fresh | which

    def guard(self) -> list[str]:
        """What each one's guard says."""
        return self._guards.statuses()

    def step(self, states: States, reference: References, tick: int, dt: float) -> Steps:
        """One tick of all."""
        law, guards = self._law, self._guards
        zeta = euler(states.quaternion)
        yaw = zeta[2]
        heading = np.cos(yaw), np.sin(yaw)
        plain = law.feedback(states.position, states.velocity, heading, reference)
        plain_rates = law.turning(zeta, law.euler_rates(zeta, plain, reference.yaw))
        actuation = guards.actuation
        self._rates.advance(self._command[:2], actuation[1], actuation[2], dt)
        share = self._faded(dt)
        acceleration, acting = self._observers.look(states, actuation, dt)
        trim = self._trimmed(states, zeta, heading, reference, dt)
        rate_delay, rate_lag, thrust_delay, thrust_lag = share * actuation[[0, 1, 3, 4]]

        turned, more = self._rates.on_its_way(rate_delay)
        body = states.angular_velocity.copy()
        body[:2] += more
        rates = _euler_rates(zeta, body)
        tilted = zeta.copy()
        tilted[:2] += _euler_rates(zeta, np.concatenate((turned, np.zeros((1, len(share))))))[:2]

        ahead, lift = np.maximum(rate_lag, AHEAD), thrust_delay + thrust_lag
        early, late, lifted = (
            self._ahead(states, acceleration, h) for h in (rate_delay, rate_delay + ahead, lift)
        )
        then = References.of(self._courses.rows("tilt", tick, rate_delay))
        later = References.of(self._courses.rows("late", tick, rate_delay + ahead))
        above = References.of(self._courses.rows("lift", tick, lift))
        tilt = law.feedback(early[0], early[1], heading, then)
        tilt_late = law.feedback(late[0], late[1], heading, later)
        thrust = law.feedback(lifted[0], lifted[1], heading, above)[2]

        before = guards.applied[2] + trim[2] + share * self._observers.pushed[2]
        asked = law.within(thrust - law.mass * before)
        soon = tilted[:2] + ahead * rates[:2]
        voltage = np.where(states.battery_voltage > 0.0, states.battery_voltage, self._nominal)
        here = states.position, states.velocity, states.height
        rows = np.array(
            [
                _features(early, tilted[:2], heading, asked, voltage, guards.wants_yaw),
                _features(late, soon, heading, asked, voltage, guards.wants_yaw),
                _features(lifted, zeta[:2] + lift * rates[:2], heading, asked, voltage, guards.wants_yaw),
                _features(here, zeta[:2], heading, acting, voltage, guards.wants_yaw),
            ]
        )
        measured = self._observers.beyond_linear(zeta, heading), self._observers.trust == 1.0
        applied, slope, raw, now = guards.step(rows, ahead, dt, states.height, *measured)
        pushed, pushing = self._observers.step(zeta, heading, now, dt)
        trim = trim + share * pushed
        slope = slope + pushing
        total = applied + trim
        led = total[:2] + share * slope / self._tilt_gain
        lifted_thrust = law.within(thrust - law.mass * total[2])
        attitude = law.tilted_by(tilt, led, lifted_thrust)
        after = law.tilted_by(tilt_late, led + ahead * slope, lifted_thrust)
        self._at_limit = law.at_limit(attitude)
        wanted = law.euler_rates(tilted, attitude, then.yaw)
        next_rates = law.euler_rates(np.array([soon[0], soon[1], yaw]), after, then.yaw)
        added = self._inverses.step((next_rates[:2] - wanted[:2]) / ahead, rate_lag, actuation[2], dt)
        wanted[:2] += added
        self._command = command = law.turning(zeta, wanted)
        self._observers.commanded(attitude[2])
        return Steps(plain[2], plain_rates, total, raw, command, law.normalised(attitude[2]), trim)

    def _ahead(self, states: States, acceleration: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, ...]:
        """Position and velocity (3, N) and height (N,) `h` (N,) s later; the height is that of the linear behaviour."""
        expected = self._behaviours.states
        position = states.position + h * states.velocity + (0.5 * h * h) * acceleration
        height = states.height - (states.position[2] - expected[2]) + h * expected[5]
        return position, states.velocity + h * acceleration, height

    def _faded(self, dt: float) -> np.ndarray:
        change = min(LONGEST_STEP, max(0.0, dt))
        self._share = np.minimum(self._share + change, np.maximum(self._share - change, self._guards.engaged))
        return self._share

    def _trimmed(
        self, states: States, zeta: np.ndarray, heading: Heading, reference: References, dt: float
    ) -> np.ndarray:
        """The trims (3, N) in m/s², heading frame, after this tick's distance to the linear behaviour."""
        behaviours, fresh = self._behaviours, self._fresh
        behaviours.step(reference, dt)
        behaviours.begin(fresh, states.position, states.velocity, zeta)
        c, s = heading
        gain = (self._share * min(LONGEST_STEP, dt)) * self._trim_gain
        along, across, up = gain * to_heading(c, s, states.position - behaviours.states[:3])
        grown = self._trim + np.array([c * along - s * across, s * along + c * across, up])
        grown = np.clip(grown, -self._most_trim, self._most_trim)
        self._trim = np.where(fresh | self._at_limit, self._trim, grown)
        self._fresh = np.zeros_like(fresh)
        return to_heading(c, s, self._share * self._trim)


def _features(
    then: tuple[np.ndarray, ...],
    tilt: np.ndarray,
    heading: Heading,
    thrust: np.ndarray,
    voltage: np.ndarray,
    wants_yaw: bool,
) -> np.ndarray:
    """Features (28) of the paper (F, N), in the order of `models.contract.FEATURES`."""
    _, velocity, height = then
    (cr, cp), (sr, sp) = np.cos(tilt), np.sin(tilt)
    u, v, w = to_heading(*heading, velocity)
    return np.array([height, cr, sr, cp, sp, u, v, w, voltage, thrust, *(heading if wants_yaw else ())])


def _euler_rates(zeta: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Rates of roll, pitch, yaw (3, N) of body rates (3, N) in rad/s."""
    (sr, sp), (cr, cp) = np.sin(zeta[:2]), np.cos(zeta[:2])
    p, q, r = body
    turning = (sr * q + cr * r) / np.maximum(0.2, cp)
    return np.array([p + sp * turning, cr * q - sr * r, turning])
