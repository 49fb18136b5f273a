"""Of several vehicles, bodies, IMUs and batteries in a ROS 2 recording those that one flight is read from, and why.

One namespace is one vehicle, and no column of another is ever taken. Setpoints are no measurements. Of several poses
and IMUs the autopilot's own go first, then those in the vehicle's namespace, then those of other devices, a motion
capture's bodies for one; bodies that move differently are told apart by which of them turns as the gyroscope says.
Where nothing tells, the recording is refused with the list.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from trueflight.groundstation.reading.plausible import body_rate
from trueflight.groundstation.reading.ros_vehicles import Fields, Source, owner, vehicles_of
from trueflight.groundstation.reading.sources import FROM, Sources
from trueflight.groundstation.reading.uniform import continuous_quaternion
from trueflight.models.errors import InputError

SAME, FITS = 0.3, 0.5
"""Shares of the motion's energy by which two topics of one body differ at most, and an attitude from its gyroscope."""
CLEARLY, NOISE = 2.0, 0.05
"""How many times, and by what share more, another one must differ to be told apart."""
STILL = 0.1
"""m; a body that moves less did not fly."""
WINDOW = 0.25
"""s over which motions are compared."""
IN_G = 5.0
"""m/s²; an accelerometer whose median is below is not in m/s², or does not carry the vehicle."""
DRAWN, AGREE = 1.5, 0.03
"""Times the current of the next battery from which on one is the flight battery; share by which voltages of one may
differ."""

Part = tuple[str, Fields]
Motion = Callable[[Source], tuple[np.ndarray, np.ndarray]]
"""Times (M,) and values (M, k) of how a topic moves."""


@dataclass(frozen=True)
class Chosen:
    """The PX4 topics to read, and what was chosen; `asked` are topics by quantity that were asked for; `vehicles` are
    all that are in the recording, the one that is read first."""

    parts: tuple[Part, ...]
    notes: tuple[str, ...]
    asked: dict[str, Part]
    vehicles: tuple[str, ...]


@dataclass(frozen=True)
class _Kind:
    """A kind of source: the PX4 topic that it makes, the quantity it is chosen by, and its name in notes."""

    part: str
    quantity: str
    words: str


POSE = _Kind("vehicle_local_position", "position", "poses")
IMU = _Kind("sensor_combined", "specific_force", "IMUs")
COMMAND = _Kind("vehicle_rates_setpoint", "thrust_command", "thrust commands")
BATTERY = _Kind("battery_status", "battery_voltage", "batteries")


def choose(origin: str, sources: Sequence[Source], wanted: Sources) -> Chosen:
    """The topics of one vehicle. Raises `InputError`, with the list, for a namespace or topic that is not there, and
    where nothing tells which of several is the vehicle's."""
    asked = _asked(origin, sources, wanted)
    vehicles = vehicles_of(sources)
    vehicle = _vehicle(origin, sources, vehicles, wanted.namespace)
    others = [v for v in vehicles if v != vehicle]
    notes = [f"{quantity} is from {name}, as chosen" for quantity, name in wanted.topics]
    if others:
        listed = f" (there are {', '.join(v or '/' for v in others[:4])})" if others[1:] else ""
        notes.append(
            f"{len(vehicles)} vehicles in the recording: that of namespace {vehicle or '/'} is read, and nothing of "
            f"the others'; --vehicle-namespace {others[0] or '/'} reads another{listed}"
        )
    all_of = set(vehicles) | {vehicle}
    owned = {s.topic: owner(s, vehicle, all_of) for s in sources}
    strange = [s.topic for s in sources if owned[s.topic] not in (None, *all_of)]
    if strange:
        notes.append(f"{', '.join(strange[:4])} left out: named as another vehicle's than {vehicle}")
    mine = {s.topic for s in sources if owned[s.topic] == vehicle}
    near = [s for s in sources if owned[s.topic] in (vehicle, None)]
    ros = [s for s in near if not s.px4]
    wants = [s for s in ros if s.target and COMMAND.part not in s.parts]
    if wants:
        names = ", ".join(s.topic for s in wants[:4])
        notes.append(f"{names} left out: setpoints are no measurements")
    stand_ins = _StandIns(origin, _own_px4([s for s in near if s.px4]), mine, bool(others))
    stand_ins.add([s for s in ros if s not in wants], asked)
    return Chosen(tuple(stand_ins.parts.items()), (*notes, *stand_ins.notes), asked, (vehicle, *others))


def _asked(origin: str, sources: Sequence[Source], wanted: Sources) -> dict[str, Part]:
    """The topics that were asked for, by quantity; what else their message holds comes along, unless it was asked for
    from elsewhere."""
    found: dict[str, Part] = {}
    along: dict[str, Part] = {}
    for quantity, name in wanted.topics:
        offered = {s.topic: s for s in sources if any(part in FROM[quantity] for part in s.parts)}
        source = offered.get(name) or offered.get(f"/{name}")
        if source is None:
            has = ", ".join(sorted(offered)) or "none that could be it"
            raise InputError(f"{origin}: no topic '{name}' for {quantity} in the recording; it has {has}")
        for part, fields in source.parts.items():
            for other, names in FROM.items():
                if part in names and (other == quantity or not source.px4):
                    (found if other == quantity else along)[other] = (part, fields)
    return along | found


def _vehicle(origin: str, sources: Sequence[Source], vehicles: list[str], asked: str | None) -> str:
    if asked is None:
        return vehicles[0] if vehicles else ""
    wanted = f"/{asked.strip('/')}" if asked.strip("/") else ""
    if wanted in vehicles or (wanted and any(f"{s.topic}/".startswith(f"{wanted}/") for s in sources)):
        return wanted
    has = ", ".join(v or "/" for v in sorted(vehicles)) or "no namespaces"
    raise InputError(f"{origin}: no vehicle with the namespace '{asked}' in the recording; it has {has}")


def _own_px4(sources: Sequence[Source]) -> dict[str, Fields]:
    """PX4's own topics. What PX4 sends tells what it did; what it was sent only stands in."""
    parts: dict[str, Fields] = {}
    for source in sorted(sources, key=lambda s: ("/out/" not in s.topic, -len(s.t))):
        for name, fields in source.parts.items():
            parts.setdefault(name, fields)
    return parts


class _StandIns:
    """ROS' own messages that stand in for what PX4's own topics (`parts`) do not hold.

    `mine` are the names of the topics that are certainly the vehicle's; where there are `several` vehicles, others' are
    taken only if they fit.
    """

    def __init__(self, origin: str, parts: dict[str, Fields], mine: set[str], several: bool) -> None:
        self.origin, self.parts, self.mine, self.several = origin, parts, mine, several
        self.notes: list[str] = []

    def add(self, sources: Sequence[Source], asked: dict[str, Part]) -> None:
        """Choose among `sources` for everything that was not `asked` for from elsewhere."""
        estimated = {"vehicle_local_position", "vehicle_odometry"} & set(self.parts)
        for kind, own in (
            (POSE, estimated),
            (IMU, {IMU.part} & set(self.parts)),
            (BATTERY, {BATTERY.part} & set(self.parts)),
        ):
            left = [s.topic for s in sources if kind.part in s.parts]
            if own and left and kind.quantity not in asked:
                self.notes.append(
                    f"of the {kind.words} in the recording PX4's own is read; --topic {kind.quantity}={left[0]} "
                    "reads another"
                )
        self._motion(
            [] if estimated or "position" in asked else [s for s in sources if POSE.part in s.parts],
            [
                s
                for s in sources
                if IMU.part in s.parts and IMU.part not in self.parts and IMU.quantity not in asked
            ],
            asked,
        )
        sure = [s for s in sources if s.topic in self.mine or not self.several]
        if COMMAND.quantity not in asked:
            self._first(COMMAND, sure, lambda s: ("target" not in s.topic, -len(s.t)))
        if BATTERY.quantity not in asked:
            self._battery([s for s in sure if BATTERY.part in s.parts])
        for part in ("actuator_armed", "vehicle_land_detected"):
            self._first(_Kind(part, "", ""), sure, lambda s: (-len(s.t),))
        if "quaternion" not in asked and "vehicle_odometry" not in self.parts:
            self._first(_Kind("vehicle_attitude", "", ""), sure, lambda s: (-len(s.t),))

    def _tier(self, source: Source) -> int:
        """0: the autopilot's own; 1: in the vehicle's namespace, or named as it is; 2: another device's."""
        own = source.topic in self.mine
        return 0 if own and source.bridged else 1 if own else 2

    def _nearest(self, sources: Sequence[Source]) -> list[Source]:
        """Those of the lowest tier there is."""
        lowest = min(map(self._tier, sources), default=0)
        return [s for s in sources if self._tier(s) == lowest]

    def _why(self, chosen: Source, others: Sequence[Source], otherwise: str) -> str:
        """Why it was chosen: by its tier, where that decided."""
        if len(self._nearest(others)) == 1:
            return ("the autopilot's own", "in the vehicle's namespace", otherwise)[self._tier(chosen)]
        return otherwise

    def _take(self, source: Source, only: tuple[str, ...] = ()) -> None:
        new = {n: f for n, f in source.parts.items() if n not in self.parts and (not only or n in only)}
        if new:
            self.parts |= new
            self.notes.append(f"{', '.join(sorted(new))} from {source.topic} ({source.kind})")

    def _tell(self, kind: _Kind, chosen: Source, others: Sequence[Source], why: str) -> None:
        left = [s.topic for s in others if s is not chosen]
        if left:
            more = (
                f" (also there: {', '.join(left[1:4])}{' ...' if len(left) > 4 else ''})" if left[1:] else ""
            )
            self.notes.append(
                f"{len(left) + 1} {kind.words} in the recording: {chosen.topic} is read, {why}; "
                f"--topic {kind.quantity}={left[0]} reads another{more}"
            )

    def _first(
        self, kind: _Kind, sources: Sequence[Source], key: Callable[[Source], tuple[float, ...]]
    ) -> None:
        """The first by tier and `key`."""
        some = [s for s in sources if kind.part in s.parts]
        if kind.part in self.parts or not some:
            return
        chosen = min(some, key=lambda s: (self._tier(s), *key(s), s.topic))
        self._take(chosen, (kind.part,))
        if kind.words:
            self._tell(
                kind, chosen, some, self._why(chosen, some, "what the autopilot reports back, or the fastest")
            )

    def _battery(self, some: Sequence[Source]) -> None:
        if BATTERY.part in self.parts or not some:
            return
        first = sorted(self._nearest(some), key=lambda s: (-_current(s), -len(s.t), s.topic))
        why = self._why(first[0], some, "it gives the most current")
        if len(first) > 1 and (_current(first[0]) <= DRAWN * _current(first[1]) or _current(first[0]) < 0.1):
            why = "their voltages agree"
            volts = [float(np.median(s.parts[BATTERY.part]["voltage_v"])) for s in first]
            if np.ptp(volts) > AGREE * max(volts):
                told = ", ".join(f"{s.topic} {v:.3g} V" for s, v in zip(first, volts, strict=True))
                self.notes.append(
                    f"{len(first)} batteries in the recording, and no current tells which of them flies ({told}): "
                    f"voltage is left out; --topic battery_voltage={first[0].topic} takes one"
                )
                return
        self._take(first[0], (BATTERY.part,))
        self._tell(BATTERY, first[0], some, why)

    def _motion(self, poses: list[Source], imus: list[Source], asked: dict[str, Part]) -> None:
        """Pose and IMU of one body."""
        moving = self._nearest([s for s in poses if _moves(s)] or poses)
        in_si = self._nearest([s for s in imus if _in_si(s)] or imus)
        pose, imu = min(moving, key=_rank, default=None), min(in_si, key=_rank, default=None)
        why = (
            self._why(pose, poses, _among(moving, poses, "the only one that moves")) if pose else "",
            self._why(imu, imus, _among(in_si, imus, "the only one in m/s²")) if imu else "",
        )
        strangers = self.several and any(self._tier(s) == 2 for s in (*moving, *in_si))
        if len(moving) > 1 or len(in_si) > 1 or strangers:
            found = _fitting(moving, in_si or _gyroscope(self.parts, asked))
            if found is None and strangers:
                return
            if found is None:
                self._refuse_strangers(POSE, moving, _speed)
                self._refuse_strangers(IMU, in_si, _spin)
            else:
                pose, imu, left = found
                fits = f"for attitude and gyroscope fit each other ({100 * left:.0f} % of the motion's energy apart)"
                why = (fits if len(moving) > 1 else why[0], fits if len(in_si) > 1 else why[1])
        if pose is not None:
            self._take(pose, (POSE.part, "vehicle_attitude") if "quaternion" not in asked else (POSE.part,))
            self._tell(POSE, pose, poses, why[0])
        if imu is not None and imu in imus:
            self._take(imu, (IMU.part,))
            self._tell(IMU, imu, imus, why[1])

    def _refuse_strangers(self, kind: _Kind, sources: Sequence[Source], motion: Motion) -> None:
        """Raise `InputError`, with the list, for topics that do not all move alike."""
        names = sorted(s.topic for s in sources)
        if all(_apart(motion(sources[0]), motion(s)) < SAME for s in sources[1:]):
            return
        raise InputError(
            f"{self.origin}: {len(names)} {kind.words} in the recording do not move alike, and nothing tells which is "
            f"the vehicle's ({', '.join(names[:6])}); choose one: --topic {kind.quantity}={names[0]}"
        )


def _gyroscope(parts: dict[str, Fields], asked: dict[str, Part]) -> list[Source]:
    """The gyroscope that was chosen already, as the only one."""
    given = [asked["angular_velocity"]] if "angular_velocity" in asked else list(parts.items())
    return [
        Source(name, "", 1e-6 * fields["timestamp"], {name: fields})
        for name, fields in given
        if name in ("sensor_combined", "vehicle_angular_velocity")
    ][:1]


def _among(left: Sequence[Source], some: Sequence[Source], alone: str) -> str:
    """Why one was chosen of `some`, where it is the only one `left`, or the best of what moves alike."""
    return alone if len(left) == 1 < len(some) else "the best estimate, or the fastest, of what moves alike"


def _rank(source: Source) -> tuple[bool, bool, int, str]:
    """Of topics of one body: the autopilot's estimate before what it was sent, one with a velocity, the fastest."""
    moves = source.parts.get(POSE.part, {})
    return "local_position" not in source.topic, "vx" not in moves, -len(source.t), source.topic


def _current(source: Source) -> float:
    """Median current, A; 0 where it was not measured."""
    current = source.parts[BATTERY.part].get("current_a", np.zeros(1))
    return float(np.nan_to_num(np.nanmedian(current))) if np.any(np.isfinite(current)) else 0.0


def _moves(source: Source) -> bool:
    return bool(np.ptp(_columns(source, POSE.part, ("x", "y", "z")), axis=0).max() > STILL)


def _in_si(source: Source) -> bool:
    names = tuple(f"accelerometer_m_s2[{i}]" for i in range(3))
    if names[0] not in source.parts[IMU.part]:
        return False
    return float(np.median(np.linalg.norm(_columns(source, IMU.part, names), axis=1))) > IN_G


def _columns(source: Source, part: str, names: tuple[str, ...]) -> np.ndarray:
    return np.stack([source.parts[part][name] for name in names], -1)


def _windows(source: Source) -> tuple[np.ndarray, np.ndarray]:
    """Rows (M,) half a window apart, and those that follow them by `WINDOW`."""
    count = int((source.t[-1] - source.t[0]) / WINDOW * 2)
    first = np.unique(np.searchsorted(source.t, source.t[0] + 0.5 * WINDOW * np.arange(count)))
    later = np.searchsorted(source.t, source.t[first] + WINDOW)
    inside = later < len(source.t)
    return first[inside], later[inside]


def _speed(source: Source) -> tuple[np.ndarray, np.ndarray]:
    """Speed (M, 1) at times (M,): the same in every frame."""
    first, later = _windows(source)
    position, seconds = _columns(source, POSE.part, ("x", "y", "z")), source.t[later] - source.t[first]
    moved = np.linalg.norm(position[later] - position[first], axis=1)
    return source.t[first], (moved / seconds)[:, None]


def _spin(source: Source) -> tuple[np.ndarray, np.ndarray]:
    """Magnitude (M, 1) of the angular velocity at times (M,)."""
    t, rates = _gyro(source)
    return t, np.linalg.norm(rates, axis=1, keepdims=True)


def _gyro(source: Source) -> tuple[np.ndarray, np.ndarray]:
    """Mean angular velocity (M, 3) from times (M,) on."""
    inertial = IMU.part in source.parts
    names = tuple(f"gyro_rad[{i}]" if inertial else f"xyz[{i}]" for i in range(3))
    rates = _columns(source, IMU.part if inertial else "vehicle_angular_velocity", names)
    first, later = _windows(source)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(rates, axis=0)])
    return source.t[first], (total[later] - total[first]) / (later - first)[:, None]


def _turning(source: Source) -> tuple[np.ndarray, np.ndarray]:
    """Angular velocity (M, 3) that an attitude tells, from times (M,) on."""
    q = continuous_quaternion(_columns(source, "vehicle_attitude", tuple(f"q[{i}]" for i in range(4))))
    first, later = _windows(source)
    seconds = source.t[later] - source.t[first]
    return source.t[first], body_rate(q[first], q[later], 1.0) / seconds[:, None]


def _apart(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> float:
    """Share of the motion's energy by which two motions (M, k) differ, at best in a frame turned against the other."""
    t, a = one
    inside = (t >= other[0][0]) & (t <= other[0][-1]) if len(other[0]) else np.zeros(len(t), dtype=bool)
    if inside.sum() < 10:
        return 2.0
    a = a[inside]
    b = np.stack([np.interp(t[inside], other[0], column) for column in other[1].T], -1)
    if a.shape[1] == 3:
        u, _, v = np.linalg.svd(b.T @ a)
        b = b @ (u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v)
    energy = 0.5 * float(np.sum(a**2) + np.sum(b**2))
    return float(np.sum((a - b) ** 2)) / max(energy, 1e-12)


def _fitting(poses: Sequence[Source], gyroscopes: Sequence[Source]) -> tuple[Source, Source, float] | None:
    """Pose and gyroscope that turn alike, and the share by which they differ; of several that do, the best by rank.
    None where none does."""
    pairs = [
        (pose, gyroscope, _apart(_turning(pose), _gyro(gyroscope)))
        for pose, gyroscope in itertools.product(poses, gyroscopes)
        if "vehicle_attitude" in pose.parts
    ]
    least = min((left for _, _, left in pairs), default=2.0)
    alike = [pair for pair in pairs if pair[2] < min(FITS, CLEARLY * least + NOISE)]
    return min(alike, key=lambda pair: (_rank(pair[0]), _rank(pair[1])), default=None)
