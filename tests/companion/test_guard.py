"""Whatever a model returns, the correction stays inside its envelope."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trueflight.companion.law.actuation import ACTS_AT_ONCE
from trueflight.companion.law.guard import Guard
from trueflight.companion.law.watch import GuardLimits, Range, Watch
from trueflight.models.contract import FEATURES

LIMITS = GuardLimits(fade=0.5)
RANGES = (Range("z", "m", 0.0, 2.0), Range("vx", "m/s", -2.0, 2.0))
INSIDE = (1.0, 0.0)
DT = 0.01


class Clock:
    """A clock that a model moves: what an inference takes."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def guard_of(model, limits=LIMITS, trips=None, clock=None) -> Guard:
    kwargs = {} if clock is None else {"clock": clock}
    on_trip = None if trips is None else lambda name, why: trips.append(why)
    return Guard(Watch(model, RANGES, limits, **kwargs), on_trip)


def step(guard: Guard, features, dt: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """One tick with the same features at each of the moments that the controller asks for."""
    correction = guard.step([features] * 4, 0.02, dt)
    return correction.applied, correction.raw


def run(guard: Guard, seconds: float, features=INSIDE) -> list[tuple[float, float, float]]:
    return [step(guard, features, DT)[0] for _ in range(round(seconds / DT))]


def constant(x: float, y: float = 0.0, z: float = 0.0):
    return lambda features: (x, y, z)


anything = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.floats(-4.0, 4.0))
answers = st.one_of(
    st.tuples(anything, anything, anything),
    st.lists(anything, max_size=5),
    st.none(),
    st.text(max_size=3),
    st.sampled_from([ValueError("no"), RuntimeError(), MemoryError()]),
)


@settings(max_examples=300, deadline=None)
@given(
    st.lists(
        st.tuples(
            answers,
            st.floats(0.0, 0.05),  # s that the inference takes
            st.floats(allow_nan=True, allow_infinity=True),  # dt
            st.tuples(anything, anything),  # features
            st.one_of(st.none(), st.tuples(anything, anything, anything)),  # what the accelerometer shows
            st.sampled_from(["", "", "", "start", "stop"]),
        ),
        max_size=60,
    )
)
def test_the_applied_correction_never_leaves_its_envelope(ticks) -> None:
    clock = Clock()
    script: list = []

    def model(features):
        answer, seconds = script[-1]
        clock.now += seconds
        if isinstance(answer, Exception):
            raise answer
        return answer

    trips: list[str] = []
    guard = guard_of(model, trips=trips, clock=clock)
    guard.start()
    previous = (0.0, 0.0, 0.0)
    for answer, seconds, dt, features, measured, order in ticks:
        script.append((answer, seconds))
        if order:
            getattr(guard, order)()
        applied = guard.step([features] * 4, 0.02, dt, measured=measured).applied
        longest = min(0.1, dt) if dt > 0 else 0.0
        for i in range(3):
            assert math.isfinite(applied[i])
            assert abs(applied[i]) <= LIMITS.authority[i]
            assert abs(applied[i] - previous[i]) <= LIMITS.slew[i] * longest + 1e-9
        previous = applied
    assert len(trips) <= 1, "a trip is told once"
    assert bool(trips) == guard.tripped


def test_it_fades_in_stays_and_fades_out() -> None:
    guard = guard_of(constant(1.0))
    assert run(guard, 0.2)[-1] == (0.0, 0.0, 0.0)
    assert guard.status == "off"
    guard.start()
    rising = [x for x, _, _ in run(guard, 0.5)]
    assert guard.status == "active"
    assert rising[0] == pytest.approx(DT / LIMITS.fade)
    assert all(b >= a for a, b in pairwise(rising))
    assert run(guard, 0.3)[-1] == (1.0, 0.0, 0.0)
    guard.stop()
    assert guard.status == "fading_out"
    falling = [x for x, _, _ in run(guard, 0.5)]
    assert all(b <= a for a, b in pairwise(falling))
    assert falling[-1] == pytest.approx(0.0)
    assert run(guard, 0.1)[-1] == (0.0, 0.0, 0.0)
    assert guard.status == "off"


def test_fading_can_turn_around() -> None:
    guard = guard_of(constant(1.0))
    guard.start()
    run(guard, 0.6)
    guard.stop()
    run(guard, 0.1)
    guard.start()
    assert guard.status == "fading_in"
    assert run(guard, 0.6)[-1] == (1.0, 0.0, 0.0)


def test_a_correction_is_cut_at_its_authority_and_tripped_when_it_stays_there() -> None:
    trips: list[str] = []
    guard = guard_of(constant(2 * LIMITS.authority[0]), trips=trips)
    guard.start()
    applied = run(guard, LIMITS.patience - 0.1)
    assert applied[-1][0] == LIMITS.authority[0]
    assert not guard.tripped
    run(guard, 0.2)
    assert guard.tripped
    assert "authority" in trips[0]


@pytest.mark.parametrize(
    ("truth", "trips"), [(5.0, False), (3.5, False), (2.9, True), (-6.0, True), (None, True)]
)
def test_a_correction_beyond_its_authority_is_cut_and_stays_where_the_accelerometer_bears_it_out(
    truth: float | None, trips: bool
) -> None:
    asked = 2.0 * LIMITS.authority[0]
    guard = guard_of(constant(asked))
    guard.start()
    measured = None if truth is None else (truth, 0.0, 0.0)
    for _ in range(round(3.0 * LIMITS.patience / DT)):
        applied = guard.step([INSIDE] * 4, 0.02, DT, measured=measured).applied
    assert guard.tripped is trips
    assert applied[0] == (0.0 if trips else LIMITS.authority[0])


def test_a_short_excess_is_forgiven() -> None:
    big = [True]
    guard = guard_of(lambda features: (2 * LIMITS.authority[0] if big[0] else 0.1, 0.0, 0.0))
    guard.start()
    for _ in range(5):
        big[0] = True
        run(guard, 0.9 * LIMITS.patience)
        big[0] = False
        run(guard, 0.05)
    assert guard.status == "active"


@pytest.mark.parametrize(
    ("model", "reason"),
    [
        (constant(math.nan), "not finite"),
        (constant(0.0, math.inf), "not finite"),
        (constant(0.0, 0.0, -math.inf), "not finite"),
        (constant(0.0, 1e9), "times its authority"),
        (lambda features: 1 / 0, "ZeroDivisionError"),
        (lambda features: (1.0,), "ValueError"),
        (lambda features: None, "TypeError"),
    ],
)
def test_nonsense_trips_at_once_and_for_good(model, reason: str) -> None:
    trips: list[str] = []
    calls: list[int] = []

    def counted(features):
        calls.append(1)
        return (1.0, 0.0, 0.0) if len(calls) <= 99 * 4 else model(features)  # four moments a tick

    guard = guard_of(counted, trips=trips)
    guard.start()
    before = run(guard, 0.99)[-1]
    assert before == (1.0, 0.0, 0.0)
    after = run(guard, 0.5)
    assert guard.tripped
    assert reason in guard.status
    assert trips == [guard.status.removeprefix("tripped: ")]
    assert after[0][0] == pytest.approx(1.0 - LIMITS.slew[0] * DT)
    assert after[-1] == (0.0, 0.0, 0.0)
    guard.start()
    guard.stop()
    assert run(guard, 0.5)[-1] == (0.0, 0.0, 0.0)
    assert guard.tripped
    assert 99 * 4 < len(calls) <= 100 * 4, "a tripped model is not called again"


def test_a_late_model_trips_after_some_misses_and_a_very_late_one_at_once() -> None:
    clock = Clock()
    delay = [0.0]

    def model(features):
        clock.now += delay[0] / 4.0  # four moments a tick
        return (0.1, 0.0, 0.0)

    guard = guard_of(model, clock=clock)
    guard.start()
    for _ in range(3):  # single misses are forgiven
        delay[0] = 1.5 * LIMITS.deadline
        step(guard, INSIDE, DT)
        delay[0] = 0.0
        step(guard, INSIDE, DT)
    assert not guard.tripped
    delay[0] = 1.5 * LIMITS.deadline
    for _ in range(LIMITS.misses - 1):
        step(guard, INSIDE, DT)
    assert not guard.tripped
    assert guard.inference_time == pytest.approx(1.5 * LIMITS.deadline)
    step(guard, INSIDE, DT)
    assert guard.tripped
    assert "inference took" in guard.status

    at_once = guard_of(model, clock=clock)
    at_once.start()
    delay[0] = 1.1 * LIMITS.stall
    step(at_once, INSIDE, DT)
    assert at_once.tripped


def test_outside_its_training_range_it_is_trusted_less_and_then_not_at_all() -> None:
    trips: list[str] = []
    guard = guard_of(constant(1.0), trips=trips)
    guard.start()
    run(guard, 1.0)
    margin = 0.25 * 2.0
    assert run(guard, 0.5, (2.0 + 0.5 * margin, 0.0))[-1][0] == pytest.approx(0.5)
    assert run(guard, 0.5, (0.0 - 0.5 * margin, 0.0))[-1][0] == pytest.approx(0.5)
    # Of two features outside, the worse one decides: vx is out by a fifth of its margin of 1 m/s.
    assert run(guard, 0.5, (2.0 + 0.5 * margin, 2.2))[-1][0] == pytest.approx(0.5)
    assert run(guard, 0.5, (2.0 + 2 * margin, 0.0))[-1][0] == 0.0
    assert guard.applied == (0.0, 0.0, 0.0)
    assert not guard.tripped
    run(guard, 0.1)  # back inside: forgiven
    run(guard, 0.9, (2.0 + 2 * margin, 0.0))
    assert not guard.tripped
    run(guard, 0.2, (2.0 + 2 * margin, 0.0))
    assert guard.tripped
    assert "z outside its training range" in trips[0]


def test_outside_its_training_range_it_acts_as_far_as_the_accelerometer_bears_it_out() -> None:
    def applied(truth: float) -> tuple[float, bool]:
        guard = guard_of(constant(1.0))
        guard.start()
        for _ in range(300):
            correction = guard.step([(9.0, 0.0)] * 4, 0.02, DT, measured=(truth, 0.0, 0.0))
        return correction.applied[0], guard.tripped

    assert applied(1.0) == (1.0, False)
    assert applied(0.8) == (pytest.approx(1.0 - 0.25**2), False), (
        "a quarter too much: a sixteenth is not explained"
    )
    assert applied(4.0) == (pytest.approx(1.0 - 0.75**2), False)
    assert applied(0.4) == applied(-1.0) == applied(0.0) == (0.0, True)


def test_a_feature_that_is_not_a_number_is_outside_every_range() -> None:
    guard = guard_of(constant(1.0))
    guard.start()
    assert run(guard, 0.5, (math.nan, 0.0))[-1] == (0.0, 0.0, 0.0)
    run(guard, 1.0, (math.nan, 0.0))
    assert guard.tripped


def test_a_feature_that_hardly_moved_in_training_has_a_margin_of_its_unit() -> None:
    ranges = (Range("u_batt", "V", 16.0, 16.0), Range("T", "N", 7.0, 7.0), Range("cos_phi", "1", 1.0, 1.0))
    guard = Guard(Watch(constant(1.0), ranges, LIMITS))
    guard.start()
    assert run(guard, 1.0, (15.75, 7.0, 1.0))[-1][0] == pytest.approx(0.5)
    assert run(guard, 0.5, (16.0, 7.35, 1.0))[-1][0] == pytest.approx(0.5)
    assert run(guard, 0.5, (16.0, 7.0, 0.95))[-1][0] == pytest.approx(0.5)


def test_near_the_ground_a_model_may_add_thrust_but_take_little_away() -> None:
    def applied(height: float, delta: float) -> float:
        ranges = [Range(name, unit, -100.0, 100.0) for name, unit in FEATURES.items()]
        guard = Guard(Watch(lambda features: (0.0, 0.0, delta), ranges))
        guard.start()
        row = [height, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 16.0, 7.0]
        for _ in range(200):
            correction = guard.step([row] * 4, 0.02, 0.01, height)
        return correction.applied[2]

    limits = GuardLimits()
    assert applied(2.0 * limits.ground, 3.0) == pytest.approx(3.0)
    assert applied(0.2 * limits.ground, 3.0) == pytest.approx(0.2 * limits.authority[2])
    assert applied(-0.1, 3.0) == 0.0
    assert applied(0.1 * limits.ground, -3.0) == pytest.approx(-3.0)


def test_without_limits_of_its_own_a_guard_fades_in_a_second_and_a_model_has_2_ms_a_tick() -> None:
    clock, takes = Clock(), [0.0]

    def model(features):
        clock.now += takes[0] / 4.0  # four moments a tick
        return (0.1, 0.0, 1.0)

    def begun() -> Guard:
        guard = guard_of(model, GuardLimits(), clock=clock)
        guard.start()
        return guard

    guard = begun()
    run(guard, 0.99)
    assert guard.status == "fading_in"
    run(guard, 0.02)
    assert guard.status == "active"
    lifts = [guard.step([INSIDE] * 4, 0.02, 0.1, height).applied[2] for height in (0.0, 0.1, 0.5)]
    assert lifts == pytest.approx([0.0, 0.2 * 4.0, 1.0]), "0.5 m above the ground all of it acts"
    for takes[0], ticks in ((0.0019, 100), (0.0021, 4), (0.0, 1), (0.049, 1)):
        for _ in range(ticks):
            step(guard, INSIDE, DT)
    assert not guard.tripped
    for takes[0], ticks in ((0.0021, 5), (0.051, 1)):
        guard = begun()
        for _ in range(ticks):
            step(guard, INSIDE, DT)
        assert guard.tripped


def test_after_a_gap_a_tick_moves_on_by_a_tenth_of_a_second() -> None:
    guard = guard_of(constant(2.0), GuardLimits(slew=(8.0, 8.0, 8.0), fade=1.0))
    guard.start()
    step(guard, INSIDE, 100.0)
    assert guard.engaged == pytest.approx(0.1)
    run(guard, 2.0)
    guard.stop()
    before = guard.applied[0]
    assert step(guard, INSIDE, 100.0)[0][0] == pytest.approx(before - 0.1 * 2.0)
    guard = guard_of(constant(2.0), GuardLimits(slew=(8.0, 8.0, 8.0), fade=1e-3))
    guard.start()
    assert step(guard, INSIDE, 100.0)[0][0] == pytest.approx(0.1 * 8.0)


def test_a_gap_gives_no_jump() -> None:
    guard = guard_of(constant(2.0), GuardLimits(fade=0.01))
    guard.start()
    applied, _ = step(guard, INSIDE, 100.0)
    assert applied[0] <= LIMITS.slew[0] * 0.1
    assert step(guard, INSIDE, -1.0)[0] == applied
    assert step(guard, INSIDE, math.nan)[0] == applied


def test_a_guard_without_a_model_changes_nothing() -> None:
    guard = Guard(None, limits=LIMITS)
    guard.start()
    assert (guard.limits, guard.status, guard.live, guard.last_good) == (LIMITS, "off", "", "")
    assert (guard.engaged, guard.actuation, guard.settled, guard.tripped) == (0.0, ACTS_AT_ONCE, True, False)
    assert (guard.wants_yaw, guard.inference_time, guard.why_tripped("a")) == (False, 0.0, "")
    assert guard.step([INSIDE] * 4, 0.02, DT) == (
        (0.0, 0.0, 0.0),
        (0.0, 0.0),
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0),
    )
    assert Guard(None).limits == GuardLimits()


def test_a_model_is_asked_from_the_first_tick_on_in_which_it_may_act_and_in_no_other() -> None:
    asked: list = []
    guard = guard_of(lambda features: asked.append(features) or (0.5, 0.0, 0.0))
    run(guard, 0.2)
    assert asked == []
    guard.start()
    step(guard, INSIDE, 0.0)  # the fade begins: nothing of it acts, but it shows what it would say
    assert len(asked) == 4
    run(guard, 0.1)
    guard.stop()
    run(guard, 0.2)
    assert guard.status == "off"
    asked.clear()
    run(guard, 0.2)
    assert asked == []


def test_the_rate_told_is_how_fast_the_applied_correction_is_about_to_change() -> None:
    slopes = [4.0, -8.0]
    guard = guard_of(lambda features: (slopes[0] * features[1], slopes[1] * features[1], 0.0))
    moving = [(1.0, 0.25), (1.0, 0.375), (1.0, 0.25), INSIDE]
    assert guard.step(moving, 0.125, DT).rate == (0.0, 0.0)
    guard.start()
    share = 0.0
    for _ in range(60):
        share = min(1.0, share + DT / LIMITS.fade)
        assert guard.step(moving, 0.125, DT).rate == pytest.approx((4.0 * share, -8.0 * share))
    for slopes[0], slopes[1] in ((-12.0, 12.0), (12.0, -12.0)):  # a change of 3 m/s² in an eighth of a second
        rate = guard.step([(1.0, -0.125), (1.0, 0.125), INSIDE, INSIDE], 0.0625, DT).rate
        assert rate == (math.copysign(30.0, slopes[0]), math.copysign(30.0, slopes[1])), "cut at the slew"


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_each_axis_moves_no_faster_than_its_slew_and_ends_at_its_authority(axis: int, sign: float) -> None:
    limits = GuardLimits(authority=(1.0, 2.0, 4.0), slew=(8.0, 16.0, 64.0), fade=1e-9)
    wanted = [0.0, 0.0, 0.0]
    wanted[axis] = sign * 1.5 * limits.authority[axis]
    guard = guard_of(constant(*wanted), limits)
    guard.start()
    for k in range(1, 20):
        applied = step(guard, INSIDE, 0.0078125)[0]
        expected = [0.0, 0.0, 0.0]
        expected[axis] = sign * min(limits.authority[axis], k * 0.0078125 * limits.slew[axis])
        assert applied == tuple(expected)


def test_time_that_stands_still_or_is_unknown_moves_nothing() -> None:
    guard = guard_of(constant(1.0))
    guard.start()
    before = run(guard, 0.2)[-1]
    for dt in (0.0, -0.5, math.nan):
        assert step(guard, INSIDE, dt)[0] == before
        assert guard.engaged == pytest.approx(0.4)


@pytest.mark.parametrize("height", [math.nan, 0.0, -1.0, -math.inf])
def test_at_no_height_or_an_unknown_one_no_model_takes_thrust_away(height: float) -> None:
    guard = guard_of(constant(0.0, 0.0, 2.0))
    guard.start()
    for _ in range(100):
        assert guard.step([INSIDE] * 4, 0.02, DT, height).applied == (0.0, 0.0, 0.0)
    for _ in range(100):
        high = guard.step([INSIDE] * 4, 0.02, DT).applied  # how high is not told: high enough
    assert high == (0.0, 0.0, 2.0)
