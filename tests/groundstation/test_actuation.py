"""A wrong sign or order of thrust, motors and rotors is named, in real and simulated flights."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.actuation import BATTERY, LIFT, MOTORS, ROTORS, TORQUE, actuation_checks
from trueflight.models.flight import COLUMNS, Check, Flight
from trueflight.models.model import rigid_body_model

SAMPLES = Path(__file__).parents[2] / "samples"
Columns = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def crazyflie() -> Flight:
    """A real flight with its motor commands."""
    return read_flight(SAMPLES / "crazyflie" / "ddsysid_crazyflie_log10_500Hz.parquet")


@pytest.fixture(scope="module")
def simulated() -> Flight:
    return read_flight(SAMPLES / "rotorpy" / "nothing_hidden" / "identify.parquet")


def columns_of(flight: Flight, *left_out: str) -> Columns:
    named = {n: getattr(flight, n, None) for n in COLUMNS if n not in ("t", "flying", *left_out)}
    return {n: column for n, column in named.items() if column is not None}


def checked(flight: Flight, columns: Columns) -> dict[str, Check]:
    assert flight.flying is not None
    return {c.pair: c for c in actuation_checks(flight.t, columns, flight.flying, flight.vehicle)}


def test_every_other_order_of_the_motors_is_refused_and_named(crazyflie: Flight) -> None:
    good = columns_of(crazyflie)
    motors = good["motor_command"]
    assert checked(crazyflie, good)[TORQUE].verdict == "agrees"
    for order in itertools.permutations(range(4)):
        if order == (0, 1, 2, 3):
            continue
        check = checked(crazyflie, {**good, "motor_command": motors[:, order]})[TORQUE]
        wanted = ", ".join(f"motor_command_{k + 1}" for k in np.argsort(order))
        assert check.verdict == "contradicts" and wanted in check.text, (order, check)


@pytest.mark.parametrize("imu", [True, False], ids=["with IMU", "without"])
def test_a_height_that_points_down_is_refused_with_the_mapping(simulated: Flight, imu: bool) -> None:
    good = columns_of(simulated, *(() if imu else ("angular_velocity", "specific_force")))
    assert checked(simulated, good)[LIFT].verdict == "agrees"
    down = [1.0, 1.0, -1.0]
    names = ("specific_force",) if imu else ("position", "velocity")
    check = checked(simulated, {**good, **{n: good[n] * down for n in names}})[LIFT]
    assert check.verdict == "contradicts"
    assert f'{names[0]}.axes = ["x", "y", "-z"]' in check.mapping


def test_thrust_of_another_vehicle_is_told(simulated: Flight) -> None:
    good = columns_of(simulated)
    check = checked(simulated, {**good, "thrust_command": good["thrust_command"][::-1]})[LIFT]
    assert check.verdict == "weak" and "hardly follows the thrust" in check.text


def test_a_vehicle_that_feels_nothing_of_its_thrust_is_refused(simulated: Flight) -> None:
    """On a bench without propellers: the command is flown, the accelerometer lies still."""
    good = columns_of(simulated, "position", "velocity")
    still = np.tile([0.2, -0.1, 9.8], (len(simulated), 1)) + 0.05 * np.random.default_rng(1).normal(
        size=(len(simulated), 3)
    )
    check = checked(simulated, {**good, "specific_force": still})[LIFT]
    assert check.verdict == "contradicts" and "without propellers" in check.text
    third = good["specific_force"] * [1.0, 1.0, 1.0 / 3.0]
    assert checked(simulated, {**good, "specific_force": third})[LIFT].verdict == "agrees"


def test_nothing_is_called_missing_where_the_thrust_is_hardly_felt(simulated: Flight) -> None:
    """The command of other moments, and a bias that would be missing beside the right one."""
    heavy = replace(simulated, specific_force=1.1 * simulated.specific_force)
    assert "thrust_gain" in diagnose(heavy, rigid_body_model(heavy.vehicle)).named("missing")
    weak = Check(LIFT, "weak", 1.0, "hardly follows")
    found = diagnose(replace(heavy, consistency=(weak,)), rigid_body_model(heavy.vehicle))
    assert not [e for e in found.effects if e.verdict == "missing" and e.seen_in == "acceleration"]
    gain = next(e for e in found.effects if e.name == "thrust_gain")
    assert gain.verdict == "possible" and "hardly follows" in gain.rests_on


def test_motors_that_do_not_follow_the_thrust_are_told(crazyflie: Flight) -> None:
    good = columns_of(crazyflie)
    thrust = good["motor_command"].mean(axis=1) * 1.01 + 0.01
    assert checked(crazyflie, {**good, "thrust_command": thrust})[MOTORS].verdict == "agrees"
    assert checked(crazyflie, {**good, "thrust_command": thrust[::-1]})[MOTORS].verdict == "weak"
    assert checked(crazyflie, {**good, "thrust_command": 1.0 - thrust})[MOTORS].verdict == "contradicts"


def test_rotor_speeds_in_another_order_than_their_motors_are_named(crazyflie: Flight) -> None:
    good = columns_of(crazyflie)
    speeds = 2500.0 * np.sqrt(np.clip(good["motor_command"], 0.0, 1.0))
    speeds[5:] = speeds[:-5]  # 10 ms later
    assert checked(crazyflie, {**good, "rotor_speed": speeds})[ROTORS].verdict == "agrees"
    check = checked(crazyflie, {**good, "rotor_speed": speeds[:, [1, 0, 3, 2]]})[ROTORS]
    assert check.verdict == "contradicts"
    assert "rotor_speed_2, rotor_speed_1, rotor_speed_4, rotor_speed_3" in check.text
    assert checked(crazyflie, {**good, "rotor_speed": speeds[::-1]})[ROTORS].verdict == "weak"


def test_a_hover_says_that_it_cannot_tell(simulated: Flight) -> None:
    generator = np.random.default_rng(1)
    good = columns_of(simulated)
    hover = np.tile([0.0, 0.0, 9.81], (len(simulated), 1)) + 0.3 * generator.standard_normal(
        (len(simulated), 3)
    )
    level = 0.4 + 0.001 * generator.standard_normal(len(simulated))
    check = checked(simulated, {**good, "specific_force": hover, "thrust_command": level})[LIFT]
    assert check.verdict == "cannot tell"


def test_a_voltage_that_rises_with_the_thrust_is_told(simulated: Flight) -> None:
    good = columns_of(simulated)
    sagging = 16.0 - 4.0 * good["thrust_command"] - 0.005 * simulated.t
    assert checked(simulated, {**good, "battery_voltage": sagging})[BATTERY].verdict == "agrees"
    assert checked(simulated, {**good, "battery_voltage": 32.0 - sagging})[BATTERY].verdict == "weak"
    stopped = checked(simulated, {**good, "battery_voltage": np.full(len(simulated), 16.0)})[BATTERY]
    assert stopped.verdict == "cannot tell" and "16.00 V from first to last" in stopped.text
