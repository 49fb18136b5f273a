"""The linear cascade of many vehicles, as arrays: `companion.law.control` for one of them has sources and reasons."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trueflight.companion.law.control import ControlLaw
from trueflight.models.vehicle import GRAVITY
from trueflight.sim_bridge.many.across import stacked
from trueflight.sim_bridge.many.courses import References


@dataclass(frozen=True)
class States:
    """What the loops need to know of N vehicles, as `companion.law.control.State` of one: vectors (3, N), `quaternion`
    (4, N), `height` and `battery_voltage` (N,); position in the home frame."""

    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    height: np.ndarray
    battery_voltage: np.ndarray
    angular_velocity: np.ndarray
    specific_force: np.ndarray

    def part(self, where: np.ndarray) -> States:
        """Those of some vehicles."""
        return States(
            self.position[:, where],
            self.velocity[:, where],
            self.quaternion[:, where],
            self.height[where],
            self.battery_voltage[where],
            self.angular_velocity[:, where],
            self.specific_force[:, where],
        )


@dataclass(frozen=True)
class Steps:
    """One tick of N control laws, as `companion.law.control.ControlStep`: thrusts (N,) in N, rates (3, N) in rad/s,
    corrections (3, N) in m/s², heading frame; `thrust_command` (N,) is normalised."""

    feedback_thrust: np.ndarray
    feedback_rate: np.ndarray
    correction: np.ndarray
    correction_raw: np.ndarray
    body_rate: np.ndarray
    thrust_command: np.ndarray
    trim: np.ndarray

    @staticmethod
    def plain(thrust: np.ndarray, rate: np.ndarray, command: np.ndarray) -> Steps:
        """Of a cascade that nothing corrects."""
        nothing = np.zeros_like(rate)
        return Steps(thrust, rate, nothing, nothing, rate, command, nothing)


def euler(quaternion: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw (3, N) in rad of unit quaternions (4, N)."""
    w, x, y, z = quaternion
    return np.array(
        [
            np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
            np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0)),
            np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
        ]
    )


def to_heading(c: np.ndarray, s: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors (3, N) of the world in heading frames of cosine `c` and sine `s` of the yaw (N,)."""
    x, y, z = vector
    return np.array([c * x + s * y, c * y - s * x, z])


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Angles in rad, -pi to pi."""
    turned: np.ndarray = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return turned


class Cascades:
    """The cascades of N vehicles, each with its own design, vehicle and limits."""

    def __init__(self, laws: Sequence[ControlLaw]) -> None:
        vehicles = [law.vehicle for law in laws]
        self.k_eta = stacked([law.design.K_eta for law in laws])
        self.k_zeta = stacked([law.design.K_zeta for law in laws])
        self.mass = np.array([vehicle.mass for vehicle in vehicles])
        self.weight = np.array([vehicle.weight for vehicle in vehicles])
        limits = [law.limits for law in laws]
        self._tilt = np.array([one.tilt for one in limits])
        rates = [(one.body_rate, one.body_rate, one.yaw_rate) for one in limits]
        self._rates = stacked(rates)
        thrusts = np.array([law.thrust_limits for law in laws]).T
        self._thrust_low, self._thrust_high = thrusts[0].copy(), thrusts[1].copy()
        self._hover = np.array([vehicle.hover_thrust for vehicle in vehicles])
        self._linear = np.array([vehicle.thrust_model == "linear" for vehicle in vehicles])

    def feedback(
        self,
        position: np.ndarray,
        velocity: np.ndarray,
        heading: tuple[np.ndarray, np.ndarray],
        reference: References,
        gains: np.ndarray | None = None,
        more: np.ndarray | None = None,
    ) -> np.ndarray:
        """Position loop: roll, pitch (rad) and thrust (N), (3, N), within the limits; `heading` cosine and sine of yaw.

        `gains` (3, 6, N) replace `K_eta`; `more` (3, N) is added to what they give.
        """
        c, s = heading
        eta = np.concatenate(
            (
                to_heading(c, s, position - reference.position),
                to_heading(c, s, velocity - reference.velocity),
            )
        )
        ax, ay, az = reference.acceleration
        asked = -np.add.reduce((self.k_eta if gains is None else gains) * eta, axis=1)
        asked[0] -= (c * ay - s * ax) / GRAVITY
        asked[1] += (c * ax + s * ay) / GRAVITY
        asked[2] += self.weight + self.mass * az
        if more is not None:
            asked += more
        return self.limited(asked)

    def tilted_by(self, attitude: np.ndarray, delta: np.ndarray, thrust: np.ndarray) -> np.ndarray:
        """(22): attitude (3, N) with another thrust (N,), tilted against error accelerations (2, N) in m/s², heading
        frame, within the limits."""
        return self.limited(
            np.array([attitude[0] + delta[1] / GRAVITY, attitude[1] - delta[0] / GRAVITY, thrust])
        )

    def within(self, thrust: np.ndarray) -> np.ndarray:
        """Thrusts (N,) in N within what the vehicles should give."""
        given: np.ndarray = np.minimum(np.maximum(thrust, self._thrust_low), self._thrust_high)
        return given

    def euler_rates(self, zeta: np.ndarray, attitude: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        """(13): rates of roll, pitch, yaw (3, N) that take `zeta` (3, N) to the attitude and yaw (N,) asked for."""
        error = np.array([zeta[0] - attitude[0], zeta[1] - attitude[1], wrapped(zeta[2] - yaw)])
        rates: np.ndarray = -np.add.reduce(self.k_zeta * error, axis=1)
        return rates

    def turning(self, zeta: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Body rates (3, N) that give these rates of roll, pitch, yaw (3, N) at `zeta` (3, N), limited."""
        rate_x, rate_y, rate_z = rates
        (sr, sp), (cr, cp) = np.sin(zeta[:2]), np.cos(zeta[:2])
        turning = np.array(
            [
                rate_x - sp * rate_z,
                cr * rate_y + sr * cp * rate_z,
                -sr * rate_y + cr * cp * rate_z,
            ]
        )
        limited: np.ndarray = np.minimum(np.maximum(turning, -self._rates), self._rates)
        return limited

    def at_limit(self, attitude: np.ndarray) -> np.ndarray:
        """Whether (N,) the limits leave no more of tilt or thrust than this attitude (3, N)."""
        roll, pitch, thrust = attitude
        tilted = np.hypot(roll, pitch) >= 0.999 * self._tilt
        reached: np.ndarray = tilted | ~((self._thrust_low < thrust) & (thrust < self._thrust_high))
        return reached

    def normalised(self, thrust: np.ndarray) -> np.ndarray:
        """Normalised collective commands (N,) believed to give thrusts (N,) in N."""
        ratio = thrust / self.weight
        if not self._linear.all():
            ratio = np.where(self._linear, ratio, np.copysign(np.sqrt(np.abs(ratio)), ratio))
        command: np.ndarray = np.clip(self._hover * ratio, 0.0, 1.0)
        return command

    def limited(self, attitude: np.ndarray) -> np.ndarray:
        """Roll, pitch and thrust (3, N) within the limits; changes what it is given."""
        tilt = np.hypot(attitude[0], attitude[1])
        if (tilt > self._tilt).any():
            attitude[:2] *= np.where(tilt > self._tilt, self._tilt / np.maximum(tilt, 1e-12), 1.0)
        np.minimum(attitude[2], self._thrust_high, out=attitude[2])
        np.maximum(attitude[2], self._thrust_low, out=attitude[2])
        return attitude
