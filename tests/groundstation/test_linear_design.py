"""The linear cascade: gains, margins, the expected behaviour, and flights measured against it."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from trueflight.groundstation.commands.app import app
from trueflight.groundstation.design.integral_design import integral_loops, with_integral
from trueflight.groundstation.design.linear_design import PHASE_MARGIN, loops, make_design
from trueflight.groundstation.design.linear_response import Reference, closed_loop, expected_behaviour
from trueflight.groundstation.evaluate.tracking import track
from trueflight.models.design import design_to_json, load_design
from trueflight.models.errors import InputError, run_command_line
from trueflight.models.flight import Flight
from trueflight.models.frames import heading_from_world, quaternion_from_euler
from trueflight.models.vehicle import GRAVITY, load_vehicle

VEHICLE = load_vehicle(Path(__file__).parents[2] / "models" / "vehicles" / "quad5" / "vehicle.toml")
BIN = Path(sys.executable).parent


@pytest.fixture(scope="module")
def design():
    return make_design(VEHICLE)


def lissajous(t, size=1.0, yaw_rate=0.0):
    w = np.array([0.9, 1.3, 0.7])
    p = size * np.sin(np.outer(t, w)) + [0.0, 0.0, 1.5]
    v = size * w * np.cos(np.outer(t, w))
    a = -size * w**2 * np.sin(np.outer(t, w))
    return Reference(p, v, a, yaw_rate * t)


def test_bryson_weights_give_the_wanted_frequency_and_damping(design):
    k = np.array(design.K_eta)
    for position, velocity, gain in ((k[1, 0], k[1, 3], GRAVITY), (-k[0, 1], -k[0, 4], GRAVITY)):
        frequency = np.sqrt(gain * position)
        assert frequency == pytest.approx(2 * np.pi * 0.35, rel=1e-6)
        assert gain * velocity / (2 * frequency) == pytest.approx(np.sqrt(3) / 2, rel=1e-6)
    assert np.sqrt(k[2, 2] / VEHICLE.mass) == pytest.approx(1.4 * 2 * np.pi * 0.35, rel=1e-6)
    assert np.count_nonzero(k) == 6


@pytest.mark.parametrize("bandwidth", [0.15, 0.25, 0.35])
def test_every_loop_is_stable_and_keeps_its_margin(bandwidth):
    found = loops(make_design(VEHICLE, bandwidth), VEHICLE)
    assert [loop.name for loop in found] == ["attitude", "yaw", "horizontal", "vertical"]
    for loop in found:
        assert max(pole.real for pole in loop.poles) < 0
        assert loop.phase_margin > 40.0
        assert loop.overshoot < 0.1


def test_a_vehicle_too_slow_for_the_bandwidth_is_told():
    slow = replace(VEHICLE, motor_time_constant=0.15)
    with pytest.raises(InputError, match=r"attitude loop|horizontal loop|vertical loop"):
        make_design(slow)
    assert make_design(slow, 0.1, 0.4).mass == VEHICLE.mass


def test_the_closed_loop_has_the_poles_of_the_design(design):
    a, _ = closed_loop(design)
    poles = np.linalg.eigvals(a)
    of_position = [loop for loop in loops(design, VEHICLE) if loop.name in ("horizontal", "vertical")]
    assert len(of_position) == 2
    for pole in (pole for loop in of_position for pole in loop.poles):
        assert np.abs(poles - pole).min() < 1e-6


def integral_flight(design, gains, push, reference, duration):
    """Position (N, 3) of the linear vehicle with its attitude loop, at yaw 0, from rest at the origin: `gains` are
    (K_eta, K_i), `push` (3,) a constant acceleration, `reference` (3,) a constant position."""
    k_zeta, (k_eta, k_i) = np.array(design.K_zeta)[:2, :2], (np.array(g) for g in gains)

    def slope(_, state):
        p, v, tilt, integral = state[:3], state[3:6], state[6:8], state[8:]
        u = -k_eta @ np.concatenate([p - reference, v]) - k_i @ integral
        a = np.array([GRAVITY * tilt[1], -GRAVITY * tilt[0], u[2] / design.mass]) + push
        return np.concatenate([v, a, -k_zeta @ (tilt - u[:2]), p - reference])

    t = np.arange(0.0, duration, 0.01)
    return t, solve_ivp(slope, (0, duration), np.zeros(11), t_eval=t, rtol=1e-8, atol=1e-9).y[:3].T


@pytest.mark.parametrize("shipped", [True, False])
def test_the_integral_removes_a_constant_disturbance_in_the_time_stated(design, shipped):
    if shipped:
        design = load_design(Path(VEHICLE.source).with_name("design.json"), VEHICLE)
    else:
        design = with_integral(design, VEHICLE)
    found = integral_loops(design, VEHICLE)
    own = {loop.name: loop for loop in loops(design, VEHICLE)}
    push = np.array([0.7, -0.4, 0.9])
    t, lqr = integral_flight(design, (design.K_eta, np.zeros((3, 3))), push, np.zeros(3), 16.0)
    _, integral = integral_flight(
        design, (design.integral.K_eta, design.integral.K_i), push, np.zeros(3), 16.0
    )
    for axis, loop in ((0, found[0]), (1, found[0]), (2, found[1])):
        kept = abs(lqr[-1, axis])
        outside = np.flatnonzero(np.abs(integral[:, axis]) > 0.05 * kept)
        assert t[outside[-1]] == pytest.approx(loop.removal, abs=0.06)
        assert np.abs(integral[:, axis]).max() == pytest.approx(loop.peak * kept, rel=0.02)
        assert loop.removal <= 2.0 * own[loop.loop.name].settling_time + 0.06
    step = np.array([1.0, 1.0, 1.0])
    _, lqr = integral_flight(design, (design.K_eta, np.zeros((3, 3))), np.zeros(3), step, 16.0)
    gains = (design.integral.K_eta, design.integral.K_i)
    _, integral = integral_flight(design, gains, np.zeros(3), step, 16.0)
    for axis, loop in ((0, found[0]), (2, found[1])):
        part = t <= 2.0 * loop.allowed
        distance = np.sqrt(np.mean((integral - lqr)[part, axis] ** 2))
        assert distance == pytest.approx(loop.step_distance, rel=0.05)


def test_the_integral_keeps_bandwidth_and_margin_of_the_lqr(design):
    own = {loop.name: loop for loop in loops(design, VEHICLE)}
    for found in integral_loops(with_integral(design, VEHICLE), VEHICLE):
        assert found.loop.phase_margin >= PHASE_MARGIN
        assert found.loop.crossover <= 1.01 * own[found.loop.name].crossover
        assert max(pole.real for pole in found.loop.poles) < 0


def test_no_other_integral_that_does_as_much_is_nearer_to_the_lqr(design):
    """Against others around it: none that is as fast, with bandwidth and margin kept, comes nearer."""
    from trueflight.groundstation.design.integral_design import (
        REMAINDER,
        STEP,
        _axes,
        _best,
        _crossover,
        _responses,
    )

    rng = np.random.default_rng(0)
    for axis in _axes(design, VEHICLE):
        best, lqr = _best(axis), np.array([axis.p, axis.v, 0.0])
        samples, after = int(4 * axis.settling / STEP), int(np.ceil(2 * axis.settling / STEP))
        target, limit = _responses(axis, lqr, samples)[0], _crossover(axis, lqr)[0]

        def distance_and_rest(gains, axis=axis, samples=samples, after=after, target=target):
            step, _, left = _responses(axis, gains, samples)
            return np.mean((step - target) ** 2), axis.p * np.abs(left[after:]).max()

        least, rest = distance_and_rest(best)
        assert rest <= 1.01 * REMAINDER
        allowed = 0
        for gains in best * np.exp(rng.normal(scale=0.08, size=(400, 3))):
            crossover, margin = _crossover(axis, gains)
            distance, rest = distance_and_rest(gains)
            if crossover <= limit and margin >= PHASE_MARGIN and rest <= REMAINDER:
                allowed += 1
                assert distance > 0.99 * least
        assert allowed > 10


def test_a_design_can_keep_its_gains_and_get_an_integral(tmp_path):
    shipped = Path(VEHICLE.source).with_name("design.json")
    plain = replace(load_design(shipped, VEHICLE), integral=None)
    (tmp_path / "mine.json").write_text(design_to_json(plain))
    keep = ["--keep", str(tmp_path / "mine.json")]
    app(["design", VEHICLE.source, *keep, "-o", str(tmp_path / "new.json")], standalone_mode=False)
    made = load_design(tmp_path / "new.json", VEHICLE)
    assert replace(made, integral=None) == plain
    for ours, theirs in zip(
        (made.integral.K_eta, made.integral.K_i),
        (load_design(shipped).integral.K_eta, load_design(shipped).integral.K_i),
        strict=True,
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-9)
    with pytest.raises(InputError, match="leave out --bandwidth"):
        app(["design", VEHICLE.source, *keep, "--bandwidth", "0.3"], standalone_mode=False)


@pytest.mark.parametrize("yaw_rate", [0.0, 0.4])
def test_expected_behaviour_solves_the_linear_equations(design, yaw_rate):
    """Against a general integrator of (9), (13) and (16), written out in world axes."""
    t = np.arange(0.0, 6.0, 0.01)
    reference = lissajous(t, yaw_rate=yaw_rate)
    start = (np.array([0.3, -0.2, 1.2]), np.array([0.1, 0.0, -0.3]), np.array([0.05, -0.1, 0.2]))
    k_zeta, k_eta = np.array(design.K_zeta), np.array(design.K_eta)

    def wanted(time):
        return lissajous(np.array([time]), yaw_rate=yaw_rate)

    def slope(time, state):
        p, v, zeta = state[:3], state[3:6], state[6:]
        r = wanted(time)
        eta = np.concatenate(
            [
                heading_from_world(p - r.position[0], zeta[2]),
                heading_from_world(v - r.velocity[0], zeta[2]),
            ]
        )
        feed = heading_from_world(r.acceleration[0], zeta[2])
        u = -k_eta @ eta + np.array([-feed[1] / GRAVITY, feed[0] / GRAVITY, VEHICLE.mass * feed[2]])
        acceleration = np.array([GRAVITY * zeta[1], -GRAVITY * zeta[0], u[2] / VEHICLE.mass])
        c, s = np.cos(zeta[2]), np.sin(zeta[2])
        world = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ acceleration
        return np.concatenate([v, world, -k_zeta @ (zeta - [u[0], u[1], r.yaw[0]])])

    exact = solve_ivp(slope, (0, t[-1]), np.concatenate(start), t_eval=t, rtol=1e-9, atol=1e-10).y.T
    found = expected_behaviour(design, t, reference, start)
    # The reference between samples is linear there, exact here: 1e-4 m at 100 Hz.
    np.testing.assert_allclose(found.position, exact[:, :3], atol=2e-4)
    np.testing.assert_allclose(found.velocity, exact[:, 3:6], atol=5e-4)
    np.testing.assert_allclose(found.zeta, exact[:, 6:], atol=5e-4)


def test_a_still_vehicle_at_its_reference_stays(design):
    t = np.arange(0.0, 3.0, 0.01)
    still = np.tile([1.0, 2.0, 3.0], (len(t), 1))
    reference = Reference(still, 0 * still, 0 * still, np.full(len(t), 0.7))
    found = expected_behaviour(design, t, reference, (still[0], np.zeros(3), np.array([0.0, 0.0, 0.7])))
    np.testing.assert_allclose(found.position, still, atol=1e-12)
    np.testing.assert_allclose(found.zeta, [[0.0, 0.0, 0.7]] * len(t), atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(yaw=st.floats(-3.1, 3.1), turns=st.integers(-2, 2))
def test_behaviour_does_not_depend_on_which_way_the_world_is_turned(design, yaw, turns):
    t = np.arange(0.0, 3.0, 0.01)
    a = lissajous(t)
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    b = Reference(
        a.position @ turn.T, a.velocity @ turn.T, a.acceleration @ turn.T, a.yaw + yaw + 2 * np.pi * turns
    )
    start = (np.array([0.2, 0.1, 1.0]), np.array([0.0, 0.3, 0.0]), np.array([0.1, 0.0, 0.0]))
    turned = (turn @ start[0], turn @ start[1], start[2] + [0.0, 0.0, yaw])
    first, second = expected_behaviour(design, t, a, start), expected_behaviour(design, t, b, turned)
    np.testing.assert_allclose(second.position, first.position @ turn.T, atol=1e-9)


def flight_of(design, t, reference, behaviour):
    return Flight(
        name="linear",
        vehicle=VEHICLE,
        t=t,
        position=behaviour.position,
        velocity=behaviour.velocity,
        quaternion=quaternion_from_euler(behaviour.zeta),
        thrust_command=np.full(len(t), VEHICLE.hover_thrust),
        position_reference=reference.position,
        velocity_reference=reference.velocity,
        acceleration_reference=reference.acceleration,
        yaw_reference=reference.yaw,
        flying=np.ones(len(t), bool),
    )


def test_a_flight_that_is_its_linear_design_tracks_without_error(design):
    t = np.arange(0.0, 5.0, 0.01)
    reference = lissajous(t)
    behaviour = expected_behaviour(design, t, reference, (reference.position[0], np.zeros(3), np.zeros(3)))
    flight = flight_of(design, t, reference, behaviour)
    exact = track(flight, design)
    assert max(exact.mse) < 1e-20 and max(exact.mse_zeta) < 1e-20
    # A constant offset of the vehicle decays as the linear design says; a wobble on top is its own square.
    wobble = 0.1 * np.sin(2 * np.pi * 5 * t)[:, None] * [1.0, 0.0, 0.0]
    moved = track(replace(flight, position=behaviour.position + wobble), design)
    assert moved.mse[0] == pytest.approx(0.005, rel=1e-3)
    assert max(moved.mse[1:]) < 1e-20


def test_only_the_mission_counts_each_stretch_from_its_own_start(design):
    t = np.arange(0.0, 8.0, 0.01)
    reference = lissajous(t)
    behaviour = expected_behaviour(design, t, reference, (reference.position[0], np.zeros(3), np.zeros(3)))
    mission = ((t > 1.0) & (t < 3.5)) | ((t > 4.0) & (t < 7.0)) | (t > 7.5)
    flight = replace(flight_of(design, t, reference, behaviour), extra={"mission": mission.astype(float)})
    found = track(flight, design)
    # The last half second is too short to say anything of tracking.
    assert len(found.t) == np.sum(mission & (t < 7.2))
    assert max(found.mse) < 1e-12
    with pytest.raises(InputError, match="no mission of 2 s"):
        track(replace(flight, extra={"mission": 0.0 * t}), design)


def test_design_command_writes_a_file_the_companion_accepts(tmp_path, capsys):
    out = tmp_path / "design.json"
    vehicle = VEHICLE.source
    app(["design", vehicle, "-o", str(out), "--bandwidth", "0.3", "--json"], standalone_mode=False)
    told = json.loads(capsys.readouterr().out)
    design = load_design(out, VEHICLE)
    assert design.K_eta == tuple(map(tuple, told["K_eta"]))
    assert {loop["name"] for loop in told["loops"]} == {"attitude", "yaw", "horizontal", "vertical"}
    assert not list(tmp_path.glob(".*"))
    with pytest.raises(SystemExit) as stopped:
        run_command_line(
            lambda: app(["design", vehicle, "-o", str(out), "--bandwidth", "3"], standalone_mode=False)
        )
    assert stopped.value.code == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "lower --bandwidth" in line
    assert load_design(out, VEHICLE) == design


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """The simulator's record of a lemniscate by the default design of this module, with and without drag."""
    folder = tmp_path_factory.mktemp("records")
    common = ["--trajectory", "lemniscate", "--vehicle", VEHICLE.source, "--seed", "3"]
    program = BIN / "groundstation"
    subprocess.run(
        [program, "design", VEHICLE.source, "-o", folder / "design.json"], check=True, capture_output=True
    )
    for name, hidden in (("drag", "rotor_drag:0.6"), ("none", "none")):
        arguments = [
            *common,
            "--design",
            folder / "design.json",
            "--hidden",
            hidden,
            "-o",
            folder / f"{name}.mcap",
        ]
        subprocess.run([BIN / "sim-bridge", "fly", *arguments], check=True, capture_output=True)
    return folder


def test_tracking_tells_a_flight_with_drag_from_one_without(records, capsys):
    app(["track", str(records / "drag.mcap"), str(records / "none.mcap"), "--json"], standalone_mode=False)
    before, after = json.loads(capsys.readouterr().out)
    assert before["seconds"] == pytest.approx(20.5, abs=0.5)
    for axis in "xy":
        assert after["mse"][axis] < 0.2 * before["mse"][axis]
    assert after["change"] < -0.6
    assert [before["label"], after["label"]] == ["drag: lemniscate lqr", "none: lemniscate lqr"]
    # With nothing hidden the vehicle flies as designed, to what delay and noise leave.
    assert after["rms"] < 0.06


def test_the_default_design_flies_in_the_simulator_with_its_delays(records):
    from trueflight.groundstation.reading import read_flight

    flight = read_flight(records / "none.mcap")
    mission = flight.extra["mission"] > 0.5
    miss = np.linalg.norm((flight.position - flight.position_reference)[mission], axis=1)
    assert miss.max() < 0.25
