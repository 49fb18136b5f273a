"""One simulated vehicle: world, truth, sensors and inner loop, stepped together at the physics rate."""

from __future__ import annotations

import mujoco

from models.vehicle import Vehicle
from sim_bridge.rates import RateController
from sim_bridge.truth.airframe import believed_powertrain
from sim_bridge.truth.hidden import Hidden, install
from sim_bridge.truth.sensors import Estimate, Noise, Sensors
from sim_bridge.world import PHYSICS_STEP, World

_STEP_US = round(PHYSICS_STEP * 1e6)


class Simulator:
    """A vehicle that follows a normalised collective command and body rates (rad/s, FLU).

    The setpoint reaches the inner loop after the powertrain's delay; the inner loop, the rotors and the rigid
    body advance by 2 ms a step. `time_us` is the vehicle's clock: simulated time.
    """

    def __init__(
        self, vehicle: Vehicle, hidden: tuple[Hidden, ...] = (), seed: int = 0, noise: Noise | None = None
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
        powertrain, self.airframe = install(
            vehicle, hidden, believed_powertrain(vehicle), self.sensors, PHYSICS_STEP
        )
        self.rates = RateController(vehicle, PHYSICS_STEP)
        self.time_us = 0
        self.motors = [0.0, 0.0, 0.0, 0.0]
        steps = powertrain.delay / PHYSICS_STEP
        whole = int(steps)
        self._late = steps - whole  # share of a step's time in which the older setpoint still acts
        self._line = [(0.0, 0.0, 0.0, 0.0)] * (whole + 2)
        self._whole = whole
        self._cursor = 0
        self._estimate: Estimate | None = None

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
        self._estimate = None

    def step(self, command: float, p: float, q: float, r: float) -> None:
        """One physics step with the rotors running under a collective command and body-rate setpoints."""
        line = self._line
        size = len(line)
        cursor = self._cursor + 1
        if cursor == size:
            cursor = 0
        self._cursor = cursor
        line[cursor] = (command, p, q, r)
        newer = cursor - self._whole
        c1, p1, q1, r1 = line[newer]
        late = self._late
        if late:
            c0, p0, q0, r0 = line[newer - 1]
            c1 += late * (c0 - c1)
            p1 += late * (p0 - p1)
            q1 += late * (q0 - q1)
            r1 += late * (r0 - r1)
        velocity = self._velocity.tolist()
        _, _, _, wx, wy, wz = velocity
        self.motors = motors = self.rates.motors(c1, p1, q1, r1, wx, wy, wz)
        self.airframe.act(self._position.tolist(), velocity, motors, self._wrench)
        self._mj_step(self._model, self._data)
        self.time_us += _STEP_US
        self._estimate = None

    def rest(self) -> None:
        """One physics step with the motors stopped (disarmed or killed)."""
        self.motors = [0.0, 0.0, 0.0, 0.0]
        self._cursor = (self._cursor + 1) % len(self._line)
        self._line[self._cursor] = (0.0, 0.0, 0.0, 0.0)
        self.rates.reset()
        world = self.world
        self.airframe.act(world.position.tolist(), world.velocity.tolist(), self.motors, world.wrench)
        world.step()
        self.time_us += _STEP_US
        self._estimate = None

    def estimate(self) -> Estimate:
        """What the vehicle believes of itself now; the same sample until the next step."""
        if self._estimate is None:
            world, m = self.world, self.airframe.motion
            position, velocity = world.position.tolist(), world.velocity.tolist()
            rotation = (m.r00, m.r01, m.r02, m.r10, m.r11, m.r12, m.r20, m.r21, m.r22)
            # Before the first step there is none to take the acceleration from: the vehicle stands or hovers.
            rate = 1.0 / PHYSICS_STEP if self.time_us else 0.0
            acceleration = (
                (velocity[0] - m.vx) * rate,
                (velocity[1] - m.vy) * rate,
                (velocity[2] - m.vz) * rate,
            )
            self._estimate = self.sensors.sample(
                self.time_us, position, velocity, acceleration, rotation, m.voltage, m.speeds
            )
        return self._estimate
