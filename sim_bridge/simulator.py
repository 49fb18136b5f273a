"""One simulated vehicle: world, truth, sensors and inner loop, stepped together at the physics rate."""

from __future__ import annotations

from models.vehicle import Vehicle
from sim_bridge.rates import RateController
from sim_bridge.truth.airframe import Airframe, believed_powertrain
from sim_bridge.truth.hidden import Hidden, install
from sim_bridge.truth.sensors import Estimate, Noise, Sensors
from sim_bridge.world import PHYSICS_STEP, World

_STEP_US = round(PHYSICS_STEP * 1e6)


class Simulator:
    """A vehicle that follows a normalised collective command and body rates (rad/s, FLU).

    The setpoint reaches the inner loop after the powertrain's delay; the inner loop, the rotors and the rigid body
    advance by 2 ms a step. `time_us` is the vehicle's clock: simulated time.
    """

    def __init__(
        self, vehicle: Vehicle, hidden: tuple[Hidden, ...] = (), seed: int = 0, noise: Noise | None = None
    ) -> None:
        self.vehicle = vehicle
        self.world = World(vehicle)
        self.sensors = Sensors(Noise() if noise is None else noise, seed)
        powertrain, self.airframe = install(vehicle, hidden, believed_powertrain(vehicle), self.sensors, PHYSICS_STEP)
        self.rates = RateController(vehicle, PHYSICS_STEP)
        self.time_us = 0
        self.motors = [0.0, 0.0, 0.0, 0.0]
        steps = powertrain.delay / PHYSICS_STEP
        whole = int(steps)
        self._late = steps - whole  # share of a step's time in which the older setpoint still acts
        self._line = [(0.0, 0.0, 0.0, 0.0)] * (whole + 2)
        self._whole = whole
        self._cursor = 0
        self._speed_before = (0.0, 0.0, 0.0)
        self._estimate: Estimate | None = None

    def start_in_hover(
        self,
        position: tuple[float, float, float],
        yaw: float = 0.0,
        velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Begin in the air (position m, velocity m/s, world; yaw rad), level, with the rotors at hover speed."""
        self.world.place(position, yaw, velocity)
        hover = self.vehicle.hover_thrust
        self.airframe.spin(self.airframe.speed_of(hover))
        self._line = [(hover, 0.0, 0.0, 0.0)] * len(self._line)
        self._speed_before = velocity
        self._estimate = None

    def step(self, command: float, p: float, q: float, r: float) -> None:
        """One physics step with the rotors running under a collective command and body-rate setpoints."""
        line = self._line
        size = len(line)
        cursor = self._cursor = (self._cursor + 1) % size
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
        velocity = self.world.velocity
        self.motors = motors = self.rates.motors(c1, p1, q1, r1, velocity[3], velocity[4], velocity[5])
        self._advance(motors)

    def rest(self) -> None:
        """One physics step with the motors stopped (disarmed or killed)."""
        self.motors = [0.0, 0.0, 0.0, 0.0]
        self._cursor = (self._cursor + 1) % len(self._line)
        self._line[self._cursor] = (0.0, 0.0, 0.0, 0.0)
        self.rates.reset()
        self._advance(self.motors)

    def _advance(self, motors: list[float]) -> None:
        world = self.world
        velocity = world.velocity
        self._speed_before = (velocity[0], velocity[1], velocity[2])
        self.airframe.act(world.position, velocity, motors, world.wrench)
        world.step()
        self.time_us += _STEP_US
        self._estimate = None

    def estimate(self) -> Estimate:
        """What the vehicle believes of itself now; the same sample until the next step."""
        if self._estimate is None:
            world, m = self.world, self.airframe.motion
            position, velocity = world.position.tolist(), world.velocity.tolist()
            bx, by, bz = self._speed_before
            rotation = (m.r00, m.r01, m.r02, m.r10, m.r11, m.r12, m.r20, m.r21, m.r22)
            # Before the first step there is none to take the acceleration from: the vehicle stands or hovers.
            rate = 1.0 / PHYSICS_STEP if self.time_us else 0.0
            acceleration = ((velocity[0] - bx) * rate, (velocity[1] - by) * rate, (velocity[2] - bz) * rate)
            self._estimate = self.sensors.sample(
                self.time_us, position, velocity, acceleration, rotation, m.voltage, m.speeds
            )
        return self._estimate
