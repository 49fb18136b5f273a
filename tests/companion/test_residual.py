"""The disturbance observer: what it sees, what it does about it, and what an accelerometer that is wrong can do."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_controllers import (
    DT,
    LAW,
    LIVELY,
    PX4,
    Linear,
    Oracle,
    drag_and_weak_thrust,
    flown,
)

from trueflight.companion.law.actuation import ACTS_AT_ONCE, Actuation
from trueflight.companion.law.control import ZERO, State, euler
from trueflight.companion.law.controllers import Corrected, TrimLimits
from trueflight.companion.law.residual import DisturbanceObserver, MeasuredAcceleration, ObserverLimits
from trueflight.models import frames
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import GRAVITY

NO_TRIM = TrimLimits(bandwidth=0.0)
HOVER = trajectory("hover", duration=8.0, height=2.0)


class Sensed(Linear):
    """The linear vehicle with an accelerometer that tells something else from a moment on."""

    def __init__(
        self, told: Callable[[tuple[float, ...]], tuple[float, ...] | None], after: float, **more
    ) -> None:
        super().__init__(**more)
        self.told, self.after, self.clock = told, after, 0.0

    def state(self) -> State:
        state, self.clock = super().state(), self.clock + DT
        assert state.specific_force is not None
        return (
            state._replace(specific_force=self.told(state.specific_force))
            if self.clock > self.after
            else state
        )


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def gusts(features) -> tuple[float, float, float]:
    """Pushes that no model knows: a wind that turns with the velocity, and thrust that is missing."""
    return 1.0 - 0.3 * features[5], -0.8, -0.12 * features[9] / LAW.vehicle.mass


@pytest.mark.parametrize("actuation", [ACTS_AT_ONCE, PX4], ids=["at once", "late"])
def test_what_no_model_knows_is_removed(actuation: Actuation) -> None:
    def error(observer: ObserverLimits) -> float:
        controller = Corrected(LAW, Oracle(actuation=actuation), NO_TRIM, observer)
        return rms(flown(controller, Linear(actuation, gusts), LIVELY))

    assert error(ObserverLimits()) < 0.15 * error(ObserverLimits(frequency=0.0))


def test_what_the_model_knows_is_no_disturbance() -> None:
    controller = Corrected(LAW, Oracle(drag_and_weak_thrust), NO_TRIM, ObserverLimits())
    vehicle, pushed = Linear(delta=drag_and_weak_thrust), []
    vehicle.position = np.array(LIVELY.start[:3])
    controller.start()
    for k in range(400):
        step = controller.step(
            vehicle.state(), lambda ahead, t=k * DT: LIVELY.at(t + ahead), DT if k else 0.0
        )
        pushed.append(step.trim)
        vehicle.fly(step.command.thrust, step.command.body_rate)
    assert np.abs(pushed).max() < 0.15, "and the correction itself takes up to 1.5 m/s²"


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(*[st.floats(-0.4, 0.4)] * 2, st.floats(-math.pi, math.pi)),
    st.tuples(*[st.floats(-2.0, 2.0)] * 3),
    st.tuples(*[st.floats(-2.0, 2.0)] * 3),
)
def test_the_residual_is_what_pushes_in_the_heading_frame(zeta, push, modelled) -> None:
    """Against plain matrices: hover thrust, a push in the heading frame, a model that knows part of it."""
    q = frames.quaternion_from_euler(np.array(zeta))
    turn = np.array(
        [[math.cos(zeta[2]), -math.sin(zeta[2]), 0], [math.sin(zeta[2]), math.cos(zeta[2]), 0], [0, 0, 1]]
    )
    linear = np.array([GRAVITY * zeta[1], -GRAVITY * zeta[0], 0.0])
    world = turn @ (linear + np.array(push))
    force = frames.rotate_inverse(q, world + np.array([0.0, 0.0, GRAVITY]))
    observer = DisturbanceObserver(LAW, ObserverLimits())
    velocity = np.zeros(3)
    for k in range(200):
        jitter = 1e-9 * k  # no accelerometer says the same number twice
        state = State(
            ZERO, tuple(velocity), tuple(q), 1.0, 16.0, ZERO, (force[0] + jitter, force[1], force[2])
        )
        acceleration, thrust = observer.look(state, ACTS_AT_ONCE, DT if k else 0.0)
        pushed, _ = observer.step(euler(state.quaternion), modelled, DT)
        observer.commanded(LAW.vehicle.weight)
        velocity = velocity + DT * world
    assert acceleration == pytest.approx(tuple(world), abs=1e-6)
    assert thrust == pytest.approx(LAW.vehicle.weight)
    expected = np.subtract(push, modelled)
    beyond = observer.beyond_linear(euler(state.quaternion))
    assert beyond is not None
    assert np.subtract(beyond, modelled) == pytest.approx(expected, abs=1e-6)
    if np.abs(turn @ expected).max() < ObserverLimits().authority:
        assert pushed == pytest.approx(tuple(expected), abs=1e-3)


def test_the_acting_thrust_follows_the_command_s_delay_and_lag() -> None:
    observer = DisturbanceObserver(LAW, ObserverLimits())
    weight, state = LAW.vehicle.weight, Linear().state()
    known = Actuation(thrust_delay=0.03, thrust_lag=0.05)
    observer.look(state, known, 0.0)
    observer.commanded(2.0 * weight)
    acting = [observer.look(state, known, DT)[1] / weight for _ in range(30)]
    elapsed = DT * np.arange(1, 31) - 0.03 + DT
    expected = 2.0 - np.exp(-np.maximum(elapsed, 0.0) / 0.05)
    assert acting == pytest.approx(expected, abs=1e-9)


WRONG: dict[str, Callable[[tuple[float, ...]], tuple[float, ...] | None]] = {
    "stuck": lambda force: (0.3, -0.2, 9.0),
    "nothing": lambda force: None,
    "zero": lambda force: ZERO,
    "huge": lambda force: (force[0] + 30.0, force[1], force[2] - 50.0),
    "biased": lambda force: (force[0] + 0.5, force[1] - 0.5, force[2] + 0.5),
    "turned about": lambda force: (-force[0], -force[1], force[2]),
}


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.parametrize("after", [0.0, 4.0])
def test_an_accelerometer_that_is_wrong_moves_the_vehicle_little(name: str, after: float) -> None:
    vehicle = Sensed(WRONG[name], after, actuation=PX4)
    error = flown(Corrected(LAW, Oracle(actuation=PX4), TrimLimits(), ObserverLimits()), vehicle, LIVELY)
    assert np.abs(error).max() < 0.15, np.abs(error).max()


def test_near_the_ground_no_lift_is_taken_away_and_all_may_be_added() -> None:
    def lift(height: float, push: float) -> float:
        observer = DisturbanceObserver(LAW, ObserverLimits(authority=3.0))
        for k in range(200):
            state = State(
                (0.0, 0.0, height), (0.0, 0.0, push * DT * k), (1.0, 0.0, 0.0, 0.0), height, 16.0, ZERO,
                (1e-9 * k, 0.0, GRAVITY + push),
            )  # fmt: skip
            observer.look(state, ACTS_AT_ONCE, DT if k else 0.0)
            pushed, _ = observer.step(ZERO, ZERO, DT)
            observer.commanded(LAW.vehicle.weight)
        return pushed[2]

    assert [lift(height, 2.0) for height in (0.0, 0.1, 1.0)] == pytest.approx([0.0, 0.6, 2.0], abs=1e-3)
    assert [lift(height, -2.0) for height in (0.0, 0.1, 1.0)] == pytest.approx([-2.0] * 3, abs=1e-3)


def test_one_spike_is_one_spike() -> None:
    observer = DisturbanceObserver(LAW, replace(ObserverLimits(), frequency=2.0))
    vehicle = Linear()
    for k in range(100):
        state = vehicle.state()
        force = (1e-9 * k, 0.0, GRAVITY) if k != 50 else (1e4, -1e4, 1e4)
        observer.look(state._replace(specific_force=force), ACTS_AT_ONCE, DT)
        pushed, _ = observer.step(ZERO, ZERO, DT)
        observer.commanded(LAW.vehicle.weight)
        assert max(map(abs, pushed)) < 0.1
    assert np.abs(pushed).max() < 0.05


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.tuples(*[st.floats(-100.0, 100.0)] * 3),
            st.tuples(*[st.floats(-1e3, 1e3)] * 3) | st.none(),
            st.tuples(*[st.floats(-10.0, 10.0)] * 3),
            st.floats(0.0, 1.0),
        ),
        max_size=30,
    )
)
def test_what_acts_stays_within_its_authority_whatever_is_told(ticks) -> None:
    limits = ObserverLimits(authority=0.7)
    observer, measured = DisturbanceObserver(LAW, limits), MeasuredAcceleration(1.0)
    for velocity, force, modelled, dt in ticks:
        state = State(ZERO, velocity, (1.0, 0.0, 0.0, 0.0), 1.0, 16.0, ZERO, force)
        observer.look(state, ACTS_AT_ONCE, dt)
        pushed, pushing = observer.step(ZERO, modelled, dt)
        assert all(abs(one) <= 0.7 + 1e-9 for one in pushed)
        assert all(map(math.isfinite, pushing))
        measured.step(state, dt)
        assert 0.0 <= measured.trust <= 1.0
