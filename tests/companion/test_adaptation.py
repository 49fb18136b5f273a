"""Learning in flight: it finds what changed, stays bounded whatever it is told, and gives way where it is wrong."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trueflight.companion.law.adaptation import Learning
from trueflight.companion.law.parameter_filter import ParameterFilter
from trueflight.models.learnable import Learnable

GAIN = Learnable("thrust_gain", "gain", "1", 1.0, 0.7, 1.3, 0.05, 0.016)
WIND = Learnable("wind", "x", "m/s", 0.0, -12.0, 12.0, 2.0, 0.63)
NOISE = (0.05, 0.05, 0.05)
G = 9.81


class Plant:
    """Thrust with a gain, and linear drag in a wind: features are specific thrust and speed."""

    def __init__(self, drag: float = 0.3) -> None:
        self.drag = drag
        self.fails: Callable[[Sequence[float]], None] = lambda row: None

    def rows(
        self, rows: Sequence[Sequence[float]], parameters: Sequence[float] | None = None
    ) -> list[tuple[float, float, float]]:
        gain, wind = parameters if parameters is not None else (1.0, 0.0)
        return [(-self.drag * (v - wind), 0.0, (gain - 1.0) * f) for f, v in rows]

    def sensed(
        self, row: Sequence[float], parameters: Sequence[float]
    ) -> tuple[tuple[float, float, float], list[float]]:
        self.fails(row)
        return self.rows((row,), parameters)[0], [0.0, 0.0, row[0], self.drag, 0.0, 0.0]


def _learning(plant: Plant | None = None) -> Learning:
    return Learning(plant or Plant(), (GAIN, WIND), NOISE)


def _fly(
    learning: Learning,
    seconds: float,
    gain: float = 1.0,
    wind: float = 0.0,
    noise: float = 0.1,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    seed: int = 0,
    waits: str = "",
) -> None:
    generator = np.random.default_rng(seed)
    truth = Plant()
    for k in range(round(100 * seconds)):
        row = (G * (1.0 + 0.1 * math.sin(0.02 * k)), 2.0 * math.sin(0.01 * k))
        (answer,) = truth.rows((row,), (gain, wind))
        x, y, z = np.array(answer) + offset + noise * generator.standard_normal(3)
        learning.step(row, (float(x), float(y), float(z)), 0.01, waits)


def test_a_payload_and_a_gust_are_found_within_five_seconds_and_act() -> None:
    learning = _learning()
    _fly(learning, 3.0)
    assert learning.status == "shadow" and learning.acting == [1.0, 0.0]
    _fly(learning, 5.0, gain=0.909, wind=5.0, seed=1)
    gain, wind = learning.told.values
    assert gain == pytest.approx(0.909, abs=0.02) and wind == pytest.approx(5.0, abs=1.0)
    assert learning.status == "acting" and learning.acting == pytest.approx([gain, wind])
    assert learning.rows(((G, 0.0),))[0][2] == pytest.approx((gain - 1.0) * G)


def test_where_nothing_changes_what_is_learnt_stays_within_its_uncertainty_and_does_not_act() -> None:
    for seed in range(5):
        learning = _learning()
        _fly(learning, 20.0, seed=seed)
        for value, deviation, one in zip(*learning.told[2:4], learning.learnables, strict=True):
            assert abs(value - one.value) < 2.0 * deviation
        assert learning.acting == [1.0, 0.0]


def test_what_nothing_excites_is_not_learnt() -> None:
    learning = Learning(Plant(drag=0.002), (GAIN, WIND), NOISE)
    _fly(learning, 10.0, wind=5.0, offset=(0.4, 0.0, 0.0))
    assert learning.told.values[1] == 0.0, "through a drag that small no wind can be seen"


@pytest.mark.parametrize(
    ("measured", "dt", "waits", "why"),
    [
        (None, 0.01, "", "no accelerometer"),
        ((0.0, 0.0, -0.5), 0.5, "", "a gap"),
        ((0.0, 0.0, -0.5), math.nan, "", "a gap"),
        ((0.0, 0.0, -0.5), 0.01, "at the limits", "at the limits"),
        ((0.0, 0.0, -40.0), 0.01, "", "pushed by more than any flight"),
    ],
)
def test_it_waits_where_nothing_can_be_learnt(
    measured: tuple[float, float, float] | None, dt: float, waits: str, why: str
) -> None:
    learning = _learning()
    _fly(learning, 2.0)
    before = learning.told.values
    for _ in range(300):
        learning.step((G, 0.0), measured, dt, waits)
    assert learning.status == f"waiting: {why}"
    assert learning.told.values == before


def test_a_number_that_is_not_finite_trips_for_the_flight_and_the_deployed_numbers_fade_back() -> None:
    learning = _learning()
    _fly(learning, 6.0, gain=0.9)
    assert learning.status == "acting"
    learning.step((G, math.nan), (0.0, 0.0, 0.0), 0.01)
    assert learning.tripped and "not finite" in learning.status
    assert all(map(math.isfinite, learning.acting))
    gains = []
    for _ in range(100):
        learning.step((G, 0.0), (0.0, 0.0, 0.0), 0.01)
        gains.append(learning.acting[0])
    assert gains[-1] == 1.0 and max(np.abs(np.diff(gains))) < 0.01
    _fly(learning, 3.0, gain=0.9)
    assert learning.acting == [1.0, 0.0], "a trip latches"


def test_a_model_that_raises_trips() -> None:
    plant = Plant()
    learning = _learning(plant)

    def fails(row: Sequence[float]) -> None:
        raise RuntimeError

    plant.fails = fails
    _fly(learning, 0.1)
    assert learning.status == "tripped: the model raised RuntimeError"


def test_a_number_at_the_end_of_its_range_trips() -> None:
    learning = _learning()
    _fly(learning, 3.0)
    _fly(learning, 8.0, gain=0.55)
    assert "thrust_gain.gain was at the end of its range" in learning.status


def test_a_prediction_that_stays_worse_trips() -> None:
    """A model whose derivatives are not its own: what it learns makes it worse."""

    class Lying(Plant):
        def sensed(self, row, parameters):  # type: ignore[no-untyped-def]
            answer, slopes = super().sensed(row, parameters)
            return answer, [-s for s in slopes]

    learning = _learning(Lying())
    _fly(learning, 2.0)
    _fly(learning, 20.0, gain=0.93)
    assert learning.tripped
    _fly(learning, 1.0)
    assert learning.acting == [1.0, 0.0]


numbers = st.floats(allow_nan=True, allow_infinity=True, width=32)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(numbers, numbers, numbers, numbers, numbers, numbers), max_size=30))
def test_whatever_it_is_told_what_acts_is_finite_and_in_its_range(told: list[tuple[float, ...]]) -> None:
    learning = _learning()
    _fly(learning, 1.0)
    for f, v, x, y, z, dt in told:
        learning.step((f, v), (x, y, z), dt)
        for acting, one in zip(learning.acting, learning.learnables, strict=True):
            assert one.low <= acting <= one.high


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-50, 50)] * 9), min_size=1, max_size=60))
def test_no_parameter_moves_faster_than_its_uncertainty_and_none_is_better_known_than_measured(
    told: list[tuple[float, ...]],
) -> None:
    found = ParameterFilter((GAIN, WIND), [0.0025] * 3, NOISE, NOISE)
    for row in told:
        found.step(row[:3], row[3:], 0.01)
        assert found.sound
        for i, one in enumerate(found.learnables):
            assert one.low <= found.values[i] <= one.high
            assert 0.0 < found.covariance[i][i] <= one.spread**2 * (1.0 + 1e-9)


def test_numbers_that_contradict_each_other_are_refused() -> None:
    for bad in ({"value": 2.0}, {"spread": 0.0}, {"drift": math.nan}, {"low": 1.3}):
        with pytest.raises(ValueError):
            Learnable(**{**GAIN.table(), **bad})
