"""The tube of the stability bound: no linear system leaves it, and a flight that does is told."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from trueflight.groundstation.commands.app import app
from trueflight.groundstation.design.linear_design import make_design
from trueflight.groundstation.design.linear_response import Reference, expected_behaviour
from trueflight.groundstation.evaluate.bound import (
    balls_of,
    jumps_of,
    memory,
    predict_tube,
    smallest_ball,
    stability_tube,
)
from trueflight.groundstation.evaluate.tracking import read_designed
from trueflight.models.design import load_design
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.frames import quaternion_from_euler, rotate_inverse
from trueflight.models.vehicle import GRAVITY, load_vehicle

QUAD5 = Path(__file__).parents[2] / "models" / "vehicles" / "quad5"
VEHICLE = load_vehicle(QUAD5 / "vehicle.toml")
DESIGN = load_design(QUAD5 / "design.json", VEHICLE)
BIN = Path(sys.executable).parent
DT = 0.01


def solve(p, v, start, d, jumps):
    """The exact states of `e'' = -p e - v e' + d` at each sample, d held between samples, eta jumping by -jumps."""
    block = np.zeros((3, 3))
    block[0, 1], block[1] = 1.0, (-p, -v, 1.0)
    step = expm(block * DT)
    states = [np.asarray(start, dtype=float)]
    for held, jump in zip(d[:-1], jumps[1:], strict=True):
        states.append(step[:2, :2] @ states[-1] + step[:2, 2] * held - jump)
    return np.array(states)


gain = st.floats(0.3, 30.0)
damping = st.floats(0.2, 2.0)


@settings(max_examples=60, deadline=None)
@given(p=gain, zeta=damping, seed=st.integers(0, 10_000), kind=st.sampled_from(["noise", "square", "spikes"]))
def test_no_bounded_disturbance_takes_the_state_out_of_its_tube(p, zeta, seed, kind):
    rng = np.random.default_rng(seed)
    v, n = 2 * zeta * np.sqrt(p), 600
    d = {
        "noise": rng.uniform(-1.0, 1.0, n),
        "square": np.sign(np.sin(np.sqrt(p) * DT * np.arange(n) + rng.uniform(0, 6))),
        "spikes": np.where(rng.random(n) < 0.02, rng.choice([-1.0, 1.0], n), 0.0),
    }[kind] * rng.uniform(0.1, 5.0)
    jumps = np.where(rng.random((n, 1)) < 0.005, rng.normal(size=(n, 2)), 0.0)
    jumps[0] = 0.0
    ball = smallest_ball(p, v)
    states = solve(p, v, rng.normal(size=2), d, jumps)
    level = ball.level(states)
    radius, bound = memory(d, ball.decay, DT).max(), np.abs(d).max()
    assert radius <= bound * (1 + 1e-12)
    allowed = stability_tube(ball, radius, bound, DT * np.arange(n), level[0], jumps)
    assert np.all(level <= allowed * (1 + 1e-9) + 1e-12)
    # The tube's extent in position and velocity holds as well, each on its own.
    assert np.all(np.abs(states) <= allowed[:, None] * [ball.position, ball.velocity] * (1 + 1e-9) + 1e-12)


@pytest.mark.parametrize(("p", "v"), [(4.0, 3.464), (5.0, 4.0), (9.5, 5.3), (2.0, 1.0)])
def test_the_ball_is_not_much_larger_than_the_worst_that_can_happen(p, v):
    """Against the peak-to-peak gain, the integral of the impulse response's size, which no bound can undercut."""
    impulse = solve(p, v, [0.0, 1.0], np.zeros(4000), np.zeros((4000, 2)))
    worst = DT * np.abs(impulse).sum(axis=0)
    ball = smallest_ball(p, v)
    assert worst[0] <= ball.position * (1 + 1e-2) and ball.position < 1.35 * worst[0]
    assert worst[1] <= ball.velocity * (1 + 1e-2) and ball.velocity < 1.5 * worst[1]


@settings(max_examples=40, deadline=None)
@given(p=gain, zeta=damping)
def test_the_ball_is_of_lyapunovs_equation(p, zeta):
    v = 2 * zeta * np.sqrt(p)
    ball = smallest_ball(p, v)
    a, b = np.array([[0.0, 1.0], [-p, -v]]), np.array([[0.0], [1.0]])
    shifted = a + ball.decay * np.eye(2)
    q = -(shifted.T @ ball.P + ball.P @ shifted)
    np.testing.assert_allclose(q, ball.P @ b @ b.T @ ball.P / (2 * ball.decay), rtol=1e-6, atol=1e-6 * p)
    assert np.linalg.eigvalsh(ball.P).min() > 0 and np.linalg.eigvalsh(q).min() > -1e-6 * p
    assert 0 < ball.decay < -np.linalg.eigvals(a).real.max()


def test_the_papers_least_eigenvalue_bounds_nothing():
    """Section IV-C bounds eta' (A - B K) eta by the eigenvalue of A - B K nearest to zero, times |eta|². For the loop
    that flies here that is wrong even in sign: there are errors whose norm grows."""
    p, v = 4.0, np.sqrt(12.0)
    a = np.array([[0.0, 1.0], [-p, -v]])
    slowest = np.linalg.eigvals(a).real.max()
    assert slowest < -1.0
    rate, directions = np.linalg.eigh(0.5 * (a + a.T))
    eta = directions[:, -1]
    assert rate[-1] > 0.5 and eta @ a @ eta > 0.5 > slowest * (eta @ eta)
    states = solve(p, v, eta, np.zeros(100), np.zeros((100, 2)))
    assert np.linalg.norm(states, axis=1).max() > 1.05
    # Lyapunov's norm of the same flight only falls, and at the rate that it promises.
    ball = smallest_ball(p, v)
    level = ball.level(states)
    assert np.all(level[1:] <= level[:-1] * np.exp(-ball.decay * DT) * (1 + 1e-9))


def test_short_spikes_weigh_less_than_what_lasts():
    ball = smallest_ball(4.0, 3.464)
    lasting, spike = np.full(1000, 1.0), np.where(np.arange(1000) == 500, 1.0, 0.0)
    assert memory(lasting, ball.decay, DT).max() == pytest.approx(1.0, abs=1e-4)
    assert memory(spike, ball.decay, DT).max() < 0.2


def test_the_axes_must_stand_alone():
    coupled = [list(row) for row in DESIGN.K_eta]
    coupled[2][0] = 0.5
    with pytest.raises(InputError, match="couples the axes"):
        balls_of(replace(DESIGN, K_eta=tuple(map(tuple, coupled))))
    x, y, z = balls_of(DESIGN)
    assert x is y and z.position != x.position


def smooth(t):
    w = np.array([0.9, 1.3, 0.7])
    position = np.sin(np.outer(t, w)) + [0.0, 0.0, 2.0]
    return Reference(position, w * np.cos(np.outer(t, w)), -(w**2) * np.sin(np.outer(t, w)), 0.0 * t + 0.4)


def with_step(reference, row, by):
    position = reference.position.copy()
    position[row:] += by
    return replace(reference, position=position)


def test_a_jump_of_the_reference_is_found_and_only_that():
    t = DT * np.arange(1000)
    assert not jumps_of(t, smooth(t)).any()
    found = jumps_of(t, with_step(smooth(t), 400, [0.5, 0.0, -0.2]))
    assert set(np.flatnonzero(found.any(axis=(1, 2)))) == {400}
    np.testing.assert_allclose(found[400, :, 0], [0.5, 0.0, -0.2], atol=1e-5)
    assert not found[..., 1].any()
    # A change of speed, as of a reference that starts to move at once, is one of velocity, not of position.
    speed = np.where(t[:, None] >= 5.0, 0.7, 0.0) * np.ones(3)
    ramp = Reference(np.maximum(t[:, None] - 5.0, 0.0) * 0.7 * np.ones(3), speed, 0.0 * speed, 0.0 * t)
    found = jumps_of(t, ramp)
    np.testing.assert_allclose(found[found.any(axis=(1, 2))], [[[0.0, 0.7]] * 3])


def flown(t, reference, d, start=(0.0, 0.0, 0.0)):
    """The flight of the linear design, its attitude loop included, under an acceleration d (N, 3), world ENU, that no
    model knows. Integrated finely, sensors perfect."""
    k_zeta, k_eta = np.array(DESIGN.K_zeta), np.array(DESIGN.K_eta)
    yaw = reference.yaw[0]
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    fine = 20
    p, v = reference.position[0] + start, reference.velocity[0].copy()
    zeta = np.array([0.0, 0.0, yaw])
    rows = []
    for k in range(len(t)):
        for part in range(fine):
            h = DT / fine
            r = reference.position[k] + h * part * reference.velocity[k]
            s = reference.velocity[k] + h * part * reference.acceleration[k]
            eta = np.concatenate([turn @ (p - r), turn @ (v - s)])
            feed = turn @ reference.acceleration[k]
            u = -k_eta @ eta + [-feed[1] / GRAVITY, feed[0] / GRAVITY, VEHICLE.mass * feed[2]]
            a = turn.T @ [GRAVITY * zeta[1], -GRAVITY * zeta[0], u[2] / VEHICLE.mass] + d[k]
            if part == 0:
                rows.append((p.copy(), v.copy(), zeta.copy(), a, u[2] + VEHICLE.weight))
            p, v = p + h * v + 0.5 * h * h * a, v + h * a
            zeta = zeta + h * (-k_zeta @ (zeta - [u[0], u[1], yaw]))
    position, velocity, angles, acceleration, thrust = (np.array(c) for c in zip(*rows, strict=True))
    quaternion = quaternion_from_euler(angles)
    return Flight(
        name="linear",
        vehicle=VEHICLE,
        t=t,
        position=position,
        velocity=velocity,
        quaternion=quaternion,
        specific_force=rotate_inverse(quaternion, acceleration + [0.0, 0.0, GRAVITY]),
        thrust_command=thrust / VEHICLE.weight * VEHICLE.hover_thrust,
        position_reference=reference.position,
        velocity_reference=reference.velocity,
        acceleration_reference=reference.acceleration,
        yaw_reference=reference.yaw,
        flying=np.ones(len(t), bool),
    )


def push(t, size):
    return size * np.stack([np.sign(np.sin(1.1 * t)), np.sin(2.0 * t), 0.6 + 0.4 * np.cos(0.7 * t)], -1)


T = DT * np.arange(1200)
INNER = np.abs(T - 6.0) < 5.7


@pytest.fixture(scope="module")
def pushed():
    return flown(T, smooth(T), push(T, 0.4), start=(0.1, -0.05, 0.0))


def test_a_flight_shows_the_disturbance_that_was_there(pushed):
    found = predict_tube(pushed, DESIGN).disturbance
    truth = push(T, 0.4)
    inner = INNER
    settled = inner & (np.abs(np.sin(1.1 * T)) > 0.3)  # the low-pass rounds the corners of the square
    np.testing.assert_allclose(found.model[settled], truth[settled], atol=0.03)
    # Thrust acts at once. Roll and pitch answer the push through the attitude loop: behind it, by about
    # the change of what is asked for over 1/8 s, and in the same direction as the push that they have to meet.
    np.testing.assert_allclose(found.attitude[settled][:, 2], 0.0, atol=0.01)
    lag = found.attitude[settled][:, :2]
    assert 0.02 < np.sqrt(np.mean(lag**2)) < 0.5 * np.sqrt(np.mean(truth[:, :2] ** 2))


@pytest.mark.parametrize("around", ["design", "reference"])
def test_a_flight_stays_in_the_tube_of_its_own_disturbance(pushed, around):
    found = predict_tube(pushed, DESIGN, around=around)
    assert found.leavings == () and np.all(found.inside == 1.0)
    # Sensors were perfect; that the push jumps between two samples is all that is left.
    assert np.all(found.resolution < 0.04 * found.radius)
    assert np.all(np.abs(found.distance) <= found.extent + found.resolution[:, None] * 0.6)


def test_the_bound_grows_with_the_disturbance(pushed):
    weak = predict_tube(flown(T, smooth(T), push(T, 0.1), start=(0.1, -0.05, 0.0)), DESIGN)
    strong = predict_tube(pushed, DESIGN)
    np.testing.assert_allclose(strong.radius / weak.radius, 4.0, rtol=0.08)
    np.testing.assert_allclose(strong.ball / weak.ball, 4.0, rtol=0.08)
    nothing = predict_tube(flown(T, smooth(T), push(T, 0.0)), DESIGN)
    assert nothing.radius.max() < 0.02 and nothing.ball.max() < 0.01


def test_a_stronger_push_leaves_the_tube_and_is_told_when(pushed):
    calm = flown(T, smooth(T), push(T, 0.1))
    burst = push(T, 0.1) + np.where((T > 6.0) & (T < 7.5), 1.0, 0.0)[:, None] * [0.0, 1.0, 0.0]
    found = predict_tube(flown(T, smooth(T), burst), DESIGN, bound_from=calm)
    assert {leaving.axis for leaving in found.leavings} == {"y"}
    (leaving,) = found.leavings
    assert 6.0 < leaving.start < 6.8 and 7.0 < leaving.end < 9.5
    assert leaving.level > leaving.allowed and found.inside[1] < 0.9
    # The other way round, the calm flight is well inside what the pushed one allows.
    assert predict_tube(calm, DESIGN, bound_from=pushed).leavings == ()


def test_a_step_of_the_reference_widens_the_tube_by_itself_and_no_more():
    by = np.array([0.6, 0.0, 0.3])
    reference = with_step(smooth(T), 500, by)
    flight = flown(T, reference, push(T, 0.2))
    around_reference = predict_tube(flight, DESIGN, around="reference")
    np.testing.assert_allclose(around_reference.jumps, [T[500]])
    assert around_reference.leavings == ()
    for k, ball in enumerate(around_reference.balls):
        before, after = around_reference.predicted[[499, 500], k]
        jump = float(ball.level(np.array([by[k], 0.0])))
        assert after == pytest.approx(before + jump, rel=0.02)
    # Around the design nothing jumps: it takes the same step.
    around_design = predict_tube(flight, DESIGN)
    assert len(around_design.jumps) == 0 and around_design.leavings == ()
    assert np.all(np.abs(np.diff(around_design.predicted[450:550], axis=0)) < 0.01)
    assert np.all(around_design.radius[:2] < 0.5 * around_reference.radius[:2])


def test_each_mission_has_a_tube_of_its_own(pushed):
    mission = ((T > 1.0) & (T < 5.0)) | (T > 7.0)
    found = predict_tube(replace(pushed, extra={"mission": mission.astype(float)}), DESIGN)
    assert len(found.starts) == 2 and len(found.t) == mission.sum()
    for start in found.starts:
        row = int(np.searchsorted(found.t, start))
        np.testing.assert_allclose(found.predicted[row], found.level[row])
    assert found.leavings == ()


def test_an_estimators_slow_error_is_a_disturbance_not_a_way_out(pushed):
    """A velocity that is off by 5 cm/s and an accelerometer that is off by 0.1 m/s² do not fake an escape."""
    off = replace(
        pushed,
        velocity=pushed.velocity + [0.05, 0.0, -0.05],
        specific_force=pushed.specific_force + [0.1, 0.0, 0.1],
    )
    found = predict_tube(off, DESIGN)
    assert found.leavings == () and found.resolution.max() < 0.05


def test_the_correction_is_taken_from_the_models_part(pushed):
    """What the guard applied counts: a model that knows the push leaves nothing of it in its part."""
    known = push(T, 0.4) @ np.array(
        [[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]]
    )
    found = predict_tube(replace(pushed, extra={"correction": known}), DESIGN)
    settled = (T > 0.3) & (T[-1] - 0.3 > T) & (np.abs(np.sin(1.1 * T)) > 0.3)
    assert np.abs(found.disturbance.model[settled]).max() < 0.03


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """The simulator's lemniscate with nothing hidden, with a battery that sags, and with a gust."""
    folder = tmp_path_factory.mktemp("records")
    for name, hidden, seed in (("none", "none", 3), ("sag", "battery_sag", 4), ("wind", "wind", 5)):
        arguments = ["--trajectory", "lemniscate", "--vehicle", VEHICLE.source, "--seed", str(seed)]
        subprocess.run(
            [BIN / "sim-bridge", "fly", *arguments, "--hidden", hidden, "-o", folder / f"{name}.mcap"],
            check=True,
            capture_output=True,
        )
    return folder


@pytest.mark.parametrize("name", ["none", "sag", "wind"])
def test_recorded_flights_stay_in_the_tube_of_their_own_bound(records, name):
    flight, design, label = read_designed(records / f"{name}.mcap")
    for around in ("design", "reference"):
        found = predict_tube(flight, design, label, around)
        assert found.leavings == ()
        # The bound is of use: the flight comes within a third of it, and the sensors see far finer.
        assert np.all(found.level.max(axis=0) > 0.33 * found.radius)
        assert np.all(found.resolution < 0.25 * found.radius)


def test_bound_command_tells_and_records(records, tmp_path, capsys):
    flight, other = str(records / "sag.mcap"), str(records / "none.mcap")
    app(
        ["bound", flight, "--from", other, "--json", "--save", str(tmp_path / "t.rrd")], standalone_mode=False
    )
    told = json.loads(capsys.readouterr().out)
    assert told["bound_from"] == other and set(told["axes"]) == set("xyz")
    for axis in told["axes"].values():
        assert 0 < axis["radius"] <= axis["bound"] and 0.98 < axis["inside"] <= 1.0
    assert (tmp_path / "t.rrd").stat().st_size > 10_000
    app(["bound", flight, "--around", "reference"], standalone_mode=False)
    text = capsys.readouterr().out
    assert "around the reference" in text and "never leaves the tube" in text


def test_a_flight_without_reference_is_told():
    t = DT * np.arange(600)
    flight = replace(flown(t, smooth(t), push(t, 0.1)), position_reference=None)
    with pytest.raises(InputError, match="reference position"):
        predict_tube(flight, DESIGN)


def test_the_default_design_has_balls_too():
    balls = balls_of(make_design(VEHICLE))
    assert len(balls) == 3
    for ball in balls:
        assert 0.05 < ball.position < 0.5


def test_the_flight_of_the_linear_design_is_the_expected_one():
    """The tests' own integration against the module that draws the middle of the tube."""
    flight = flown(T, smooth(T), 0.0 * push(T, 1.0))
    start = (flight.position[0], flight.velocity[0], np.array([0.0, 0.0, 0.4]))
    np.testing.assert_allclose(
        expected_behaviour(DESIGN, T, smooth(T), start).position, flight.position, atol=5e-3
    )
