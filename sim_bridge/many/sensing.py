"""The sensors and estimators of many vehicles, as arrays: the same draws as `truth.sensors` makes one by one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trueflight.models.vehicle import GRAVITY
from trueflight.sim_bridge.many.across import stacked
from trueflight.sim_bridge.many.airframes import Airframes
from trueflight.sim_bridge.many.bodies import Bodies
from trueflight.sim_bridge.truth.sensors import BLOCK, DRAWS, Sensors
from trueflight.sim_bridge.world import PHYSICS_STEP

_AT_A_TIME = 32  # samples whose draws are turned at a time, so that they are read one after the other


@dataclass(frozen=True)
class Estimates:
    """What N vehicles believe of themselves at one moment, as `truth.sensors.Estimate` says it of one: vectors (3, N),
    `quaternion` (4, N), `battery_voltage` (N,), `rotor_speed` (4, N); position from the world's origin."""

    time_us: int
    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    angular_velocity: np.ndarray
    specific_force: np.ndarray
    battery_voltage: np.ndarray
    rotor_speed: np.ndarray


class Sensing:
    """Samples all vehicles once a control tick, each from its own generator, as late as its `Sensors` say."""

    def __init__(
        self, sensors: Sequence[Sensors], bodies: Bodies, frames: Airframes, steps_per_tick: int
    ) -> None:
        self._sensors, self._bodies, self._frames = sensors, bodies, frames
        self._period_us = round(PHYSICS_STEP * 1e6) * steps_per_tick
        noises = [one.noise for one in sensors]
        white = ((n.position, n.velocity, 0.5 * n.attitude, n.gyroscope, n.accelerometer) for n in noises)
        self._white = np.repeat(stacked(list(white)), 3, axis=0).reshape(15, -1)
        slow = ((n.position_wander, n.velocity_wander, 0.5 * n.attitude_wander) for n in noises)
        self._slow = np.repeat(stacked(list(slow)), 3, axis=0).reshape(9, -1)
        self._voltage = np.array([n.voltage for n in noises])
        self._keep = np.array([math.exp(-self._period_us * 1e-6 / n.wander_time) for n in noises])
        self._kick = np.sqrt(1.0 - self._keep * self._keep)
        self._wander = stacked([one.wander for one in sensors])
        self._bias = stacked([one.accelerometer_bias for one in sensors])
        arms = [one.lever_arm for one in sensors]
        self._armed = np.flatnonzero([arm is not None for arm in arms])
        self._arms = (
            stacked([arm for arm in arms if arm is not None]) if len(self._armed) else np.zeros((3, 0))
        )
        self._samples = 0
        self._block = np.empty((len(sensors), BLOCK, DRAWS))
        self._turned = np.empty((_AT_A_TIME, DRAWS, len(sensors)))
        late = [round(one.delay / PHYSICS_STEP) for one in sensors]
        self._late = np.flatnonzero(late)
        """Vehicles whose companion is told late; `_past` (steps, 30, n) what they were, one row a step."""
        self._age = np.array(late)[self._late]
        self._past: np.ndarray | None = None
        self._step = 0

    def begin(self) -> None:
        """The vehicles have hovered as they are for a while."""
        if len(self._late):
            self._past = np.repeat(self._moments(self._late)[None], int(self._age.max()) + 1, axis=0)

    def stepped(self) -> None:
        """A physics step has been made."""
        if self._past is not None:
            self._step += 1
            self._past[self._step % len(self._past)] = self._moments(self._late)

    def sample(self) -> Estimates:
        """What the companions are told now; to be called once a tick."""
        moments = self._moments(None)
        if self._past is not None:
            rows = (self._step - self._age) % len(self._past)
            moments[:, self._late] = self._past[rows, :, np.arange(len(rows))].T
        draws = self._draws()
        if self._samples > 1:
            self._wander *= self._keep
            self._wander += self._kick * draws[:9]
        slow = self._slow * self._wander
        white = self._white * draws[9:24]
        position, velocity, force = moments[:3], moments[7:10], moments[13:16]
        force[2] += GRAVITY
        rotation = moments[16:25].reshape(3, 3, -1)
        return Estimates(
            (self._samples - 1) * self._period_us,
            position + white[:3] + slow[:3],
            velocity + white[3:6] + slow[3:6],
            _turned(moments[3:7], white[6:9] + slow[6:9]),
            moments[10:13] + white[9:12],
            np.add.reduce(rotation * force[:, None], axis=0) + self._bias + white[12:15],
            moments[25] + self._voltage * draws[24],
            moments[26:30],
        )

    def _moments(self, where: np.ndarray | None) -> np.ndarray:
        """The truth (30, n) of some vehicles, or of all: position and quaternion, velocity and rates, acceleration of
        where the accelerometer is (world), rotation, voltage, rotor speeds; as `Simulator.moment`."""
        bodies, motion = self._bodies, self._frames.motion
        if where is None:
            position, velocity = bodies.position, bodies.velocity
        else:
            position, velocity, motion = (
                bodies.position[:, where],
                bodies.velocity[:, where],
                motion[:, where],
            )
        out = np.concatenate(
            (position, velocity, (velocity[:3] - motion[3:6]) * (1.0 / PHYSICS_STEP), motion[12:])
        )
        if len(self._armed):
            _, here, armed = np.intersect1d(
                np.arange(position.shape[1]) if where is None else where, self._armed, True, True
            )
            if len(here):
                out[13:16, here] += _swing(out[:, here], motion[:, here], self._arms[:, armed])
        return out

    def _draws(self) -> np.ndarray:
        """Standard normal draws (25, N) of the next sample."""
        at = self._samples % BLOCK
        if at == 0:
            for row, one in zip(self._block, self._sensors, strict=True):
                row[:] = one.draw_block()
        if at % _AT_A_TIME == 0:
            end = BLOCK - at
            self._turned[:] = self._block[:, end - _AT_A_TIME : end].transpose(1, 2, 0)[::-1]
        self._samples += 1
        drawn: np.ndarray = self._turned[at % _AT_A_TIME]
        return drawn


def _swing(moments: np.ndarray, before: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """Acceleration (world, m/s²) over the last step of points of the bodies, `arm` (3, n) from the centres of mass."""
    now = _rotations(moments[3:7])
    then = before[12:21].reshape(3, 3, -1)
    after, earlier = _cross(moments[10:13], arm), _cross(before[9:12], arm)
    turned = np.add.reduce(now * after, axis=1) - np.add.reduce(then * earlier, axis=1)
    swung: np.ndarray = turned / PHYSICS_STEP
    return swung


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.cross(a, b, axis=0)


def _rotations(quaternion: np.ndarray) -> np.ndarray:
    """Rotations (3, 3, n), body to world, of quaternions (4, n)."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _turned(quaternion: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Small rotations (3, n) in the world of quaternions (4, n), then normalised."""
    qw, qx, qy, qz = quaternion
    ex, ey, ez = error
    turned = np.array(
        [
            qw - ex * qx - ey * qy - ez * qz,
            qx + ex * qw + ey * qz - ez * qy,
            qy + ey * qw + ez * qx - ex * qz,
            qz + ez * qw + ex * qy - ey * qx,
        ]
    )
    turned /= np.sqrt(np.add.reduce(turned * turned, axis=0))
    return turned
