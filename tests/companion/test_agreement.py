"""The odometry against gyroscope and accelerometer: plain vector algebra, and flights of every hidden effect."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trueflight.companion.agreement import Agreement, AgreementLimits, _turned, rotated
from trueflight.companion.odometry import ImuSample, Odometry
from trueflight.models import frames
from trueflight.models.design import load_design
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.in_process import Sample, fly
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.truth.hidden import choose

QUAD5 = Path(__file__).parents[2] / "models" / "vehicles" / "quad5"
numbers = st.floats(-1.0, 1.0)
quaternions = st.tuples(numbers, numbers, numbers, numbers).filter(lambda q: np.linalg.norm(q) > 0.1)


def unit(q: tuple[float, ...]) -> tuple[float, float, float, float]:
    w, x, y, z = (float(c) for c in np.array(q) / np.linalg.norm(q))
    return w, x, y, z


@given(q=quaternions, v=st.tuples(numbers, numbers, numbers))
def test_rotated_is_the_rotation_matrix(q: tuple[float, ...], v: tuple[float, float, float]) -> None:
    expected = frames.rotation_matrix(np.array(unit(q))) @ np.array(v)
    assert rotated(unit(q), v) == pytest.approx(expected, abs=1e-12)


@given(q=quaternions, v=st.tuples(*[st.floats(-0.05, 0.05)] * 3))
def test_turned_is_the_small_rotation_in_body_axes(
    q: tuple[float, ...], v: tuple[float, float, float]
) -> None:
    before = frames.rotation_matrix(np.array(unit(q)))
    x, y, z = v
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    small = np.eye(3) + skew + 0.5 * skew @ skew
    w, i, j, k = unit(q)
    a, b, c, d = 1 - (x * x + y * y + z * z) / 8, x / 2, y / 2, z / 2
    after = unit(
        (
            w * a - i * b - j * c - k * d,
            w * b + i * a + j * d - k * c,
            w * c - i * d + j * a + k * b,
            w * d + i * c - j * b + k * a,
        )
    )
    assert frames.rotation_matrix(np.array(after)) == pytest.approx(before @ small, abs=1e-3)
    assert _turned(unit(q), after) == pytest.approx(v, abs=1e-4)


def judged(hidden: str, path: str, seed: int, spoil=None, **parameters: float) -> tuple[Agreement, list[str]]:
    """A simulated flight as the companion hears it; `spoil` changes the odometry after 10 s."""
    vehicle = load_vehicle(QUAD5 / "vehicle.toml")
    design = load_design(QUAD5 / "design.json", vehicle)
    agreement, reasons = Agreement(AgreementLimits()), []

    def heard(sample: Sample) -> None:
        e = sample.estimate
        odometry = Odometry(e.time_us, 0, e.position, e.velocity, e.quaternion, e.angular_velocity, 0)
        if spoil is not None and e.time_us > 10_000_000:
            odometry = spoil(odometry)
        reasons.append(agreement.step(odometry, ImuSample(e.time_us, e.specific_force, e.angular_velocity)))

    plan = Plan(vehicle, design, trajectory(path, **parameters), choose([hidden], vehicle, seed), seed)
    assert fly(plan, heard).outcome == "finished"
    return agreement, reasons


@pytest.mark.parametrize(
    "hidden", ["none", "rich", "estimator_delay:0.05", "imu_lever_arm", "accelerometer_bias"]
)
@pytest.mark.parametrize("path", ["lemniscate", "excitation"])
def test_no_flight_with_a_hidden_effect_disagrees(hidden: str, path: str) -> None:
    agreement, reasons = judged(hidden, path, seed=11)
    assert not any(reasons)
    limits, found = agreement.limits, agreement.greatest
    assert 2.0 * found.turn < limits.turn
    assert 2.0 * found.velocity < limits.velocity
    assert 2.0 * found.position < limits.position
    assert 2.0 * found.drift < limits.drift


def standing_still(noise: float):
    first: list[Odometry] = []
    generator = np.random.default_rng(5)

    def spoil(odometry: Odometry) -> Odometry:
        first.append(odometry)
        x, y, z = noise * generator.standard_normal(3)
        w, i, j, k = first[0].quaternion
        return first[0]._replace(
            vehicle_time_us=odometry.vehicle_time_us,
            velocity=tuple(v + x for v in first[0].velocity),
            position=tuple(v + y for v in first[0].position),
            quaternion=unit((w, i + 0.5 * x, j + 0.5 * y, k + 0.5 * z)),
        )

    return spoil


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_odometry_that_stands_still_in_a_moving_vehicle_disagrees(noise: float) -> None:
    _, reasons = judged("none", "lemniscate", 3, standing_still(noise), speed=2.0)
    assert not any(reasons[:999])
    assert any(reasons[1000:1200])


def test_a_mirrored_axis_and_another_vehicles_attitude_disagree() -> None:
    def mirrored(odometry: Odometry) -> Odometry:
        w, x, y, z = odometry.quaternion
        return odometry._replace(quaternion=(w, -x, y, z))

    _, reasons = judged("none", "excitation", 4, mirrored)
    assert any(reasons[1000:])
