"""Every hidden effect against plain vector algebra, and what a draw may and may not do."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trueflight.models.errors import InputError
from trueflight.models.frames import quaternion_from_euler, rotation_matrix
from trueflight.models.vehicle import GRAVITY, Vehicle
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.truth.airframe import Airframe, believed_powertrain
from trueflight.sim_bridge.truth.effects import EFFECTS
from trueflight.sim_bridge.truth.hidden import Hidden, choose, pool
from trueflight.sim_bridge.truth.installation import install
from trueflight.sim_bridge.truth.sensors import NO_NOISE, Sensors
from trueflight.sim_bridge.world import PHYSICS_STEP

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


def test_every_hidden_effect_is_tested() -> None:
    tests = "".join(path.read_text() for path in Path(__file__).parent.glob("test_*.py"))
    untested = {name for name in EFFECTS if f'Hidden("{name}"' not in tests}
    assert not untested, "hold its forces against plain vector algebra"


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


@pytest.mark.parametrize("seed", STATES)
def test_external_force_stays_as_it_is_in_the_world(vehicle: Vehicle, seed: int) -> None:
    force, torque, *_ = added(
        vehicle, Hidden("external_force", {"force": 1.3, "x": 0.3, "y": -0.4, "z": 1.2}), seed
    )
    assert force == pytest.approx([0.3, -0.4, 1.2]) and torque == pytest.approx(np.zeros(3), abs=1e-12)


def test_external_torque_turns_with_the_body(vehicle: Vehicle) -> None:
    force, torque, *_ = added(vehicle, Hidden("external_torque", {"torque": 0.05, "x": 0.03, "y": -0.04}), 1)
    assert torque == pytest.approx([0.03, -0.04, 0.0]) and force == pytest.approx(np.zeros(3), abs=1e-12)


def test_periodic_torque_is_a_sine_of_time(vehicle: Vehicle) -> None:
    numbers = {"amplitude": 0.05, "x": 0.03, "y": 0.04, "frequency": 1.0 / (8 * PHYSICS_STEP)}
    airframe = airframe_with(vehicle, Hidden("periodic_torque", numbers))
    position, velocity, commands, _ = random_state(0)
    told = np.array([wrench_of(airframe, position, velocity, commands)[1] for _ in range(8)])
    _, plain = wrench_of(airframe_with(vehicle), position, velocity, commands)
    sine = np.sin(2 * np.pi * np.arange(8) / 8)
    assert told - plain == pytest.approx(np.outer(sine, [0.03, 0.04, 0.0]), abs=1e-12)


def test_gusts_have_their_deviation_and_are_the_same_whoever_flies(vehicle: Vehicle) -> None:
    steps = round(200.0 / PHYSICS_STEP)  # s: five periods of the slowest
    gusts = Hidden("gusts", {"deviation": 2.0, "draw": 7.0, "drag": 0.2})
    one, other = (airframe_with(vehicle, gusts).turbulence for _ in range(2))
    assert one is not None and other is not None
    air = np.array([one.step() for _ in range(steps)])
    assert air.std(axis=0) == pytest.approx([2.0, 2.0, 1.0], rel=0.1)
    assert abs(air.mean(axis=0)).max() < 0.1
    assert np.array_equal(air[:50], [other.step() for _ in range(50)])
    speed = np.linalg.norm(np.diff(air, axis=0), axis=1) / PHYSICS_STEP
    assert 0.5 < speed.mean() < 10.0  # m/s²: gusts, neither a calm nor noise


def test_gusts_act_through_drag_alone(vehicle: Vehicle) -> None:
    airframe = airframe_with(vehicle, Hidden("gusts", {"deviation": 3.0, "draw": 1.0, "drag": 0.2}))
    assert airframe.turbulence is not None
    hover = [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    expected = np.array(airframe_with(vehicle, Hidden("gusts", {"deviation": 3.0, "draw": 1.0, "drag": 0.2}))
                        .turbulence.step())  # fmt: skip
    force, _ = wrench_of(airframe, hover, [0.0] * 6, [vehicle.hover_thrust] * 4)
    assert force[:2] == pytest.approx(0.2 * vehicle.mass * expected[:2])


def test_inertia_is_the_bodys_own_by_a_factor_and_a_payload_comes_on_top(vehicle: Vehicle) -> None:
    hidden = (Hidden("inertia", {"factor": 1.4}), Hidden("payload", {"mass_fraction": 0.2, "time": 0.1}))
    simulator = Simulator(vehicle, hidden, noise=NO_NOISE)
    simulator.start_in_hover((0.0, 0.0, 1.0))
    model = simulator.world.model
    for _ in range(2):
        simulator.step(vehicle.hover_thrust, 0.0, 0.0, 0.0)
    assert model.body_inertia[1] == pytest.approx(1.4 * np.array(vehicle.inertia))
    assert model.body_mass[1] == pytest.approx(vehicle.mass)
    for _ in range(60):
        simulator.step(vehicle.hover_thrust, 0.0, 0.0, 0.0)
    cube = 0.2 * vehicle.mass * vehicle.rotor_radius**2 / 6.0
    assert model.body_inertia[1] == pytest.approx(1.4 * np.array(vehicle.inertia) + cube)
    assert model.body_mass[1] == pytest.approx(1.2 * vehicle.mass)
    simulator.world.unload()
    assert model.body_inertia[1] == pytest.approx(vehicle.inertia)


@pytest.mark.parametrize("bad", [["windd"], ["wind:fast"], ["wind:99"], ["wind:nan"], ["none", "wind"]])
def test_what_cannot_be_hidden_is_refused(vehicle: Vehicle, bad: list[str]) -> None:
    with pytest.raises(InputError, match="--hidden"):
        choose(bad, vehicle, 0)


@pytest.mark.parametrize("seed", STATES)
def test_translational_lift_goes_with_the_airspeed_at_each_hub(vehicle: Vehicle, seed: int) -> None:
    force, torque, _, velocity, _, rotation = added(
        vehicle, Hidden("translational_lift", {"lift": 0.05}), seed
    )
    air, omega = rotation.T @ velocity[:3], velocity[3:]
    expected_force, expected_torque = np.zeros(3), np.zeros(3)
    for arm in vehicle.rotor_positions:
        hub = air + np.cross(omega, arm)
        lift = np.array([0.0, 0.0, vehicle.mass / 4 * 0.05 * (hub[0] ** 2 + hub[1] ** 2)])
        expected_force += lift
        expected_torque += np.cross(arm, lift)
    assert rotation.T @ force == pytest.approx(expected_force)
    assert torque[:2] == pytest.approx(expected_torque[:2])


@pytest.mark.parametrize("seed", STATES)
def test_ceiling_effect_is_the_published_law_at_each_hub(vehicle: Vehicle, seed: int) -> None:
    hidden = Hidden("ceiling_effect", {"radius_factor": 2.0, "height": 1.6})
    force, _, position, _, commands, rotation = added(vehicle, hidden, seed)
    thrusts = vehicle.weight / 4 * commands / vehicle.hover_thrust
    distance = 1.6 - position[2] - (np.array(vehicle.rotor_positions) @ rotation.T)[:, 2]
    near = (2.0 * vehicle.rotor_radius / (distance + 0.0378)) ** 2 / 6.924
    assert rotation[:, 2] @ force == pytest.approx((thrusts * (1 / (1 - np.minimum(near, 0.5)) - 1)).sum())


def test_vortex_ring_takes_most_in_the_middle_of_its_range_and_nothing_outside(vehicle: Vehicle) -> None:
    hidden = Hidden("vortex_ring", {"loss": 0.3})
    disc = np.pi * vehicle.rotor_radius**2
    induced = np.sqrt(vehicle.weight / 4 / (2 * 1.225 * disc))
    hover = [vehicle.hover_thrust] * 4
    level = [0, 0, 9, 1, 0, 0, 0]

    def thrust(sinking: float, edgewise: float = 0.0) -> float:
        velocity = [edgewise * induced, 0, -sinking * induced, 0, 0, 0]
        return wrench_of(airframe_with(vehicle, hidden), level, velocity, hover)[0][2] / vehicle.weight

    assert thrust(0.9) == pytest.approx(0.7)
    assert thrust(0.2) == thrust(1.6) == thrust(-0.9) == pytest.approx(1.0)
    assert 0.7 < thrust(0.9, 0.5) < thrust(0.9, 0.9) < 1.0


@pytest.mark.parametrize("seed", STATES)
def test_thrust_misalignment_turns_the_thrust_and_keeps_its_size(vehicle: Vehicle, seed: int) -> None:
    hidden = Hidden("thrust_misalignment", {"angle": 0.05, "x": 0.03, "y": -0.04})
    position, velocity, commands, rotation = random_state(seed)
    force, _ = wrench_of(airframe_with(vehicle, hidden), position, velocity, commands)
    thrust = vehicle.weight / 4 * commands.sum() / vehicle.hover_thrust
    assert np.linalg.norm(force) == pytest.approx(thrust)
    body = rotation.T @ force / thrust
    assert body[:2] == pytest.approx(np.sin([0.03, -0.04]))


@pytest.mark.parametrize("seed", STATES)
def test_com_offset_is_the_torque_of_thrust_about_another_point(vehicle: Vehicle, seed: int) -> None:
    hidden = Hidden("com_offset", {"distance": 0.01, "x": 0.006, "y": -0.008})
    force, torque, _, _, commands, _ = added(vehicle, hidden, seed)
    thrust = vehicle.weight / 4 * commands.sum() / vehicle.hover_thrust
    assert force == pytest.approx(np.zeros(3), abs=1e-12)
    assert torque == pytest.approx(-np.cross([0.006, -0.008, 0.0], [0.0, 0.0, thrust]))


@pytest.mark.parametrize("rotor", [1, 2, 3, 4])
def test_rotor_damage_takes_from_one_rotor_only(vehicle: Vehicle, rotor: int) -> None:
    hidden = Hidden("rotor_damage", {"loss": 0.2, "rotor": float(rotor)})
    force, torque, _, _, commands, rotation = added(vehicle, hidden, rotor)
    lost = 0.2 * vehicle.weight / 4 * commands[rotor - 1] / vehicle.hover_thrust
    assert rotation.T @ force == pytest.approx([0, 0, -lost])
    arm = vehicle.rotor_positions[rotor - 1]
    assert torque[:2] == pytest.approx(-np.cross(arm, [0, 0, lost])[:2])
    assert np.sign(torque[2]) == vehicle.rotor_directions[rotor - 1]


def test_gyroscopic_torque_keeps_the_momentum_of_rotors_and_body(vehicle: Vehicle) -> None:
    inertia = 3e-5
    airframe = airframe_with(vehicle, Hidden("gyroscopic", {"inertia": inertia}))
    speeds = np.array([900.0, 1000.0, 1100.0, 800.0])
    commands = (speeds / airframe.powertrain.hover_speed) ** 2 * vehicle.hover_thrust
    rates = np.array([2.0, -1.0, 0.5])
    state = [0, 0, 5, 1, 0, 0, 0], [0, 0, 0, *rates]
    _, torque = wrench_of(airframe, *state, commands)
    _, plain = wrench_of(airframe_with(vehicle), *state, commands)
    momentum = np.array([0, 0, inertia * np.dot(vehicle.rotor_directions, speeds)])
    assert torque - plain == pytest.approx(-np.cross(rates, momentum), abs=1e-9)
    # the next step with the first pair faster: the body is turned against what the rotors gain
    faster = commands * [1.2, 1.2, 1.0, 1.0]
    out, same = np.zeros(6), np.zeros(6)
    airframe.act(*state, list(faster), memoryview(out))
    other = airframe_with(vehicle)
    wrench_of(other, *state, commands)
    other.act(*state, list(faster), memoryview(same))
    assert (out[5] - same[5]) * sum(vehicle.rotor_directions[:2]) < 0


def test_imu_lever_arm_is_felt_while_turning_and_not_in_hover(vehicle: Vehicle) -> None:
    arm = np.array([0.05, 0.0, 0.02])
    hidden = Hidden("imu_lever_arm", {"length": 0.054, **dict(zip("xyz", arm.tolist(), strict=True))})
    readings = []
    for one in ((hidden,), ()):
        simulator = Simulator(vehicle, one, noise=NO_NOISE)
        simulator.start_in_hover((0.0, 0.0, 5.0))
        told = []
        for i in range(400):
            simulator.step(vehicle.hover_thrust, 0.0, 0.0, 0.0 if i < 100 else 2.0)
            now = simulator.estimate()
            told.append((*now.specific_force, *now.angular_velocity))
        readings.append(np.array(told))
    with_it, without = readings
    swing = (with_it - without)[:, :3]
    assert swing[:100] == pytest.approx(np.zeros((100, 3)), abs=1e-9)
    rates = without[:, 3:]
    slope = np.gradient(rates, PHYSICS_STEP, axis=0)
    expected = np.cross(slope, arm) + np.cross(rates, np.cross(rates, arm))
    # the simulator's is the mean of a step, this one of two
    assert np.max(np.abs(swing - expected)[110:]) < 0.05 * np.max(np.abs(expected))


def test_rate_loop_lag_filters_the_commanded_rates(vehicle: Vehicle) -> None:
    def response(*hidden: Hidden) -> np.ndarray:
        simulator = Simulator(vehicle, hidden, noise=NO_NOISE)
        simulator.start_in_hover((0.0, 0.0, 50.0))
        rates = []
        for _ in range(500):
            simulator.step(vehicle.hover_thrust, 0.2, 0.0, 0.0)
            rates.append(simulator.estimate().angular_velocity[0])
        return np.array(rates)

    late = response(Hidden("rate_loop_lag", {"time_constant": 0.08}))
    missing = (response() - late).sum() * PHYSICS_STEP / 0.2
    assert missing == pytest.approx(0.08, rel=0.05)  # the area that a first-order filter in front takes away


def test_any_draws_from_more_and_random_from_what_it_always_did(vehicle: Vehicle) -> None:
    assert pool("random") == [
        *("thrust_gain", "thrust_curve", "battery_sag", "motor_lag", "transport_delay", "rotor_drag"),
        *("parasitic_drag", "ground_effect", "wind", "accelerometer_bias"),
    ]
    assert set(pool("any")) > set(pool("random"))
    # what these seeds hid when there were only the first ten
    drawn = [choose(["random"], vehicle, seed)[0].name for seed in range(1, 11)]
    assert drawn == [
        *("motor_lag", "parasitic_drag", "transport_delay", "thrust_curve", "wind", "parasitic_drag"),
        *("battery_sag", "rotor_drag", "battery_sag", "ground_effect"),
    ]
    assert {choose(["any"], vehicle, seed)[0].name for seed in range(300)} == set(pool("any"))
    assert choose(["any"], vehicle, 4, 3) == choose(["any"], vehicle, 4, 3)


@pytest.mark.parametrize("name", list(EFFECTS))
def test_half_the_strength_is_half_as_far_from_nothing_and_in_the_same_direction(
    vehicle: Vehicle, name: str
) -> None:
    effect = EFFECTS[name]
    first, nothing = next(iter(effect.units)), effect.neutral(vehicle)
    (usual,), (half,) = (choose([name], vehicle, 3, strength=strength) for strength in (1.0, 0.5))
    assert half.parameters[first] - nothing == pytest.approx(0.5 * (usual.parameters[first] - nothing))
    if "x" in usual.parameters and first != "x":
        assert half.parameters["x"] == pytest.approx(0.5 * usual.parameters["x"])
    # what was asked for is what is hidden
    given = f"{name}:{usual.parameters[first]!r}"
    assert choose([given], vehicle, 3, strength=0.5)[0].parameters[first] == usual.parameters[first]


def test_lengths_on_the_frame_go_with_its_size(vehicle: Vehicle) -> None:
    large = replace(vehicle, rotor_radius=2.0 * vehicle.rotor_radius, mass=8.0 * vehicle.mass)
    for name, factor in (
        ("com_offset", 2.0),
        ("imu_lever_arm", 2.0),
        ("parasitic_drag", 0.5),
        ("gyroscopic", 32.0),
    ):
        first = next(iter(EFFECTS[name].units))
        (small,), (big,) = (choose([name], v, 3) for v in (vehicle, large))
        assert big.parameters[first] == pytest.approx(factor * small.parameters[first]), name
    assert choose(["rotor_drag"], large, 3) == choose(["rotor_drag"], vehicle, 3)
