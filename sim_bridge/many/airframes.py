"""Many airframes in air, as arrays: what `truth.airframe` and `truth.battery` compute for one vehicle."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from trueflight.sim_bridge.many.across import stacked
from trueflight.sim_bridge.many.laws import Laws
from trueflight.sim_bridge.truth.airframe import (
    AVIONICS_POWER,
    DISCHARGE_STEPS,
    MOTOR_EFFICIENCY,
    Airframe,
)
from trueflight.sim_bridge.truth.battery import CELL, CELL_CHARGE


class Airframes:
    """Rotors and batteries of N vehicles, each as its `Airframe` tells of powertrain, wind and what acts.

    `motion` (26, N) holds in rows what `truth.airframe.Motion` has: position, velocity in the world, velocity through
    the air in the body, body rates, rotation body to world, voltage, rotor speeds; all of the beginning of the last
    step. `wrench` (6, N) is the force in the world (N) and the torque in the body (N m).
    """

    def __init__(self, frames: Sequence[Airframe]) -> None:
        count = len(frames)
        self._frames = frames
        dt = frames[0].dt
        self.motion = np.zeros((26, count))
        self.motion[12:21] = np.eye(3).reshape(9, 1)
        self._voltage, self._speeds = self.motion[21], self.motion[22:]
        self.thrusts = np.zeros((4, count))
        self._body = np.zeros((6, count))
        self.wrench = np.zeros((6, count))
        trains = [frame.powertrain for frame in frames]
        vehicles = [frame.vehicle for frame in frames]
        self._hover_speed = np.array([train.hover_speed for train in trains])
        self._per_hover = 1.0 / np.array([train.hover_command for train in trains])
        blends = np.array([train.speed_blend for train in trains])
        self._blend = blends if blends.any() else None
        self._linear = np.array([train.linear for train in trains])
        taus = (train.time_constant for train in trains)
        self._follow = np.array([1.0 - math.exp(-dt / tau) if tau > 0 else 1.0 for tau in taus])
        ratios = np.array([train.torque_per_thrust for train in trains])
        self._power_per_speed = ratios / MOTOR_EFFICIENCY
        x, y, _ = stacked([vehicle.rotor_positions for vehicle in vehicles]).transpose(1, 0, 2)
        drag = stacked([vehicle.rotor_directions for vehicle in vehicles]) * ratios
        # Lift and torques (4) of each rotor's thrust (4).
        self._arms = np.stack([np.ones_like(x), y, -x, -drag])
        same = np.all(self._arms == self._arms[:, :, :1])
        self._same_arms = self._arms[:, :, 0].copy() if same else None
        self._battery = Batteries(frames)
        self._steps = 0
        self._products = np.empty((4, 4, count))
        self._turned, self._work4 = np.empty((3, 3, count)), np.empty((4, count))
        self._pair = np.empty((2, count))
        self.refresh()

    def refresh(self) -> None:
        """Take over what acts by now: thrust constants, wind, formulas."""
        frames = self._frames
        self._constants = stacked([frame.powertrain.thrust_constants for frame in frames])
        wind = stacked([frame.wind for frame in frames])
        self._wind = wind if wind.any() else None
        self._turbulent = [(i, t) for i, frame in enumerate(frames) if (t := frame.turbulence) is not None]
        before = getattr(self, "_rotor_laws", None), getattr(self, "_body_laws", None)
        self._rotor_laws = Laws([frame.rotor_laws for frame in frames], self.motion, self.thrusts, before[0])
        self._body_laws = Laws([frame.body_laws for frame in frames], self.motion, self.thrusts, before[1])

    def hover(self, speeds: np.ndarray) -> None:
        """Set all rotors of each vehicle to a speed (N,) in rad/s, and the batteries under that load."""
        self._speeds[:] = speeds
        power = self._constants.sum(axis=0) * speeds**3 * self._power_per_speed
        self._voltage[:] = self._battery.load(power + AVIONICS_POWER)

    def act(self, position: np.ndarray, velocity: np.ndarray, commands: np.ndarray) -> np.ndarray:
        """Advance rotors by one step; `wrench` (6, N) of that step.

        `position` (7, N) and `velocity` (6, N) as in `Bodies`, `commands` (4, N) the motors' commands, 0 to 1.
        """
        motion, body, wrench = self.motion, self._body, self.wrench
        motion[:3] = position[:3]
        motion[3:6] = velocity[:3]
        motion[9:12] = velocity[3:]
        rotation = motion[12:21]
        self._rotate(position[3:], rotation)
        r = rotation.reshape(3, 3, -1)
        air = velocity[:3] if self._wind is None else velocity[:3] - self._wind
        if self._turbulent:
            air = air.copy()
            for i, turbulence in self._turbulent:
                air[:, i] -= turbulence.step()
        np.multiply(r, air[:, None], out=self._turned)
        np.add.reduce(self._turned, axis=0, out=motion[6:9])

        self._turn_rotors(commands)
        self._rotor_laws.on_rotors()
        if self._same_arms is not None:
            np.matmul(self._same_arms, self.thrusts, out=body[2:])
        else:
            np.multiply(self._arms, self.thrusts, out=self._products)
            np.add.reduce(self._products, axis=1, out=body[2:])
        body[:2] = 0.0
        self._body_laws.on_body(body)
        np.multiply(r, body[:3], out=self._turned)
        np.add.reduce(self._turned, axis=1, out=wrench[:3])
        wrench[3:] = body[3:]
        return wrench

    def _rotate(self, quaternion: np.ndarray, out: np.ndarray) -> None:
        """Rotations (9, N), row by row, of quaternions (4, N)."""
        w, x, y, _ = quaternion
        doubled = np.add(quaternion, quaternion, out=self._work4)
        _, twice_x, twice_y, twice_z = doubled
        one, other = self._pair
        for first, second, plus, minus in (
            ((x, twice_y), (w, twice_z), 3, 1),
            ((x, twice_z), (w, twice_y), 2, 6),
            ((y, twice_z), (w, twice_x), 7, 5),
        ):
            np.multiply(*first, out=one)
            np.multiply(*second, out=other)
            np.add(one, other, out=out[plus])
            np.subtract(one, other, out=out[minus])
        doubled *= quaternion
        _, xx, yy, zz = doubled
        for row, first_square, second_square in ((0, yy, zz), (4, xx, zz), (8, xx, yy)):
            np.subtract(1.0, first_square, out=out[row])
            out[row] -= second_square

    def _turn_rotors(self, commands: np.ndarray) -> None:
        target = commands * self._per_hover
        if self._linear.all():
            root = np.sqrt(target)
            if self._blend is not None:
                target -= root
                target *= self._blend
                target += root
            else:
                target = root
        elif self._blend is not None or self._linear.any():
            root = np.sqrt(target)
            believed, other = np.where(self._linear, (root, target), (target, root))
            target = believed if self._blend is None else believed + self._blend * (other - believed)
        target *= self._hover_speed
        target -= self._speeds
        target *= self._follow
        middle = np.multiply(target, 0.5, out=self._work4)
        middle += self._speeds
        self._speeds += target
        thrusts = np.multiply(middle, middle, out=self.thrusts)
        thrusts *= self._constants
        middle *= thrusts
        power = middle[0] + middle[1]
        power += middle[2]
        power += middle[3]
        power *= self._power_per_speed
        power += AVIONICS_POWER
        self._voltage[:] = self._battery.load(power)
        self._steps += 1
        if self._steps % DISCHARGE_STEPS == 0:
            self._battery.discharge(DISCHARGE_STEPS * self._frames[0].dt)


class Batteries:
    """The batteries of N vehicles, as `truth.battery.Battery`."""

    def __init__(self, frames: Sequence[Airframe]) -> None:
        cells = [frame.powertrain.battery for frame in frames]
        self._volts = np.array([cell.volts_per_cell_volt for cell in cells])
        self._capacity = np.array([cell.capacity for cell in cells])
        self._resistance = np.array([cell.resistance for cell in cells])
        self._slow_resistance = np.array([cell.polarisation_resistance for cell in cells])
        self._slow_time = np.array([cell.polarisation_time for cell in cells])
        self._charge = np.array([cell.charge for cell in cells])
        self._polarisation = np.zeros(len(cells))
        self._current = np.zeros(len(cells))
        self._settle()

    def load(self, power: np.ndarray) -> np.ndarray:
        """Terminal voltages (N,), V, when the consumers draw `power` (N,) W now."""
        discriminant = power * self._four_resistances
        np.subtract(self._source_squared, discriminant, out=discriminant)
        # Half the source's voltage where a battery cannot give that power.
        np.maximum(discriminant, 0.0, out=discriminant)
        voltage = np.sqrt(discriminant, out=discriminant)
        voltage += self._source
        voltage *= 0.5
        self._voltage = voltage
        return voltage

    def discharge(self, dt: float) -> None:
        """Let the present currents flow for `dt` s."""
        current = (self._source - self._voltage) / self._resistance
        self._charge = np.maximum(self._charge - current * dt / self._capacity, 0.0)
        self._polarisation += (current * self._slow_resistance - self._polarisation) * dt / self._slow_time
        self._settle()

    def _settle(self) -> None:
        charge = np.clip(self._charge, 0.0, 1.0)
        self._source = self._volts * np.interp(charge, CELL_CHARGE, CELL) - self._polarisation
        self._source_squared = self._source * self._source
        self._four_resistances = 4.0 * self._resistance
