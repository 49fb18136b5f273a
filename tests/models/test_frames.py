"""Every conversion against plain vector algebra: frames and signs kill drones."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from trueflight.models import frames

angle = st.floats(-3.1, 3.1)
pitch = st.floats(-1.5, 1.5)
vector = arrays(float, 3, elements=st.floats(-10, 10))


def elementary(phi: float, theta: float, psi: float) -> np.ndarray:
    cx, sx, cy, sy, cz, sz = (f(a) for a in (phi, theta, psi) for f in (math.cos, math.sin))
    rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return rz @ ry @ rx


@given(angle, pitch, angle)
def test_euler_quaternion_and_matrix_are_one_rotation(phi: float, theta: float, psi: float) -> None:
    euler = np.array([phi, theta, psi])
    quaternion = frames.quaternion_from_euler(euler)
    np.testing.assert_allclose(np.linalg.norm(quaternion), 1.0, atol=1e-12)
    np.testing.assert_allclose(frames.rotation_matrix(quaternion), elementary(phi, theta, psi), atol=1e-12)
    np.testing.assert_allclose(frames.euler_from_quaternion(quaternion), euler, atol=1e-6)


@given(angle, pitch, angle, vector)
def test_rotate_and_its_inverse(phi: float, theta: float, psi: float, v: np.ndarray) -> None:
    quaternion = frames.quaternion_from_euler(np.array([phi, theta, psi]))
    world = frames.rotate(quaternion, v)
    np.testing.assert_allclose(world, elementary(phi, theta, psi) @ v, atol=1e-9)
    np.testing.assert_allclose(frames.rotate_inverse(quaternion, world), v, atol=1e-9)


@given(angle, vector)
def test_heading_frame_is_the_world_turned_by_yaw(psi: float, v: np.ndarray) -> None:
    ahead, left = (
        np.array([math.cos(psi), math.sin(psi), 0.0]),
        np.array([-math.sin(psi), math.cos(psi), 0.0]),
    )
    np.testing.assert_allclose(frames.heading_from_world(v, psi), [v @ ahead, v @ left, v[2]], atol=1e-9)
    np.testing.assert_allclose(
        frames.world_from_heading(frames.heading_from_world(v, psi), psi), v, atol=1e-9
    )


def test_signs_that_a_pilot_can_check() -> None:
    roll_right = frames.quaternion_from_euler(np.array([0.2, 0.0, 0.0]))
    assert frames.rotate(roll_right, np.array([0.0, 0.0, 1.0]))[1] < 0, (
        "positive roll pushes to the right, -y"
    )
    nose_down = frames.quaternion_from_euler(np.array([0.0, 0.2, 0.0]))
    assert frames.rotate(nose_down, np.array([0.0, 0.0, 1.0]))[0] > 0, "positive pitch (FLU) pushes forward"
    turned_left = frames.quaternion_from_euler(np.array([0.0, 0.0, 0.5]))
    assert frames.rotate(turned_left, np.array([1.0, 0.0, 0.0]))[1] > 0, "positive yaw turns to the left"


@given(angle, pitch, angle, vector)
def test_ned_frd_is_the_same_attitude_and_the_same_vectors(
    phi: float, theta: float, psi: float, v: np.ndarray
) -> None:
    north_east_down = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    front_right_down = np.diag([1.0, -1, -1])
    quaternion = frames.quaternion_from_euler(np.array([phi, theta, psi]))  # FRD to NED
    ours = frames.rotation_matrix(frames.enu_flu_from_ned_frd(quaternion))
    np.testing.assert_allclose(
        ours, north_east_down @ elementary(phi, theta, psi) @ front_right_down, atol=1e-9
    )
    np.testing.assert_allclose(frames.enu_from_ned(v), north_east_down @ v)
    np.testing.assert_allclose(frames.flu_from_frd(v), front_right_down @ v)
    np.testing.assert_allclose(frames.enu_from_ned(frames.enu_from_ned(v)), v)


@given(st.floats(-50, 50))
def test_wrapped_angle_is_the_same_direction(a: float) -> None:
    wrapped = float(frames.wrap_angle(a))
    assert -math.pi <= wrapped < math.pi
    assert math.isclose(math.cos(wrapped), math.cos(a), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(a), abs_tol=1e-9)
