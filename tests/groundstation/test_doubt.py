"""What no static effect explains is told as such, and nothing that stands in for it is called missing."""

import re
from dataclasses import replace

import numpy as np
import pytest
from simulated import fly, fly_with, simulated

from trueflight.groundstation.evaluate.compare import compare
from trueflight.groundstation.evaluate.where import where_it_fails
from trueflight.groundstation.identify.spectrum import spectral_lines
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.measured.measurement import measure
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.results import Diagnosis, SpectralLine
from trueflight.models.flight import Flight
from trueflight.models.frames import rotate_inverse
from trueflight.models.model import rigid_body_model
from trueflight.models.reference import trajectory_from_csv
from trueflight.models.trajectory import Trajectory
from trueflight.models.vehicle import GRAVITY
from trueflight.sim_bridge.truth.hidden import Hidden, choose


def said_of(flight: Flight) -> Diagnosis:
    return diagnose(flight, rigid_body_model(flight.vehicle))


def test_a_swinging_load_is_told_by_frequency_and_axis_and_nothing_is_called_missing() -> None:
    flight = simulated(3, "none")
    t = flight.t - flight.t[0]
    size = 0.6 * np.exp(-(t % 20.0) / 8.0)
    pull = np.stack([size * np.cos(2 * np.pi * 0.6 * t), size * np.sin(2 * np.pi * 0.6 * t), 0.0 * t], axis=1)
    found = said_of(
        replace(flight, specific_force=flight.specific_force + rotate_inverse(flight.quaternion, pull))
    )
    assert found.named("missing") == ()
    assert found.unexplained.verdict
    assert {(x.frame, x.axis) for x in found.unexplained.misfit} == {("world", "x"), ("world", "y")}
    for x in found.unexplained.misfit:
        told = re.search(r": ([0-9.]+) Hz", x.text)
        assert told and float(told[1]) == pytest.approx(0.6, abs=1.0 / flight.duration), x.text
        assert x.rms == pytest.approx(np.sqrt(np.mean(pull[:, 0] ** 2)), rel=0.25)


def test_a_thrust_that_comes_and_goes_is_told_and_no_curve_is_called_missing() -> None:
    flight = simulated(3, "none")
    t = flight.t - flight.t[0]
    weaker = np.where((t // 3.0) % 2 == 0.0, 1.15, 1.0)
    found = said_of(replace(flight, thrust_command=weaker * flight.thrust_command))
    assert set(found.named("missing")) <= {"thrust_gain"}
    assert found.unexplained.verdict
    first = found.unexplained.misfit[0]
    assert (first.axis, first.noise) == ("z", pytest.approx(0.05, abs=0.01))
    for effect in found.effects:
        assert bool(effect.rests_on) == (effect.rank is not None), effect.name
    doubted = [e for e in found.effects if e.rank and e.verdict == "possible"]
    assert all(e.rests_on for e in doubted)


def test_a_misfit_is_judged_axis_by_axis() -> None:
    flight = simulated(3, "none")
    rng = np.random.default_rng(0)
    buffeted = np.convolve(rng.normal(0.0, 1.0, len(flight)), np.ones(40) / 40, mode="same")
    force = flight.specific_force + 2.0 * buffeted[:, None] * [0.0, 1.0, 0.0]
    found = said_of(replace(flight, specific_force=force))
    assert [(x.frame, x.axis) for x in found.unexplained.misfit] == [("body", "y")]
    assert found.named("missing") == ()


def test_a_constant_is_told_in_the_axes_in_which_it_is_one() -> None:
    flight = simulated(3, "none")
    turned = rotate_inverse(flight.quaternion, np.array([0.9, 0.0, 0.0]))
    for force, frame in ((turned, "the world"), (np.array([0.9, 0.0, 0.0]), "body")):
        bad = replace(flight, specific_force=flight.specific_force + force)
        first = where_it_fails(compare(bad, rigid_body_model(flight.vehicle), horizons=False)).regions[0]
        assert first.variable == f"constant, {frame}"
        assert first.low == pytest.approx(0.9, rel=0.02)
    assert "+0.90 m/s² forward" in first.text


def test_a_slow_line_is_found_and_the_flights_own_period_named() -> None:
    flight = simulated(8, "none", kind="lemniscate")
    t = flight.t - flight.t[0]
    m = measure(flight)
    rng = np.random.default_rng(0)

    def lines(hz: float) -> tuple[SpectralLine, ...]:
        noise = rng.normal(0.0, 0.05, (len(m.t), 3))
        noise[:, 1] += 0.3 * np.sin(2.0 * np.pi * hz * t[m.rows])
        return spectral_lines(m, noise[m.used])

    (found,) = lines(0.7)
    assert found.axis == "y" and found.in_band
    assert found.frequency == pytest.approx(0.7, abs=0.5 / flight.duration)
    assert found.rms == pytest.approx(0.3 / np.sqrt(2.0), rel=0.15)
    assert "does not repeat" in found.text
    assert spectral_lines(m, rng.normal(0.0, 0.05, (int(m.used.sum()), 3))) == ()


def through(*places: tuple[float, float, float]) -> Trajectory:
    """From place to place, each in 2.5 s."""
    rows = (f"{2.5 * k},{x},{y},{z}" for k, (x, y, z) in enumerate(places))
    return trajectory_from_csv("\n".join(["t,x,y,z", *rows]))


def test_wind_across_a_flight_that_never_moves_that_way_is_not_determined(tmp_path) -> None:
    there_and_back = through(*[(2.0 * (k % 2), 0.0, 1.5) for k in range(10)])
    wind = Hidden("wind", {"speed": 3.0, "east": -3.0, "north": 0.0, "drag": 0.25})
    fly_with(tmp_path / "fan.mcap", (wind,), 7, there_and_back)
    found = said_of(read_flight(tmp_path / "fan.mcap"))
    assert set(found.named("missing")) == {"rotor_drag", "wind"}
    verdicts = {e.name: e for e in found.effects}
    x, y = verdicts["wind"].parameters
    assert x.value == pytest.approx(-3.0, rel=0.05) and x.high < 0.0
    assert y.low <= 0.0 <= y.high
    assert verdicts["wind"].undetermined == verdicts["rotor_drag"].undetermined == ("y",)
    (product,) = verdicts["wind"].products
    assert product.name == "rotor_drag.y x wind.y"
    assert product.low < 0.0 < product.high < 0.1


def test_a_curve_that_swallows_a_gain_and_the_ground_is_not_called_missing(tmp_path) -> None:
    heights = (0.5, 0.15, 0.3, 0.5, 0.2, 0.3, 0.15, 0.5, 0.15)
    fly(
        tmp_path / "low.mcap",
        ("thrust_gain:0.855", "ground_effect:1.5"),
        3,
        through(*[(0, 0, z) for z in heights]),
    )
    found = said_of(read_flight(tmp_path / "low.mcap"))
    assert set(found.named("missing")) <= {"thrust_gain", "ground_effect"}
    named = {*found.named("missing"), *found.named("possible"), *(n for s in found.alternatives for n in s)}
    assert {"thrust_gain", "ground_effect"} <= named


def test_a_weak_thrust_and_the_ground_that_hide_each_other_are_found_together(tmp_path) -> None:
    heights = (0.1, 0.6, 0.08, 0.3, 0.08, 0.6, 0.1, 0.2, 0.4)
    fly(
        tmp_path / "low.mcap",
        ("thrust_gain:0.9", "ground_effect:1.8"),
        24,
        through(*[(0, 0, z) for z in heights]),
    )
    found = said_of(read_flight(tmp_path / "low.mcap"))
    assert {*found.named("missing")} == {"thrust_gain", "ground_effect"}
    (gain,) = (e.parameters[0] for e in found.effects if e.name == "thrust_gain")
    assert gain.value == pytest.approx(0.9, abs=0.02)


def test_a_noisy_gyroscope_does_not_make_the_lever_arm_smaller() -> None:
    flight = simulated(4, "imu_lever_arm")
    (hidden,) = choose(["imu_lever_arm"], flight.vehicle, 4)
    rng = np.random.default_rng(1)
    shaken = flight.angular_velocity + rng.normal(0.0, 0.03, flight.angular_velocity.shape)
    found = said_of(replace(flight, angular_velocity=shaken))
    (told,) = (e for e in found.effects if e.name == "imu_lever_arm")
    for p in told.parameters:
        assert p.low < hidden.parameters[p.name] < p.high, p
    x = told.parameters[0]
    assert x.value == pytest.approx(hidden.parameters["x"], rel=0.04)  # 30 % less where the noise is left in


def hover_in_gusts(seed: int) -> Flight:
    """40 s of a hover that a controller holds by position and velocity against gusts of 0.3 m/s², nothing hidden."""
    flight = simulated(3, "none")
    rng, dt, n = np.random.default_rng(seed), 0.01, 4000
    z = v = gust = 0.0
    rows = []
    for _ in range(n):
        gust += -gust * dt / 1.0 + 0.3 * np.sqrt(2.0 * dt / 1.0) * rng.normal()
        thrust = GRAVITY - 6.0 * z - 4.0 * v + 0.05 * rng.normal()
        rows.append((z, v, thrust, thrust + gust))
        v += (thrust + gust - GRAVITY) * dt
        z += v * dt
    height, climb, thrust, felt = np.array(rows).T
    up = np.array([0.0, 0.0, 1.0])
    noise = 0.08 * rng.normal(size=(n, 3))
    return Flight(
        name="hover",
        vehicle=flight.vehicle,
        t=dt * np.arange(n),
        position=(1.5 + height)[:, None] * up,
        velocity=climb[:, None] * up,
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        angular_velocity=0.002 * rng.normal(size=(n, 3)),
        specific_force=felt[:, None] * up + noise,
        thrust_command=thrust / GRAVITY * flight.vehicle.hover_thrust,
    )


@pytest.mark.parametrize("seed", [1, 2])
def test_thrust_that_answers_gusts_is_not_taken_for_a_bent_curve(seed: int) -> None:
    found = said_of(hover_in_gusts(seed))
    assert found.named("missing") == ()
    (first,) = (e for e in found.effects if e.rank == 1)
    assert "after what it is to explain" in first.rests_on and (first.confidence or 0.0) < 0.5


def test_a_bias_and_a_thrust_that_leans_are_told_as_one_where_thrust_hardly_varies(tmp_path) -> None:
    low_and_slow = through(*[(0.1 * (k % 2), 0.0, 1.5) for k in range(12)])
    fly(tmp_path / "still.mcap", ("accelerometer_bias", "thrust_misalignment"), 5, low_and_slow)
    found = said_of(read_flight(tmp_path / "still.mcap"))
    assert not {"accelerometer_bias", "thrust_misalignment"} & {*found.named("missing")}
    told = {e.name: e for e in found.effects}
    both = [told["accelerometer_bias"], told["thrust_misalignment"]]
    assert all(e.verdict == "possible" for e in both), [e.verdict for e in both]


def test_where_an_estimator_made_the_acceleration_a_delay_may_be_its_own() -> None:
    flight = simulated(3, "motor_lag")
    assert "motor_lag" in said_of(flight).named("missing")
    (told,) = (e for e in said_of(replace(flight, accelerometer=False)).effects if e.name == "motor_lag")
    assert told.verdict == "possible" and "a late estimate" in told.indistinguishable_from
    from_velocity = replace(flight, specific_force=None)
    assert "motor_lag" in said_of(from_velocity).named("missing")
