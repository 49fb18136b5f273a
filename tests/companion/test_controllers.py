"""Controllers: the integral holds what the cascade cannot, and the corrected one arrives when it should."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from trueflight.companion.law.actuation import ACTS_AT_ONCE, Actuation, LagInverse, RateModel
from trueflight.companion.law.behaviour import LinearBehaviour
from trueflight.companion.law.control import ZERO, ControlLaw, State, euler
from trueflight.companion.law.controllers import Corrected, Lqr, LqrIntegral, TrimLimits, make_controller
from trueflight.companion.law.guard import Correction
from trueflight.companion.law.residual import ObserverLimits
from trueflight.groundstation.design.linear_response import Reference, expected_behaviour
from trueflight.groundstation.identify.actuation import respond
from trueflight.models import frames
from trueflight.models.design import load_design
from trueflight.models.errors import InputError
from trueflight.models.reference import trajectory
from trueflight.models.trajectory import ReferenceSample, Trajectory
from trueflight.models.vehicle import GRAVITY, load_vehicle

QUAD5 = Path(__file__).parents[2] / "models" / "vehicles" / "quad5"
VEHICLE = load_vehicle(QUAD5 / "vehicle.toml")
DESIGN = load_design(QUAD5 / "design.json")
LAW = ControlLaw(VEHICLE, DESIGN)
DT = 0.01
NO_OBSERVER = ObserverLimits(frequency=0.0)
PX4 = Actuation(0.03, 0.045, 1.5, 0.01, 0.03)

numbers = st.floats(-2.0, 2.0)
angles = st.floats(-0.5, 0.5)


class Oracle:
    """A corrector that returns what it is told: `delta` of features, wholly engaged."""

    wants_yaw = False
    learning = None

    def learn(self, *told: object) -> None:
        """It learns nothing."""

    def __init__(self, delta=lambda features: ZERO, actuation: Actuation = ACTS_AT_ONCE, engaged=1.0) -> None:
        self.delta, self.actuation, self.engaged = delta, actuation, engaged
        self.applied = ZERO

    def step(
        self, rows: Sequence[list[float]], ahead: float, dt: float, height: float, measured: object = None
    ) -> Correction:
        now, later, lifted, present = (self.delta(row) for row in rows)
        self.applied = (now[0], now[1], lifted[2])
        return Correction(
            self.applied, ((later[0] - now[0]) / ahead, (later[1] - now[1]) / ahead), self.applied, present
        )


class Linear:
    """The linear vehicle (9) behind a real actuation: PI rate loop with delay, thrust with delay and lag.

    `delta` (m/s², heading frame) of its true features is what the linear model does not know.
    """

    def __init__(
        self, actuation: Actuation = ACTS_AT_ONCE, delta=lambda features: ZERO, substep=0.001
    ) -> None:
        self.actuation, self.delta, self.h = actuation, delta, substep
        self.position, self.velocity = np.array([0.0, 0.0, 1.0]), np.zeros(3)
        self.zeta, self.rate, self.integral = np.zeros(3), np.zeros(3), np.zeros(3)
        self.thrust = VEHICLE.weight
        late = round(max(actuation.rate_delay, actuation.thrust_delay) / substep) + 1
        self.sent = [(VEHICLE.weight, np.zeros(3))] * late
        self.acceleration = np.zeros(3)

    def state(self) -> State:
        q = frames.quaternion_from_euler(self.zeta)
        force = frames.rotate_inverse(q, self.acceleration + np.array([0.0, 0.0, GRAVITY]))
        three = lambda v: tuple(float(x) for x in v)  # noqa: E731
        return State(
            three(self.position),
            three(self.velocity),
            tuple(float(x) for x in q),
            float(self.position[2]),
            16.0,
            three(self.rate),
            three(force),
        )

    def fly(self, thrust: float, rates: Sequence[float]) -> None:
        a, h = self.actuation, self.h
        for _ in range(round(DT / h)):
            self.sent.append((thrust, np.array(rates)))
            _, wanted = self.sent[-1 - round(a.rate_delay / h)]
            lift, _ = self.sent[-1 - round(a.thrust_delay / h)]
            if a.rate_lag:
                error = wanted - self.rate
                self.rate = self.rate + h * (error / a.rate_lag + self.integral)
                self.integral = self.integral + h * a.rate_integral / a.rate_lag * error
            else:
                self.rate = wanted
            self.thrust += (lift - self.thrust) * (1 - math.exp(-h / a.thrust_lag) if a.thrust_lag else 1.0)
            roll, pitch, _ = self.zeta
            values = [self.position[2], math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)]
            values += [*self.velocity, 16.0, self.thrust]
            more = np.array(self.delta(values))
            self.acceleration = more + np.array(
                [GRAVITY * pitch, -GRAVITY * roll, self.thrust / VEHICLE.mass - GRAVITY]
            )
            self.position = self.position + h * self.velocity + 0.5 * h * h * self.acceleration
            self.velocity = self.velocity + h * self.acceleration
            self.zeta = self.zeta + h * self.rate


def flown(controller, vehicle: Linear, path: Trajectory) -> np.ndarray:
    """Positions minus those of the expected linear behaviour, (N, 3) m."""
    vehicle.position = np.array(path.start[:3], dtype=float)
    controller.start()
    positions, references = [], []
    for k in range(int(path.duration / DT)):
        preview = partial(lambda t, ahead: path.at(t + ahead), k * DT)
        positions.append(vehicle.position)
        references.append(preview(0.0))
        step = controller.step(vehicle.state(), preview, DT if k else 0.0)
        vehicle.fly(step.command.thrust, step.command.body_rate)
    columns = [np.array(column) for column in zip(*references, strict=True)]
    behaviour = expected_behaviour(
        DESIGN,
        DT * np.arange(len(positions)),
        Reference(*columns[:4]),
        (positions[0], np.zeros(3), np.zeros(3)),
    )
    return np.array(positions) - behaviour.position


def drag_and_weak_thrust(features: Sequence[float]) -> tuple[float, float, float]:
    return (-0.3 * features[5], -0.4 * features[6], -0.08 * features[9] / VEHICLE.mass)


def mse(error: np.ndarray) -> np.ndarray:
    return np.mean(error**2, axis=0)


LIVELY = trajectory("lemniscate", speed=2.0, height=1.0)


@settings(max_examples=100, deadline=None)
@given(st.tuples(*[numbers] * 3), st.tuples(*[numbers] * 3), angles, angles, st.floats(-3.0, 3.0))
def test_with_nothing_engaged_the_corrected_controller_is_the_cascade(
    position, velocity, roll, pitch, yaw
) -> None:
    q = tuple(float(x) for x in frames.quaternion_from_euler(np.array([roll, pitch, yaw])))
    here = State(position, velocity, q, position[2], 16.0, (0.3, -0.2, 0.1), (0.1, 0.2, 9.0))
    still = ReferenceSample((0.0, 0.0, 1.0), ZERO, ZERO, 0.0, 0.0)
    controller = Corrected(
        LAW, Oracle(drag_and_weak_thrust, PX4, engaged=0.0), TrimLimits(), ObserverLimits()
    )
    for _ in range(3):
        step = controller.step(here, lambda ahead: still, DT)
        assert step.command == Lqr(LAW).step(here, lambda ahead: still, DT).command
        assert step.correction == ZERO


def test_a_known_error_is_cancelled_and_the_flight_is_the_linear_one() -> None:
    plain = mse(flown(Lqr(LAW), Linear(delta=drag_and_weak_thrust), LIVELY))
    corrected = Corrected(LAW, Oracle(drag_and_weak_thrust), TrimLimits(bandwidth=0.0), ObserverLimits())
    assert np.all(mse(flown(corrected, Linear(delta=drag_and_weak_thrust), LIVELY)) < plain / 200)


def test_looking_ahead_over_delay_and_lag_brings_the_linear_behaviour_back() -> None:
    def error(known: Actuation) -> np.ndarray:
        oracle = Oracle(drag_and_weak_thrust, known)
        vehicle = Linear(PX4, drag_and_weak_thrust)
        return mse(flown(Corrected(LAW, oracle, TrimLimits(bandwidth=0.0), NO_OBSERVER), vehicle, LIVELY))

    unknown, exact = error(ACTS_AT_ONCE), error(PX4)
    assert np.all(exact[:2] < unknown[:2] / 5)
    # A third too much or too little still helps: no number of it has to be exact.
    for factor in (0.67, 1.33):
        near = replace(
            PX4, rate_delay=factor * PX4.rate_delay, rate_lag=factor * PX4.rate_lag, rate_integral=2.0
        )
        assert np.all(error(near)[:2] < unknown[:2])


def test_the_trim_removes_what_no_model_knows_and_stays_within_its_authority() -> None:
    wind = lambda features: (0.4, -0.3, -0.5)  # noqa: E731
    hover = trajectory("hover", height=1.5, duration=25.0)
    without = flown(
        Corrected(LAW, Oracle(), TrimLimits(bandwidth=0.0), NO_OBSERVER), Linear(delta=wind), hover
    )
    trimmed = flown(Corrected(LAW, Oracle(), TrimLimits(), NO_OBSERVER), Linear(delta=wind), hover)
    assert np.all(np.abs(without[-1]) > 0.05)
    assert np.all(np.abs(trimmed[-1]) < 0.1 * np.abs(without[-1]))

    storm = Corrected(LAW, Oracle(), TrimLimits(authority=0.2), NO_OBSERVER)
    vehicle, still = Linear(delta=wind), ReferenceSample((0.0, 0.0, 1.0), ZERO, ZERO, 0.0, 0.0)
    storm.start()
    for _ in range(3000):
        step = storm.step(vehicle.state(), lambda ahead: still, DT)
        vehicle.fly(step.command.thrust, step.command.body_rate)
        assert max(abs(t) for t in step.trim) <= 0.2 * math.sqrt(2) + 1e-9


def test_the_trim_turns_with_the_vehicle_for_what_stands_still_in_the_world() -> None:
    controller = Corrected(LAW, Oracle(), TrimLimits(), NO_OBSERVER)
    behind = ReferenceSample((0.0, 0.0, 1.0), ZERO, ZERO, 0.0, 0.0)

    def at(x: float, yaw: float) -> State:
        q = tuple(float(c) for c in frames.quaternion_from_euler(np.array([0.0, 0.0, yaw])))
        return State((x, 0.0, 1.0), ZERO, q, 1.0, 16.0)

    controller.start()
    controller.step(at(0.0, 0.0), lambda ahead: behind, DT)
    for _ in range(200):
        blown = controller.step(at(0.3, 0.0), lambda ahead: behind, DT).trim
    assert blown[0] > 0.1 and abs(blown[1]) < 1e-9
    turned = controller.step(at(0.3, 0.5 * math.pi), lambda ahead: behind, 0.0).trim
    assert turned == pytest.approx((0.0, -blown[0], blown[2]), abs=1e-9)


def test_the_trim_does_not_grow_where_the_limits_leave_no_more() -> None:
    """What is missing there is not the correction."""
    controller, still = (
        Corrected(LAW, Oracle(), TrimLimits(), NO_OBSERVER),
        ReferenceSample((0.0, 0.0, 1.0), ZERO, ZERO, 0.0, 0.0),
    )

    def at(x: float) -> State:
        return State((x, 0.0, 1.0), ZERO, (1.0, 0.0, 0.0, 0.0), 1.0, 16.0)

    controller.start()
    controller.step(at(0.0), lambda ahead: still, DT)
    for _ in range(100):
        near = controller.step(at(0.3), lambda ahead: still, DT).trim
    controller.step(at(50.0), lambda ahead: still, DT)  # what it asks for is cut from here on
    first = controller.step(at(50.0), lambda ahead: still, DT).trim
    for _ in range(100):
        far = controller.step(at(50.0), lambda ahead: still, DT).trim
    assert near[0] > 0.0
    assert far == first


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.005, 0.08), st.floats(0.02, 0.1), st.floats(0.0, 8.0))
@example(0, 0.0625, 0.0625, 2.2e-313)
def test_the_rate_model_tells_what_the_commands_on_their_way_will_do(seed, delay, lag, integral) -> None:
    """Undelayed response minus delayed response, against the ground's own simulation of the same loop."""
    command = np.cumsum(np.random.default_rng(seed).normal(size=(200, 2)), axis=0) * 0.05
    command[:10] = 0.0
    model = RateModel(Actuation(delay, lag, integral))
    got = []
    for one in command:
        got.append(model.on_its_way()[1])
        model.advance((float(one[0]), float(one[1])), DT)
    fine = 20
    held = np.repeat(command, fine, axis=0)
    undelayed = respond(held, DT / fine, 0.0, lag, integral)
    late = respond(held, DT / fine, delay, lag, integral)
    difference = (undelayed - late)[::fine]
    scale = np.abs(undelayed).max()
    np.testing.assert_allclose(np.array(got)[5:], difference[5:], atol=0.03 * scale + 1e-3)


def test_the_inverse_of_the_lag_gives_the_wanted_rate() -> None:
    lag, integral = 0.05, 4.0
    t = DT * np.arange(600)
    wanted = np.sin(3.0 * t) + 0.5 * np.sin(7.0 * t)
    slope = 3.0 * np.cos(3.0 * t) + 3.5 * np.cos(7.0 * t)
    inverse = LagInverse()
    added = np.array([inverse.step((float(s), 0.0), lag, integral, DT)[0] for s in slope])
    plain = respond(wanted[:, None], DT, 0.0, lag, integral)[:, 0]
    led = respond((wanted + added)[:, None], DT, 0.0, lag, integral)[:, 0]
    settled = t > 2.0
    miss = lambda y: float(np.std((y - wanted)[settled]))  # noqa: E731
    assert miss(led) < 0.2 * miss(plain)


def test_a_gap_in_the_odometry_starts_the_rate_model_anew() -> None:
    model = RateModel(PX4)
    for _ in range(20):
        model.advance((1.0, -1.0), DT)
    assert model.on_its_way()[0][0] > 0.0
    model.advance((1.0, -1.0), 1.0)
    assert model.on_its_way() == ((0.0, 0.0), (0.0, 0.0))


@pytest.mark.parametrize("bad", [{"rate_delay": -0.01}, {"rate_lag": 1.0}, {"thrust_lag": math.nan}])
def test_an_actuation_that_cannot_be_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        Actuation(**bad)


@pytest.mark.parametrize("name", ["lemniscate", "scenario", "rotation", "spiral"])
def test_the_linear_behaviour_on_board_is_the_ground_s(name: str) -> None:
    path = trajectory(name)
    start = (
        np.array(path.start[:3]) + [0.1, -0.1, 0.05],
        np.array([0.1, 0.0, -0.1]),
        np.array([0.05, -0.02, 0.0]),
    )
    n = int(path.duration / DT)
    samples = [path.at(k * DT) for k in range(n)]
    columns = [np.array(column) for column in zip(*samples, strict=True)]
    expected = expected_behaviour(DESIGN, DT * np.arange(n), Reference(*columns[:4]), start)
    behaviour = LinearBehaviour(DESIGN, *(tuple(float(x) for x in v) for v in start), samples[0])
    onboard = [behaviour.position]
    for sample in samples[1:]:
        behaviour.step(sample, DT)
        onboard.append(behaviour.position)
    np.testing.assert_allclose(np.array(onboard), expected.position, atol=2e-3)


def test_the_integral_holds_a_constant_push_and_does_not_wind_up() -> None:
    push = lambda features: (0.5, -0.4, -0.6)  # noqa: E731
    hover = trajectory("hover", height=1.5, duration=20.0)
    plain = flown(Lqr(LAW), Linear(delta=push), hover)[-1]
    held = flown(LqrIntegral(LAW), Linear(delta=push), hover)[-1]
    assert np.all(np.abs(plain) > 0.05)
    assert np.all(np.abs(held) < 0.05 * np.abs(plain))

    controller = LqrIntegral(LAW)
    still = ReferenceSample((0.0, 0.0, 1.0), ZERO, ZERO, 0.0, 0.0)
    far = State((50.0, 0.0, 1.0), ZERO, (1.0, 0.0, 0.0, 0.0), 1.0, 16.0)
    for _ in range(1000):  # tilt is at its limit all the time
        controller.step(far, lambda ahead: still, DT)
    home = replace_position(far, (0.0, 0.0, 1.0))
    assert controller.step(home, lambda ahead: still, DT).command.body_rate[1] == pytest.approx(0.0, abs=1e-6)


def test_a_ground_effect_that_is_expected_too_strong_does_not_pull_the_vehicle_down() -> None:
    """Corrected at the measured height this falls: the correction loses more with height than the loop gives."""
    cushion = lambda gain: lambda features: (0.0, 0.0, gain * 8.0 * math.exp(-features[0] / 0.06))  # noqa: E731
    low = trajectory("lemniscate", height=0.15)
    vehicle = Linear(delta=cushion(1.0))
    error = flown(Corrected(LAW, Oracle(cushion(2.0)), TrimLimits(), ObserverLimits()), vehicle, low)
    assert np.abs(error[:, 2]).max() < 0.05


def replace_position(state: State, position: tuple[float, float, float]) -> State:
    return state._replace(position=position)


def test_what_the_trim_has_learned_stays_when_the_mission_is_over_and_grows_no_more() -> None:
    controller, still = (
        Corrected(LAW, Oracle(), TrimLimits(), NO_OBSERVER),
        ReferenceSample((0.0, 0.0, 1.0), ZERO, ZERO, 0.0, 0.0),
    )
    home = State((0.0, 0.0, 1.0), ZERO, (1.0, 0.0, 0.0, 0.0), 1.0, 16.0)
    aside = replace_position(home, (0.2, 0.0, 1.0))
    controller.start()
    controller.step(home, lambda ahead: still, DT)
    for _ in range(150):
        learned = controller.step(aside, lambda ahead: still, DT).trim
    controller.stop()
    for _ in range(50):
        step = controller.step(aside, lambda ahead: still, DT)
        assert step.trim == learned
    assert learned[0] > 0.0


def test_a_mission_chooses_its_controller_by_name() -> None:
    made = [make_controller(name, LAW, Oracle()) for name in ("lqr", "lqr_integral", "corrected")]
    assert [type(one) for one in made] == [Lqr, LqrIntegral, Corrected]


def test_controllers_that_lack_something_are_refused() -> None:
    with pytest.raises(InputError, match="needs a deployed model"):
        make_controller("corrected", LAW)
    with pytest.raises(InputError, match="unknown"):
        make_controller("pid", LAW)
    without = ControlLaw(VEHICLE, replace(DESIGN, integral=None))
    with pytest.raises(InputError, match="no gains for lqr_integral"):
        make_controller("lqr_integral", without)


def test_euler_rates_of_the_state_are_used() -> None:
    """A vehicle that turns already is asked to turn less: the look-ahead has the right sign."""
    still = ReferenceSample((0.0, 0.0, 1.0), ZERO, ZERO, 0.0, 0.0)
    q = tuple(float(x) for x in frames.quaternion_from_euler(np.array([-0.1, 0.0, 0.0])))
    rates = []
    for p in (0.0, 0.5):
        controller = Corrected(
            LAW, Oracle(actuation=Actuation(rate_lag=0.05)), TrimLimits(bandwidth=0.0), NO_OBSERVER
        )
        here = State((0.0, 0.0, 1.0), ZERO, q, 1.0, 16.0, (p, 0.0, 0.0), (0.0, 0.0, GRAVITY))
        for _ in range(150):
            step = controller.step(here, lambda ahead: still, DT)
        rates.append(step.command.body_rate[0])
    assert euler(q)[0] == pytest.approx(-0.1)
    assert rates[1] < rates[0]
