"""The age of samples: by the vehicle's clock, whatever queues, drifts, pauses or restarts."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trueflight.companion.arrival import ASK_EVERY, Arrivals

MS, S = 1_000_000, 1_000_000_000


def flown(
    seconds: float,
    *,
    way: float = 0.004,
    rate: float = 1.0,
    answers: bool = True,
    behind: float = 0.0,
    arrivals: Arrivals | None = None,
    begin: int = 50 * S,
) -> tuple[Arrivals, list[float]]:
    """100 Hz of odometry that needs `way` s, read `behind` s late; ages as judged. Questions need 1 ms to arrive."""
    arrivals = arrivals or Arrivals()
    ages = []
    for n in range(round(seconds * 100)):
        stamp = 10_000 * (n + 1)
        moment = begin + round(stamp * 1000 / rate)  # of our clock when the vehicle's says `stamp`
        read = moment + round((way + behind) * S)
        ages.append(arrivals.judge(stamp, read).age)
        arrivals.done(read + MS)
        if arrivals.clock.due(read + MS):
            arrivals.clock.ask(read + MS)
            if answers:
                arrivals.clock.answered(read + MS, round((read + 2 * MS - begin) * rate))
    return arrivals, ages


@given(way=st.floats(0.001, 0.02), rate=st.sampled_from([1.0, 0.99, 0.8, 2.0]))
def test_by_pings_a_slow_vehicle_is_not_late_and_a_full_queue_is(way: float, rate: float) -> None:
    """The answer to a PING is read where it stands in the queue, here one period after it was asked, or much later."""
    for queue in (0, 30):  # messages that wait
        arrivals, ages = Arrivals(), []
        asked: list[tuple[int, int]] = []
        for n in range(300):
            stamp = 10_000 * (n + 1)
            waiting = min(queue, max(n - 100, 0))
            read = 50 * S + round((stamp + 10_000 * waiting) * 1000 / rate) + round(way * S)
            ages.append(arrivals.judge(stamp, read).age)
            arrivals.done(read + MS)
            if asked and n >= asked[0][0]:
                arrivals.echoed(asked.pop(0)[1])
            if arrivals.clock.due(read + MS):
                arrivals.clock.ask(read + MS)
                arrivals.echo.ask(read + MS)
                asked.append((n + 1 + waiting, read + MS))
        assert max(ages[20:100]) < 0.04  # a period, the way, and the slow clock between two answers
        assert ages[-1] == pytest.approx(0.01 * queue, abs=0.04)


@given(way=st.floats(0.001, 0.3), rate=st.sampled_from([1.0, 1.00005, 0.9, 2.0, 0.5]))
def test_a_constant_delay_is_seen_where_the_vehicle_tells_its_time(way: float, rate: float) -> None:
    _, ages = flown(3.0, way=way, rate=rate)
    assert ages[-1] == pytest.approx(way * rate, abs=0.003 * max(rate, 1.0) + 0.05 * abs(rate - 1.0))


def test_without_answers_what_is_more_than_the_fastest_is_seen() -> None:
    arrivals, ages = flown(3.0, answers=False)
    assert ages[-1] == pytest.approx(0.0, abs=1e-9)
    late = arrivals.judge(4_000_000, 50 * S + 4 * S + 600 * MS)
    assert late.age == pytest.approx(0.596, abs=0.04)  # less what the clock may be slow in 1.6 s


def test_without_answers_a_slow_clock_is_not_age_and_falling_behind_is() -> None:
    """PX4's SIH runs 1 % slow, and its answers do not come through MAVSDK."""
    _, ages = flown(20.0, rate=0.99, answers=False)
    assert max(ages) < 0.02
    _, ages = flown(5.0, rate=0.8, answers=False)  # a queue that grows by 0.2 s each second looks like this
    assert ages[-1] > 0.4


def test_a_backlog_is_overtaken_and_the_last_of_it_is_not() -> None:
    arrivals, _ = flown(1.0)
    now = 50 * S + S + 500 * MS  # stood still for half a second: 50 samples wait
    judged = []
    for n in range(50):
        judged.append(arrivals.judge(1_010_000 + 10_000 * n, now))
        arrivals.done(now) if not judged[-1].overtaken else None
        now += MS // 20
    assert judged[0].age > 0.45
    assert not judged[0].overtaken  # nobody knows yet
    assert all(one.overtaken for one in judged[1:-2])
    assert not judged[-1].overtaken


def test_bursts_of_a_link_starve_nothing() -> None:
    """A link that suddenly needs 50 ms more: samples come at their pace, and each is answered."""
    arrivals, _ = flown(2.0)
    for n in range(200):
        stamp = 2_010_000 + 10_000 * n
        read = 50 * S + stamp * 1000 + 54 * MS
        assert not arrivals.judge(stamp, read).overtaken
        arrivals.done(read + MS)


def test_repeated_and_reordered_samples_are_no_news_and_a_restart_is() -> None:
    arrivals, _ = flown(2.0)
    now = 50 * S + 2 * S + 20 * MS
    assert not arrivals.judge(2_000_000, now).newer
    assert not arrivals.judge(1_990_000, now).newer
    assert arrivals.judge(2_010_000, now).newer
    assert arrivals.judge(5_000, now).newer  # the autopilot began anew
    assert arrivals.repeated == 2


def test_only_what_was_asked_is_an_answer() -> None:
    arrivals, _ = flown(1.0)
    before = arrivals.clock.now(51 * S)
    arrivals.clock.answered(12345, 10**15)
    assert arrivals.clock.now(51 * S) == before


def test_a_pause_of_the_vehicle_is_not_age() -> None:
    """A simulator that stands still for 0.3 s: its clock does, too."""
    arrivals, _ = flown(2.0)
    paused = round(0.3 * S)
    _, ages = 0, []
    begin = 50 * S + paused
    for n in range(200):
        stamp = 2_010_000 + 10_000 * n
        read = begin + stamp * 1000 + 4 * MS
        ages.append(arrivals.judge(stamp, read).age)
        arrivals.done(read + MS)
        if arrivals.clock.due(read + MS):
            arrivals.clock.ask(read + MS)
            arrivals.clock.answered(read + MS, read + 2 * MS - begin)
    wait = round(2 * ASK_EVERY * 100)
    assert all(abs(age - 0.004) < 0.07 for age in ages[wait:])
    assert ages[-1] == pytest.approx(0.004, abs=0.005)
