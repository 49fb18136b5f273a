"""Rigid body, contact, energy, battery, sensors and the inner loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from trueflight.models.errors import InputError
from trueflight.models.vehicle import GRAVITY, Vehicle
from trueflight.sim_bridge.many.bodies import Bodies, Load
from trueflight.sim_bridge.rates import IDLE_SHARE, Mixer
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.truth.airframe import believed_powertrain
from trueflight.sim_bridge.truth.battery import Battery
from trueflight.sim_bridge.truth.sensors import NO_NOISE, Noise, Sensors
from trueflight.sim_bridge.world import PHYSICS_STEP, World


def test_free_fall_keeps_its_energy(vehicle: Vehicle) -> None:
    world = World(vehicle)
    world.place((0.0, 0.0, 40.0), velocity=(3.0, 0.0, 1.0))
    world.velocity[3] = 2.0  # rolling
    before = world.energy()
    for _ in range(500):
        world.step()
    seconds = 500 * PHYSICS_STEP
    assert world.velocity[2] == pytest.approx(1.0 - GRAVITY * seconds)
    # Semi-implicit Euler is off by half a step of falling, and by no more.
    assert world.energy() == pytest.approx(before, abs=vehicle.weight * PHYSICS_STEP * GRAVITY * seconds)


def test_a_dropped_vehicle_comes_to_rest_on_its_feet(vehicle: Vehicle) -> None:
    simulator = Simulator(vehicle, noise=NO_NOISE)
    simulator.world.place((0.0, 0.0, 0.5))
    energy = simulator.world.energy()
    for _ in range(1500):
        simulator.rest()
        assert simulator.world.energy() < energy + 1e-6  # contact takes energy and gives none
    now = simulator.estimate()
    assert simulator.world.touching
    assert now.position[2] == pytest.approx(simulator.world.standing_height, abs=2e-3)
    assert np.linalg.norm(now.velocity) < 1e-3
    # Standing still the accelerometer feels the ground's reaction.
    assert now.specific_force == pytest.approx((0.0, 0.0, GRAVITY), abs=1e-3)


def test_torque_turns_by_the_inertia(vehicle: Vehicle) -> None:
    world = World(vehicle)
    world.place((0.0, 0.0, 40.0))
    torque = 1e-3
    for axis, moment in enumerate(vehicle.inertia):
        world.place((0.0, 0.0, 40.0))
        world.wrench[3 + axis] = torque
        for _ in range(50):
            world.step()
        world.wrench[3 + axis] = 0.0
        assert world.velocity[3 + axis] == pytest.approx(torque / moment * 50 * PHYSICS_STEP, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"rotor_positions": (), "rotor_directions": ()}, "four rotors"),
        ({"inertia": (0.0, 0.0, 0.0)}, "above 0"),
        ({"inertia": (0.001, 0.001, 0.01)}, "no rigid body"),
        ({"rotor_directions": (1, 1, 1, -1)}, "two of each"),
    ],
)
def test_a_vehicle_that_cannot_be_simulated_is_refused(vehicle: Vehicle, change, says: str) -> None:
    with pytest.raises(InputError, match=says):
        World(replace(vehicle, **change))


def test_voltage_sags_with_power_and_recovers(vehicle: Vehicle) -> None:
    battery = Battery(believed_powertrain(vehicle).battery)
    rest = battery.open_circuit_voltage()
    hover = battery.load(130.0)
    assert battery.current * hover == pytest.approx(130.0)
    full = battery.load(400.0)
    assert full < hover < rest
    for _ in range(1000):
        battery.load(130.0)
        battery.discharge(0.1)
    tired = battery.load(0.0)
    assert tired < rest
    assert battery.charge == pytest.approx(battery.cell.charge - battery.consumed / battery.cell.capacity)
    for _ in range(1000):
        battery.load(0.0)
        battery.discharge(0.1)
    assert battery.load(0.0) > tired  # polarisation relaxes


def test_hover_voltage_is_near_the_nominal_one(vehicle: Vehicle) -> None:
    simulator = Simulator(vehicle, noise=NO_NOISE)
    simulator.start_in_hover((0.0, 0.0, 5.0))
    assert simulator.estimate().battery_voltage == pytest.approx(vehicle.nominal_voltage, rel=0.02)


def test_noise_has_the_stated_size_and_no_bias(vehicle: Vehicle) -> None:
    noise = replace(Noise(), position_wander=0.0, velocity_wander=0.0, attitude_wander=0.0)
    sensors = Sensors(noise, 3)
    identity = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    rows = []
    for i in range(4000):
        e = sensors.sample(
            10_000 * i,
            [1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0],
            [0.0] * 6,
            (0.0, 0.0, 0.0),
            identity,
            16.0,
            [9.0] * 4,
        )
        rows.append((*e.position, *e.velocity, *e.angular_velocity, *e.specific_force, e.battery_voltage))
    data = np.array(rows)
    truth = [1, 2, 3, 0, 0, 0, 0, 0, 0, 0, 0, GRAVITY, 16]
    sizes = np.repeat([noise.position, noise.velocity, noise.gyroscope, noise.accelerometer], 3)
    sizes = np.append(sizes, noise.voltage)
    # Five standard errors of the mean, and of the standard deviation.
    assert np.all(np.abs(data.mean(0) - truth) < 5 * sizes / np.sqrt(4000))
    assert data.std(0) == pytest.approx(sizes, rel=5 / np.sqrt(8000))


def test_a_sample_is_the_same_until_the_next_step(vehicle: Vehicle) -> None:
    simulator = Simulator(vehicle, seed=1)
    simulator.start_in_hover((0.0, 0.0, 5.0))
    assert simulator.estimate() is simulator.estimate()
    before = simulator.estimate()
    simulator.step(vehicle.hover_thrust, 0.0, 0.0, 0.0)
    assert simulator.estimate() != before


@pytest.mark.parametrize("model", ["linear", "quadratic"])
def test_the_mixer_gives_the_torque_it_is_asked_for_and_no_thrust(vehicle: Vehicle, model: str) -> None:
    vehicle = replace(vehicle, thrust_model=model)
    mixer = Mixer(vehicle)
    torque = np.array([0.02, -0.03, 0.005])
    thrusts = vehicle.thrust(np.array(mixer.mix(1.0, *torque))) / 4
    assert thrusts.sum() == pytest.approx(vehicle.weight)
    arms = np.array(vehicle.rotor_positions)
    made = np.cross(arms, np.outer(thrusts, [0, 0, 1])).sum(0)
    made[2] -= believed_powertrain(vehicle).torque_per_thrust * np.dot(vehicle.rotor_directions, thrusts)
    assert made == pytest.approx(torque)


@pytest.mark.parametrize("seed", range(30))
def test_a_saturated_mixer_stays_in_range_and_gives_up_yaw_first(vehicle: Vehicle, seed: int) -> None:
    generator = np.random.default_rng(seed)
    mixer = Mixer(vehicle)
    collective = generator.uniform(0.0, 2.6)
    roll, pitch, yaw = generator.uniform(-0.4, 0.4, 3)
    motors = np.array(mixer.mix(collective, roll, pitch, yaw))
    low, high = IDLE_SHARE * vehicle.hover_thrust, 1.0
    assert np.all(motors >= low - 1e-12) and np.all(motors <= high + 1e-12)
    thrusts = vehicle.thrust(motors) / 4
    made = np.cross(np.array(vehicle.rotor_positions), np.outer(thrusts, [0, 0, 1])).sum(0)
    wanted = np.array([roll, pitch])
    # Roll and pitch keep their direction, and their size wherever they fit without yaw.
    assert np.cross(np.append(made[:2], 0), np.append(wanted, 0))[2] == pytest.approx(0.0, abs=1e-9)
    assert made[:2] @ wanted >= 0
    mixer.mix(collective, roll, pitch, 0.0)
    if not mixer.saturated:
        assert made[:2] == pytest.approx(wanted)


def test_a_payload_takes_the_place_of_the_one_before_and_wrong_moments_stay(vehicle: Vehicle) -> None:
    world, many = World(vehicle), Bodies([vehicle] * 2)
    own = float(world.model.body_mass[1]), world.model.body_inertia[1].copy()
    one = Load(many, 1)
    for body in (world, one):
        body.spread((1e-3, 2e-3, 3e-3))
        body.load(0.3, 1e-4)
        body.load(0.1, 2e-4)
    assert world.model.body_mass[1] == pytest.approx(own[0] + 0.1)
    assert world.model.body_inertia[1] == pytest.approx(own[1] + (1.2e-3, 2.2e-3, 3.2e-3))
    assert many._mass == pytest.approx([own[0], own[0] + 0.1])
    assert many._inertia[:, 1] == pytest.approx(world.model.body_inertia[1])
    for body in (world, one):
        body.load(0.0, 0.0)  # dropped
    assert (world.model.body_mass[1], many._mass[1]) == pytest.approx((own[0], own[0]))
    world.unload()
    assert world.model.body_inertia[1] == pytest.approx(own[1])
