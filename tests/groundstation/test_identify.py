"""The vehicle's numbers with intervals that hold them, and its full state predicted from what was sent to it."""

from dataclasses import replace

import numpy as np
import pytest
from multirotor import TORQUE_CONSTANT, flown, vehicle
from scipy.spatial.transform import Rotation

from trueflight.groundstation.evaluate.full_state import predict
from trueflight.groundstation.evaluate.vehicle_model import identified
from trueflight.groundstation.identify.airframe import identify
from trueflight.groundstation.identify.spin import Spin, fit_spin
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.model import rigid_body_model
from trueflight.models.vehicle import GRAVITY

INERTIA = (0.024, 0.017, 0.03)


@pytest.mark.parametrize("rotors", [4, 6])
def test_inertia_torque_constant_and_lag_are_found_with_intervals_that_hold_them(rotors: int) -> None:
    flight = flown(vehicle(rotors), seed=101, lag=0.05, inertia=INERTIA)
    true = {
        "inertia_x": INERTIA[0],
        "inertia_y": INERTIA[1],
        "torque_constant_over_inertia_z": TORQUE_CONSTANT / INERTIA[2],
        "rotor_lag": 0.05,
    }
    for one in (
        flight,
        replace(flight, rotor_speed=None),
        replace(flight, rotor_speed=None, angular_velocity=None),
    ):
        found = identify(one)
        assert found is not None and found.undetermined == ()
        numbers = {n.name: n for n in found.numbers}
        for name, value in true.items():
            assert numbers[name].low <= value <= numbers[name].high, name
            assert numbers[name].high - numbers[name].low < (0.1 if "lag" not in name else 1.0) * value, name
        assert numbers["inertia_x"].believed == one.vehicle.inertia[0]


def test_what_something_else_turns_is_no_measure_of_the_rotors() -> None:
    flight = replace(flown(vehicle(4), seed=3, swing=0.1), rotor_speed=None)
    draw = np.random.default_rng(4)
    shaken = flight.angular_velocity + np.cumsum(0.1 * draw.standard_normal((len(flight), 3)), axis=0)  # type: ignore[operator]
    found = identify(replace(flight, angular_velocity=shaken))
    assert found is not None and found.numbers == ()
    assert {"inertia_x", "inertia_y", "rotor_lag"} <= set(found.undetermined)


def at_rest(seconds: float = 8.0) -> Flight:
    """A vehicle that hovers, at a clock of 100 Hz."""
    n, craft = round(seconds / 0.01), vehicle(4)
    return Flight(
        "rest", craft, np.arange(n) * 0.01, position=np.zeros((n, 3)), velocity=np.zeros((n, 3)),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)), angular_velocity=np.zeros((n, 3)),
        thrust_command=np.full(n, craft.hover_thrust), body_rate_command=np.zeros((n, 3)),
    )  # fmt: skip


IDLE = Spin(vehicle(4), "commands", 0.0, 0.0, np.zeros(3), np.zeros((3, 2)), np.zeros(3))
"""A rotation that nothing drives."""


def test_errors_are_mean_lengths_and_the_angle_between_attitudes() -> None:
    flight, model = at_rest(), rigid_body_model(vehicle(4))
    still = predict(flight, model, IDLE)
    assert still is not None and [e.horizon for e in still.errors] == [0.1, 0.5, 1.0]
    for error in still.errors:
        assert (error.position, error.velocity, error.attitude, error.rate) == pytest.approx(
            (0, 0, 0, 0), abs=1e-6
        )
    # it turns about its vertical axis, which its gyroscope does not say
    turned = Rotation.from_rotvec(np.outer(flight.t, [0.0, 0.0, 0.3])).as_quat(scalar_first=True)
    drifting = predict(replace(flight, quaternion=turned), model, IDLE)
    assert drifting is not None
    assert [e.attitude for e in drifting.errors] == pytest.approx([0.03, 0.15, 0.3], abs=1e-6)
    # 3 and 4 m/s that it does not keep: a length of 5
    blown = replace(flight, position=flight.t[:, None] * [3.0, 4.0, 0.0])
    moved = predict(blown, model, IDLE)
    assert moved is not None and moved.errors[1].position == pytest.approx(2.5, abs=1e-6)


def test_a_tilted_vehicle_that_turns_is_predicted_to_fall_sideways() -> None:
    # from level, turning about body x at w rad/s: -g sin(w t) along y, by hand
    flight, w = at_rest(), 0.4
    rolling = replace(
        flight,
        angular_velocity=np.tile([w, 0.0, 0.0], (len(flight), 1)),
        quaternion=Rotation.from_rotvec(np.outer(flight.t, [w, 0.0, 0.0])).as_quat(scalar_first=True),
    )
    sideways = GRAVITY / w * (np.cos(w * flight.t) - 1.0)
    down = GRAVITY * (np.sin(w * flight.t) / w - flight.t)
    velocity = np.stack([0.0 * flight.t, sideways, down], axis=1)
    position = np.cumsum(0.5 * (velocity[1:] + velocity[:-1]), axis=0) * 0.01
    true = replace(rolling, velocity=velocity, position=np.concatenate([np.zeros((1, 3)), position]))
    found = predict(true, rigid_body_model(vehicle(4)), IDLE)
    assert found is not None
    assert (
        found.errors[2].velocity < 2e-3
        and found.errors[2].position < 2e-3
        and found.errors[2].attitude < 1e-6
    )


def test_the_rotation_from_motors_or_from_rate_commands_beats_a_rate_that_stays() -> None:
    seen = flown(vehicle(6), seconds=15.0, seed=40, lag=0.04, inertia=INERTIA)
    unseen = flown(vehicle(6), seconds=15.0, seed=41, lag=0.04, inertia=INERTIA)
    n = len(unseen)
    placed = replace(unseen, position=np.zeros((n, 3)), rotor_speed=None)
    stays = predict(placed, rigid_body_model(vehicle(6)), replace(IDLE, vehicle=vehicle(6), inputs="motors"))
    spin = fit_spin([replace(seen, rotor_speed=None)])
    assert spin is not None and spin.inputs == "motors"
    assert spin.lag + spin.delay == pytest.approx(0.045, abs=0.01)
    found = predict(placed, rigid_body_model(vehicle(6)), spin)
    assert found is not None and stays is not None
    for mine, other in zip(found.errors, stays.errors, strict=True):
        assert mine.rate < 0.2 * other.rate and mine.attitude < 0.4 * other.attitude


def test_rate_commands_are_enough_where_no_motor_was_logged() -> None:
    draw, dt, n = np.random.default_rng(5), 0.01, 1500
    command = np.cumsum(draw.standard_normal((n, 3)), axis=0) * 0.02
    command -= command.mean(axis=0)
    rate = np.zeros((n, 3))
    for k in range(1, n):
        rate[k] = rate[k - 1] + dt * (command[max(k - 4, 0)] - rate[k - 1]) / 0.06
    flight = replace(at_rest(n * dt), angular_velocity=rate, body_rate_command=command)
    spin = fit_spin([flight])
    assert spin is not None and spin.inputs == "commands"
    # gain over damping is 1: commands are followed
    assert spin.gains[:, 0] / spin.damping == pytest.approx(np.ones(3), abs=0.1)


def test_a_flight_without_inputs_is_refused_with_what_it_needs() -> None:
    flight = replace(at_rest(), body_rate_command=None)
    with pytest.raises(InputError, match="motor_command, rotor_speed or body_rate_command"):
        identified([flight], rigid_body_model(flight.vehicle))
    with pytest.raises(InputError, match="motor_command or rotor_speed"):
        identified([at_rest()], rigid_body_model(flight.vehicle), inputs="motors")
