"""What stands on the wire in NED and FRD arrives in ENU and FLU, whichever frame the velocity is in."""

from __future__ import annotations

import numpy as np
import pytest

from trueflight.companion.latest import mode_name
from trueflight.companion.odometry import odometry_from_wire
from trueflight.models import frames

LOCAL_NED, BODY_FRD = 1, 12


def wire(position, velocity, quaternion, angular_velocity, child_frame: int) -> dict[str, object]:
    """Fields of ODOMETRY for a state in ENU and FLU, by the vectorised maps of `models.frames`."""
    ned = frames.enu_from_ned(np.array(position))
    attitude = frames.enu_flu_from_ned_frd(np.array(quaternion))
    moving = frames.enu_from_ned(np.array(velocity))
    if child_frame != LOCAL_NED:
        moving = frames.flu_from_frd(frames.rotate_inverse(np.array(quaternion), np.array(velocity)))
    p, q, r = frames.flu_from_frd(np.array(angular_velocity))
    return {
        "time_usec": 123456,
        "arrived": 42,
        "child_frame_id": child_frame,
        **dict(zip(("x", "y", "z"), map(float, ned), strict=True)),
        **dict(zip(("vx", "vy", "vz"), map(float, moving), strict=True)),
        "q": [float(x) for x in attitude],
        "rollspeed": float(p),
        "pitchspeed": float(q),
        "yawspeed": float(r),
        "reset_counter": 3,
    }


@pytest.mark.parametrize("child_frame", [LOCAL_NED, 8, BODY_FRD])
def test_any_state_comes_back_from_either_frame(child_frame: int) -> None:
    rng = np.random.default_rng(child_frame)
    for _ in range(100):
        position, velocity, rates = rng.normal(size=(3, 3))
        quaternion = rng.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        odometry = odometry_from_wire(wire(position, velocity, quaternion, rates, child_frame))
        assert odometry is not None
        np.testing.assert_allclose(odometry.position, position, atol=1e-12)
        np.testing.assert_allclose(odometry.velocity, velocity, atol=1e-12)
        np.testing.assert_allclose(odometry.angular_velocity, rates, atol=1e-12)
        np.testing.assert_allclose(
            frames.rotation_matrix(np.array(odometry.quaternion)),
            frames.rotation_matrix(quaternion),
            atol=1e-12,
        )
        assert (odometry.vehicle_time_us, odometry.host_time_ns, odometry.reset_counter) == (123456, 42, 3)


def test_yawed_to_the_north_forward_is_north() -> None:
    """PX4 at yaw 0 (nose to the north), flying forward at 2 m/s, says so in either frame."""
    for child_frame in (LOCAL_NED, BODY_FRD):
        fields = wire((0, 0, 0), (0, 0, 0), (1, 0, 0, 0), (0, 0, 0), child_frame)
        fields.update(q=[1.0, 0.0, 0.0, 0.0], vx=2.0, vy=0.0, vz=0.0)
        odometry = odometry_from_wire(fields)
        assert odometry is not None
        np.testing.assert_allclose(odometry.velocity, (0.0, 2.0, 0.0), atol=1e-12)
        forward = frames.rotate(np.array(odometry.quaternion), np.array([1.0, 0.0, 0.0]))
        np.testing.assert_allclose(forward, (0.0, 1.0, 0.0), atol=1e-12)


@pytest.mark.parametrize(
    "change", [{"x": None}, {"vz": None}, {"q": [None] * 4}, {"q": [0.0] * 4}, {"y": float("nan")}]
)
def test_an_estimate_that_is_not_there_is_no_odometry(change: dict[str, object]) -> None:
    fields = wire((1, 2, 3), (1, 2, 3), (1, 0, 0, 0), (0, 0, 0), LOCAL_NED)
    assert odometry_from_wire({**fields, **change}) is None


def test_an_unknown_frame_is_an_error_not_a_guess() -> None:
    fields = wire((1, 2, 3), (1, 2, 3), (1, 0, 0, 0), (0, 0, 0), LOCAL_NED)
    with pytest.raises(ValueError, match="frame 20"):
        odometry_from_wire({**fields, "child_frame_id": 20})


@pytest.mark.parametrize(
    ("custom_mode", "name"),
    [
        (6 << 16, "OFFBOARD"),
        (4 << 16 | 6 << 24, "LAND"),
        (4 << 16 | 3 << 24, "HOLD"),
        (3 << 16, "POSCTL"),
        (0, "UNKNOWN"),
    ],
)
def test_modes_are_px4_s(custom_mode: int, name: str) -> None:
    assert mode_name(custom_mode) == name
