"""From a flight (or a table of features) to predicted acceleration, through a chain of effects.

Two readings of one motion: the specific force that acts, and, from each rotor's thrust, the torque on the body.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from array_api_compat import array_namespace

from trueflight.models.effect import Array, Effect, Motion, Stage
from trueflight.models.flight import Flight
from trueflight.models.frames import euler_from_quaternion, heading_from_world, rotation_matrix
from trueflight.models.lag import delayed, lagged
from trueflight.models.linear import hover_acceleration
from trueflight.models.vehicle import GRAVITY, Vehicle

Chain = Sequence[tuple[Effect, Mapping[str, Any]]]
"""Effects with parameter values, in the order in which they were added."""
Step = Callable[[Motion], Motion]
Take = Callable[[Motion, str, tuple[Any, ...], Step], Motion]
"""How a step of a chain is taken: the motion before it, its name and its numbers, and the step itself."""


def motion_of_flight(flight: Flight) -> Motion:
    """The flight as effects see it, before any of them acts. Needs `thrust_command`; other columns where present."""
    n = len(flight)
    command = flight.vehicle.thrust(flight.column("thrust_command")) / flight.vehicle.mass
    zero = np.zeros((n, 3))
    changes: dict[str, Any] = {}
    if flight.quaternion is not None:
        euler = euler_from_quaternion(flight.quaternion)
        yaw = euler[:, 2]
        body_to_world = rotation_matrix(flight.quaternion)
        c, s = np.cos(yaw), np.sin(yaw)
        rotation = by_column(body_to_world)
        rotation[:, 0] = c[:, None] * body_to_world[:, 0] + s[:, None] * body_to_world[:, 1]
        rotation[:, 1] = -s[:, None] * body_to_world[:, 0] + c[:, None] * body_to_world[:, 1]
        changes |= {"rotation": rotation, "euler": tuple(by_column(euler).T[:2]), "cos_yaw": c, "sin_yaw": s}
        if flight.velocity is not None:
            changes["air_velocity"] = by_column(heading_from_world(flight.velocity, yaw))
    if flight.position is not None:
        changes["height"] = flight.position[:, 2].copy()
    if flight.battery_voltage is not None:
        changes["voltage"] = flight.battery_voltage
    if flight.angular_velocity is not None:
        changes["body_rate"] = by_column(flight.angular_velocity)
        changes["body_acceleration"] = by_column(derivative(flight.angular_velocity, flight.t))
    if (thrust := rotor_thrust(flight)) is not None:
        changes |= {"rotor_thrust": thrust, "rotor_speed": flight.rotor_speed}
    return Motion(
        vehicle=flight.vehicle,
        dt=flight.dt,
        command=command,
        thrust=command,
        force=zero,
        reading=zero,
        tau=flight.vehicle.motor_time_constant,
        delay=flight.vehicle.command_delay,
        **changes,
    )


def by_column(array: np.ndarray) -> np.ndarray:
    """The same array (N, ...), each of its columns in one piece of memory: formulas go through them twice as fast."""
    return np.moveaxis(np.array(np.moveaxis(array, 0, -1), order="C"), -1, 0)


def derivative(column: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Central difference of a column (N, k) over `t` (N,) s that reaches across no gap."""
    period = float(np.median(np.diff(t)))
    edges = [0, *(np.flatnonzero(np.diff(t) > 3.0 * period) + 1).tolist(), len(t)]
    out = np.zeros_like(column)
    for start, stop in itertools.pairwise(edges):
        if stop - start > 1:
            out[start:stop] = np.gradient(column[start:stop], period, axis=0)
    return out


def rotor_thrust(flight: Flight) -> np.ndarray | None:
    """Thrust (N, 4) of each rotor in N as its speed tells, or else its motor command; None where the flight has
    neither.

    What thrust a rotor speed gives is not in a vehicle file: its mean over the flight is taken from the accelerometer's
    mean, or from the weight where there is none.
    """
    vehicle = flight.vehicle
    count = len(vehicle.rotor_positions)
    if flight.rotor_speed is not None and flight.rotor_speed.shape[1] == count:
        squares = np.nan_to_num(flight.rotor_speed) ** 2
    elif flight.motor_command is not None and flight.motor_command.shape[1] == count:
        squares = vehicle.thrust(np.nan_to_num(flight.motor_command)) / count
    else:
        return None
    flying = slice(None) if flight.flying is None else flight.flying
    mean = float(np.mean(squares[flying].sum(axis=1)))
    felt = 0.0
    if flight.specific_force is not None:
        felt = vehicle.mass * float(np.mean(flight.specific_force[flying, 2]))
    return squares * ((felt if felt > 0.0 else vehicle.weight) / mean) if mean > 0.0 else None


def motion_of_features(columns: Mapping[str, Array], vehicle: Vehicle) -> Motion:
    """The motion that effects see, from the features (28) of `models.contract`: `columns` (N,) by name, of a
    `vehicle`. Features have no history, so there is no delay and no lag."""
    thrust = columns["T"] / vehicle.mass
    xp = array_namespace(thrust)
    zero, one = 0.0 * thrust, 0.0 * thrust + 1.0
    cp, sp, ct, st = (columns[k] for k in ("cos_phi", "sin_phi", "cos_theta", "sin_theta"))
    rotation = xp.stack(
        [
            xp.stack([ct, st * sp, st * cp], axis=-1),
            xp.stack([zero, cp, -sp], axis=-1),
            xp.stack([-st, ct * sp, ct * cp], axis=-1),
        ],
        axis=1,
    )
    nothing = xp.stack([zero, zero, zero], axis=-1)
    return Motion(
        vehicle=vehicle,
        dt=0.0,
        command=thrust,
        thrust=thrust,
        force=nothing,
        reading=nothing,
        rotation=rotation,
        # beyond 90 degrees there is no hover to linearise
        euler=(xp.asin(xp.clip(sp, -1.0, 1.0)), xp.asin(xp.clip(st, -1.0, 1.0))),
        air_velocity=xp.stack([columns["vx"], columns["vy"], columns["vz"]], axis=-1),
        cos_yaw=columns.get("cos_psi", one),
        sin_yaw=columns.get("sin_psi", zero),
        height=columns["z"],
        voltage=columns["u_batt"],
    )


def at_once(motion: Motion, name: str, numbers: tuple[Any, ...], step: Step) -> Motion:
    """Takes a step of a chain."""
    return step(motion)


def apply_effects(motion: Motion, chain: Chain, take: Take = at_once) -> Motion:
    """The motion with the effects of `chain` acting, stage by stage."""
    motion = _up_to_the_air(motion, chain, take)
    return _with_effects(motion, chain, (Stage.FORCE, Stage.SENSOR), take)


def parts_of_force(motion: Motion, chain: Chain, take: Take = at_once) -> list[np.ndarray]:
    """What adds up to the specific force (N, 3) of the chain, body axes, m/s²: of the thrust, and of each effect on the
    forces and on the sensor. Those are taken from a motion without any other force: they have to be `separable`."""
    turned = [effect for effect, _ in chain if effect.stage in (Stage.ROTATION, Stage.REMAINDER)]
    if len(turned) == 1 and turned[0].exact_rotation:  # along the body's z axis, to there and back
        motion = _up_to_the_air(motion, chain, take, turned=False)
        thrust = take(motion, "thrust along z", (), lambda m: m.with_(force=_along_z(np.asarray(m.thrust))))
    else:
        motion = _up_to_the_air(motion, chain, take)
        thrust = take(motion, "thrust along the body", (), lambda m: m.with_(force=body_thrust(m)))
    found = [thrust.force]
    for effect, values in chain:
        if effect.stage in (Stage.FORCE, Stage.SENSOR):
            acted = take(motion, *named(effect, values))
            changed = ((acted.force, motion.force), (acted.reading, motion.reading))
            found += [after for after, before in changed if after is not before]
    return [np.asarray(part) for part in found]


def separable(effect: Effect, motion: Motion, values: Mapping[str, Any]) -> bool:
    """Whether what an effect does can be told apart from what others do: one on the air, the forces or the sensor must
    not ask for the acceleration by the thrust; one on the forces or the sensor adds to them what it adds to none, and
    does nothing else."""
    if effect.stage not in (Stage.AIR, Stage.FORCE, Stage.SENSOR):
        return True
    motion = _up_to_the_air(motion, (), at_once, turned=False)
    try:
        effect.apply(motion, values)
    except Exception:  # noqa: BLE001 - a user's formula may fail in any way where something is None
        return False
    if effect.stage is Stage.AIR:
        return True
    pushed = motion.with_(force=motion.force + 1.0, reading=motion.reading - 0.5)
    alone, beside = effect.apply(motion, values), effect.apply(pushed, values)
    for name, before in vars(motion).items():
        here = getattr(alone, name)
        if name in ("force", "reading"):
            added = getattr(beside, name) - getattr(pushed, name)
            if not np.allclose(here - before, added, rtol=1e-9, atol=1e-9, equal_nan=True):
                return False
        elif here is not before:
            return False
    return True


def _up_to_the_air(motion: Motion, chain: Chain, take: Take, turned: bool = True) -> Motion:
    """All stages from the command to the velocity of the air; thrust that is not `turned` has a magnitude alone."""
    motion = _with_effects(motion, chain, (Stage.COMMAND,), take)
    if motion.tau > 0.0 or motion.delay > 0.0:
        motion = take(motion, "actuation", (), _with_actuation)
    motion = _with_effects(motion, chain, (Stage.THRUST,), take)
    turned = turned and motion.euler is not None
    if turned:
        motion = take(motion, "linear thrust", (), _with_linear_thrust)
    if motion.torque is not None:
        motion = motion.with_(torque=rotor_torque(motion))
        motion = _with_effects(motion, chain, (Stage.TORQUE,), take)
    motion = _with_effects(motion, chain, (Stage.RATE,), take)
    # without attitude there is nothing to rotate: thrust is compared along the body's axis
    rotation = (Stage.ROTATION,) if turned else ()
    return _with_effects(motion, chain, (*rotation, Stage.REMAINDER, Stage.AIR), take)


def _with_effects(motion: Motion, chain: Chain, stages: Sequence[Stage], take: Take) -> Motion:
    for stage in stages:
        for effect, values in chain:
            if effect.stage is stage:
                motion = take(motion, *named(effect, values))
    return motion


def named(effect: Effect, values: Mapping[str, Any]) -> tuple[str, tuple[Any, ...], Step]:
    """An effect with its values as a step of a chain."""
    numbers = tuple(values.get(p.name) for p in effect.parameters)
    return effect.name, numbers, lambda motion: effect.apply(motion, values)


def _with_actuation(motion: Motion) -> Motion:
    """Delay and lag act on rotor speed, the root of thrust (a negative command stands still)."""
    speed = np.sqrt(np.clip(motion.command, 0.0, None))
    acting = lagged(delayed(speed, motion.delay, motion.dt), motion.tau, motion.dt) ** 2
    return motion.with_(command=acting, thrust=acting)


def _with_linear_thrust(motion: Motion) -> Motion:
    return motion.with_(thrust_acceleration=linear_thrust(motion))


def linear_thrust(motion: Motion) -> Array:
    """What the hover linearisation makes of the thrust: heading-frame acceleration plus gravity, (N, 3), m/s²."""
    assert motion.euler is not None
    xp = array_namespace(motion.thrust)
    phi, theta = motion.euler
    acceleration = hover_acceleration(phi, theta, motion.thrust)
    return acceleration + xp.stack(
        [0.0 * motion.thrust, 0.0 * motion.thrust, 0.0 * motion.thrust + GRAVITY], axis=-1
    )


def rotor_torque(motion: Motion) -> Array:
    """Torque (N, 3) of the rotors' thrusts about the believed centre of mass, body axes, N m.

    About z it is the drag torque of the rotors divided by the length that relates it to thrust, which no vehicle file
    tells.
    """
    xp = array_namespace(motion.rotor_thrust)
    roll = pitch = yaw = 0.0 * motion.rotor_thrust[:, 0]
    rotors = zip(motion.vehicle.rotor_positions, motion.vehicle.rotor_directions, strict=True)
    for i, ((x, y, _), direction) in enumerate(rotors):
        thrust = motion.rotor_thrust[:, i]
        roll, pitch, yaw = roll + y * thrust, pitch - x * thrust, yaw - float(direction) * thrust
    return xp.stack([roll, pitch, yaw], axis=-1)


def to_heading(motion: Motion, body: Array) -> Array:
    """Body vectors `body` (N, 3) in the heading frame of the `motion`."""
    xp, r = array_namespace(motion.thrust), motion.rotation
    x, y, z = body[:, 0], body[:, 1], body[:, 2]
    return xp.stack([r[:, i, 0] * x + r[:, i, 1] * y + r[:, i, 2] * z for i in range(3)], axis=-1)


def acceleration(motion: Motion) -> Array:
    """Acceleration (N, 3) of the vehicle, heading frame, m/s², of a motion that effects have acted on."""
    xp = array_namespace(motion.thrust)
    gravity = xp.stack([0.0 * motion.thrust, 0.0 * motion.thrust, 0.0 * motion.thrust + GRAVITY], axis=-1)
    return motion.thrust_acceleration + to_heading(motion, motion.force) - gravity


def specific_force(motion: Motion) -> np.ndarray:
    """What the accelerometer reads (N, 3), body axes, m/s²; without attitude, thrust along the body's z axis."""
    return np.asarray(body_thrust(motion) + motion.force + motion.reading)


def body_thrust(motion: Motion) -> np.ndarray:
    """The part of it (N, 3) that the rotors' thrust gives."""
    if motion.rotation is None:
        return _along_z(motion.thrust)
    r, (x, y, z) = motion.rotation, motion.thrust_acceleration.T
    return np.stack([r[:, 0, j] * x + r[:, 1, j] * y + r[:, 2, j] * z for j in range(3)], axis=-1)


def _along_z(thrust: np.ndarray) -> np.ndarray:
    force = np.zeros((3, len(thrust))).T
    force[:, 2] = thrust
    return force


def error_acceleration(motion: Motion, chain: Chain) -> Array:
    """`delta_hat` (N, 3): acceleration of the chain minus the hover linearisation at the same input, heading frame."""
    linear = linear_thrust(motion)
    acted = apply_effects(motion, chain)
    return acted.thrust_acceleration + to_heading(acted, acted.force) - linear
