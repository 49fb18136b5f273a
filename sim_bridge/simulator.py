"""One simulated vehicle: world, truth, sensors and inner loop, stepped together at the physics rate."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from trueflight.models.frames import rotation_matrix
from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.rates import RateController
from trueflight.sim_bridge.truth.airframe import believed_powertrain
from trueflight.sim_bridge.truth.battery import FULL, BatteryState, in_state
from trueflight.sim_bridge.truth.hidden import Hidden
from trueflight.sim_bridge.truth.installation import after_takeoff, install
from trueflight.sim_bridge.truth.sensors import Estimate, Noise, Sensors
from trueflight.sim_bridge.world import PHYSICS_STEP, World

_STEP_US = round(PHYSICS_STEP * 1e6)
LEFT_GROUND = 0.05  # m above standing at which the time after take-off begins

Moment = tuple[
    int, list[float], list[float], tuple[float, float, float], tuple[float, ...], float, Sequence[float]
]
"""The arguments of `Sensors.sample`."""

_Setpoint = tuple[float, float, float, float]  # collective and body rates, or four motor commands


class Simulator:
    """A vehicle that follows a normalised collective command and body rates (rad/s, FLU), or four motor commands.

    The setpoint reaches the inner loop after the powertrain's delay; the inner loop, the rotors and the rigid
    body advance by 2 ms a step. `time_us` is the vehicle's clock: simulated time. `estimate` is what the vehicle
    itself knows, `reported` what a companion has been told of it.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        hidden: tuple[Hidden, ...] = (),
        seed: int = 0,
        noise: Noise | None = None,
        battery: BatteryState = FULL,
    ) -> None:
        self.vehicle = vehicle
        self.world = World(vehicle)
        # Bound once: looking these up in every step would cost as much as the inner loop.
        self._position, self._velocity, self._wrench = (
            self.world.position,
            self.world.velocity,
            self.world.wrench,
        )
        self._mj_step, self._model, self._data = mujoco.mj_step, self.world.model, self.world.data
        self.sensors = Sensors(Noise() if noise is None else noise, seed)
        believed = believed_powertrain(vehicle)
        believed = replace(believed, battery=in_state(believed.battery, battery))
        powertrain, self.airframe = install(vehicle, hidden, believed, self.sensors, PHYSICS_STEP)
        self.rates = RateController(vehicle, PHYSICS_STEP)
        self.time_us = 0
        self.motors = [0.0, 0.0, 0.0, 0.0]
        steps = powertrain.delay / PHYSICS_STEP
        whole = int(steps)
        self._late = steps - whole  # share of a step's time in which the older setpoint still acts
        self._line = [(0.0, 0.0, 0.0, 0.0)] * (whole + 2)
        self._whole = whole
        self._cursor = 0
        tau = powertrain.rate_filter
        self._filter = math.exp(-PHYSICS_STEP / tau) if tau > 0.0 else 0.0
        self._asked = (0.0, 0.0, 0.0)
        self._estimate: Estimate | None = None
        self._reported: Estimate | None = None
        # Samples on their way to the companion, oldest first; none are kept where it is told at once.
        late = round(self.sensors.delay / PHYSICS_STEP)
        self._underway: deque[Moment] | None = deque(maxlen=late + 1) if late else None
        if self._underway is not None:
            self._underway.append(self.moment())
        self._flying_steps = 0
        self._events = after_takeoff(hidden, vehicle, self.airframe, self.sensors)
        self._ahead = list(self._events)

    def start_in_hover(
        self,
        position: tuple[float, float, float],
        yaw: float = 0.0,
        velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Begin in the air (position m, velocity m/s, world; yaw rad), level, with the rotors at hover
        speed.
        """
        self.world.place(position, yaw, velocity)
        hover = self.vehicle.hover_thrust
        self.airframe.spin(self.airframe.speed_of(hover))
        self.motors = [hover] * 4
        self._line = [(hover, 0.0, 0.0, 0.0)] * len(self._line)
        # There is no step yet to take an acceleration from: none.
        motion = self.airframe.motion
        motion.vx, motion.vy, motion.vz = velocity
        self._estimate = self._reported = None
        if self._underway is not None:
            # It has hovered there for a while: the first sample to arrive is of time zero.
            size = self._underway.maxlen or 1
            still = self.moment()[1:]
            self.time_us = (size - 1) * _STEP_US
            self._underway.extend((i * _STEP_US, *still) for i in range(size))

    def step(self, command: float, p: float, q: float, r: float) -> None:
        """One physics step with the rotors running under a collective command and body-rate setpoints."""
        c1, p1, q1, r1 = self._delayed((command, p, q, r))
        if old := self._filter:
            p0, q0, r0 = self._asked
            self._asked = p1, q1, r1 = p1 + old * (p0 - p1), q1 + old * (q0 - q1), r1 + old * (r0 - r1)
        velocity = self._velocity.tolist()
        _, _, _, wx, wy, wz = velocity
        self.motors = motors = self.rates.motors(c1, p1, q1, r1, wx, wy, wz)
        self._turn(velocity, motors)

    def drive(self, motors: tuple[float, float, float, float]) -> None:
        """One physics step under the motor commands (0 to 1) of an autopilot outside, which has an inner loop of its
        own; the powertrain's delay acts on the commands.
        """
        self.motors = commands = list(self._delayed(motors))
        self._turn(self._velocity.tolist(), commands)

    def _delayed(self, setpoint: _Setpoint) -> _Setpoint:
        """Put a setpoint into the delay line and take out the one that acts in this step."""
        line = self._line
        cursor = self._cursor + 1
        if cursor == len(line):
            cursor = 0
        self._cursor = cursor
        line[cursor] = setpoint
        newer = cursor - self._whole
        late = self._late
        if not late:
            return line[newer]
        c1, p1, q1, r1 = line[newer]
        c0, p0, q0, r0 = line[newer - 1]
        return c1 + late * (c0 - c1), p1 + late * (p0 - p1), q1 + late * (q0 - q1), r1 + late * (r0 - r1)

    def _turn(self, velocity: list[float], motors: list[float]) -> None:
        """One physics step with the rotors under motor commands."""
        self.airframe.act(self._position.tolist(), velocity, motors, self._wrench)
        self._mj_step(self._model, self._data)
        self.time_us += _STEP_US
        self._estimate = None
        if self._underway is not None:
            self._underway.append(self.moment())
        if self._ahead:
            self._fly_on()

    def rest(self) -> None:
        """One physics step with the motors stopped (disarmed or killed)."""
        self.motors = [0.0, 0.0, 0.0, 0.0]
        self._cursor = (self._cursor + 1) % len(self._line)
        self._line[self._cursor] = (0.0, 0.0, 0.0, 0.0)
        self.rates.reset()
        self._asked = (0.0, 0.0, 0.0)
        world = self.world
        self.airframe.act(world.position.tolist(), world.velocity.tolist(), self.motors, world.wrench)
        world.step()
        self.time_us += _STEP_US
        self._estimate = None
        if self._underway is not None:
            self._underway.append(self.moment())
        if self._flying_steps:
            self._flying_steps = 0
            self._ahead = list(self._events)
            world.unload()
            self.airframe.restore()

    def estimate(self) -> Estimate:
        """What the vehicle believes of itself now; the same sample until the next step."""
        if self._estimate is None:
            self._estimate = self.sensors.sample(*self.moment())
        return self._estimate

    def reported(self) -> Estimate:
        """What a companion has been told last: the estimate as old as the sensors' delay, with its own time."""
        if self._underway is None:
            return self.estimate()
        moment = self._underway[0]
        if self._reported is None or self._reported.time_us != moment[0]:
            self._reported = self.sensors.sample(*moment)
        return self._reported

    def moment(self) -> Moment:
        """The truth now, as `Sensors.sample` takes it."""
        m = self.airframe.motion
        velocity = self._velocity.tolist()
        rate = 1.0 / PHYSICS_STEP
        ax, ay, az = (velocity[0] - m.vx) * rate, (velocity[1] - m.vy) * rate, (velocity[2] - m.vz) * rate
        if self.sensors.lever_arm is not None:
            bx, by, bz = self._swing(velocity, self.sensors.lever_arm)
            ax, ay, az = ax + bx, ay + by, az + bz
        return (
            self.time_us,
            self._position.tolist(),
            velocity,
            (ax, ay, az),
            (m.r00, m.r01, m.r02, m.r10, m.r11, m.r12, m.r20, m.r21, m.r22),
            m.voltage,
            tuple(m.speeds),
        )

    def _swing(self, velocity: list[float], arm: tuple[float, float, float]) -> tuple[float, float, float]:
        """Acceleration (world, m/s²) of a point of the body against its centre of mass, over the last step."""
        m = self.airframe.motion
        x, y, z = arm
        before = np.array([m.q * z - m.r * y, m.r * x - m.p * z, m.p * y - m.q * x])
        turned = np.array([[m.r00, m.r01, m.r02], [m.r10, m.r11, m.r12], [m.r20, m.r21, m.r22]])
        p, q, r = velocity[3:]
        after = np.array([q * z - r * y, r * x - p * z, p * y - q * x])
        now = rotation_matrix(np.array(self._position.tolist()[3:]))
        a, b, c = ((now @ after - turned @ before) / PHYSICS_STEP).tolist()
        return a, b, c

    def _fly_on(self) -> None:
        """Let happen what happens at a time after take-off; the clock starts when the vehicle leaves the
        ground.
        """
        if not self._flying_steps and self._position[2] < self.world.standing_height + LEFT_GROUND:
            return
        self._flying_steps += 1
        airborne = self._flying_steps * PHYSICS_STEP
        while self._ahead and self._ahead[0][0] <= airborne:
            self._ahead.pop(0)[1](self.world)
