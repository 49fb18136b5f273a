"""One model takes over from another: no step, never outside the envelope, and back where the new one fails."""

from __future__ import annotations

import math
import random
from dataclasses import astuple
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trueflight.companion.law.actuation import ACTS_AT_ONCE, Actuation
from trueflight.companion.law.guard import Guard
from trueflight.companion.law.watch import GuardLimits, Range, Watch
from trueflight.companion.shadow import Shadow, ShadowLimits, error_acceleration
from trueflight.models import frames
from trueflight.models.contract import ACTUATION_LIMITS

LIMITS = GuardLimits(fade=0.5)
RANGES = (Range("z", "m", 0.0, 2.0), Range("vx", "m/s", -2.0, 2.0))
INSIDE = (1.0, 0.0)
DT, AHEAD = 0.01, 0.02
SLEW = np.array(LIMITS.slew)


def constant(x: float, y: float = 0.0, z: float = 0.0):
    return lambda features: (x, y, z)


def watch(model, name: str) -> Watch:
    return Watch(model, RANGES, LIMITS, name=name)


def flying(model, trips: list | None = None) -> Guard:
    """A guard whose first model, `a`, is fully faded in."""
    told = None if trips is None else lambda name, why: trips.append((name, why))
    guard = Guard(watch(model, "a"), told)
    guard.start()
    run(guard, 1.0)
    return guard


def run(guard: Guard, seconds: float, features=INSIDE) -> np.ndarray:
    return np.array([guard.step([features] * 4, AHEAD, DT).applied for _ in range(round(seconds / DT))])


def test_a_successor_fades_in_without_a_step_and_the_weights_sum_to_one() -> None:
    guard = flying(constant(1.0, -1.0))
    guard.succeed(watch(constant(2.0, 1.0), "b"))
    assert (guard.live, guard.last_good, guard.status) == ("b", "a", "fading_over")
    applied = run(guard, 0.6)
    share = np.minimum(1.0, DT * np.arange(1, 61) / LIMITS.fade)
    np.testing.assert_allclose(applied[:, 0], 1.0 + share, atol=1e-9)
    np.testing.assert_allclose(applied[:, 1], -1.0 + 2.0 * share, atol=1e-9)
    assert (guard.status, guard.settled) == ("active", True)


smooth = st.tuples(*[st.floats(-3.0, 3.0)] * 6)


def model_of(numbers):
    """Some smooth model of the two features."""
    a, b, c, d, e, f = numbers
    return lambda x: (a + b * math.sin(3.0 * x[1]), c + d * x[0] * x[1], e * math.cos(f * x[0]))


@settings(max_examples=150, deadline=None)
@given(
    st.lists(smooth, min_size=2, max_size=4),
    st.lists(
        st.tuples(
            st.sampled_from(["", "", "", "succeed", "roll_back", "start", "stop", "trip"]),
            st.floats(0.0, 0.15),
            st.tuples(st.floats(-0.5, 2.5), st.floats(-2.5, 2.5)),
        ),
        max_size=80,
    ),
)
def test_whatever_is_swapped_and_when_the_envelope_holds_and_a_tripped_model_stays_out(models, ticks) -> None:
    calls: list[str] = []
    broken: set[str] = set()

    def told(name, numbers):
        model = model_of(numbers)

        def asked(x):
            calls.append(name)
            return (math.nan, 0.0, 0.0) if name in broken else model(x)

        return asked

    tripped: list[str] = []
    guard = Guard(watch(told("0", models[0]), "0"), lambda name, why: tripped.append(name))
    guard.start()
    previous, number = np.zeros(3), 0
    for order, dt, features in ticks:
        if order == "succeed":
            number += 1
            guard.succeed(watch(told(str(number), models[number % len(models)]), str(number)))
        elif order == "trip":
            broken.add(guard.live)
        elif order:
            getattr(guard, order)()
        calls.clear()
        out = set(tripped)
        correction = guard.step([features] * 4, AHEAD, dt)
        applied = np.array(correction.applied)
        assert np.all(np.isfinite(applied))
        assert np.all(np.abs(applied) <= LIMITS.authority)
        assert np.all(np.abs(applied - previous) <= SLEW * min(0.1, dt) + 1e-9)
        assert not out & set(calls), "a tripped model is never asked again"
        assert 0.0 <= guard.engaged <= 1.0
        previous = applied
    assert len(tripped) == len(set(tripped)), "a trip is told once"


@settings(max_examples=60, deadline=None)
@given(
    smooth,
    st.lists(st.tuples(st.floats(0.0, 2.0), st.floats(-2.0, 2.0)), min_size=60, max_size=60),
    st.lists(st.integers(0, 59), max_size=4),
)
def test_between_equal_models_the_output_does_not_change(numbers, track, swaps) -> None:
    alone, swapped = flying(model_of(numbers)), flying(model_of(numbers))
    for i, features in enumerate(track):
        if i in swaps:
            swapped.succeed(watch(model_of(numbers), f"b{i}"))
        one, other = (guard.step([features] * 4, AHEAD, DT) for guard in (alone, swapped))
        np.testing.assert_allclose(other.applied, one.applied, atol=1e-9)
        np.testing.assert_allclose(other.rate, one.rate, atol=1e-6)


def test_a_successor_that_trips_gives_way_to_the_last_good_model() -> None:
    trips: list[tuple[str, str]] = []
    bad = [False]
    guard = flying(constant(1.0), trips)
    guard.succeed(watch(lambda features: (math.nan if bad[0] else 2.0, 0.0, 0.0), "b"))
    run(guard, 0.7)
    bad[0] = True
    applied = run(guard, 1.0)[:, 0]
    assert [name for name, _ in trips] == ["b"]
    assert guard.live == "a"
    assert guard.status == "active"
    assert applied[-1] == 1.0
    steps = np.abs(np.diff(np.concatenate([[2.0], applied])))
    assert steps.max() <= LIMITS.slew[0] * DT + 1e-9
    assert "not finite" in guard.why_tripped("b")
    # The same file once more in this flight: it does not act.
    guard.succeed(watch(constant(2.0), "b"))
    assert np.all(run(guard, 1.0)[-1] == 0.0)
    assert guard.status.startswith("tripped")


def test_where_the_last_good_model_trips_as_well_the_plain_cascade_flies_on() -> None:
    trips: list[tuple[str, str]] = []
    bad = [False]

    def turning_bad(features):
        if bad[0]:
            raise RuntimeError
        return (1.0, 0.0, 0.0)

    guard = flying(turning_bad, trips)
    guard.succeed(watch(turning_bad, "b"))
    run(guard, 0.7)
    bad[0] = True
    applied = run(guard, 1.0)
    assert [name for name, _ in trips] == ["b", "a"]
    assert guard.tripped
    assert np.all(applied[-1] == 0.0)


def test_rolled_back_by_command_it_fades_to_the_last_good_then_an_earlier_one_then_nothing() -> None:
    guard = flying(constant(1.0))
    guard.succeed(watch(constant(2.0), "b"))
    run(guard, 0.2)
    guard.roll_back()  # in the middle of the change
    applied = run(guard, 0.5)[:, 0]
    assert all(later <= now + 1e-12 for now, later in pairwise(applied))
    assert (guard.live, guard.last_good, applied[-1]) == ("a", "", 1.0)
    guard.roll_back(watch(constant(0.5), "earlier"))
    assert run(guard, 0.6)[-1][0] == 0.5
    guard.roll_back()
    applied = run(guard, 0.6)[:, 0]
    np.testing.assert_allclose(applied[:20], 0.5 - 0.5 * DT * np.arange(1, 21) / LIMITS.fade, atol=1e-9)
    assert (guard.live, guard.status, applied[-1]) == ("", "off", 0.0)


def shadowed(model, truth, seconds: float = 3.0, features=INSIDE, noise: float = 0.0) -> Shadow:
    """A model after `seconds` in the shadow of a vehicle whose error acceleration is `truth`."""
    shadow = Shadow(watch(model, "b"), ShadowLimits(), "b", seconds)
    rng = np.random.default_rng(1)
    for i in range(2 * round(seconds / DT)):
        now = truth(i * DT) if truth is not None else None
        measured = None if now is None else tuple(np.array(now) + noise * rng.normal(size=3))
        shadow.step(features, measured, DT)
    return shadow


def swaying(t: float) -> tuple[float, float, float]:
    return (0.8 * math.sin(t), 0.5, -0.3)


@pytest.mark.parametrize(
    ("model", "truth", "reason"),
    [
        (constant(0.3, 0.5, -0.3), swaying, ""),  # better than nothing
        (constant(0.0, 0.0, 0.0), swaying, ""),  # as good as nothing
        (constant(0.1), lambda t: (0.0, 0.0, 0.0), ""),  # wrong, but harmless
        (constant(2.0), lambda t: (0.0, 0.0, 0.0), "worse than none: along x"),
        (constant(0.0, -0.5), swaying, "worse than none: along y"),
        (constant(0.0, 0.0, 21.0), lambda t: (0.0, 0.0, 21.0), "times its authority"),
        (constant(3.5), lambda t: (3.5, 0.0, 0.0), ""),  # it will be cut, and is right as far as that goes
        (constant(3.5), lambda t: (1.5, 0.0, 0.0), "beyond its authority"),
        (constant(math.nan), swaying, "not finite"),
        (constant(0.0), None, "no accelerometer"),
    ],
)
def test_a_model_is_judged_by_what_the_accelerometer_says(model, truth, reason: str) -> None:
    for noise in (0.0, 1.0):
        shadow = shadowed(model, truth, noise=noise)
        assert reason in shadow.refused
        assert shadow.passed == (reason == ""), shadow.refused
        assert bool(shadow.refused) == bool(reason)


def test_a_model_that_knows_nothing_of_this_flight_is_refused() -> None:
    shadow = shadowed(constant(0.0), swaying, features=(2.4, 0.0))  # four fifths through the margin
    assert "mostly outside its training range" in shadow.refused


def test_only_flown_trajectory_counts() -> None:
    shadow = Shadow(watch(constant(9.0), "b"), ShadowLimits(), seconds=1.0)
    for _ in range(1000):
        shadow.step(INSIDE, (0.0, 0.0, 0.0), 0.0)
    assert shadow.remaining == 1.0
    assert not shadow.refused
    shadow.step(INSIDE, (0.0, 0.0, 0.0), 100.0)
    assert shadow.remaining > 0.5, "a gap in the odometry is no flight"


@settings(max_examples=100, deadline=None)
@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: sum(x * x for x in q) > 0.01),
    st.tuples(*[st.floats(-20.0, 20.0)] * 3),
    st.floats(0.0, 20.0),
)
def test_the_measured_error_acceleration_is_the_papers(quaternion, force, thrust) -> None:
    q = np.array(quaternion) / np.linalg.norm(quaternion)
    roll, pitch, yaw = frames.euler_from_quaternion(q[None])[0]
    world = frames.rotate(q[None], np.array(force)[None])[0] - (0.0, 0.0, 9.81)
    heading = frames.heading_from_world(world[None], np.array([yaw]))[0]
    linear = (9.81 * pitch, -9.81 * roll, thrust / 0.75 - 9.81)
    measured = error_acceleration(tuple(q.tolist()), force, thrust, 0.75)
    np.testing.assert_allclose(measured, heading - linear, atol=1e-6)


def one(answer: tuple[float, float, float], name: str, takes: float = 0.0, **more) -> Watch:
    """A watch over a constant model that takes so many seconds a moment."""
    now = [0.0]

    def model(features):
        now[0] += takes
        return answer

    return Watch(model, RANGES, LIMITS, name=name, clock=lambda: now[0], **more)


def half_over(old: Watch, new: Watch, trips: list | None = None) -> Guard:
    """A guard in the middle of the change from one model to another: each has half of the effect."""
    guard = Guard(old, None if trips is None else lambda name, why: trips.append((name, why)))
    guard.start()
    run(guard, 0.6)
    guard.succeed(new)
    run(guard, 0.25)
    return guard


def test_while_they_change_both_are_asked_the_live_one_s_answer_is_recorded_and_both_take_their_time() -> (
    None
):
    guard = half_over(one((0.5, 0.0, 0.0), "a", 1e-4), one((1.0, 0.0, 0.0), "b", 2e-4))
    correction = guard.step([INSIDE] * 4, AHEAD, 0.0)
    assert correction.raw == (1.0, 0.0, 0.0)
    assert correction.applied[0] == pytest.approx(0.75)
    assert guard.inference_time == pytest.approx(4 * 1e-4 + 4 * 2e-4)
    assert (guard.engaged, guard.settled) == (pytest.approx(1.0), False)
    run(guard, 0.3)
    assert guard.inference_time == pytest.approx(4 * 2e-4), "only of this tick"
    assert guard.settled


def test_where_the_one_that_leaves_trips_the_other_still_acts_in_that_very_tick() -> None:
    trips: list[tuple[str, str]] = []
    bad = [False]
    old = watch(lambda features: (math.nan if bad[0] else 0.1, 0.0, 0.0), "a")
    guard = half_over(old, one((0.1, 0.0, 0.0), "b"), trips)
    bad[0] = True
    assert guard.step([INSIDE] * 4, AHEAD, 0.01).applied[0] == pytest.approx(0.1 * 0.52)
    assert trips == [("a", "the model returned a number that is not finite")]
    assert (guard.live, guard.last_good, guard.tripped) == ("b", "", False), "nothing is left to go back to"
    guard.roll_back()
    assert guard.live == ""


def test_what_is_known_of_the_actuation_changes_over_with_the_models() -> None:
    slow, quick = Actuation(0.03, 0.06, 2.0, 0.01, 0.04), Actuation(0.01, 0.02, 1.0, 0.03, 0.02)
    guard = Guard(one((0.0, 0.0, 0.0), "a", actuation=slow))
    assert guard.actuation == ACTS_AT_ONCE, "no model acts yet"
    guard.start()
    run(guard, 0.25)
    assert guard.actuation == slow
    run(guard, 0.5)
    guard.succeed(one((0.0, 0.0, 0.0), "b", actuation=quick))
    assert guard.actuation == slow
    run(guard, 0.125)
    np.testing.assert_allclose(
        astuple(guard.actuation), np.average([astuple(slow), astuple(quick)], 0, [0.76, 0.24])
    )
    run(guard, 0.5)
    assert guard.actuation == quick


def test_while_the_correction_is_half_in_the_actuation_is_known_all_the_same() -> None:
    slow, quick = Actuation(0.03, 0.06, 2.0, 0.01, 0.04), Actuation(0.01, 0.02, 1.0, 0.03, 0.02)
    guard = Guard(one((0.0, 0.0, 0.0), "a", actuation=slow))
    guard.start()
    run(guard, 0.25)
    assert guard.actuation is slow, "one model acts: it is as that model knows it, to the last bit"
    guard.succeed(one((0.0, 0.0, 0.0), "b", actuation=quick))
    run(guard, 0.125)
    guard.stop()
    run(guard, 0.05)
    assert 0.0 < guard.engaged < 0.5
    weighted = astuple(guard.actuation)
    for number, a, b in zip(weighted, astuple(slow), astuple(quick), strict=True):
        assert min(a, b) < number < max(a, b), "between the two models', however little of both acts"


def test_however_the_ticks_fall_no_more_than_all_acts_and_nothing_known_leaves_its_limits() -> None:
    most = Actuation(**ACTUATION_LIMITS)
    for seed in (*range(20), 1207, 1815):  # the last two once summed to more than 1 by the last bit
        draw = random.Random(seed)
        limits = GuardLimits(fade=draw.choice([0.3, 0.5, 0.7, 1.0]))

        def model(name: str, limits: GuardLimits = limits) -> Watch:
            return Watch(constant(0.0), RANGES, limits, name=name, actuation=most)

        guard = Guard(model("a"))
        guard.start()
        for i in range(25):
            guard.step([INSIDE] * 4, AHEAD, draw.choice([0.01, 0.02, 0.033, 0.1]))
            assert guard.engaged <= 1.0, "to the last bit, or a limit times it is beyond the limit"
            assert guard.actuation == most
            assert guard.actuation.scaled(guard.engaged) != ACTS_AT_ONCE
            if draw.random() < 0.3:
                guard.succeed(model(f"b{i}"))


def test_yaw_is_told_to_models_as_long_as_one_of_them_wants_it() -> None:
    plain, turned = one((0.0, 0.0, 0.0), "a"), one((0.0, 0.0, 0.0), "b", wants_yaw=True)
    assert not Guard(plain).wants_yaw
    assert Guard(turned).wants_yaw
    guard = half_over(plain, turned)
    assert guard.wants_yaw
    run(guard, 0.5)
    guard.succeed(one((0.0, 0.0, 0.0), "c"))
    assert guard.wants_yaw, "b still acts"
    run(guard, 0.6)
    guard.succeed(one((0.0, 0.0, 0.0), "d"))
    assert not guard.wants_yaw


def test_a_model_that_enters_while_the_correction_is_off_does_not_act() -> None:
    guard = Guard(one((1.0, 0.0, 0.0), "a"))
    guard.succeed(one((1.0, 0.0, 0.0), "b"))
    assert (guard.live, guard.last_good, guard.engaged, guard.status) == ("b", "a", 0.0, "off")
    assert np.all(run(guard, 0.2) == 0.0)


def test_models_without_a_name_are_not_taken_for_one_another() -> None:
    guard = Guard(one((math.nan, 0.0, 0.0), ""))
    guard.start()
    run(guard, 0.1)
    assert guard.tripped
    guard.succeed(one((0.5, 0.0, 0.0), ""))
    assert (guard.tripped, guard.last_good) == (False, ""), "what tripped is nothing to go back to"
    assert run(guard, 0.6)[-1][0] == 0.5


def test_of_a_model_that_did_not_trip_there_is_no_reason_why() -> None:
    guard = flying(constant(1.0))
    assert (guard.why_tripped("a"), guard.why_tripped("b")) == ("", "")
