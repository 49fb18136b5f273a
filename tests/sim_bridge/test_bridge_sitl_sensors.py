"""What PX4's raw sensors read, against plain vector algebra in numpy."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trueflight.models.frames import rotation_matrix
from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.mavlink import wire
from trueflight.sim_bridge.simulator import Moment, Simulator
from trueflight.sim_bridge.sitl.sensors import (
    FIELD,
    FORCE_STEP,
    RawNoise,
    RawSensors,
    magnetic_field,
    pressure,
    pressure_altitude,
    rounded_by_px4,
    specific_force,
)
from trueflight.sim_bridge.truth.hidden import choose

# Rows: the axes of NED in ENU, and of FRD in FLU.
NED_OF_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_OF_FLU = np.diag([1.0, -1.0, -1.0])
SILENT = replace(RawNoise().times(0.0), accelerometer=0.0, gyroscope=0.0, magnetometer=0.0, pressure=0.0)

numbers = st.floats(-20.0, 20.0)
vectors = st.tuples(numbers, numbers, numbers)
quaternions = (
    st.tuples(*(st.floats(-1.0, 1.0),) * 4)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: tuple(float(x) for x in np.array(q) / np.linalg.norm(q)))
)


def moment(
    position=(0.0, 0.0, 0.0),
    quaternion=(1.0, 0.0, 0.0, 0.0),
    velocity=(0.0, 0.0, 0.0),
    rates=(0.0, 0.0, 0.0),
    acceleration=(0.0, 0.0, 0.0),
    time_us: int = 0,
) -> Moment:
    rotation = tuple(float(x) for x in rotation_matrix(np.array(quaternion)).ravel())
    state = [*position, *quaternion]
    return time_us, state, [*velocity, *rates], acceleration, rotation, 16.0, (0.0,) * 4


@given(quaternions, vectors)
@settings(max_examples=60, deadline=None)
def test_the_accelerometer_reads_the_force_that_is_not_gravity(quaternion, acceleration) -> None:
    now = moment(quaternion=quaternion, acceleration=acceleration)
    body_from_world = rotation_matrix(np.array(quaternion)).T
    expected = FRD_OF_FLU @ body_from_world @ (np.array(acceleration) - [0.0, 0.0, -9.81])
    assert RawSensors(SILENT, 0).imu(now, now).specific_force == pytest.approx(expected, abs=1e-9)


def test_at_rest_it_reads_up_and_in_free_fall_nothing() -> None:
    sensors = RawSensors(SILENT, 0)
    rest = moment()
    assert sensors.imu(rest, rest).specific_force == pytest.approx((0.0, 0.0, -9.81))
    fall = moment(acceleration=(0.0, 0.0, -9.81))
    assert sensors.imu(fall, fall).specific_force == pytest.approx((0.0, 0.0, 0.0))


@given(vectors)
@settings(max_examples=30, deadline=None)
def test_body_rates_turn_nose_up_and_right_wing_down(rates) -> None:
    now = moment(rates=rates)
    assert RawSensors(SILENT, 0).imu(now, now).body_rate == pytest.approx(FRD_OF_FLU @ np.array(rates))


@given(quaternions)
@settings(max_examples=60, deadline=None)
def test_the_compass_reads_the_earths_field_in_the_body(quaternion) -> None:
    expected = FRD_OF_FLU @ rotation_matrix(np.array(quaternion)).T @ np.array(FIELD)
    assert magnetic_field(quaternion) == pytest.approx(expected, abs=1e-12)


def test_the_field_points_north_down_and_a_little_east() -> None:
    """Zurich, World Magnetic Model: 48.3 microtesla, 63.2 degrees down, 3.3 degrees east."""
    facing_north = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # yaw 90 degrees from east
    x, y, z = magnetic_field(facing_north)
    assert math.hypot(x, y, z) == pytest.approx(0.483, abs=0.005)
    assert math.degrees(math.atan2(z, math.hypot(x, y))) == pytest.approx(63.2, abs=0.5)
    assert math.degrees(math.atan2(y, x)) == pytest.approx(3.3, abs=0.2)


@given(st.floats(-100.0, 3000.0))
@settings(max_examples=30, deadline=None)
def test_pressure_altitude_is_the_altitude_of_the_pressure(altitude) -> None:
    assert pressure_altitude(pressure(altitude)) == pytest.approx(altitude, abs=1e-6)


def test_the_barometer_falls_a_hectopascal_in_eight_metres() -> None:
    sensors = RawSensors(SILENT, 0)
    low, high = sensors.barometer(moment()), sensors.barometer(moment(position=(0.0, 0.0, 10.0)))
    # Hydrostatics: rho g h with the air of 488 m altitude (1.168 kg/m³).
    assert low - high == pytest.approx(1.168 * 9.81 * 10.0 / 100.0, rel=0.01)
    assert pressure(0.0) == 1013.25


@given(vectors, vectors)
@settings(max_examples=30, deadline=None)
def test_gps_tells_north_of_north_and_down_of_down(position, velocity) -> None:
    gps = RawSensors(SILENT, 0).gps(moment(position=position, velocity=velocity))
    latitude, longitude, altitude = wire.ORIGIN
    radius = 6371000.0
    north = math.radians(gps.latitude - latitude) * radius
    east = math.radians(gps.longitude - longitude) * radius * math.cos(math.radians(latitude))
    assert (north, east, altitude - gps.altitude) == pytest.approx(NED_OF_ENU @ np.array(position), abs=1e-6)
    assert gps.velocity == pytest.approx(NED_OF_ENU @ np.array(velocity))


@given(quaternions, vectors, vectors)
@settings(max_examples=60, deadline=None)
def test_vision_is_pose_and_velocity_in_ned(quaternion, position, velocity) -> None:
    seen = RawSensors(SILENT, 0).vision(moment(position, quaternion, velocity))
    assert seen.position == pytest.approx(NED_OF_ENU @ np.array(position))
    assert seen.velocity == pytest.approx(NED_OF_ENU @ np.array(velocity))
    world_from_body = NED_OF_ENU @ rotation_matrix(np.array(quaternion)) @ FRD_OF_FLU.T
    assert rotation_matrix(np.array(seen.quaternion)) == pytest.approx(world_from_body, abs=1e-9)


def test_noise_is_that_of_its_seed_and_of_its_size() -> None:
    still = moment()
    first, again, other = (RawSensors(RawNoise(), seed) for seed in (4, 4, 5))
    samples = np.array([first.imu(still, still).specific_force for _ in range(2000)])
    assert first.noise == again.noise
    assert tuple(samples[0]) == again.imu(still, still).specific_force
    assert tuple(samples[0]) != other.imu(still, still).specific_force
    # Chi-square of 2000 samples: the standard deviation is known to 5 % at 3 sigma.
    assert samples.std(axis=0) == pytest.approx([RawNoise().accelerometer] * 3, rel=0.06)


def test_without_noise_no_reading_repeats_itself() -> None:
    """PX4 declares a sensor stale whose 16-bit readings do not change."""
    sensors, still = RawSensors(RawNoise().times(0.0), 0), moment()
    step = 9.80665 / 2048
    counts = [
        tuple(int(value / step) for value in sensors.imu(still, still).specific_force) for _ in range(200)
    ]
    assert max(len(list(same)) for _, same in itertools.groupby(counts)) < 10


@given(vectors)
@settings(max_examples=60, deadline=None)
def test_what_px4_cuts_off_is_rounded(reading) -> None:
    told = rounded_by_px4(reading, FORCE_STEP)
    kept = [int(value / FORCE_STEP) * FORCE_STEP for value in told]
    assert kept == pytest.approx(reading, abs=0.5 * FORCE_STEP + 1e-9)


def test_gps_wanders_slowly_around_the_truth() -> None:
    sensors = RawSensors(RawNoise(), 1)
    norths = []
    for tick in range(20_000):
        gps = sensors.gps(moment(time_us=tick * 100_000))
        norths.append(math.radians(gps.latitude - wire.ORIGIN[0]) * 6371000.0)
    error = np.array(norths)
    # 2000 s are 50 time constants: spread and mean are known to about 15 and 20 % of the wander.
    assert error.std() == pytest.approx(RawNoise().gps_wander, rel=0.35)
    assert abs(error.mean()) < 0.5 * RawNoise().gps_wander
    assert np.abs(np.diff(error)).std() < 0.1 * error.std()


def test_motor_commands_drive_the_same_vehicle_as_setpoints(vehicle: Vehicle) -> None:
    """An autopilot outside that commands what the inner loop would command flies the same flight."""
    inside, outside = Simulator(vehicle), Simulator(vehicle)
    for one in (inside, outside):
        one.start_in_hover((0.0, 0.0, 2.0))
    prompt = replace(vehicle, command_delay=0.0)
    follower = Simulator(prompt)
    follower.start_in_hover((0.0, 0.0, 2.0))
    for tick in range(500):
        inside.step(vehicle.hover_thrust, 0.0, 0.4 * math.sin(tick * 0.02), 0.1)
        a, b, c, d = inside.motors
        follower.drive((a, b, c, d))
    # The inner loop's commands have passed the delay line already.
    assert follower.world.position.tolist() == pytest.approx(inside.world.position.tolist(), abs=1e-9)
    assert follower.world.velocity.tolist() == pytest.approx(inside.world.velocity.tolist(), abs=1e-9)


def test_the_delay_acts_on_motor_commands(vehicle: Vehicle) -> None:
    late = choose(["transport_delay:0.021"], vehicle, 0)
    simulator = Simulator(vehicle, late)
    simulator.start_in_hover((0.0, 0.0, 2.0))
    felt = next(
        tick
        for tick in range(100)
        if (simulator.drive((0.6, 0.6, 0.6, 0.6)), simulator.motors[0])[1] > vehicle.hover_thrust
    )
    # 5 ms believed and 21 ms hidden: 13 steps of 2 ms.
    assert felt == 13


def test_a_lever_arm_shows_in_the_accelerometer(vehicle: Vehicle) -> None:
    """Spinning about z at 4 rad/s, a sensor 5 cm forward reads a centripetal force to the rear, omega² r."""
    simulator = Simulator(vehicle, choose(["imu_lever_arm"], vehicle, 3))
    simulator.sensors.lever_arm = (0.05, 0.0, 0.0)
    simulator.world.place((0.0, 0.0, 3.0))
    simulator.world.velocity[5] = 4.0
    simulator.rest()
    _, _, _, acceleration, rotation, _, _ = simulator.moment()
    fx, _, _ = specific_force(acceleration, rotation)
    assert fx == pytest.approx(-(4.0**2) * 0.05, rel=0.02)
