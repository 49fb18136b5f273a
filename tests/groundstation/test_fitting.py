"""Intervals hold the truth as often as they say, under correlated residuals too."""

import numpy as np
import pytest
from scipy import signal
from simulated import simulated
from statsmodels.stats.sandwich_covariance import S_hac_simple

from trueflight.groundstation.evaluate.compare import compare
from trueflight.groundstation.evaluate.where import where_it_fails
from trueflight.groundstation.identify.fitting import MeasuredFlights, bartlett_sum, critical_value, fit
from trueflight.groundstation.measured.measurement import measure
from trueflight.models.effect import Stage
from trueflight.models.effects import catalogue
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.frames import quaternion_from_euler
from trueflight.models.model import Term, rigid_body_model
from trueflight.models.vehicle import GRAVITY, Vehicle

VEHICLE = Vehicle(name="test", mass=1.0, hover_thrust=0.5, rotor_radius=0.1)
DRAG = 0.25


def flight(seed: int, colour: float, seconds: float = 30.0, noise: float = 0.15) -> Flight:
    """A swaying flight with linear drag along x and y, and AR(1) noise of coefficient `colour` on the accelerometer."""
    rng = np.random.default_rng(seed)
    n, dt = round(seconds / 0.01), 0.01
    t = np.arange(n) * dt
    velocity = np.stack([2.0 * np.sin(0.9 * t), 1.5 * np.sin(0.7 * t + 1.0), 0.3 * np.sin(1.1 * t)], axis=1)
    euler = np.stack([0.1 * np.sin(0.7 * t), 0.15 * np.cos(0.9 * t), 0.3 * np.sin(0.2 * t)], axis=1)
    quaternion = quaternion_from_euler(euler)
    thrust = np.full(n, GRAVITY) * (1.0 + 0.1 * np.sin(1.7 * t))
    white = rng.normal(0, noise * np.sqrt(1 - colour**2), (n + 500, 3))
    coloured = signal.lfilter([1.0], [1.0, -colour], white, axis=0)[500:]
    made = Flight(
        "made",
        VEHICLE,
        t,
        position=np.stack([0 * t, 0 * t, 1.5 + 0 * t], axis=1),
        velocity=velocity,
        quaternion=quaternion,
        specific_force=coloured,
        thrust_command=0.5 * thrust / GRAVITY,
    )
    from trueflight.models.effects import effect_named
    from trueflight.models.prediction import apply_effects, motion_of_flight, specific_force

    chain = [(effect_named("rigid_body"), {}), (effect_named("rotor_drag"), {"x": DRAG, "y": DRAG})]
    truth = specific_force(apply_effects(motion_of_flight(made), chain))
    return Flight(**{**made.__dict__, "specific_force": truth + coloured})


@pytest.mark.parametrize("colour", [0.0, 0.9, 0.98])
def test_intervals_of_drag_hold_the_truth(colour: float) -> None:
    inside = []
    for seed in range(40):
        problem = MeasuredFlights((measure(flight(seed, colour)),))
        fitted = fit(problem, [Term("rigid_body", {}), Term("rotor_drag", {})])
        inside += [low <= DRAG <= high for low, high in (fitted.interval(i) for i in fitted.of("rotor_drag"))]
    # 80 intervals; 95 % of them should hold it. Below 0.86 has a probability of 0.1 % if they do.
    assert np.mean(inside) >= 0.86


@pytest.mark.parametrize("lags", [1, 7, 400])
def test_newey_west_sum_is_that_of_statsmodels(lags: int) -> None:
    scores = np.cumsum(np.random.default_rng(lags).normal(size=(500, 4)), axis=0)
    assert bartlett_sum(scores, lags) == pytest.approx(S_hac_simple(scores, nlags=lags), rel=1e-9)


def test_critical_value_is_the_normal_one_for_long_flights() -> None:
    assert critical_value(1e6) == pytest.approx(1.96, abs=1e-3)
    assert critical_value(20.0) > 2.2


def test_noise_floor_is_the_noise_behind_the_filter() -> None:
    made = flight(3, 0.0, noise=0.3)
    m = measure(made)
    # white noise of 0.3 over 50 Hz of band, behind a low-pass of 20 Hz
    passed = m.see(np.random.default_rng(1).normal(0, 0.3, (len(made), 3))).std()
    np.testing.assert_allclose(m.noise, passed, rtol=0.08)


def test_acceleration_from_velocity_has_the_same_filter_on_both_sides() -> None:
    made = flight(4, 0.0, noise=1e-3)
    from trueflight.models.frames import rotate

    world = rotate(made.quaternion, made.specific_force) - [0.0, 0.0, GRAVITY]
    velocity = np.cumsum(world, axis=0) * made.dt
    bare = Flight(**{**made.__dict__, "specific_force": None, "velocity": velocity, "accelerometer": False})
    m = measure(bare)
    assert m.bandwidth == 5.0
    # the sum above lags the acceleration by half a sample; nothing else may differ
    difference = (m.see(made.specific_force) - m.value)[m.used]
    assert np.sqrt(np.mean(difference**2)) < 0.02


def test_where_it_fails_names_the_region_that_was_made_bad() -> None:
    made = flight(5, 0.0, seconds=60.0, noise=0.02)
    height = 1.0 + 0.9 * np.sin(0.35 * made.t)
    position = np.stack([0 * made.t, 0 * made.t, height], axis=1)
    force = made.specific_force + np.outer(np.where(height < 0.4, 1.0, 0.0), [0.0, 0.0, 1.0])
    bad = Flight(**{**made.__dict__, "position": position, "specific_force": force})
    base = rigid_body_model(VEHICLE)
    model = base.with_terms((*base.terms, Term("rotor_drag", {"x": DRAG, "y": DRAG})))
    where = where_it_fails(compare(bad, model, horizons=False))
    region = next(r for r in where.regions if r.variable == "height")
    assert region.share_of_error > 0.95
    assert region.share_of_time < 0.4
    assert region.high == pytest.approx(0.4, abs=0.05)
    assert "below 0." in region.text
    heights = next(m for m in where.maps if m.variable == "height")
    assert heights.share_of_error.sum() == pytest.approx(1.0)
    assert np.nanargmax(heights.rms) == 0 or heights.edges[np.nanargmax(heights.rms)] < 0.4
    worst = [height[np.searchsorted(made.t, moment.start + 0.5)] for moment in where.worst[:2]]
    assert len(worst) == 2 and max(worst) < 0.5


def test_open_loop_error_falls_with_the_right_model() -> None:
    made = flight(6, 0.0)
    # a trajectory that obeys the model: velocity and position are integrals of its acceleration
    from trueflight.models.frames import rotate

    acceleration = rotate(made.quaternion, made.specific_force) - [0.0, 0.0, GRAVITY]
    acceleration -= acceleration.mean(axis=0)
    velocity = np.cumsum(acceleration, axis=0) * made.dt
    own = Flight(
        **{
            **made.__dict__,
            "velocity": velocity,
            "position": np.cumsum(velocity, axis=0) * made.dt + [0, 0, 9],
        }
    )
    horizons = compare(own, rigid_body_model(VEHICLE)).horizons
    assert [h.horizon for h in horizons] == [0.1, 0.5, 1.0]
    assert horizons[0].restarts > 50
    assert np.linalg.norm(horizons[0].position) < np.linalg.norm(horizons[2].position)


def test_every_effect_can_be_compared_open_loop_and_the_sensors_do_not_move_the_vehicle() -> None:
    flown = simulated(5, "wind:4")
    at = {e.name: Term(e.name, {p.name: p.typical for p in e.parameters}) for e in catalogue().values()}
    base = rigid_body_model(flown.vehicle)
    base = base.with_terms((*base.terms, at["transport_delay"]))  # so that no clock is fitted
    sensors = [n for n, e in catalogue().items() if e.stage is Stage.SENSOR]
    alone = compare(flown, base).horizons
    assert compare(flown, base.with_terms((*base.terms, *(at[n] for n in sensors)))).horizons == alone
    assert len(compare(flown, base.with_terms(tuple(at.values()))).horizons) == len(alone) == 3


def test_too_short_a_flight_is_refused_in_one_line() -> None:
    with pytest.raises(InputError, match="too short"):
        measure(flight(1, 0.0).part(slice(0, 300)))


def test_flight_without_any_measure_of_acceleration_is_refused() -> None:
    made = flight(1, 0.0)
    with pytest.raises(InputError, match="specific_force_x"):
        measure(Flight(**{**made.__dict__, "specific_force": None, "velocity": None}))
