"""Every hidden effect against plain vector algebra, and what a draw may and may not do."""

from __future__ import annotations

import itertools
import random

import numpy as np
import pytest

from models.errors import InputError
from models.frames import quaternion_from_euler, rotation_matrix
from models.vehicle import GRAVITY, Vehicle
from sim_bridge.simulator import Simulator
from sim_bridge.truth.airframe import Airframe, believed_powertrain
from sim_bridge.truth.hidden import EFFECTS, Hidden, choose, install
from sim_bridge.truth.sensors import NO_NOISE, Sensors
from sim_bridge.world import PHYSICS_STEP

STATES = list(range(6))


def airframe_with(vehicle: Vehicle, *hidden: Hidden) -> Airframe:
    return install(vehicle, hidden, believed_powertrain(vehicle), Sensors(NO_NOISE, 0), PHYSICS_STEP)[1]


def wrench_of(airframe: Airframe, position, velocity, commands) -> tuple[np.ndarray, np.ndarray]:
    """Force (world) and torque (body) in the steady state of the rotors."""
    airframe.motion.speeds[:] = [airframe.speed_of(command) for command in commands]
    out = np.zeros(6)
    airframe.act(list(position), list(velocity), list(commands), memoryview(out))
    return out[:3], out[3:]


def random_state(seed: int):
    generator = np.random.default_rng(seed)
    q = quaternion_from_euler(generator.uniform(-0.6, 0.6, 3) * [1, 1, 5])
    position = np.array([*generator.uniform(-2, 2, 2), generator.uniform(0.15, 1.0), *q])
    velocity = np.concatenate([generator.uniform(-4, 4, 3), generator.uniform(-3, 3, 3)])
    commands = generator.uniform(0.2, 0.6, 4)
    return position, velocity, commands, rotation_matrix(q)


def added(vehicle: Vehicle, hidden: Hidden, seed: int):
    """What the effect adds to force (world) and torque (body) in a random state, and that state."""
    position, velocity, commands, rotation = random_state(seed)
    force, torque = wrench_of(airframe_with(vehicle, hidden), position, velocity, commands)
    plain_force, plain_torque = wrench_of(airframe_with(vehicle), position, velocity, commands)
    return force - plain_force, torque - plain_torque, position, velocity, commands, rotation


@pytest.mark.parametrize("seed", STATES)
def test_nothing_hidden_is_what_the_owner_believes(vehicle: Vehicle, seed: int) -> None:
    position, velocity, commands, rotation = random_state(seed)
    force, torque = wrench_of(airframe_with(vehicle), position, velocity, commands)
    thrusts = vehicle.weight / 4 * commands / vehicle.hover_thrust
    assert force == pytest.approx(rotation[:, 2] * thrusts.sum())
    expected = sum(
        np.cross(np.array(arm), [0, 0, thrust])
        for arm, thrust in zip(vehicle.rotor_positions, thrusts, strict=True)
    )
    assert torque[:2] == pytest.approx(expected[:2])
    # Drag torque turns the body against the rotors.
    assert torque[2] * -np.dot(vehicle.rotor_directions, thrusts) > 0


@pytest.mark.parametrize("seed", STATES)
def test_thrust_gain_scales_every_rotor(vehicle: Vehicle, seed: int) -> None:
    force, torque, position, velocity, commands, _ = added(
        vehicle, Hidden("thrust_gain", {"gain": 1.15}), seed
    )
    plain_force, plain_torque = wrench_of(airframe_with(vehicle), position, velocity, commands)
    assert force == pytest.approx(0.15 * plain_force)
    assert torque == pytest.approx(0.15 * plain_torque)


def test_thrust_curve_is_right_at_hover_and_steeper_around_it(vehicle: Vehicle) -> None:
    hidden, plain = (
        airframe_with(vehicle, Hidden("thrust_curve", {"speed_blend": 1.0})),
        airframe_with(vehicle),
    )
    hover = vehicle.hover_thrust
    assert hidden.speed_of(hover) == pytest.approx(plain.speed_of(hover))
    # With a blend of one, rotor speed is proportional to the command and thrust to its square.
    assert hidden.speed_of(1.3 * hover) == pytest.approx(1.3 * hidden.speed_of(hover))


@pytest.mark.parametrize("seed", STATES)
def test_battery_sag_is_a_power_of_the_voltage(vehicle: Vehicle, seed: int) -> None:
    position, velocity, commands, rotation = random_state(seed)
    airframe = airframe_with(vehicle, Hidden("battery_sag", {"exponent": 1.5}))
    force, _ = wrench_of(airframe, position, velocity, commands)
    thrust = vehicle.weight / 4 * commands.sum() / vehicle.hover_thrust
    assert rotation[:, 2] @ force == pytest.approx(
        thrust * (airframe.motion.voltage / vehicle.nominal_voltage) ** 1.5
    )


@pytest.mark.parametrize("seed", STATES)
def test_rotor_drag_is_the_sum_of_h_forces(vehicle: Vehicle, seed: int) -> None:
    cx, cy = 0.3, 0.4
    force, torque, _, velocity, commands, rotation = added(
        vehicle, Hidden("rotor_drag", {"x": cx, "y": cy}), seed
    )
    air, omega = rotation.T @ velocity[:3], velocity[3:]
    expected_force, expected_torque = np.zeros(3), np.zeros(3)
    for arm, command in zip(vehicle.rotor_positions, commands, strict=True):
        speed_ratio = np.sqrt(command / vehicle.hover_thrust)
        hub = air + np.cross(omega, arm)
        drag = -vehicle.mass / 4 * speed_ratio * np.array([cx, cy, 0.0]) * hub
        expected_force += drag
        expected_torque += np.cross(arm, drag)
    assert rotation.T @ force == pytest.approx(expected_force)
    assert torque == pytest.approx(expected_torque, abs=1e-12)


@pytest.mark.parametrize("seed", STATES)
def test_parasitic_drag_opposes_motion_quadratically(vehicle: Vehicle, seed: int) -> None:
    c = np.array([0.08, 0.1, 0.13])
    hidden = Hidden("parasitic_drag", dict(zip("xyz", c, strict=True)))
    force, torque, _, velocity, _, rotation = added(vehicle, hidden, seed)
    air = rotation.T @ velocity[:3]
    assert rotation.T @ force == pytest.approx(-vehicle.mass * c * np.linalg.norm(air) * air)
    assert torque == pytest.approx(np.zeros(3))
    assert force @ velocity[:3] < 0


@pytest.mark.parametrize("seed", STATES)
def test_ground_effect_is_the_sum_over_images(vehicle: Vehicle, seed: int) -> None:
    factor = 2.5
    hidden = Hidden("ground_effect", {"radius_factor": factor})
    force, _, position, _, commands, rotation = added(vehicle, hidden, seed)
    radius = factor * vehicle.rotor_radius
    arms = np.array(vehicle.rotor_positions)
    heights = np.maximum(position[2] + (arms @ rotation.T)[:, 2], 0.25 * radius)
    thrusts = vehicle.weight / 4 * commands / vehicle.hover_thrust
    gain = np.zeros(4)
    for i, j in itertools.product(range(4), range(4)):
        h = 0.5 * (heights[i] + heights[j])
        image = np.array([*(arms[i] - arms[j])[:2], 2 * h])  # from the image of j to hub i
        gain[i] += radius**2 / 2 * h / np.linalg.norm(image) ** 3
    expected = (thrusts * (1 / (1 - np.minimum(gain, 0.5)) - 1)).sum()
    assert rotation[:, 2] @ force == pytest.approx(expected)


def test_ground_effect_of_one_image_is_cheeseman_and_bennett(vehicle: Vehicle) -> None:
    """Far above the ground four images count as four times the rotor's own: 4 (R / 4 z)²."""
    airframe = airframe_with(vehicle, Hidden("ground_effect", {"radius_factor": 2.0}))
    z, radius = 2.0, 2.0 * vehicle.rotor_radius
    force, _ = wrench_of(airframe, [0, 0, z, 1, 0, 0, 0], [0] * 6, [vehicle.hover_thrust] * 4)
    assert force[2] / vehicle.weight - 1 == pytest.approx(4 * (radius / (4 * z)) ** 2, rel=0.02)


def test_wind_pushes_a_hovering_vehicle_downwind(vehicle: Vehicle) -> None:
    hidden = Hidden("wind", {"speed": 5.0, "east": 3.0, "north": -4.0, "drag": 0.2})
    airframe = airframe_with(vehicle, hidden)
    force, _ = wrench_of(airframe, [0, 0, 5, 1, 0, 0, 0], [0] * 6, [vehicle.hover_thrust] * 4)
    assert force / vehicle.mass == pytest.approx([0.6, -0.8, GRAVITY])
    # Drifting with the wind there is none to feel.
    force, _ = wrench_of(airframe, [0, 0, 5, 1, 0, 0, 0], [3.0, -4.0, 0, 0, 0, 0], [vehicle.hover_thrust] * 4)
    assert force / vehicle.mass == pytest.approx([0.0, 0.0, GRAVITY], abs=1e-9)


def test_wind_brings_no_second_drag_where_drag_is_hidden_with_it(vehicle: Vehicle) -> None:
    wind = Hidden("wind", {"speed": 5.0, "east": 5.0, "north": 0.0, "drag": 0.2})
    both = airframe_with(vehicle, Hidden("rotor_drag", {"x": 0.3, "y": 0.3}), wind)
    force, _ = wrench_of(both, [0, 0, 5, 1, 0, 0, 0], [0] * 6, [vehicle.hover_thrust] * 4)
    assert force[0] / vehicle.mass == pytest.approx(1.5)


def test_accelerometer_bias_is_read_and_not_felt(vehicle: Vehicle) -> None:
    bias = (0.2, -0.1, 0.3)
    hidden = Hidden("accelerometer_bias", {"size": 0.37, **dict(zip("xyz", bias, strict=True))})
    simulator = Simulator(vehicle, (hidden,), noise=NO_NOISE)
    simulator.start_in_hover((0.0, 0.0, 5.0))
    for _ in range(500):
        simulator.step(vehicle.hover_thrust, 0.0, 0.0, 0.0)
    now = simulator.estimate()
    assert now.specific_force == pytest.approx((bias[0], bias[1], GRAVITY + bias[2]), abs=1e-9)
    assert now.position == pytest.approx((0.0, 0.0, 5.0), abs=1e-6)


def step_response(vehicle: Vehicle, *hidden: Hidden) -> np.ndarray:
    """Specific force over weight after a step of the command by 10 % at time zero, every 2 ms."""
    simulator = Simulator(vehicle, hidden, noise=NO_NOISE)
    simulator.start_in_hover((0.0, 0.0, 5.0))
    out = []
    for _ in range(400):
        simulator.step(1.1 * vehicle.hover_thrust, 0.0, 0.0, 0.0)
        out.append(simulator.estimate().specific_force[2] / GRAVITY - 1.0)
    return np.array(out) / 0.1


@pytest.mark.parametrize(
    ("hidden", "delay", "tau"),
    [
        ((), 0.005, 0.02),
        ((Hidden("motor_lag", {"time_constant": 0.06}),), 0.005, 0.06),
        ((Hidden("transport_delay", {"extra_delay": 0.030}),), 0.035, 0.02),
        ((Hidden("transport_delay", {"extra_delay": 0.0213}),), 0.0263, 0.02),
    ],
)
def test_thrust_follows_after_delay_and_lag(vehicle: Vehicle, hidden, delay: float, tau: float) -> None:
    """For a small step of rotor speed the area above the response is the delay plus the time constant."""
    response = step_response(vehicle, *hidden)
    missing = (1.0 - response).sum() * PHYSICS_STEP
    # Thrust is the square of a speed that lags: a trifle faster upwards than the lag itself.
    assert missing == pytest.approx(delay + tau, rel=0.03)
    # Each value is the mean of its step: all of them are zero that end before the delay is over.
    assert np.all(response[: int(delay / PHYSICS_STEP)] == pytest.approx(0.0, abs=1e-9))
    assert response[-1] == pytest.approx(1.0, abs=1e-3)


def test_the_same_seed_hides_the_same(vehicle: Vehicle) -> None:
    assert choose(["random"], vehicle, 7, 2) == choose(["random"], vehicle, 7, 2)
    drawn = {choose(["random"], vehicle, seed)[0].name for seed in range(200)}
    assert drawn == {name for name, effect in EFFECTS.items() if effect.drawn}


@pytest.mark.parametrize("name", list(EFFECTS))
def test_a_drawn_size_is_in_its_range_and_a_given_one_is_taken(vehicle: Vehicle, name: str) -> None:
    effect = EFFECTS[name]
    first = next(iter(effect.units))
    for seed in range(20):
        value = choose([name], vehicle, seed)[0].parameters[first]
        assert effect.low <= value <= effect.high
    middle = random.Random(name).uniform(effect.low, effect.high)
    assert choose([f"{name}:{middle!r}"], vehicle, 1)[0].parameters[first] == middle


@pytest.mark.parametrize("bad", [["windd"], ["wind:fast"], ["wind:99"], ["wind:nan"], ["none", "wind"]])
def test_what_cannot_be_hidden_is_refused(vehicle: Vehicle, bad: list[str]) -> None:
    with pytest.raises(InputError, match="--hidden"):
        choose(bad, vehicle, 0)
