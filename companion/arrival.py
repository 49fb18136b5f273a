"""How old a sample is when the control law gets to it: the vehicle's clock against ours.

A callback runs when its turn comes, so that the time at which it runs tells nothing of a sample that waited in a
queue, in a buffer of the system or on the link. The sample's own stamp does, once it is known what the vehicle's clock
says now. TIMESYNC asks for that: the autopilot stamps its answer with its clock at some moment after our question
left, so that each answer bounds the vehicle's present from above, however late the answer itself was read. The least
bound of the last few is taken; what it is off by is what the fastest question needed to get there.

PX4 1.14 to 1.17 seldom tell it through MAVSDK: they address their answers to whoever stands in memory that they did not
fill, and MAVSDK drops what is not for us. Every PX4 answers to PING instead, without its time; but the answer stands in
the same queue as the odometry, so that the odometry read just before it tells the time of the answer to a period. What
delays the odometry alone is not seen in that way, and what delays all of it is.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

ASK_EVERY = 0.1
"""s between two questions for the vehicle's time."""
_ASKED = 32
"""Questions that may be unanswered; an answer to an older one is not taken."""
_ANSWERS, _RECENT = 20, 5
"""Answers that give the rate of the vehicle's clock, and the newest of them, which give its present."""
_SILENT = 1.0
"""s without an answer after which the fastest arrivals take its place."""
_SAME_RATE = 0.02
"""Clocks that run this much alike are taken to run alike: real ones do, simulated time may not."""
_BUCKET, _BUCKETS = 1.0, 5
"""The fastest arrival is that of the last `_BUCKETS` times `_BUCKET` s."""
_SLIP = 0.02
"""s each second by which the vehicle's clock may be slow without that being taken for age: PX4's SIH is 0.01 slow."""
_LEAK = 0.001
"""s each second by which the usual age may grow: so fast is a slower link taken for the usual one."""
_RESTART = 1.0
"""s by which a stamp may lie before the last one and be a sample that came late; beyond, the clock began anew."""


class Arrival(NamedTuple):
    """What is known of a sample's way: `age` s of the vehicle's clock, from its stamp to now.

    `overtaken` where a newer one is waiting already; `newer` is false for one that is repeated or came after a newer
    one.
    """

    age: float
    overtaken: bool
    newer: bool


class VehicleClock:
    """The vehicle's clock now, by answers to TIMESYNC. Times in ns: `vehicle` of its clock, `host` of ours."""

    def __init__(self) -> None:
        self._asked: deque[int] = deque(maxlen=_ASKED)
        self._answers: deque[tuple[int, int]] = deque(maxlen=_ANSWERS)
        self._rate = 1.0
        self._newest: tuple[tuple[int, int], ...] = ()
        self._least = 0
        """ns: the least bound of the newest answers, as the vehicle's clock less ours, for clocks that run alike."""

    def due(self, host_ns: int) -> bool:
        """Whether it is time to ask again."""
        return not self._asked or host_ns - self._asked[-1] >= ASK_EVERY * 1e9

    def ask(self, host_ns: int) -> None:
        """A question leaves at `host_ns`."""
        self._asked.append(host_ns)

    def answered(self, asked_ns: int, vehicle_ns: int) -> None:
        """The vehicle's clock said `vehicle_ns` some time after `asked_ns`. What nobody asked is no answer."""
        if asked_ns not in self._asked:
            return
        if self._answers and vehicle_ns < self._answers[-1][1]:
            self._answers.clear()  # the autopilot has started again
        self._answers.append((asked_ns, vehicle_ns))
        (first, begin), (last, end) = self._answers[0], self._answers[-1]
        rate = (end - begin) / (last - first) if last - first > 0.5e9 else 1.0
        self._rate = 1.0 if abs(rate - 1.0) < _SAME_RATE else rate
        self._newest = tuple(self._answers)[-_RECENT:]
        self._least = min(vehicle - asked for asked, vehicle in self._newest)

    def now(self, host_ns: int) -> int | None:
        """The vehicle's clock at `host_ns`; None where it has not been told lately."""
        if not self._answers or host_ns - self._answers[-1][0] > _SILENT * 1e9:
            return None
        if self._rate == 1.0:
            return host_ns + self._least
        return min(vehicle + round(self._rate * (host_ns - asked)) for asked, vehicle in self._newest)


class Arrivals:
    """Judges sample after sample of one stream; everything on one thread.

    The age is measured by the vehicle's clock, `clock` by TIMESYNC or `echo` by PING. Where neither is answered, it is
    what a sample needed more than the fastest of the last seconds: a delay that is always there is not seen then.
    """

    def __init__(self) -> None:
        self.clock, self.echo = VehicleClock(), VehicleClock()
        self.overtaken = 0
        self.repeated = 0
        self.age = math.inf
        self.last_us = -1
        """The newest stamp, by the vehicle's clock; -1 before the first."""
        self._done_ns = 0
        self._usual = math.inf
        self._usual_ns = 0
        self._fastest: deque[tuple[int, int, int]] = deque(maxlen=_BUCKETS)

    def judge(self, vehicle_us: int, host_ns: int) -> Arrival:
        """The arrival at `host_ns` (monotonic, now) of the sample that is of `vehicle_us` by the vehicle's clock."""
        previous, stamp = self.last_us, 1000 * vehicle_us
        age = self.age = self._age(stamp, host_ns)
        period = 1e-6 * (vehicle_us - previous)
        if -_RESTART < period <= 0.0:
            self.repeated += 1
            return Arrival(age, False, False)
        since = 1e-9 * (host_ns - self._usual_ns)
        begun = previous >= 0 and period > 0.0
        self._usual = min(age, self._usual + _LEAK * since) if begun else age
        self.last_us, self._usual_ns = vehicle_us, host_ns
        busy = 1e-9 * (host_ns - self._done_ns) < 0.5 * period
        overtaken = begun and busy and age - self._usual > period
        self.overtaken += overtaken
        return Arrival(age, overtaken, True)

    def echoed(self, asked_ns: int) -> None:
        """The answer to the PING that left at `asked_ns` has been read, after the last sample."""
        if self.last_us >= 0:
            self.echo.answered(asked_ns, 1000 * self.last_us)

    def status(self) -> dict[str, float | int | None]:
        """For JSON: age of the last sample in ms, None before the first; how many were overtaken, and repeated."""
        age = round(1e3 * self.age, 1) if math.isfinite(self.age) else None
        return {"age_ms": age, "overtaken": self.overtaken, "repeated": self.repeated}

    def done(self, host_ns: int) -> None:
        """The control law has answered to the last sample."""
        self._done_ns = host_ns

    def _age(self, stamp_ns: int, host_ns: int) -> float:
        now = self.clock.now(host_ns)
        if now is not None:
            return 1e-9 * (now - stamp_ns)
        now = self.echo.now(host_ns)
        if now is not None:
            return max(1e-9 * (now - stamp_ns), 0.0)
        bucket, way = host_ns // round(_BUCKET * 1e9), host_ns - stamp_ns
        if not self._fastest or self._fastest[-1][0] != bucket:
            self._fastest.append((bucket, way, host_ns))
        elif way < self._fastest[-1][1]:
            self._fastest[-1] = (bucket, way, host_ns)
        fastest = min(least + _SLIP * (host_ns - at) for _, least, at in self._fastest)
        return max(1e-9 * (way - fastest), 0.0)
