"""Many rigid bodies: MuJoCo's semi-implicit Euler step in free flight as arrays, MuJoCo itself near the ground."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from trueflight.models.vehicle import GRAVITY, Vehicle
from trueflight.sim_bridge.world import PHYSICS_STEP, World, check_vehicle, leg_length, reach

_MARGIN = 0.001  # m above the height from which a part of a vehicle may touch the ground


class Load:
    """One of many bodies, for what may be fixed to it in flight; the seam is that of `World.load`."""

    def __init__(self, bodies: Bodies, index: int) -> None:
        self._bodies, self._index = bodies, index

    def load(self, mass: float, inertia: float) -> None:
        """The payload (kg, kg m² about every axis) of this body is this one now."""
        self._bodies.load(self._index, mass, inertia)

    def spread(self, inertia: tuple[float, float, float]) -> None:
        """This body's own moments (kg m²) are so much greater than believed."""
        self._bodies.spread(self._index, inertia)


class Bodies:
    """Rigid bodies of N vehicles, world ENU, body FLU, SI units.

    `position` (7, N) holds x, y, z and the quaternion w, x, y, z; `velocity` (6, N) the linear velocity in the world
    and the body rates; `touching` (N,) whether any part of a vehicle touches the ground. A body that may touch it is
    stepped by MuJoCo with its contacts; all others by the same step in free flight.
    """

    def __init__(self, vehicles: Sequence[Vehicle]) -> None:
        for vehicle in set(vehicles):
            check_vehicle(vehicle)
        count = len(vehicles)
        self._vehicles = vehicles
        self.position = np.zeros((7, count))
        self.velocity = np.zeros((6, count))
        self.touching = np.zeros(count, dtype=bool)
        self.standing_height = np.array([leg_length(vehicle) for vehicle in vehicles])
        known: dict[Vehicle, World] = {}
        models = [known.setdefault(v, known.get(v) or World(v)).model for v in vehicles]
        # MuJoCo's own numbers: its file format has rounded those of the vehicle file.
        self._mass = np.array([float(model.body_mass[1]) for model in models])
        self._inertia = np.array([model.body_inertia[1] for model in models]).T.copy()
        self._near = np.array([reach(vehicle) for vehicle in vehicles]) + _MARGIN
        self._worlds: dict[int, World] = {}
        self._payloads: dict[int, tuple[float, float]] = {}
        self._wrong: dict[int, tuple[float, float, float]] = {}
        self._work3, self._turned, self._square = (
            np.empty((3, count)),
            np.empty((4, count)),
            np.empty((4, count)),
        )
        self._part = np.empty(count)
        self._weigh()

    def place(self, index: int, position: tuple[float, float, float], yaw: float) -> None:
        """Put one vehicle level and at rest at a position (m, world) with a heading (rad)."""
        self.position[:, index] = (*position, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        self.velocity[:, index] = 0.0
        self.touching[index] = False

    def load(self, index: int, mass: float, inertia: float) -> None:
        """The payload (kg, kg m² about every axis) of one vehicle is this one now."""
        before, moments = self._payloads.get(index, (0.0, 0.0))
        self._payloads[index] = mass, inertia
        self._mass[index] += mass - before
        self._inertia[:, index] += inertia - moments
        self._weigh()
        if index in self._worlds:
            self._worlds[index].load(mass, inertia)

    def spread(self, index: int, inertia: tuple[float, float, float]) -> None:
        """One vehicle's own moments (kg m²) are so much greater than believed."""
        self._inertia[:, index] += np.subtract(inertia, self._wrong.get(index, (0.0, 0.0, 0.0)))
        self._wrong[index] = inertia
        self._weigh()
        if index in self._worlds:
            self._worlds[index].spread(inertia)

    def step(self, wrench: np.ndarray) -> None:
        """Advance by `PHYSICS_STEP` under `wrench` (6, N): force (N, world) and torque (N m, body)."""
        low = self.position[2] < self._near
        near = np.flatnonzero(low) if low.any() else None
        if near is not None:
            before = self.position[:, near], self.velocity[:, near]
        self._fly(wrench)
        if near is None:
            if self.touching.any():
                self.touching[:] = False
            return
        self.touching[:] = False
        for i, position, velocity in zip(near.tolist(), before[0].T, before[1].T, strict=True):
            self._touch(i, position, velocity, wrench[:, i])

    def _weigh(self) -> None:
        x, y, z = self._inertia
        self._per_mass = PHYSICS_STEP / self._mass
        self._per_inertia = PHYSICS_STEP / self._inertia
        self._coupling = np.array([z - y, x - z, y - x])

    def _fly(self, wrench: np.ndarray) -> None:
        """A step of free flight: velocity first, then position with the new velocity."""
        position, velocity, work = self.position, self.velocity, self._work3
        p, q, r = turning = velocity[3:]
        np.multiply(q, r, out=work[0])
        np.multiply(r, p, out=work[1])
        np.multiply(p, q, out=work[2])
        work *= self._coupling
        np.subtract(wrench[3:], work, out=work)
        work *= self._per_inertia
        turning += work
        np.multiply(wrench[:3], self._per_mass, out=work)
        velocity[:3] += work
        velocity[2] -= PHYSICS_STEP * GRAVITY
        np.multiply(velocity[:3], PHYSICS_STEP, out=work)
        position[:3] += work

        np.multiply(turning, turning, out=work)
        square = work[0] + work[1]
        square += work[2]
        square *= 0.25 * PHYSICS_STEP**2  # of half the angle turned
        share, cosine = _half_turn(square)
        a, b, c = np.multiply(turning, share, out=work)
        w, x, y, z = position[3:]
        # The quaternion times (cosine, a, b, c).
        turned = self._turned
        part = self._part
        for out, scaled, added, taken in (
            (turned[0], w, (), ((x, a), (y, b), (z, c))),
            (turned[1], x, ((w, a), (y, c)), ((z, b),)),
            (turned[2], y, ((w, b), (z, a)), ((x, c),)),
            (turned[3], z, ((w, c), (x, b)), ((y, a),)),
        ):
            np.multiply(scaled, cosine, out=out)
            for q, by in added:
                out += np.multiply(q, by, out=part)
            for q, by in taken:
                out -= np.multiply(q, by, out=part)
        np.multiply(turned, turned, out=self._square)
        norm = np.add.reduce(self._square, axis=0, out=part)
        np.sqrt(norm, out=norm)
        np.divide(turned, norm, out=position[3:])

    def _touch(self, index: int, position: np.ndarray, velocity: np.ndarray, wrench: np.ndarray) -> None:
        """A step of one vehicle by MuJoCo, from the state before the step."""
        world = self._worlds.get(index)
        if world is None:
            world = self._worlds[index] = World(self._vehicles[index])
            if index in self._payloads:
                world.load(*self._payloads[index])
            if index in self._wrong:
                world.spread(self._wrong[index])
        data = world.data
        data.qpos[:] = position
        data.qvel[:] = velocity
        data.qfrc_applied[:] = wrench
        world.step()
        self.position[:, index] = data.qpos
        self.velocity[:, index] = data.qvel
        self.touching[index] = world.touching


def _half_turn(square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """sin(h) / rate and cos(h) of half the angle h = rate PHYSICS_STEP / 2 turned in a step, given h² (N,).

    By their series, whose next term is below a float's last digit up to 50 rad/s.
    """
    if square.max() > 0.05**2:
        half = np.sqrt(square)
        return (0.5 * PHYSICS_STEP) * np.sinc(half / np.pi), np.cos(half)
    share = square * (-1.0 / 5040.0)
    share += 1.0 / 120.0
    share *= square
    share -= 1.0 / 6.0
    share *= square
    share += 1.0
    share *= 0.5 * PHYSICS_STEP
    cosine = square * (1.0 / 40320.0)
    cosine -= 1.0 / 720.0
    cosine *= square
    cosine += 1.0 / 24.0
    cosine *= square
    cosine -= 0.5
    cosine *= square
    cosine += 1.0
    return share, cosine
