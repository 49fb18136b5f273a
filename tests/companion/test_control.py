"""The cascade pushes the right way, stays within its limits, and is the paper's law at hover."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trueflight.companion.law.control import ControlLaw, Limits, State, euler, features
from trueflight.models import frames
from trueflight.models.contract import FEATURES, YAW_FEATURES
from trueflight.models.design import hover_input_matrix, load_design
from trueflight.models.errors import InputError
from trueflight.models.trajectory import ReferenceSample
from trueflight.models.vehicle import GRAVITY, load_vehicle

QUAD5 = Path(__file__).parents[2] / "models" / "vehicles" / "quad5"
VEHICLE = load_vehicle(QUAD5 / "vehicle.toml")
DESIGN = load_design(QUAD5 / "design.json")
LAW = ControlLaw(VEHICLE, DESIGN)
HERE = (0.0, 0.0, 1.0)


def reference(
    position=HERE, velocity=(0.0, 0.0, 0.0), acceleration=(0.0, 0.0, 0.0), yaw=0.0
) -> ReferenceSample:
    return ReferenceSample(position, velocity, acceleration, yaw, 0.0)


def state(position=HERE, velocity=(0.0, 0.0, 0.0), roll=0.0, pitch=0.0, yaw=0.0) -> State:
    q = tuple(float(x) for x in frames.quaternion_from_euler(np.array([roll, pitch, yaw])))
    return State(position, velocity, q, position[2], 16.0)


angles = st.floats(-math.pi, math.pi)
lengths = st.floats(-3.0, 3.0)


def test_at_rest_on_the_reference_it_asks_for_the_weight_and_no_rates() -> None:
    step = LAW.step(state(), reference())
    assert step.command.thrust == pytest.approx(VEHICLE.weight)
    assert step.thrust_command == pytest.approx(VEHICLE.hover_thrust)
    assert step.command.body_rate == pytest.approx((0.0, 0.0, 0.0))


@pytest.mark.parametrize("yaw", [0.0, 0.5 * math.pi, 2.5, -1.0])
def test_an_error_in_the_world_tilts_thrust_towards_the_reference(yaw: float) -> None:
    for direction in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)):
        target = (HERE[0] + direction[0], HERE[1] + direction[1], HERE[2])
        attitude = LAW.feedback(state(yaw=yaw), yaw, reference(target, yaw=yaw))
        zeta = np.array([attitude.roll, attitude.pitch, yaw])
        thrust_axis = frames.rotate(frames.quaternion_from_euler(zeta), np.array([0.0, 0.0, 1.0]))
        horizontal = thrust_axis[:2] / np.linalg.norm(thrust_axis[:2])
        assert horizontal @ np.array(direction) > 0.99


def test_below_the_reference_it_pushes_harder() -> None:
    assert LAW.step(state((0.0, 0.0, 0.5)), reference()).command.thrust > VEHICLE.weight
    assert LAW.step(state((0.0, 0.0, 1.5)), reference()).command.thrust < VEHICLE.weight


@settings(max_examples=200)
@given(angles, lengths, lengths, lengths, lengths, lengths, lengths, lengths, lengths, lengths)
def test_the_position_loop_is_equation_16_in_the_heading_frame(yaw, x, y, z, vx, vy, vz, ax, ay, az) -> None:
    law = ControlLaw(VEHICLE, DESIGN, Limits(tilt=100.0, thrust_low=-100.0, thrust_high=100.0))
    thrust_limit = 0.95 * float(VEHICLE.thrust(1.0))
    attitude = law.feedback(
        state((x, y, z), (vx, vy, vz), yaw=yaw), yaw, reference((0, 0, 0), acceleration=(ax, ay, az))
    )
    turn = lambda v: frames.heading_from_world(np.array(v), np.array(yaw))  # noqa: E731
    eta = np.concatenate([turn([x, y, z]), turn([vx, vy, vz])])
    u = -np.array(DESIGN.K_eta) @ eta + np.linalg.inv(hover_input_matrix(VEHICLE.mass)) @ turn([ax, ay, az])
    expected = [u[0], u[1], min(u[2] + VEHICLE.weight, thrust_limit)]
    np.testing.assert_allclose([attitude.roll, attitude.pitch, attitude.thrust], expected, atol=1e-9)


@settings(max_examples=200)
@given(angles, st.floats(-1.2, 1.2), angles, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), angles)
def test_body_rates_turn_the_euler_angles_as_the_linear_design_says(
    roll, pitch, yaw, r_ref, p_ref, y_ref
) -> None:
    """The attitude that a small turn by these body rates leads to, against equation 13."""
    law = ControlLaw(VEHICLE, DESIGN, Limits(body_rate=1e9, yaw_rate=1e9))
    zeta = np.array([roll, pitch, yaw])
    command = law.command(
        (roll, pitch, yaw), law.feedback(state(), 0.0, reference())._replace(roll=r_ref, pitch=p_ref), y_ref
    )
    error = zeta - np.array([r_ref, p_ref, y_ref])
    error[2] = frames.wrap_angle(error[2])
    wanted = -np.array(DESIGN.K_zeta) @ error
    dt = 1e-6
    half = 0.5 * dt * np.array(command.body_rate)
    w, x, y, z = frames.quaternion_from_euler(zeta)
    turned = np.array([w, x, y, z]) + np.array(
        [
            -x * half[0] - y * half[1] - z * half[2],
            w * half[0] + y * half[2] - z * half[1],
            w * half[1] - x * half[2] + z * half[0],
            w * half[2] + x * half[1] - y * half[0],
        ]
    )
    moved = frames.euler_from_quaternion(turned / np.linalg.norm(turned))
    rate = frames.wrap_angle(moved - zeta) / dt
    np.testing.assert_allclose(rate, wanted, atol=1e-3 * (1 + np.abs(wanted).max()))


@settings(max_examples=200)
@given(lengths, lengths, lengths)
def test_the_correction_cancels_an_error_acceleration_in_the_linear_model(dx, dy, dz) -> None:
    law = ControlLaw(VEHICLE, DESIGN, Limits(tilt=100.0))
    plain = law.feedback(state(), 0.0, reference())
    corrected = law.corrected(plain, (dx, dy, dz))
    change = np.array(corrected) - np.array(plain)
    np.testing.assert_allclose(hover_input_matrix(VEHICLE.mass) @ change, [-dx, -dy, -dz], atol=1e-9)


@settings(max_examples=300)
@given(
    st.tuples(*[st.floats(-1e6, 1e6)] * 3),
    st.tuples(*[st.floats(-1e3, 1e3)] * 3),
    angles,
    st.floats(-1.5, 1.5),
    angles,
    st.tuples(*[st.floats(-1e3, 1e3)] * 3),
)
def test_whatever_the_state_the_command_stays_within_the_limits(
    position, velocity, roll, pitch, yaw, acceleration
) -> None:
    step = LAW.step(state(position, velocity, roll, pitch, yaw), reference(acceleration=acceleration))
    limits = LAW.limits
    assert limits.thrust_low * VEHICLE.weight <= step.command.thrust <= limits.thrust_high * VEHICLE.weight
    assert 0.0 <= step.thrust_command <= 1.0
    p, q, r = step.command.body_rate
    assert max(abs(p), abs(q)) <= limits.body_rate
    assert abs(r) <= limits.yaw_rate


def test_a_tilt_limit_keeps_the_direction() -> None:
    attitude = LAW.feedback(state((-30.0, -15.0, 1.0)), 0.0, reference())
    assert math.hypot(attitude.roll, attitude.pitch) == pytest.approx(LAW.limits.tilt)
    assert -attitude.roll / attitude.pitch == pytest.approx(0.5)


def test_yaw_takes_the_shorter_way() -> None:
    left = LAW.step(state(yaw=3.1), reference(yaw=-3.1)).command.body_rate[2]
    assert left > 0.0


def test_euler_angles_are_those_of_the_frames_module() -> None:
    rng = np.random.default_rng(1)
    for q in rng.normal(size=(50, 4)):
        q /= np.linalg.norm(q)
        np.testing.assert_allclose(euler(tuple(q)), frames.euler_from_quaternion(q), atol=1e-12)


def test_features_are_the_contract_s() -> None:
    yaw = 0.5 * math.pi
    here = state((5.0, 6.0, 1.5), (1.0, 2.0, 3.0), yaw=yaw)
    attitude = LAW.feedback(here, yaw, reference())._replace(roll=0.1, pitch=-0.2, thrust=8.0)
    named = dict(zip((*FEATURES, *YAW_FEATURES), features(here, yaw, attitude, 15.5, True), strict=True))
    # Yawed to the north, the world's x (east) is to the right: minus y of the heading frame.
    assert named["vx"] == pytest.approx(2.0)
    assert named["vy"] == pytest.approx(-1.0)
    expected = {
        "z": 1.5,
        "vz": 3.0,
        "u_batt": 15.5,
        "T": 8.0,
        "cos_phi": math.cos(0.1),
        "sin_phi": math.sin(0.1),
    }
    expected |= {"cos_theta": math.cos(0.2), "sin_theta": -math.sin(0.2), "cos_psi": 0.0, "sin_psi": 1.0}
    for name, value in expected.items():
        assert named[name] == pytest.approx(value, abs=1e-12), name
    assert len(features(here, yaw, attitude, 15.5, False)) == len(FEATURES)


def test_a_design_for_another_vehicle_never_flies() -> None:
    with pytest.raises(InputError, match="made for vehicle"):
        ControlLaw(replace(VEHICLE, name="other"), DESIGN)


def test_the_linear_closed_loop_flown_by_the_law_follows_its_design() -> None:
    """A step flown on the linear vehicle (9) by this code decays as the eigenvalues of the design say."""
    dt, position, velocity = 0.002, np.array([0.5, -0.4, 1.3]), np.zeros(3)
    for _ in range(2500):
        here = state(tuple(position), tuple(velocity))
        attitude = LAW.feedback(here, 0.0, reference())
        u = np.array([attitude.roll, attitude.pitch, attitude.thrust - VEHICLE.mass * GRAVITY])
        velocity = velocity + dt * hover_input_matrix(VEHICLE.mass) @ u
        position = position + dt * velocity
    # 5 s at the slowest pole, real part below -1.7 1/s.
    np.testing.assert_allclose(position, HERE, atol=0.5 * 5 * math.exp(-1.7 * 5))
