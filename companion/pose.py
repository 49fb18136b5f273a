"""Poses of motion capture or vision, from Zenoh to the autopilot.

What is stale, jumps or is no pose is not passed on, and told. The autopilot's estimator gets each pose with the time
at which it was taken, so that what the way took is not taken for movement.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from trueflight.models.errors import InputError
from trueflight.models.pose import Pose, pose_from_json

CLOCKS = SENDER, ARRIVAL = ("sender", "arrival")
_WAITING = 8
"""Poses that may wait; the oldest goes first, for only the newest counts."""
_TOLD_AGAIN = 2.0
"""Seconds until the same trouble is told again."""
_KEPT = 1000
_WINDOW = 0.1  # s over which the velocity is taken
_FUTURE = 0.01
"""s that a time stamp may lie ahead of this machine's clock: two clocks kept by NTP on one network agree so far."""


@dataclass(frozen=True)
class PoseSettings:
    """Section `[pose]`.

    `clock` "sender" takes the time stamps of the poses, "arrival" the time of their arrival. `latency` s from the
    picture to that time. A pose older than `stale` s is not passed on, nor one that lies more than `jump` m from where
    the last velocity and `acceleration` m/s² could have brought the vehicle, or more than `turn` rad from where
    `spin` rad/s could have turned it; poses that stay together elsewhere for `settle` s are believed again. `lost` s
    without a good pose end a flight.
    """

    enabled: bool = False
    clock: str = SENDER
    latency: float = field(default=0.0, metadata={"zero": True})
    stale: float = 0.1
    jump: float = 0.2
    turn: float = 0.35
    acceleration: float = 20.0
    spin: float = 6.0
    settle: float = 1.0
    lost: float = 0.5

    def checked(self) -> PoseSettings:
        """The same, or `InputError`."""
        if self.clock not in CLOCKS:
            raise InputError(f"[pose] clock = '{self.clock}'; write {' or '.join(CLOCKS)}")
        return self


class PoseGate:
    """Decides pose by pose. `reset_counter` goes up when it believes another place than before."""

    def __init__(self, settings: PoseSettings) -> None:
        self.settings = settings
        self.reset_counter = 0
        self._good: deque[tuple[float, Pose]] = deque(maxlen=_KEPT)
        self._other: tuple[float, float, Pose] | None = None

    def judge(self, pose: Pose, taken: float, now: float) -> str:
        """'' where the pose may pass, otherwise why not; `taken` and `now` in s of one clock."""
        settings = self.settings
        age = now - taken
        if age > settings.stale:
            return f"stale: {age:.2f} s old (are both clocks kept by NTP? otherwise set [pose] clock = 'arrival')"
        if age < -_FUTURE:
            return f"from the future: {-age:.2f} s ahead (are both clocks kept by NTP?)"
        if self._good:
            then, last = self._good[-1]
            if taken <= then:
                return "out of order: not newer than the one before"
            dt = taken - then
            expected = tuple(
                p + v * min(dt, settings.lost) for p, v in zip(last.position, self._velocity(), strict=True)
            )
            if not self._near(expected, last, pose, dt):
                if not self._settled(pose, taken):
                    away = math.dist(expected, pose.position)
                    turned = math.degrees(_angle(last, pose))
                    return f"jump: {away:.2f} m and {turned:.0f} degrees within {1e3 * dt:.0f} ms"
                self.reset_counter = (self.reset_counter + 1) % 256
                self._good.clear()
        self._good.append((taken, pose))
        while self._good[-1][0] - self._good[0][0] > _WINDOW:
            self._good.popleft()
        self._other = None
        return ""

    def _velocity(self) -> tuple[float, float, float]:
        """m/s over the last good poses; zero before there are enough of them."""
        (begin, first), (end, last) = self._good[0], self._good[-1]
        if end - begin < 0.2 * _WINDOW:
            return (0.0, 0.0, 0.0)
        vx, vy, vz = ((b - a) / (end - begin) for a, b in zip(first.position, last.position, strict=True))
        return vx, vy, vz

    def _near(self, expected: tuple[float, ...], last: Pose, pose: Pose, dt: float) -> bool:
        settings = self.settings
        dt = min(dt, settings.stale)  # what is not known for longer is not allowed for more
        return (
            math.dist(expected, pose.position) <= settings.jump + 0.5 * settings.acceleration * dt * dt
            and _angle(last, pose) <= settings.turn + settings.spin * dt
        )

    def _settled(self, pose: Pose, taken: float) -> bool:
        """Whether poses elsewhere have stayed together for long enough."""
        if self._other is not None:
            since, then, last = self._other
            if taken <= then or self._near(last.position, last, pose, taken - then):
                self._other = (since, max(taken, then), pose)
                return taken - since >= self.settings.settle
        self._other = (taken, taken, pose)
        return False


def _angle(one: Pose, other: Pose) -> float:
    """rad between two attitudes."""
    dot = abs(sum(a * b for a, b in zip(one.quaternion, other.quaternion, strict=True)))
    return 2.0 * math.acos(min(1.0, dot))


class PoseFeed:
    """Takes payloads from Zenoh and hands good poses to `send`, on a thread of its own.

    `send(pose, taken_us, reset_counter)`: `taken_us` is when the pose was taken, microseconds since 1970 by this
    machine's clock. `emit(level, kind, text)` must only enqueue.
    """

    def __init__(
        self,
        settings: PoseSettings,
        send: Callable[[Pose, int, int], None],
        emit: Callable[[str, str, str], None],
    ) -> None:
        self.settings = settings
        self._send, self._emit = send, emit
        self._gate = PoseGate(settings)
        self._waiting: deque[tuple[int, int, bytes]] = deque(maxlen=_WAITING)
        self._wake = threading.Event()
        self._closing = False
        self._passed = 0
        self._refused: Counter[str] = Counter()
        self._ages: deque[float] = deque(maxlen=_KEPT)
        self._handling: deque[float] = deque(maxlen=_KEPT)
        self._times: deque[float] = deque(maxlen=_KEPT)
        self._last = -math.inf
        self._lost = False
        self._told: dict[str, float] = {}
        self._thread = threading.Thread(target=self._run, name="pose", daemon=True)
        self._thread.start()

    def refuse_size(self, reason: str) -> None:
        """A message was too large to be looked at; only counts and tells."""
        self._refuse("too large", reason)

    def take(self, payload: bytes) -> None:
        """A payload has arrived; only enqueues."""
        self._waiting.append((time.time_ns(), time.monotonic_ns(), payload))
        self._wake.set()

    def close(self) -> None:
        """Pass nothing on any more."""
        self._closing = True
        self._wake.set()
        self._thread.join(2.0)

    @property
    def age(self) -> float:
        """Seconds since the last good pose; infinite before the first."""
        return time.monotonic() - self._last

    @property
    def why_not(self) -> str:
        """'' where good poses arrive, otherwise what is missing."""
        if self.age <= self.settings.lost:
            return ""
        return "no good mocap or vision pose arrives" + (
            f" ({dict(self._refused)} refused)" if self._refused else " at all"
        )

    def status(self) -> dict[str, Any]:
        """How it is going, for JSON: rate (Hz), latencies (ms: taken to sent, arrived to sent), what was refused."""
        times, ages, handling = list(self._times), sorted(self._ages), sorted(self._handling)
        recent = [t for t in times if t > time.monotonic() - 2.0]
        rate = (
            (len(recent) - 1) / (recent[-1] - recent[0])
            if len(recent) > 1 and recent[-1] > recent[0]
            else 0.0
        )
        return {
            "rate": round(rate, 1),
            "passed": self._passed,
            "refused": dict(self._refused),
            "latency_ms": _spread(ages),
            "handling_ms": _spread(handling),
            "good": self.age <= self.settings.lost,
        }

    def _run(self) -> None:
        while not self._closing:
            self._wake.wait(0.1)
            self._wake.clear()
            try:
                while self._waiting and not self._closing:
                    self._handle(*self._waiting.popleft())
                self._watch()
            except Exception as error:  # noqa: BLE001 - no packet, whatever it is, may end this thread
                self._refuse(
                    "failed", f"it could not be handled ({type(error).__name__}: {str(error)[:100]})"
                )

    def _handle(self, arrived_ns: int, arrived_mono_ns: int, payload: bytes) -> None:
        settings = self.settings
        try:
            pose = pose_from_json(payload)
        except ValueError as error:
            self._refuse("malformed", str(error))
            return
        if settings.clock == SENDER and not pose.time_ns:
            self._refuse("no time", "it has no 'time_ns'; send one, or set [pose] clock = 'arrival'")
            return
        stamp = pose.time_ns if settings.clock == SENDER else arrived_ns
        taken_ns = stamp - round(1e9 * settings.latency)
        taken, now = 1e-9 * taken_ns, 1e-9 * time.time_ns()
        reason = self._gate.judge(pose, taken, now)
        if reason:
            self._refuse(reason.partition(":")[0], reason)
            return
        try:
            self._send(pose, taken_ns // 1000, self._gate.reset_counter)
        except RuntimeError as error:
            self._refuse("not sent", str(error))
            return
        self._passed += 1
        self._last = time.monotonic()
        self._times.append(self._last)
        self._ages.append(1e-9 * (time.time_ns() - taken_ns))
        self._handling.append(1e-9 * (time.monotonic_ns() - arrived_mono_ns))

    def _refuse(self, kind: str, text: str) -> None:
        self._refused[kind] += 1
        now = time.monotonic()
        if now - self._told.get(kind, -math.inf) > _TOLD_AGAIN:
            self._told[kind] = now
            self._emit("warning", "pose_refused", f"a pose was not passed on: {text}")

    def _watch(self) -> None:
        """Tell when poses stay away and when they are back."""
        if self._passed and self.age > self.settings.lost and not self._lost:
            self._lost = True
            self._emit("error", "pose_lost", f"no good pose for {self.settings.lost:g} s")
        elif self._lost and self.age <= self.settings.lost:
            self._lost = False
            self._emit("info", "pose_back", "good poses arrive again")


def _spread(values: list[float]) -> dict[str, float]:
    """Median and 99th percentile in ms of sorted seconds."""
    if not values:
        return {}
    return {
        "median": round(1e3 * values[len(values) // 2], 2),
        "p99": round(1e3 * values[min(len(values) - 1, int(0.99 * len(values)))], 2),
    }
