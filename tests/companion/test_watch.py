"""A watch believes nothing of its model: where exactly it stops believing, and what it says then."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trueflight.companion.law.actuation import ACTS_AT_ONCE, Actuation
from trueflight.companion.law.watch import SMOOTHING, ZERO, Borne, Evidence, GuardLimits, Range, Watch

LIMITS = GuardLimits(authority=(2.0, 4.0, 8.0), absurd=4.0, patience=1.0, deadline=0.25, misses=3, stall=1.0)
Z, VX = Range("z", "m", 0.0, 4.0), Range("vx", "m/s", -2.0, 2.0)  # margins 1 m and 1 m/s
INSIDE = (1.0, 0.0)


class Clock:
    """A clock that moves on by `takes` s whenever a model was asked."""

    def __init__(self) -> None:
        self.now = self.takes = 0.0

    def __call__(self) -> float:
        return self.now


def watch_of(
    model: Callable[[Sequence[float]], Sequence[float]],
    clock: Clock | None = None,
    limits: GuardLimits = LIMITS,
) -> Watch:
    clock = clock or Clock()

    def asked(features: Sequence[float]) -> Sequence[float]:
        clock.now += clock.takes
        return model(features)

    return Watch(asked, (Z, VX), limits, clock=clock)


def constant(*answer: float) -> Callable[[Sequence[float]], Sequence[float]]:
    return lambda features: answer


def test_a_watch_begins_untripped_without_trust_and_without_a_name() -> None:
    watch = Watch(constant(0.0, 0.0, 0.0), (Z, VX))
    assert (watch.tripped, watch.reason, watch.trust, watch.inference_time) == (False, "", 0.0, 0.0)
    assert (watch.name, watch.wants_yaw, watch.actuation) == ("", False, ACTS_AT_ONCE)
    assert watch.limits == GuardLimits()
    slow = Actuation(rate_lag=0.04)
    told = Watch(constant(0.0, 0.0, 0.0), (Z, VX), LIMITS, True, "abc", actuation=slow)
    assert (told.limits, told.wants_yaw, told.name, told.actuation) == (LIMITS, True, "abc", slow)


def test_tilt_is_corrected_for_when_it_acts_thrust_for_when_that_acts_and_the_rate_is_in_between() -> None:
    watch = watch_of(lambda features: (features[1], 3.0 * features[1] ** 2, features[0]))
    look = watch.look([(1.0, 0.5), (1.5, 0.75), (2.0, -1.0), (3.0, 1.0)], 0.125, 0.01)
    assert look.raw == look.wanted == (0.5, 0.75, 2.0)
    assert look.rate == ((0.75 - 0.5) / 0.125, (3.0 * 0.75**2 - 0.75) / 0.125)
    assert look.now == (1.0, 3.0, 3.0)


def test_what_a_model_says_is_cut_for_acting_and_told_whole_for_the_record() -> None:
    look = watch_of(constant(-5.0, 5.0, -9.0)).look([INSIDE] * 4, 0.02, 0.01)
    assert look.raw == (-5.0, 5.0, -9.0)
    assert look.wanted == (-2.0, 4.0, -8.0)
    assert look.rate == (0.0, 0.0)


def test_each_moment_is_trusted_by_its_own_features_and_the_worst_of_them_is_told() -> None:
    watch = watch_of(constant(1.0, 2.0, 4.0))
    look = watch.look([(4.25, 0.0), (1.0, 0.0), (4.5, 2.75), (4.5, 0.0)], 0.5, 0.01)
    assert look.wanted == (0.75, 1.5, 1.0)
    assert look.rate == ((1.0 - 0.75) / 0.5, (2.0 - 1.5) / 0.5)
    assert look.now == (0.5, 1.0, 2.0)
    assert watch.trust == 0.25
    assert watch.evaluate(INSIDE, 0.01) == ((1.0, 2.0, 4.0), (1.0, 2.0, 4.0))
    assert watch.trust == 1.0


@pytest.mark.parametrize(
    ("features", "trust"),
    [
        ((0.0, 0.0), 1.0),  # on the edge
        ((4.0, 2.0), 1.0),
        ((-0.25, 0.0), 0.75),
        ((4.25, 0.0), 0.75),
        ((4.25, -2.5), 0.5),  # two outside: the worse one, in either order
        ((-0.5, 2.25), 0.5),
        ((5.0, 0.0), 0.0),
        ((50.0, 0.0), 0.0),
        ((math.nan, 0.0), 0.0),
        ((0.0, math.inf), 0.0),
    ],
)
def test_trust_falls_from_the_edge_of_the_training_range_across_the_margin(features, trust: float) -> None:
    watch = watch_of(constant(1.0, 1.0, 1.0))
    assert watch.evaluate(features, 0.01)[1] == (trust, trust, trust)
    assert watch.trust == trust


@pytest.mark.parametrize(
    ("one", "margin"),
    [
        (Range("z", "m", 1.0, 9.0), 2.0),  # a quarter of the range's width
        (Range("z", "m", 1.0, 1.0), 0.2),
        (Range("vx", "m/s", 1.0, 1.0), 0.5),
        (Range("u_batt", "V", 16.0, 16.0), 0.5),
        (Range("cos_phi", "1", 1.0, 1.0), 0.1),
        (Range("T", "N", -8.0, -8.0), 0.8),  # a tenth of what it was, whichever its sign
        (Range("T", "N", -8.0, -7.5), 0.8),
        (Range("T", "N", -2.0, 5.0), 1.75),
        (Range("T", "N", -2.0, 2.0), 1.0),
        (Range("T", "N", 4.0, 5.0), 0.5),
        (Range("T", "N", 0.0, 0.0), 1e-7),
    ],
)
def test_the_margin_is_a_share_of_the_range_and_never_less_than_noise_and_trim_of_its_unit(
    one: Range, margin: float
) -> None:
    for value in (one.low - 0.5 * margin, one.high + 0.5 * margin):
        watch = Watch(constant(1.0, 1.0, 1.0), (one,))
        assert watch.evaluate((value,), 0.01)[1][0] == pytest.approx(0.5)


def test_features_beyond_the_model_s_own_are_left_out() -> None:
    got = []
    watch = watch_of(lambda features: got.append(tuple(features)) or (0.0, 0.0, 0.0))
    watch.evaluate((1.0, 0.5, 7.0), 0.01)
    assert got == [(1.0, 0.5)]
    assert not watch.tripped


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_up_to_its_authority_a_model_may_stay_and_beyond_it_for_the_patience_only(
    axis: int, sign: float
) -> None:
    authority = LIMITS.authority[axis]

    def asking(share: float) -> Callable[[Sequence[float]], Sequence[float]]:
        return constant(*(sign * share * authority if i == axis else 0.0 for i in range(3)))

    content = watch_of(asking(1.0))
    for _ in range(20):
        content.evaluate(INSIDE, 0.25)
    assert not content.tripped

    greedy = watch_of(asking(1.5))
    for _ in range(4):
        greedy.evaluate(INSIDE, 0.25)
    assert not greedy.tripped, "at the patience, not yet beyond it"
    raw, wanted = greedy.evaluate(INSIDE, 0.25)
    assert greedy.reason == "beyond its authority for 1 s"
    assert (raw[axis], wanted, greedy.trust) == (sign * 1.5 * authority, ZERO, 0.0)

    wild = watch_of(asking(4.0))
    wild.evaluate(INSIDE, 0.25)
    assert not wild.tripped, "at four times its authority, not yet beyond it"
    absurd = watch_of(asking(5.0))
    absurd.evaluate(INSIDE, 0.0)
    assert absurd.reason == "a correction 5 times its authority"


NOTHING = Borne((False, False, False), 0.0)


def borne_out(said, measured, seconds: float = 1.0) -> Borne:
    evidence = Evidence()
    for _ in range(round(seconds / 0.0625)):
        borne = evidence.step(said, measured, 0.0625)
    return borne


def test_borne_out_is_what_is_nearer_to_the_measured_than_nothing_is() -> None:
    assert borne_out((1.0, -2.0, 4.0), (1.0, -2.0, 4.0)) == Borne((True, True, True), 1.0)
    assert borne_out((1.0, 1.0, 1.0), (0.5, 0.625, -1.0)) == Borne((False, True, False), 0.0)
    assert borne_out((1.0, 0.0, 1.0), (4.0, 0.0, 3.0)) == Borne(
        (True, False, True), pytest.approx(1.0 - 13.0 / 25.0)
    )
    assert borne_out((1.0, 1.0, 1.0), ZERO) == borne_out(ZERO, ZERO) == NOTHING


def test_nothing_is_borne_out_until_it_was_seen_twice_as_long_as_it_is_smoothed() -> None:
    evidence, right = Evidence(), (1.0, 2.0, 3.0)
    for _ in range(3):
        for k in range(1, 6):
            borne = evidence.step(right, right, 0.5 * SMOOTHING)
            assert borne == (NOTHING if k < 4 else Borne((True, True, True), 1.0))
        for unbelieved in (None, (1.0, math.nan, 3.0), (math.inf, 2.0, 3.0)):
            assert evidence.step(right, unbelieved, 0.5 * SMOOTHING) == NOTHING


def test_noise_of_the_accelerometer_bears_nothing_out() -> None:
    evidence = Evidence()
    for k in range(200):
        borne = evidence.step((4.0, 4.0, 4.0), ((6.0, -6.0)[k % 2],) * 3, 0.01)
        assert borne == NOTHING


def test_what_is_seen_follows_what_is_measured_and_what_is_said_within_the_smoothing() -> None:
    evidence = Evidence()
    for _ in range(100):
        evidence.step((4.0, 0.0, 0.0), (4.0, 0.0, 0.0), 0.01)
    turned = [evidence.step((4.0, 0.0, 0.0), (-4.0, 0.0, 0.0), 0.01).axes[0] for _ in range(20)]
    # 4 of it, of which 8 (1 - (0.2 / 0.21)^k) are gone: half is left after 6 steps
    assert turned == [k < 6 for k in range(1, 21)]
    evidence = Evidence()
    for _ in range(100):
        evidence.step((4.0, 0.0, 0.0), (4.0, 0.0, 0.0), 0.01)
    turned = [evidence.step((-4.0, 0.0, 0.0), (4.0, 0.0, 0.0), 0.01).axes[0] for _ in range(20)]
    assert turned == [0.5 * 8.0 * (1.0 - (0.2 / 0.21) ** k) < 2.0 for k in range(1, 21)]


@pytest.mark.parametrize("axis", range(3))
def test_beyond_its_authority_a_model_may_stay_as_long_as_the_accelerometer_bears_that_axis_out(
    axis: int,
) -> None:
    def along(size: float) -> tuple[float, float, float]:
        return (size if axis == 0 else 0.0, size if axis == 1 else 0.0, size if axis == 2 else 0.0)

    asked = 1.5 * LIMITS.authority[axis]
    watch = watch_of(constant(*along(asked)))
    for _ in range(40):
        raw, wanted = watch.evaluate(INSIDE, 0.25, along(0.75 * asked))
        assert (raw, wanted) == (along(asked), along(LIMITS.authority[axis]))
    for _ in range(4):
        assert not watch.tripped
        watch.evaluate(INSIDE, 0.25)
    watch.evaluate(INSIDE, 0.25)
    assert watch.reason == "beyond its authority for 1 s"

    other = (axis + 1) % 3
    everywhere = watch_of(constant(*(1.5 * a for a in LIMITS.authority)))
    measured = [1.5 * a for a in LIMITS.authority]
    measured[other] = 0.0
    for _ in range(6):
        everywhere.look([INSIDE] * 4, 0.02, 0.25, tuple(measured))
    assert everywhere.reason == "beyond its authority for 1 s", "one axis of three is not borne out"


def test_however_well_it_is_borne_out_an_absurd_answer_trips() -> None:
    watch = watch_of(constant(8.5, 0.0, 0.0))
    watch.evaluate(INSIDE, 0.25, (8.5, 0.0, 0.0))
    assert watch.reason == "a correction 4 times its authority"


accelerations = st.floats(-7.0, 7.0)


@settings(deadline=None)
@given(
    st.tuples(accelerations, accelerations, accelerations),
    st.tuples(accelerations, accelerations, accelerations),
)
def test_what_acts_for_long_beyond_the_authority_or_the_range_is_nearer_to_the_measured_than_nothing(
    asked, measured
) -> None:
    for features in (INSIDE, (9.0, 0.0)):
        watch = watch_of(constant(*asked))
        for _ in range(12):
            _, acts = watch.evaluate(features, 0.125, measured)
        if watch.tripped:
            continue
        for r, a, m, most in zip(asked, acts, measured, LIMITS.authority, strict=True):
            assert abs(a) <= most
            if abs(r) > most:
                assert abs(m - a) < abs(m)


def test_where_the_range_does_not_trust_the_accelerometer_may_and_the_last_row_is_the_one_it_speaks_of() -> (
    None
):
    watch = watch_of(lambda features: (features[1], 0.0, 0.0))
    for _ in range(20):
        look = watch.look([(9.0, 1.0), (9.0, 1.0), (9.0, 1.0), (9.0, 0.5)], 0.5, 0.1, (0.5, 0.0, 0.0))
    assert look.wanted == (1.0, 0.0, 0.0)
    assert look.now == (0.5, 0.0, 0.0)
    assert watch.trust == 1.0
    for _ in range(20):
        look = watch.look([(4.25, 1.0), (4.25, 1.0), (4.25, 1.0), (4.25, 1.0)], 0.5, 0.1, (-1.0, 0.0, 0.0))
    assert watch.trust == look.wanted[0] == 0.75, (
        "what it does not bear out is trusted as far as the range goes"
    )


def test_the_patience_begins_anew_after_one_answer_within_the_authority_or_the_range() -> None:
    answer = [3.0]
    watch = watch_of(lambda features: (answer[0], 0.0, 0.0))
    for asked, features in [(3.0, INSIDE)] * 4 + [(0.0, INSIDE)] + [(0.0, (9.0, 0.0))] * 4 + [(0.0, INSIDE)]:
        answer[0] = asked
        watch.evaluate(features, 0.25)
        assert not watch.tripped
    for asked, features in [(3.0, INSIDE)] * 4 + [(0.0, INSIDE)] + [(0.0, (0.0, 9.0))] * 4:
        answer[0] = asked
        watch.evaluate(features, 0.25)
        assert not watch.tripped
    watch.evaluate((0.0, 9.0), 0.25)
    assert watch.reason == "vx outside its training range for 1 s"


def test_of_two_features_that_are_outside_alike_the_first_is_told() -> None:
    watch = watch_of(constant(0.0, 0.0, 0.0))
    for _ in range(5):
        watch.evaluate((5.0, 3.0), 0.25)  # both just where nothing is believed any more
    assert watch.reason == "z outside its training range for 1 s"


def test_fewer_features_than_the_model_knows_are_a_mistake_of_ours() -> None:
    with pytest.raises(ValueError, match="longer"):
        watch_of(constant(0.0, 0.0, 0.0)).evaluate((1.0,), 0.01)


def test_an_answer_in_time_is_one_within_the_deadline_and_some_late_ones_in_a_row_trip() -> None:
    clock = Clock()
    watch = watch_of(constant(1.0, 0.0, 0.0), clock)
    clock.takes = LIMITS.deadline
    for _ in range(10):
        watch.evaluate(INSIDE, 0.01)
    assert not watch.tripped, "at the deadline is in time"
    for _ in range(5):
        clock.takes = 2.0 * LIMITS.deadline
        for _ in range(LIMITS.misses - 1):
            watch.evaluate(INSIDE, 0.01)
        clock.takes = 0.0
        watch.evaluate(INSIDE, 0.01)
        assert not watch.tripped, "not in a row"
    clock.takes = 2.0 * LIMITS.deadline
    fresh = watch_of(constant(1.0, 0.0, 0.0), clock)
    for _ in range(LIMITS.misses):
        assert not (watch.tripped or fresh.tripped)
        fresh.evaluate(INSIDE, 0.01)
        raw, wanted = watch.evaluate(INSIDE, 0.01)
        assert watch.inference_time == 0.5
    assert watch.reason == fresh.reason == "inference took 500.0 ms"
    assert (raw, wanted) == ((1.0, 0.0, 0.0), ZERO)


def test_a_single_answer_beyond_the_stall_trips_and_four_moments_are_one_inference() -> None:
    clock = Clock()
    clock.takes = LIMITS.stall
    at_the_stall = watch_of(constant(1.0, 0.0, 0.0), clock)
    at_the_stall.evaluate(INSIDE, 0.01)
    assert not at_the_stall.tripped
    clock.takes = 0.5
    watch = watch_of(constant(1.0, 0.0, 0.0), clock)
    watch.look([INSIDE] * 4, 0.02, 0.01)
    assert watch.inference_time == 2.0
    assert watch.reason == "inference took 2000.0 ms"


@pytest.mark.parametrize("nonsense", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("moment", range(4))
def test_a_number_that_is_not_finite_anywhere_leaves_nothing_of_all(nonsense, axis: int, moment: int) -> None:
    asked = []

    def model(features: Sequence[float]) -> Sequence[float]:
        asked.append(features)
        bad = len(asked) - 1 == moment
        return tuple(nonsense if bad and i == axis else 1.0 for i in range(3))

    watch = watch_of(model)
    assert watch.look([INSIDE] * 4, 0.02, 0.01) == (ZERO, ZERO, (0.0, 0.0), ZERO)
    assert watch.reason == "the model returned a number that is not finite"
    assert watch.tripped


def test_after_a_trip_the_model_is_not_asked_again_and_nothing_is_wanted() -> None:
    clock, asked = Clock(), []

    def model(features: Sequence[float]) -> Sequence[float]:
        asked.append(features)
        raise LookupError

    clock.takes = 0.125
    watch = watch_of(model, clock)
    assert watch.evaluate(INSIDE, 0.01) == (ZERO, ZERO)
    assert watch.reason == "the model raised LookupError"
    assert watch.look([INSIDE] * 4, 0.02, 0.01) == (ZERO, ZERO, (0.0, 0.0), ZERO)
    assert len(asked) == 1
    assert watch.inference_time == 0.0


def test_a_model_that_takes_rows_is_asked_once_for_the_four_moments() -> None:
    class Rows:
        asked = 0

        def __call__(self, features: Sequence[float]) -> Sequence[float]:
            raise AssertionError("asked one by one")

        def rows(self, rows: Sequence[Sequence[float]]) -> Sequence[Sequence[float]]:
            self.asked += 1
            return [(features[1], 0.0, 0.0) for features in rows]

    model = Rows()
    watch = Watch(model, (Z, VX), LIMITS)
    assert watch.look([(1.0, 0.5), (1.0, 1.0), INSIDE, INSIDE], 0.25, 0.01).rate == (2.0, 0.0)
    assert model.asked == 1


@pytest.mark.parametrize("answers", [3, 5])
def test_a_model_that_answers_for_more_or_fewer_moments_than_asked_trips(answers: int) -> None:
    class Miscounting:
        def __call__(self, features: Sequence[float]) -> Sequence[float]:
            raise AssertionError("asked one by one")

        def rows(self, rows: Sequence[Sequence[float]]) -> Sequence[Sequence[float]]:
            return [(1.0, 0.0, 0.0)] * answers

    watch = Watch(Miscounting(), (Z, VX), LIMITS)
    assert watch.look([INSIDE] * 4, 0.02, 0.01) == (ZERO, ZERO, (0.0, 0.0), ZERO)
    assert watch.reason == "the model raised ValueError"
