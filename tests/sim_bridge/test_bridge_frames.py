"""Frames and signs: what every axis does, seen in the world."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trueflight.models.frames import (
    enu_flu_from_ned_frd,
    enu_from_ned,
    quaternion_from_euler,
    rotation_matrix,
)
from trueflight.models.vehicle import GRAVITY, Vehicle
from trueflight.sim_bridge.mavlink import wire
from trueflight.sim_bridge.position_control import attitude_of_thrust, tilt_of, yaw_of
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.truth.sensors import NO_NOISE
from trueflight.sim_bridge.world import PHYSICS_STEP


def fly(
    vehicle: Vehicle, rates: tuple[float, float, float], command: float, seconds: float, yaw: float = 0.0
):
    simulator = Simulator(vehicle, noise=NO_NOISE)
    simulator.start_in_hover((0.0, 0.0, 50.0), yaw)
    for _ in range(round(seconds / PHYSICS_STEP)):
        simulator.step(command, *rates)
    return simulator.estimate()


def test_positive_roll_rate_moves_to_the_right(vehicle: Vehicle) -> None:
    end = fly(vehicle, (0.3, 0.0, 0.0), vehicle.hover_thrust, 1.5)
    assert end.position[1] < -0.05
    assert abs(end.position[0]) < 1e-6
    assert end.angular_velocity[0] == pytest.approx(0.3, abs=0.01)


def test_positive_pitch_rate_moves_forward(vehicle: Vehicle) -> None:
    end = fly(vehicle, (0.0, 0.3, 0.0), vehicle.hover_thrust, 0.8)
    assert end.position[0] > 0.05
    assert abs(end.position[1]) < 1e-6


def test_forward_is_along_the_heading(vehicle: Vehicle) -> None:
    end = fly(vehicle, (0.0, 0.3, 0.0), vehicle.hover_thrust, 0.8, yaw=math.pi / 2)
    assert end.position[1] > 0.05
    assert abs(end.position[0]) < 1e-6


def test_positive_yaw_rate_turns_counter_clockwise(vehicle: Vehicle) -> None:
    end = fly(vehicle, (0.0, 0.0, 0.5), vehicle.hover_thrust, 2.0)
    assert yaw_of(end.quaternion) == pytest.approx(0.5 * 2.0, abs=0.12)  # less the time to spin up
    # While the rotors change speed the mean of their squares is not quite the square they settle at.
    assert end.position[2] == pytest.approx(50.0, abs=0.01)


def test_more_thrust_climbs_by_the_believed_acceleration(vehicle: Vehicle) -> None:
    end = fly(vehicle, (0.0, 0.0, 0.0), 1.2 * vehicle.hover_thrust, 1.0)
    assert end.specific_force == pytest.approx((0.0, 0.0, 1.2 * GRAVITY), abs=1e-3)
    assert end.velocity[2] == pytest.approx(0.2 * GRAVITY * (1.0 - 0.005 - 0.02), rel=0.02)


def test_hover_thrust_holds_a_hover(vehicle: Vehicle) -> None:
    end = fly(vehicle, (0.0, 0.0, 0.0), vehicle.hover_thrust, 5.0)
    assert end.position == pytest.approx((0.0, 0.0, 50.0), abs=1e-6)
    assert end.specific_force == pytest.approx((0.0, 0.0, GRAVITY), abs=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_wire_frames_are_those_of_the_project(seed: int) -> None:
    generator = np.random.default_rng(seed)
    vector, q = generator.normal(size=3), generator.normal(size=4)
    q /= np.linalg.norm(q)
    assert wire.ned(tuple(vector)) == pytest.approx(enu_from_ned(vector))
    assert wire.attitude(tuple(q)) == pytest.approx(enu_flu_from_ned_frd(q))
    assert wire.attitude(wire.attitude(tuple(q))) == pytest.approx(q if q[0] >= 0 else -q)


@pytest.mark.parametrize("yaw", [-3.0, -1.0, 0.0, 0.7, 2.0])
def test_heading_east_is_ninety_degrees_from_north(yaw: float) -> None:
    q = wire.attitude(tuple(quaternion_from_euler([0.0, 0.0, yaw])))
    assert math.remainder(wire.euler(q)[2] - wire.heading(yaw), 2 * math.pi) == pytest.approx(0.0, abs=1e-12)
    assert math.remainder(wire.heading(wire.heading(yaw)) - yaw, 2 * math.pi) == pytest.approx(0.0, abs=1e-12)
    assert wire.heading(0.0) == pytest.approx(math.pi / 2)


def test_local_and_geodetic_are_inverse() -> None:
    position = (12.0, -34.0, 5.6)
    assert wire.local(*wire.geodetic(position)) == pytest.approx(position, abs=1e-6)


@pytest.mark.parametrize("integer", [0, 4, -1, 2000, -123456])
def test_integer_parameters_travel_bytewise(integer: int) -> None:
    assert wire.int_of_float(wire.float_of_int(integer)) == integer


@pytest.mark.parametrize("yaw", [-2.0, 0.0, 1.3])
def test_attitude_of_thrust_points_body_z_along_the_force(yaw: float) -> None:
    force = (1.0, -2.0, 9.0)
    q = attitude_of_thrust(force, yaw)
    rotation = rotation_matrix(np.array(q))
    assert rotation[:, 2] == pytest.approx(np.array(force) / np.linalg.norm(force))
    # Body x stays in the vertical plane of the heading: no component along the heading's left.
    assert rotation[:, 0] @ np.array([-math.sin(yaw), math.cos(yaw), 0.0]) == pytest.approx(0.0, abs=1e-12)
    assert tilt_of(q) == pytest.approx(math.acos(9.0 / np.linalg.norm(force)))
