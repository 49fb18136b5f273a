"""The rigid body and its contact with the ground, in MuJoCo.  World ENU, body FLU, SI units."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from trueflight.models.errors import InputError
from trueflight.models.vehicle import GRAVITY, Vehicle

PHYSICS_STEP = 0.002
"""Time step of the physics, s (500 Hz)."""

ARENA = 400.0  # m, half the side of the ground plane
_FOOT_RADIUS_PER_ARM = 0.08
_LEG_PER_ARM = 0.45
_FRAME_PER_ARM = 0.35


def check_vehicle(vehicle: Vehicle) -> None:
    """Raise `InputError` where a vehicle file does not hold what a simulation needs."""
    where = vehicle.source or vehicle.name
    if len(vehicle.rotor_positions) != 4:
        raise InputError(
            f"{where}: {len(vehicle.rotor_positions)} rotor_positions; "
            "the simulation flies four rotors, give four"
        )
    ixx, iyy, izz = vehicle.inertia
    if min(vehicle.inertia) <= 0:
        raise InputError(
            f"{where}: inertia {list(vehicle.inertia)} must be three moments above 0 kg m^2 to simulate"
        )
    if ixx + iyy < izz or iyy + izz < ixx or izz + ixx < iyy:
        raise InputError(
            f"{where}: inertia {list(vehicle.inertia)} is no rigid body's: "
            "each moment is at most the sum of the other two"
        )
    if sum(vehicle.rotor_directions) != 0:
        raise InputError(
            f"{where}: rotor_directions must be two of each, or the rotors' drag torques do not cancel"
        )


def leg_length(vehicle: Vehicle) -> float:
    """Height of the centre of mass above the ground when the vehicle stands on its feet, m."""
    arm = max(math.hypot(x, y) for x, y, _ in vehicle.rotor_positions)
    lowest = min(z for _, _, z in vehicle.rotor_positions)
    return max(_LEG_PER_ARM * arm, -lowest + 2 * _FOOT_RADIUS_PER_ARM * arm)


def reach(vehicle: Vehicle) -> float:
    """Distance from the centre of mass to the farthest part that can touch the ground, m."""
    arm = max(math.hypot(x, y) for x, y, _ in vehicle.rotor_positions)
    foot = _FOOT_RADIUS_PER_ARM * arm
    frame = _FRAME_PER_ARM * arm
    return max(
        math.hypot(arm, leg_length(vehicle) - foot) + foot, math.sqrt(2.0 * frame**2 + (0.1 * arm) ** 2)
    )


def model_xml(vehicle: Vehicle) -> str:
    """The MJCF of a vehicle: one free body with its believed mass and inertia, four feet, and a ground
    plane.
    """
    arm = max(math.hypot(x, y) for x, y, _ in vehicle.rotor_positions)
    foot = _FOOT_RADIUS_PER_ARM * arm
    leg = leg_length(vehicle)
    feet = "\n".join(
        f'      <geom name="foot{i}" type="sphere" size="{foot:.6g}" pos="{x:.6g} {y:.6g} {foot - leg:.6g}"/>'
        for i, (x, y, _) in enumerate(vehicle.rotor_positions)
    )
    half = _FRAME_PER_ARM * arm
    inertia = " ".join(f"{moment:.9g}" for moment in vehicle.inertia)
    # A contact's damping must not push a light vehicle off the ground: one step's time constant is too stiff,
    # ten steps (20 ms) keep the legs' spring well below the physics rate.
    return f"""<mujoco model="{vehicle.name}">
  <option timestep="{PHYSICS_STEP}" integrator="Euler" gravity="0 0 {-GRAVITY}" cone="elliptic"/>
  <default><geom friction="0.9 0.005 0.0001" solref="0.02 1"/></default>
  <worldbody>
    <geom name="ground" type="plane" size="{ARENA} {ARENA} 1"/>
    <body name="vehicle" pos="0 0 {leg:.9g}">
      <freejoint name="free"/>
      <inertial pos="0 0 0" mass="{vehicle.mass:.9g}" diaginertia="{inertia}"/>
      <geom name="frame" type="box" size="{half:.6g} {half:.6g} {0.1 * arm:.6g}"/>
{feet}
    </body>
  </worldbody>
</mujoco>
"""


def _floats(array: np.ndarray) -> Any:
    """A view of an array that gives and takes plain floats, faster than numpy's own scalars."""
    return memoryview(array)  # type: ignore[arg-type]


class World:
    """MuJoCo's model and data of one vehicle, with the arrays bound once.

    `position` holds x, y, z (m, world) and the quaternion w, x, y, z; `velocity` holds the linear velocity
    (m/s, world) and the body rates (rad/s, body); `wrench` is the force (N, world) and torque (N m, body) for
    the next step. All three are views of MuJoCo's memory.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        check_vehicle(vehicle)
        self.model = mujoco.MjModel.from_xml_string(model_xml(vehicle))
        self.data = mujoco.MjData(self.model)
        self.standing_height = leg_length(vehicle)
        self.position = _floats(self.data.qpos)
        self.velocity = _floats(self.data.qvel)
        # A free joint's generalised force is the force in the world and the torque in the body.
        self.wrench = _floats(self.data.qfrc_applied)
        self._mass, self._inertia = float(self.model.body_mass[1]), self.model.body_inertia[1].copy()
        self._load, self._wrong = (0.0, 0.0), np.zeros(3)
        mujoco.mj_forward(self.model, self.data)

    def step(self) -> None:
        """Advance the physics by `PHYSICS_STEP` under the present `wrench`."""
        mujoco.mj_step(self.model, self.data)

    def place(
        self,
        position: tuple[float, float, float],
        yaw: float = 0.0,
        velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Put the vehicle level at a position (m, world) with a heading (rad) and a velocity (m/s, world)."""
        self.data.qpos[:] = (*position, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        self.data.qvel[:] = (*velocity, 0.0, 0.0, 0.0)
        mujoco.mj_forward(self.model, self.data)

    @property
    def touching(self) -> bool:
        """Whether any part of the vehicle touches the ground."""
        return bool(self.data.ncon)

    def load(self, mass: float, inertia: float) -> None:
        """The payload (kg, kg m² about every axis) is this one now, with its centre in the centre of mass; none: 0."""
        self._load = mass, inertia
        self._weigh()

    def spread(self, inertia: tuple[float, float, float]) -> None:
        """The vehicle's own moments (kg m²) are so much greater than its file says."""
        self._wrong = np.array(inertia)
        self._weigh()

    def unload(self) -> None:
        """The vehicle's own mass and inertia again."""
        self._load, self._wrong = (0.0, 0.0), np.zeros(3)
        self._weigh()

    def _weigh(self) -> None:
        mass, inertia = self._load
        self.model.body_mass[1] = self._mass + mass
        self.model.body_inertia[1] = self._inertia + inertia + self._wrong
        # What contacts derive from masses follows; the scratch data keeps the present state out of it.
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def energy(self) -> float:
        """Kinetic plus potential energy in J (potential zero at the ground)."""
        mass = float(self.model.body_mass[1])
        moments = [float(moment) for moment in self.model.body_inertia[1]]
        vx, vy, vz, p, q, r = map(float, self.velocity)
        turning = moments[0] * p * p + moments[1] * q * q + moments[2] * r * r
        return (
            0.5 * mass * (vx * vx + vy * vy + vz * vz)
            + 0.5 * turning
            + mass * GRAVITY * float(self.position[2])
        )
