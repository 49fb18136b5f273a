"""The innermost loop: body rates to motor commands, as in PX4's rate controller and control allocation."""

from __future__ import annotations

import math

import numpy as np

from trueflight.models.vehicle import GRAVITY, Vehicle
from trueflight.sim_bridge.truth.airframe import believed_powertrain

IDLE_SHARE = 0.03
"""Lowest thrust of a running rotor, as a share of its hover thrust (PX4's PWM_MAIN_MIN keeps rotors
turning).
"""

# PX4's default MC_ROLLRATE_I over _P and MC_YAWRATE_I over _P, 1/s.
_INTEGRAL, _YAW_INTEGRAL = 0.2 / 0.15, 0.1 / 0.2

_YAW_HEADROOM = 0.15  # of a rotor's range that yaw may take from the collective, as PX4's MINIMUM_YAW_MARGIN


class Mixer:
    """Control allocation with what the owner believes: relative thrust and torque (N m, body FLU) to motor
    commands.

    Works in thrust relative to hover, so that a torque never changes the collective, whichever curve the
    vehicle file assumes between command and thrust. Saturation gives way in PX4's order: yaw first, then the
    collective, then roll and pitch.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        share = vehicle.weight / 4
        ratio = believed_powertrain(vehicle).torque_per_thrust
        rows = [
            (0.25, y * share, -x * share, -direction * ratio * share)
            for (x, y, _), direction in zip(vehicle.rotor_positions, vehicle.rotor_directions, strict=True)
        ]
        inverse = np.linalg.inv(np.array(rows).T)
        self.rows: tuple[tuple[float, float, float, float], ...] = tuple(
            (float(a), float(b), float(c), float(d)) for a, b, c, d in inverse
        )
        self.hover = vehicle.hover_thrust
        self.linear = vehicle.thrust_model == "linear"
        self.top = 1.0 / self.hover if self.linear else 1.0 / self.hover**2
        self.saturated = False

    def relative(self, command: float) -> float:
        """Believed thrust over hover thrust of a normalised collective command."""
        ratio = command / self.hover
        return ratio if self.linear else ratio * ratio

    def mix(self, collective: float, roll: float, pitch: float, yaw: float) -> list[float]:
        """Four motor commands, 0 to 1, for a thrust relative to hover and torques in N m."""
        (a0, b0, c0, d0), (a1, b1, c1, d1), (a2, b2, c2, d2), (a3, b3, c3, d3) = self.rows
        t0 = a0 * collective + b0 * roll + c0 * pitch + d0 * yaw
        t1 = a1 * collective + b1 * roll + c1 * pitch + d1 * yaw
        t2 = a2 * collective + b2 * roll + c2 * pitch + d2 * yaw
        t3 = a3 * collective + b3 * roll + c3 * pitch + d3 * yaw
        top = self.top
        low = IDLE_SHARE
        self.saturated = not (low <= t0 <= top and low <= t1 <= top and low <= t2 <= top and low <= t3 <= top)
        if self.saturated:
            t0, t1, t2, t3 = self.give_way(collective, roll, pitch, yaw)
        hover = self.hover
        if self.linear:
            return [hover * t0, hover * t1, hover * t2, hover * t3]
        return [hover * t0**0.5, hover * t1**0.5, hover * t2**0.5, hover * t3**0.5]

    def give_way(self, collective: float, roll: float, pitch: float, yaw: float) -> list[float]:
        """Relative thrusts of the motors where their range does not suffice for all that is asked."""
        low, top = IDLE_SHARE, self.top
        tilt = [b * roll + c * pitch for _, b, c, _ in self.rows]
        turn = [d * yaw for _, _, _, d in self.rows]
        span = max(tilt) - min(tilt)
        if span > top - low:
            tilt = [share * (top - low) / span for share in tilt]
        base = min(max(collective, low), top)
        # Too much asked: the collective gives way to roll and pitch.
        base = min(base, top - max(tilt))
        if base + min(tilt) < low:
            # Too little collective for that torque: PX4 without air mode weakens the torque and keeps the
            # thrust.
            base = max(base, low)
            room = base - low
            weaker = room / -min(tilt) if min(tilt) < 0 else 1.0
            tilt = [share * weaker for share in tilt]
        strongest = max(abs(share) for share in turn)
        if strongest > 0:
            # A little of the collective makes room for yaw at the top, then yaw takes what is left.
            crowded = base + max(tilt[i] + turn[i] for i in range(4)) - top
            if crowded > 0:
                give = min(crowded, _YAW_HEADROOM * top, max(base + min(tilt) - low, 0.0))
                base -= give
            weaker = 1.0
            for i in range(4):
                if turn[i] > 0:
                    weaker = min(weaker, (top - base - tilt[i]) / turn[i])
                elif turn[i] < 0:
                    weaker = min(weaker, (base + tilt[i] - low) / -turn[i])
            turn = [share * max(weaker, 0.0) for share in turn]
        return [min(max(base + tilt[i] + turn[i], low), top) for i in range(4)]


class RateController:
    """PID on body rates (rad/s, FLU) to torque (N m), tuned from the vehicle file as its owner would tune
    it.
    """

    def __init__(self, vehicle: Vehicle, dt: float) -> None:
        self.dt = dt
        self.mixer = Mixer(vehicle)
        ixx, iyy, izz = vehicle.inertia
        # Crossover well below the corner of rotor lag and half a control step; yaw has little authority.
        lag = vehicle.motor_time_constant + 1.5 * dt
        crossover = min(0.5 / lag, 25.0)
        arm = believed_powertrain(vehicle).torque_per_thrust
        yaw_acceleration = arm * vehicle.mass * GRAVITY / izz
        yaw_crossover = min(0.35 * crossover, 0.6 * yaw_acceleration)
        self.gains = (
            (crossover * ixx, _INTEGRAL * crossover * ixx, 0.006 * crossover * ixx),
            (crossover * iyy, _INTEGRAL * crossover * iyy, 0.006 * crossover * iyy),
            (yaw_crossover * izz, _YAW_INTEGRAL * yaw_crossover * izz, 0.0),
        )
        self.limits = (2.0 * crossover * ixx, 2.0 * crossover * iyy, 0.5 * yaw_acceleration * izz)
        self.smooth = 1.0 - math.exp(-2 * math.pi * 30.0 * dt)
        self.reset()

    def reset(self) -> None:
        """Forget integrals and slopes, as on the ground."""
        self._ip = self._iq = self._ir = 0.0
        self._dp = self._dq = 0.0
        self._p = self._q = 0.0

    def motors(
        self, command: float, p_set: float, q_set: float, r_set: float, p: float, q: float, r: float
    ) -> list[float]:
        """Motor commands for a normalised collective command and body-rate setpoints, at body rates p, q,
        r.
        """
        dt = self.dt
        (kp, ki, kd), (kp2, ki2, kd2), (kp3, ki3, _) = self.gains
        smooth = self.smooth
        dp = self._dp = self._dp + smooth * ((p - self._p) / dt - self._dp)
        dq = self._dq = self._dq + smooth * ((q - self._q) / dt - self._dq)
        self._p = p
        self._q = q
        ep, eq, er = p_set - p, q_set - q, r_set - r
        mixer = self.mixer
        motors = mixer.mix(
            mixer.relative(command),
            kp * ep + self._ip - kd * dp,
            kp2 * eq + self._iq - kd2 * dq,
            kp3 * er + self._ir,
        )
        if not mixer.saturated:
            # Comparisons instead of min and max: this runs 500 times a simulated second.
            lp, lq, lr = self.limits
            i = self._ip + ki * ep * dt
            self._ip = i if -lp < i < lp else (lp if i > 0 else -lp)
            i = self._iq + ki2 * eq * dt
            self._iq = i if -lq < i < lq else (lq if i > 0 else -lq)
            i = self._ir + ki3 * er * dt
            self._ir = i if -lr < i < lr else (lr if i > 0 else -lr)
        return motors
