"""Rotors on a frame in air: from motor commands and motion to the force and torque on the body.

Nominally it does what the owner of the vehicle believes: thrust follows the believed curve of the command
through the believed first-order lag of rotor speed, whatever the battery does, and the air does nothing.
Hidden effects change its numbers or act in `on_rotors` and `on_body`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np

from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.truth.battery import Battery, BatteryCell, battery_for
from trueflight.sim_bridge.truth.turbulence import Turbulence

AIR_DENSITY = 1.225
"""kg/m³ at sea level."""

_THRUST_COEFFICIENT = 0.1  # of a small fixed-pitch propeller: thrust = C_T rho n² D⁴
_DRAG_TORQUE_PER_DIAMETER = 0.07  # drag torque over thrust and diameter, likewise typical
MOTOR_EFFICIENCY = 0.75
AVIONICS_POWER = 3.0  # W
DISCHARGE_STEPS = 5  # the state of charge moves in minutes; it need not be integrated at the physics rate


@dataclass(frozen=True)
class Powertrain:
    """The numbers of the rotors and of what drives them. Rotors in the order of the vehicle's
    rotor_positions.

    `thrust_constants` in N s² (thrust over rotor speed squared), `torque_per_thrust` in m, `hover_speed` in
    rad/s. `speed_blend` is the share of the other curve in the map from command to rotor speed (0: as
    believed). `time_constant` of rotor speed, `delay` from setpoint to motors and `rate_filter`, the time constant
    of a filter on the commanded body rates, in s.
    """

    thrust_constants: tuple[float, float, float, float]
    torque_per_thrust: float
    hover_speed: float
    hover_command: float
    linear: bool
    speed_blend: float
    time_constant: float
    delay: float
    battery: BatteryCell
    rate_filter: float = 0.0


def believed_powertrain(vehicle: Vehicle) -> Powertrain:
    """A powertrain that agrees with the vehicle file."""
    share = vehicle.weight / 4
    diameter = 2 * vehicle.rotor_radius
    turns = math.sqrt(share / (_THRUST_COEFFICIENT * AIR_DENSITY * diameter**4))
    speed = 2 * math.pi * turns
    torque_per_thrust = _DRAG_TORQUE_PER_DIAMETER * diameter
    power = 4 * torque_per_thrust * share * speed / MOTOR_EFFICIENCY + AVIONICS_POWER
    constant = share / speed**2
    return Powertrain(
        thrust_constants=(constant, constant, constant, constant),
        torque_per_thrust=torque_per_thrust,
        hover_speed=speed,
        hover_command=vehicle.hover_thrust,
        linear=vehicle.thrust_model == "linear",
        speed_blend=0.0,
        time_constant=vehicle.motor_time_constant,
        delay=vehicle.command_delay,
        battery=battery_for(vehicle, power),
    )


class Motion:
    """What the air and the rotors meet, one step at a time; every number a plain float.

    `x, y, z` m in the world; `r00..r22` the rotation body to world; `vx, vy, vz` m/s in the world; `u, v, w`
    the velocity through the air in the body, m/s; `p, q, r` body rates, rad/s; `speeds` rad/s and `thrusts` N
    of the rotors; `wrench` the force (N) and torque (N m) in the body; `voltage` at the battery.
    """

    __slots__ = (
        *("x", "y", "z", "vx", "vy", "vz", "u", "v", "w", "p", "q", "r"),
        *("r00", "r01", "r02", "r10", "r11", "r12", "r20", "r21", "r22"),
        *("speeds", "thrusts", "wrench", "voltage"),
    )

    def __init__(self) -> None:
        self.x = self.y = self.z = self.vx = self.vy = self.vz = 0.0
        self.u = self.v = self.w = self.p = self.q = self.r = 0.0
        self.r00 = self.r11 = self.r22 = 1.0
        self.r01 = self.r02 = self.r10 = self.r12 = self.r20 = self.r21 = 0.0
        self.speeds = [0.0, 0.0, 0.0, 0.0]
        self.thrusts = [0.0, 0.0, 0.0, 0.0]
        self.wrench = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        self.voltage = 0.0


Act = Callable[[Motion], None]
Law = Callable[..., Act]
"""A formula, given its numbers; these may be floats, or arrays with one number for each of many vehicles, and so may
those of `Motion` then."""


@dataclass(frozen=True)
class Acting:
    """A formula that acts, with its numbers (floats, or tuples of them), so that many vehicles with the same one can be
    flown together; `many` is its form for arrays."""

    many: Law
    numbers: tuple[Any, ...]


def by_rotor(hubs: Sequence[Sequence[Any]]) -> tuple[np.ndarray, ...]:
    """Numbers of each rotor, floats or arrays (n,), as arrays (rotors, 1) or (rotors, n): x, y, z of hubs."""
    found = []
    for column in zip(*hubs, strict=True):
        rows = np.broadcast_arrays(*(np.atleast_1d(np.asarray(number, dtype=float)) for number in column))
        found.append(np.stack(rows))
    return tuple(found)


class Airframe:
    """The vehicle's rotors in air.

    `on_rotors` are called after the rotors' speeds are known and may change `motion.thrusts`; `on_body` are
    called last and add to `motion.wrench`; `rotor_laws` and `body_laws` tell what they are made of. `wind` is the air's
    mean velocity in the world, m/s, and `turbulence` what comes beside it.
    """

    def __init__(self, vehicle: Vehicle, powertrain: Powertrain, dt: float) -> None:
        self.vehicle = vehicle
        self.powertrain = powertrain
        self.dt = dt
        self.motion = Motion()
        self.battery = Battery(powertrain.battery)
        self.motion.voltage = self.battery.load(AVIONICS_POWER)
        self.wind = (0.0, 0.0, 0.0)
        self.turbulence: Turbulence | None = None
        self.on_rotors: list[Act] = []
        self.on_body: list[Act] = []
        self.rotor_laws: list[Acting] = []
        self.body_laws: list[Acting] = []
        self._arms = tuple(
            (x, y, direction * powertrain.torque_per_thrust)
            for (x, y, _), direction in zip(vehicle.rotor_positions, vehicle.rotor_directions, strict=True)
        )
        # Exact solution of the first-order lag over one step; a vehicle file may believe in no lag at all.
        tau = powertrain.time_constant
        self._follow = 1.0 - math.exp(-dt / tau) if tau > 0 else 1.0
        self._power_per_speed = powertrain.torque_per_thrust / MOTOR_EFFICIENCY
        self._steps = 0
        self.keep()

    def act_on_rotors(self, law: Law, *numbers: Any, many: Law | None = None) -> None:
        """Let a formula act on the rotors' thrusts; `many` where it has another form for arrays."""
        self.on_rotors.append(law(*numbers))
        self.rotor_laws.append(Acting(many or law, numbers))

    def act_on_body(self, law: Law, *numbers: Any, many: Law | None = None) -> None:
        """Let a formula act on the body's force and torque; `many` where it has another form for arrays."""
        self.on_body.append(law(*numbers))
        self.body_laws.append(Acting(many or law, numbers))

    def keep(self) -> None:
        """Remember what acts now as what acts at every take-off."""
        self._at_takeoff = self.powertrain, self.wind, len(self.on_rotors), len(self.on_body)

    def restore(self) -> None:
        """Undo what began in flight."""
        self.powertrain, self.wind, rotors, body = self._at_takeoff
        del self.on_rotors[rotors:], self.rotor_laws[rotors:], self.on_body[body:], self.body_laws[body:]

    def speed_of(self, command: float) -> float:
        """Rotor speed, rad/s, that a motor command (normalised) settles at."""
        train = self.powertrain
        ratio = command / train.hover_command
        if ratio <= 0.0:
            return 0.0
        believed, other = (ratio**0.5, ratio) if train.linear else (ratio, ratio**0.5)
        return train.hover_speed * (believed + train.speed_blend * (other - believed))

    def spin(self, speed: float) -> None:
        """Set all rotors to a speed (rad/s), and the battery under that load, to start a simulation in the air."""
        self.motion.speeds[:] = (speed,) * 4
        power = sum(self.powertrain.thrust_constants) * speed**3 * self._power_per_speed
        self.motion.voltage = self.battery.load(power + AVIONICS_POWER)

    def act(
        self, position: list[float], velocity: list[float], commands: list[float], wrench: memoryview[float]
    ) -> None:
        """Advance the rotors by one step and write force (world) and torque (body) of that step into
        `wrench`.

        `position` (x, y, z, quaternion) and `velocity` (linear, angular) are those of `World`; `commands` the
        four motor commands, 0 to 1.
        """
        m = self.motion
        m.x, m.y, m.z, qw, qx, qy, qz = position
        m.vx, m.vy, m.vz, m.p, m.q, m.r = vx, vy, vz, _, _, _ = velocity
        xx, yy, zz = 2.0 * qx * qx, 2.0 * qy * qy, 2.0 * qz * qz
        xy, xz, yz = 2.0 * qx * qy, 2.0 * qx * qz, 2.0 * qy * qz
        wx, wy, wz = 2.0 * qw * qx, 2.0 * qw * qy, 2.0 * qw * qz
        m.r00, m.r01, m.r02 = r00, r01, r02 = 1.0 - yy - zz, xy - wz, xz + wy
        m.r10, m.r11, m.r12 = r10, r11, r12 = xy + wz, 1.0 - xx - zz, yz - wx
        m.r20, m.r21, m.r22 = r20, r21, r22 = xz - wy, yz + wx, 1.0 - xx - yy
        wind = self.wind
        ax, ay, az = vx - wind[0], vy - wind[1], vz - wind[2]
        if self.turbulence is not None:
            gx, gy, gz = self.turbulence.step()
            ax, ay, az = ax - gx, ay - gy, az - gz
        m.u = r00 * ax + r10 * ay + r20 * az
        m.v = r01 * ax + r11 * ay + r21 * az
        m.w = r02 * ax + r12 * ay + r22 * az

        self._turn_rotors(commands)
        if self.on_rotors:
            for act in self.on_rotors:
                act(m)
        t0, t1, t2, t3 = m.thrusts
        (x0, y0, c0), (x1, y1, c1), (x2, y2, c2), (x3, y3, c3) = self._arms
        body = m.wrench
        body[0] = body[1] = 0.0
        body[2] = t0 + t1 + t2 + t3
        body[3] = y0 * t0 + y1 * t1 + y2 * t2 + y3 * t3
        body[4] = -(x0 * t0 + x1 * t1 + x2 * t2 + x3 * t3)
        # A rotor that turns counter-clockwise is braked clockwise by the air, and so is the body that holds
        # it.
        body[5] = -(c0 * t0 + c1 * t1 + c2 * t2 + c3 * t3)
        for act in self.on_body:
            act(m)
        fx, fy, fz, wrench[3], wrench[4], wrench[5] = body
        wrench[0] = r00 * fx + r01 * fy + r02 * fz
        wrench[1] = r10 * fx + r11 * fy + r12 * fz
        wrench[2] = r20 * fx + r21 * fy + r22 * fz

    def _turn_rotors(self, commands: list[float]) -> None:
        """Advance rotors and battery by one step: speeds, thrusts and voltage of `motion`."""
        train = self.powertrain
        constants = train.thrust_constants
        hover_speed, hover_command, blend = train.hover_speed, train.hover_command, train.speed_blend
        linear, follow = train.linear, self._follow
        speeds, thrusts = self.motion.speeds, self.motion.thrusts
        power = 0.0
        for i in (0, 1, 2, 3):
            ratio = commands[i] / hover_command
            if linear:
                target = sqrt(ratio)
                if blend:
                    target += blend * (ratio - target)
            else:
                target = ratio + blend * (sqrt(ratio) - ratio)
            before = speeds[i]
            change = follow * (hover_speed * target - before)
            speeds[i] = before + change
            # The mean speed of the step, so that the lag is the believed one and not half a step more.
            middle = before + 0.5 * change
            thrusts[i] = thrust = constants[i] * middle * middle
            power += thrust * middle
        self.motion.voltage = self.battery.load(power * self._power_per_speed + AVIONICS_POWER)
        self._steps += 1
        if self._steps % DISCHARGE_STEPS == 0:
            self.battery.discharge(DISCHARGE_STEPS * self.dt)
