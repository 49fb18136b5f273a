"""Trajectories are smooth where they should be, and say truly where they go."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trueflight.models.errors import InputError
from trueflight.models.reference import KINDS, Trajectory, trajectory, trajectory_from_csv, transfer

SMOOTH = sorted(name for name in KINDS if not name.startswith("step") and name != "scenario")


@pytest.mark.parametrize("name", sorted(KINDS))
def test_one_sample_and_many_are_the_same(name: str) -> None:
    path = trajectory(name)
    times = np.linspace(-1.0, path.duration + 1.0, 97)
    columns = path.sample(times)
    for i, t in enumerate(times):
        one = path.at(float(t))
        np.testing.assert_allclose(one.position, columns.position[i], atol=1e-9)
        np.testing.assert_allclose(one.velocity, columns.velocity[i], atol=1e-9)
        np.testing.assert_allclose(one.acceleration, columns.acceleration[i], atol=1e-9)
        assert one.yaw == pytest.approx(columns.yaw[i], abs=1e-9)


@pytest.mark.parametrize("name", SMOOTH)
def test_velocity_and_acceleration_are_derivatives_of_position(name: str) -> None:
    path = trajectory(name)
    t = np.arange(0.0, path.duration, 1e-3)
    columns = path.sample(t)
    velocity = np.gradient(columns.position, t, axis=0)[2:-2]
    acceleration = np.gradient(columns.velocity, t, axis=0)[2:-2]
    # The error of central differences over 1 ms, with a jerk that has corners.
    np.testing.assert_allclose(velocity, columns.velocity[2:-2], atol=2e-4)
    np.testing.assert_allclose(acceleration, columns.acceleration[2:-2], atol=0.1)


@pytest.mark.parametrize("name", sorted(KINDS))
def test_a_trajectory_begins_and_ends_at_rest_and_keeps_its_own_bounds(name: str) -> None:
    path = trajectory(name)
    for t in (0.0, path.duration):
        assert math.hypot(*path.at(t).velocity) == pytest.approx(0.0, abs=1e-9)
    low, high = path.bounds
    columns = path.sample(np.linspace(0.0, path.duration, 3001))
    assert np.all(columns.position >= np.array(low) - 0.01)
    assert np.all(columns.position <= np.array(high) + 0.01)
    assert low[2] > 0.05, "never into the ground"
    assert path.start[:3] == path.at(0.0).position


@pytest.mark.parametrize("name", SMOOTH)
def test_no_command_is_outrageous(name: str) -> None:
    path = trajectory(name)
    assert path.max_acceleration < 6.5
    assert path.max_speed < 4.5


def test_excitation_shows_every_effect_in_less_than_a_minute() -> None:
    path = trajectory("excitation")
    assert 35.0 < path.duration < 50.0
    c = path.sample(np.arange(0.0, path.duration, 0.01))
    low = c.position[:, 2] < 0.35
    assert low.mean() > 0.08, "time near the ground"
    assert np.abs(c.velocity[low, 0]).max() > 2.0, "fast near the ground"
    for axis in (0, 1):
        assert c.velocity[:, axis].max() > 3.5
        assert c.velocity[:, axis].min() < -2.5
    assert c.velocity[:, 2].max() > 1.5
    assert np.abs(c.acceleration[:, 2]).max() > 5.0
    turned = c.yaw > 1.5
    assert np.linalg.norm(c.velocity[turned, :2], axis=1).max() > 3.5, "fast while yawed"
    speed = np.linalg.norm(c.velocity, axis=1)
    assert ((speed > 0.2) & (speed < 1.0)).mean() > 0.15, "slow as well"


@pytest.mark.parametrize("axis", ["x", "y", "z", "yaw"])
def test_steps_are_steps_in_their_own_axis_only(axis: str) -> None:
    path = trajectory(f"step_{axis}", size=0.5, time=2.0)
    c = path.sample(np.arange(0.0, path.duration, 0.01))
    values = np.column_stack([c.position, c.yaw])
    index = ["x", "y", "z", "yaw"].index(axis)
    spread = np.ptp(values, axis=0)
    assert spread[index] == pytest.approx(0.5)
    assert np.delete(spread, index) == pytest.approx(0.0)
    assert np.all(c.velocity == 0.0)


@pytest.mark.parametrize(("plane", "still"), [("xy", 2), ("xz", 1), ("yz", 0)])
def test_translations_stay_in_their_plane(plane: str, still: int) -> None:
    c = trajectory("translation", plane=plane).sample(np.linspace(0.0, 30.0, 500))
    spread = np.ptp(c.position, axis=0)
    assert spread[still] == pytest.approx(0.0)
    assert np.delete(spread, still) == pytest.approx(2.0, abs=0.01)


def test_a_transfer_turns_the_shorter_way_and_respects_its_limits() -> None:
    path = transfer((0.0, 0.0, 1.0, 3.0), (4.0, 3.0, 1.0, -3.0), speed=2.0, acceleration=2.0)
    yaw = path.sample(np.linspace(0.0, path.duration, 100)).yaw
    assert np.ptp(yaw) == pytest.approx(2 * math.pi - 6.0)
    assert path.max_speed <= 2.0 + 1e-9
    assert path.max_acceleration <= 2.0 + 1e-9


@settings(deadline=None, max_examples=40)
@given(
    st.sampled_from(["circle", "spiral", "lemniscate", "translation", "low_pass"]),
    st.floats(0.3, 6.0),
    st.floats(0.6, 5.0),
)
def test_speed_limits_hold_for_any_parameters(name: str, speed: float, height: float) -> None:
    path = trajectory(name, speed=speed, height=height)
    # Up to the greatest of what is asked and the vertical parts that have a pace of their own.
    assert path.max_speed <= max(speed, 1.5) * 1.01


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("lemniscat", {}, "did you mean 'lemniscate'"),
        ("circle", {"raduis": 2.0}, "did you mean 'radius'"),
        ("circle", {"radius": -1.0}, "outside"),
        ("circle", {"radius": "wide"}, "must be a number"),
        ("circle", {"radius": math.nan}, "outside"),
        ("translation", {"plane": "zz"}, "one of xy"),
    ],
)
def test_what_cannot_be_flown_is_told(name: str, parameters: dict[str, float | str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        trajectory(name, **parameters)


def test_setpoints_are_passed_at_their_times() -> None:
    rows = np.array(
        [[0, 0, 0, 1, 0], [1.0, 0.5, 0.2, 1.2, 0.3], [2.5, 1.5, 0.1, 1.1, 0.6], [4, 2, 0, 1, 0]], float
    )
    text = "t,x,y,z,yaw\n" + "\n".join(",".join(map(str, row)) for row in rows)
    path = trajectory_from_csv(text)
    for t, x, y, z, yaw in rows:
        sample = path.at(float(t))
        assert sample.position == pytest.approx((x, y, z))
        assert sample.yaw == pytest.approx(yaw)
    assert path.at(0.0).velocity == (0.0, 0.0, 0.0)
    c = path.sample(np.linspace(0.0, 4.0, 4001))
    np.testing.assert_allclose(np.gradient(c.position, c.t, axis=0)[5:-5], c.velocity[5:-5], atol=1e-3)


def test_a_dense_table_gives_back_the_trajectory_it_was_taken_from() -> None:
    original = trajectory("lemniscate")
    t = np.arange(0.0, original.duration, 0.05)
    c = original.sample(t)
    table = np.column_stack([t, c.position, c.velocity, c.acceleration, c.yaw])
    text = "t,x,y,z,vx,vy,vz,ax,ay,az,yaw\n" + "\n".join(",".join(f"{v:.12g}" for v in row) for row in table)
    copy = trajectory_from_csv(text)
    times = np.linspace(0.0, t[-1], 777)
    np.testing.assert_allclose(copy.sample(times).position, original.sample(times).position, atol=1e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("t,x,y\n0,0,0\n", "'z' is missing"),
        ("t,x,y,z\n0,0,0,1\n", "at least 2"),
        ("t,x,y,z,jaw\n0,0,0,1,0\n1,0,0,1,0\n", "did you mean 'yaw'"),
        ("t,x,y,z,vx\n0,0,0,1,0\n1,0,0,1,0\n", "all three or none"),
        ("t,x,y,z\n0,0,0,1\n0,0,0,1\n", "time does not increase at row 3"),
        ("t,x,y,z\n0,0,0,1\n1,0,zero,1\n", "row 3, column 'y'"),
        ("t,x,y,z\n0,0,0,1\n1,0,nan,1\n", "not finite"),
        ("t,x,y,z\n0,0,0,1\n1,0,0\n", "3 values for 4"),
        ("t,x,x,y,z\n0,0,0,0,1\n1,0,0,0,1\n", "named twice"),
    ],
)
def test_a_table_that_cannot_be_flown_is_told_with_its_row(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        trajectory_from_csv(text)


def test_a_trajectory_holds_its_ends() -> None:
    path = trajectory("spiral")
    assert isinstance(path, Trajectory)
    assert path.at(-5.0).position == path.start[:3]
    assert path.at(path.duration + 5.0).position == pytest.approx(path.end[:3])
    assert path.at(path.duration + 5.0).velocity == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("seed", range(12))
def test_the_scenario_steps_along_every_axis_and_translates_in_every_plane(seed: int) -> None:
    path = trajectory("scenario", seed=seed)
    assert 30.0 < path.duration < 45.0
    t = np.arange(0.0, path.duration, 0.01)
    c = path.sample(t)
    jumps = np.diff(c.position, axis=0)
    stepped = np.abs(jumps).max(axis=1) > 0.2  # smooth motion makes 0.02 m a sample at most
    assert stepped.sum() == 6  # each axis, there and back
    for axis in range(3):
        sizes = np.abs(jumps[stepped, axis])
        assert (sizes > 0.2).sum() == 2 and 0.5 <= sizes.max() <= 1.0
    moving = np.linalg.norm(c.velocity, axis=1) > 0.3
    assert np.all(np.abs(c.velocity).max(axis=0) > 0.5), "every axis is translated along"
    assert 0.3 < moving.mean() < 0.8
    assert path.max_speed <= 2.0 + 1e-9 and path.bounds[0][2] > 0.6


def test_another_seed_is_another_scenario_and_the_same_seed_the_same() -> None:
    t = np.arange(0.0, 30.0, 0.1)
    one, again, other = (trajectory("scenario", seed=s).sample(t).position for s in (4, 4, 5))
    assert np.array_equal(one, again)
    assert not np.allclose(one, other)


@pytest.mark.parametrize("seed", range(5))
def test_steps_go_everywhere_there_and_back_above_the_floor(seed: int) -> None:
    path = trajectory("steps", seed=seed, size=1.5, height=1.0, count=26, time=1.0)
    c = path.sample(np.arange(0.0, path.duration, 0.05))
    away = c.position - np.array(path.start[:3])
    directions = {tuple(np.sign(np.round(d, 6)).astype(int)) for d in away}
    assert len(directions) > 16  # those that would end below the floor are mirrored
    lengths = np.linalg.norm(away, axis=1)
    assert lengths.max() <= 1.5 + 1e-9 and lengths[lengths > 0].min() >= 0.75 - 1e-9
    assert c.position[:, 2].min() >= 0.3
