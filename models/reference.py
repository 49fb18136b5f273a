"""The trajectories that can be flown by name, with their parameters, and those read from a table of
setpoints.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from trueflight.models.contract import REQUEST_BYTES
from trueflight.models.errors import InputError, shown
from trueflight.models.trajectory import (
    Curve,
    ReferenceColumns,
    ReferenceSample,
    Segment,
    Trajectory,
    Wave,
    Waypoint,
    hold,
    min_jerk,
    path,
    quintics,
    transfer,
)

__all__ = [
    "KINDS",
    "Parameter",
    "ReferenceColumns",
    "ReferenceSample",
    "Trajectory",
    "TrajectoryKind",
    "trajectory",
    "trajectory_from_csv",
    "transfer",
]

LONGEST = 3600.0
"""s, the longest trajectory; no quadrotor of this size flies longer on one battery."""
CLOSEST = 0.001
"""s, the least time between two setpoints of a table: the fastest control loop meant here ticks once in that."""
MOST_ROWS = 20_000
"""Setpoints of one table."""
_FARTHEST = 1e6
"""m, m/s, m/s²: no setpoint is beyond."""

ACCELERATION = 4.0
"""Greatest reference acceleration of a transfer inside a trajectory unless it says otherwise, m/s²."""


@dataclass(frozen=True)
class Parameter:
    """A number (or, with `choices`, a word) that shapes a trajectory; lengths m, times s, angles rad, speeds
    m/s.
    """

    name: str
    default: float | str
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    text: str = ""
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class TrajectoryKind:
    """A named trajectory: what it does, its parameters, and how it is built from them."""

    name: str
    text: str
    parameters: tuple[Parameter, ...]
    build: Callable[..., list[Segment]]


KINDS: dict[str, TrajectoryKind] = {}


def _kind(name: str, text: str, *parameters: Parameter) -> Callable[..., Callable[..., list[Segment]]]:
    def register(build: Callable[..., list[Segment]]) -> Callable[..., list[Segment]]:
        KINDS[name] = TrajectoryKind(name, text, parameters, build)
        return build

    return register


def trajectory(name: str, /, **parameters: float | str) -> Trajectory:
    """The trajectory of this name.

    Raises `InputError` for an unknown name or parameter (with a suggestion) and for a value out of its range.
    """
    if name not in KINDS:
        raise InputError(f"no trajectory {shown(name)}; {_suggest(name, list(KINDS))}")
    kind = KINDS[name]
    known = {p.name: p for p in kind.parameters}
    values: dict[str, float | str] = {p.name: p.default for p in kind.parameters}
    for key, value in parameters.items():
        if key not in known:
            raise InputError(
                f"trajectory '{name}' has no parameter {shown(key)}; {_suggest(key, list(known))}"
            )
        values[key] = _checked(name, known[key], value)
    built = Trajectory(name, tuple(kind.build(**values)), values)
    check_duration(built.duration, f"trajectory '{name}'")
    return built


def check_duration(seconds: float, where: str) -> None:
    """Raise `InputError`, which names `where`, for a flight of too many `seconds`, or of NaN."""
    if not seconds <= LONGEST:
        raise InputError(f"{where} takes {seconds:.4g} s; at most {LONGEST:g} s are flown at once")


def _suggest(word: str, known: list[str]) -> str:
    close = difflib.get_close_matches(word[:40], known, 1)
    return f"did you mean '{close[0]}'?" if close else f"known: {', '.join(known)}"


def _checked(name: str, parameter: Parameter, value: object) -> float | str:
    where = f"trajectory '{name}': {parameter.name}"
    if parameter.choices:
        if value not in parameter.choices:
            raise InputError(f"{where} is {shown(value)}; it must be one of {', '.join(parameter.choices)}")
        return str(value)
    try:
        number = math.nan if isinstance(value, bool) else float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{where} must be a number, not {shown(value)}") from None
    if not parameter.low <= number <= parameter.high:  # false for NaN as well
        raise InputError(
            f"{where} = {number:g} is outside {parameter.low:g} to {parameter.high:g} "
            f"{parameter.unit}".rstrip()
        )
    return number


_FLOOR = 0.3
"""m above ground: no step of a random direction ends lower."""

HEIGHT = Parameter("height", 1.2, 0.1, 50.0, "m", "height above ground")
YAW = Parameter("yaw", 0.0, -2 * math.pi, 2 * math.pi, "rad", "yaw, zero along world x (east)")
SPEED = Parameter("speed", 2.0, 0.05, 15.0, "m/s", "greatest reference speed")


@_kind("hover", "stand still", HEIGHT, Parameter("duration", 10.0, 0.5, 3600.0, "s", "how long"), YAW)
def _hover(height: float, duration: float, yaw: float) -> list[Segment]:
    return [hold((0.0, 0.0, height, yaw), duration)]


def _step(axis: int) -> Callable[..., list[Segment]]:
    def build(size: float, height: float, time: float, count: float, yaw: float) -> list[Segment]:
        base: Waypoint = (0.0, 0.0, height, yaw)
        moved = list(base)
        moved[axis] += size
        there: Waypoint = tuple(moved)  # type: ignore[assignment]
        segments: list[Segment] = [hold(base, 0.5 * time)]
        for _ in range(int(count)):
            segments += [hold(there, time), hold(base, time)]
        return segments

    return build


for _axis, _name in enumerate(("x", "y", "z", "yaw")):
    _unit = "rad" if _name == "yaw" else "m"
    _kind(
        f"step_{_name}",
        f"steps of the {_name} reference, there and back",
        Parameter("size", 0.8, -3.0, 3.0, _unit, "size of the step"),
        HEIGHT,
        Parameter("time", 4.0, 0.5, 60.0, "s", "time between two steps"),
        Parameter("count", 1.0, 1.0, 100.0, "", "how often there and back"),
        YAW,
    )(_step(_axis))


_SEED = Parameter("seed", 1.0, 0.0, 2.0**31, "", "another number is another order and other sizes")
_DIRECTIONS = tuple(
    (dx, dy, dz) for dx in (-1, 0, 1) for dy in (-1, 0, 1) for dz in (-1, 0, 1) if (dx, dy, dz) != (0, 0, 0)
)
"""The 26 neighbours of a point: along every axis, every diagonal of a plane, and every diagonal of space."""


def _beside(base: Waypoint, direction: Sequence[float], size: float) -> Waypoint:
    """The waypoint `size` m from `base` along a direction of any length."""
    length = math.hypot(*direction)
    x, y, z = (b + size * d / length for b, d in zip(base[:3], direction, strict=True))
    return (x, y, z, base[3])


@_kind(
    "steps",
    "steps of the position reference in all directions of space, each there and back, in an order of the seed",
    Parameter("size", 0.8, 0.05, 3.0, "m", "greatest size of a step; the smallest is half of it"),
    HEIGHT,
    Parameter("time", 2.5, 0.5, 60.0, "s", "time between two steps"),
    Parameter("count", 7.0, 1.0, 100.0, "", "how many there and back"),
    YAW,
    _SEED,
)
def _steps(size: float, height: float, time: float, count: float, yaw: float, seed: float) -> list[Segment]:
    generator = random.Random(f"steps {int(seed)}")
    base: Waypoint = (0.0, 0.0, height, yaw)
    segments: list[Segment] = [hold(base, 1.0)]
    order: list[tuple[int, int, int]] = []
    for _ in range(int(count)):
        order = order or generator.sample(_DIRECTIONS, len(_DIRECTIONS))
        there = _beside(base, order.pop(), size * generator.uniform(0.5, 1.0))
        # A step that would end below the ground or close above it is mirrored.
        there = (*there[:2], max(there[2], 2 * height - there[2]) if there[2] < _FLOOR else there[2], yaw)
        segments += [hold(there, time), hold(base, time)]
    return segments


@_kind(
    "scenario",
    "steps of 0.5 to 1 m along every axis and smooth translations in every plane, about 40 s, in the style of the "
    "paper's figure 6; order, sizes and directions are the seed's",
    _SEED,
    Parameter("height", 1.8, 1.3, 50.0, "m", "height above ground"),
    Parameter("speed", 2.0, 0.2, 4.0, "m/s", "greatest reference speed of the translations"),
    YAW,
)
def _scenario(seed: float, height: float, speed: float, yaw: float) -> list[Segment]:
    generator = random.Random(f"scenario {int(seed)}")
    base: Waypoint = (0.0, 0.0, height, yaw)

    def size() -> float:
        return generator.choice((-1.0, 1.0)) * generator.uniform(0.5, 1.0)

    parts: list[list[Segment]] = []
    for axis in range(3):
        direction = [0.0, 0.0, 0.0]
        direction[axis] = 1.0
        parts.append([hold(_beside(base, direction, size()), 2.5), hold(base, 2.5)])
    for first, second in ((0, 1), (0, 2), (1, 2)):
        corners = [list(base[:3]) for _ in range(3)]
        a, b = 2.5 * size(), size() if second == 2 else 2.5 * size()
        corners[0][first] += a
        corners[1][first] += a
        corners[1][second] += b
        corners[2][second] += b
        points: list[Waypoint] = [base, *((x, y, z, yaw) for x, y, z in corners), base]
        parts.append(path(points, speed, ACCELERATION, 0.3))
    generator.shuffle(parts)
    return [hold(base, 1.0), *(segment for part in parts for segment in part), hold(base, 1.0)]


@_kind(
    "translation",
    "a square (or a line there and back) in a plane, corner to corner",
    Parameter(
        "plane",
        "xy",
        text="plane of the square, or axis of the line",
        choices=("xy", "xz", "yz", "x", "y", "z"),
    ),
    Parameter("size", 2.0, 0.1, 50.0, "m", "side of the square"),
    SPEED,
    HEIGHT,
    Parameter("laps", 1.0, 1.0, 100.0, "", "how often"),
    YAW,
)
def _translation(
    plane: str, size: float, speed: float, height: float, laps: float, yaw: float
) -> list[Segment]:
    corners = ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0)) if len(plane) == 2 else ((0, 0), (1, 0), (0, 0))
    points: list[Waypoint] = []
    for first, second in corners:
        point = {
            "x": 0.0,
            "y": 0.0,
            "z": height,
            plane[0]: size * first + (height if plane[0] == "z" else 0.0),
        }
        if len(plane) == 2:
            point[plane[1]] = size * second + (height if plane[1] == "z" else 0.0)
        points.append((point["x"], point["y"], point["z"], yaw))
    return [hold(points[0], 1.0), *(path(points, speed, ACCELERATION, 0.7) * int(laps))]


@_kind(
    "rotation",
    "turn about the vertical, there and back, standing still",
    Parameter("angle", math.pi, -12.6, 12.6, "rad", "how far"),
    Parameter("rate", 1.0, 0.05, 4.0, "rad/s", "greatest yaw rate"),
    HEIGHT,
)
def _rotation(angle: float, rate: float, height: float) -> list[Segment]:
    here, there = (0.0, 0.0, height, 0.0), (0.0, 0.0, height, angle)
    time = max(1.875 * abs(angle) / rate, 0.5)
    return [
        hold(here, 1.0),
        min_jerk(here, there, time),
        hold(there, 1.0),
        min_jerk(there, here, time),
        hold(here, 1.0),
    ]


RADIUS = Parameter("radius", 1.5, 0.1, 50.0, "m", "radius")


def _turning_time(length: float, speed: float) -> tuple[float, float]:
    """Duration and ramp of a curve of this length with a cruise at about `speed`."""
    ramp = max(speed / ACCELERATION * 1.5, 0.5)
    return max(length / speed + ramp, 2.0 * ramp + 0.1), ramp


@_kind(
    "circle",
    "a horizontal circle",
    RADIUS,
    SPEED,
    HEIGHT,
    Parameter("laps", 2.0, 0.25, 100.0, "", "turns"),
    YAW,
)
def _circle(radius: float, speed: float, height: float, laps: float, yaw: float) -> list[Segment]:
    angle = 2 * math.pi * laps
    duration, ramp = _turning_time(radius * angle, speed)
    waves = (
        Wave(0.0, amplitude=radius, frequency=angle, phase=0.5 * math.pi),
        Wave(0.0, amplitude=radius, frequency=angle),
        Wave(height),
        Wave(yaw),
    )
    return [
        hold((radius, 0.0, height, yaw), 1.0),
        Curve(duration, ramp, waves),
        hold((*_at(angle, radius), height, yaw), 1.0),
    ]


def _at(angle: float, radius: float) -> tuple[float, float]:
    return radius * math.cos(angle), radius * math.sin(angle)


@_kind(
    "spiral",
    "circles of growing radius while climbing, and back down the same way",
    RADIUS,
    SPEED,
    HEIGHT,
    Parameter("climb", 1.0, 0.0, 50.0, "m", "height gained"),
    Parameter("laps", 3.0, 0.5, 100.0, "", "turns"),
    YAW,
)
def _spiral(
    radius: float, speed: float, height: float, climb: float, laps: float, yaw: float
) -> list[Segment]:
    angle = 2 * math.pi * laps
    # The phase runs at a constant rate: the greatest speed is that of the outermost turn.
    duration, ramp = _turning_time(math.hypot(radius * math.hypot(angle, 1.0), climb), speed)
    quarter = 0.5 * math.pi
    up = (
        Wave(0.0, growth=radius, frequency=angle, phase=quarter),
        Wave(0.0, growth=radius, frequency=angle),
        Wave(height, slope=climb),
        Wave(yaw),
    )
    down = (
        Wave(0.0, amplitude=radius, growth=-radius, frequency=-angle, phase=angle + quarter),
        Wave(0.0, amplitude=radius, growth=-radius, frequency=-angle, phase=angle),
        Wave(height + climb, slope=-climb),
        Wave(yaw),
    )
    top = (*_at(angle, radius), height + climb, yaw)
    base = (0.0, 0.0, height, yaw)
    return [
        hold(base, 1.0),
        Curve(duration, ramp, up),
        hold(top, 0.5),
        Curve(duration, ramp, down),
        hold(base, 1.0),
    ]


@_kind(
    "lemniscate",
    "a figure of eight (Gerono), horizontal or tilted by `climb`",
    Parameter("width", 4.0, 0.2, 100.0, "m", "length along x"),
    Parameter("depth", 2.0, 0.2, 100.0, "m", "width along y"),
    SPEED,
    HEIGHT,
    Parameter("climb", 0.0, -20.0, 20.0, "m", "height of the far lobe over the near one"),
    Parameter("laps", 2.0, 1.0, 100.0, "", "how often"),
    YAW,
)
def _lemniscate(
    width: float, depth: float, speed: float, height: float, climb: float, laps: float, yaw: float
) -> list[Segment]:
    angle = 2 * math.pi * round(laps)
    # Fastest at the crossing, where both sines are steepest.
    steepest = math.hypot(0.5 * width, depth, 0.5 * climb)
    duration, ramp = _turning_time(steepest * angle, speed)
    waves = (
        Wave(0.0, amplitude=0.5 * width, frequency=angle),
        Wave(0.0, amplitude=0.5 * depth, frequency=2 * angle),
        Wave(height, amplitude=0.5 * climb, frequency=angle),
        Wave(yaw),
    )
    base = (0.0, 0.0, height, yaw)
    return [hold(base, 1.0), Curve(duration, ramp, waves), hold(base, 1.0)]


@_kind(
    "vertical_eight",
    "an upright figure of eight; as it stands x 1.25 sin t, z 0.75 sin 2t, which Neural-Fly flies in its winds",
    Parameter("width", 2.5, 0.2, 100.0, "m", "length along x"),
    Parameter("rise", 1.5, 0.2, 20.0, "m", "height from the lowest to the highest point"),
    Parameter("speed", math.hypot(1.25, 1.5), 0.05, 15.0, "m/s", "greatest reference speed"),
    Parameter("height", 2.0, 0.1, 50.0, "m", "height of the crossing above ground"),
    Parameter("laps", 4.0, 1.0, 100.0, "", "how often"),
    YAW,
)
def _vertical_eight(
    width: float, rise: float, speed: float, height: float, laps: float, yaw: float
) -> list[Segment]:
    if height <= 0.5 * rise:
        raise InputError(
            f"trajectory 'vertical_eight': height {height:g} m leaves no room for a rise of {rise:g} m"
        )
    angle = 2 * math.pi * round(laps)
    duration, ramp = _turning_time(math.hypot(0.5 * width, rise) * angle, speed)
    waves = (
        Wave(0.0, amplitude=0.5 * width, frequency=angle),
        Wave(0.0),
        Wave(height, amplitude=0.5 * rise, frequency=2 * angle),
        Wave(yaw),
    )
    base = (0.0, 0.0, height, yaw)
    return [hold(base, 1.0), Curve(duration, ramp, waves), hold(base, 1.0)]


@_kind(
    "low_pass",
    "fast and slow passes close to the ground, with a dip before and a climb after each",
    Parameter("low", 0.2, 0.08, 20.0, "m", "height of the pass above ground"),
    Parameter("length", 4.0, 0.5, 100.0, "m", "length of the pass, along x"),
    SPEED,
    Parameter("height", 1.0, 0.1, 50.0, "m", "height between the passes"),
    Parameter("passes", 4.0, 1.0, 100.0, "", "how many, every second one at half the speed"),
    YAW,
)
def _low_pass(
    low: float, length: float, speed: float, height: float, passes: float, yaw: float
) -> list[Segment]:
    x = -0.5 * length
    segments: list[Segment] = [hold((x, 0.0, height, yaw), 1.0)]
    for index in range(int(passes)):
        pace = speed if index % 2 == 0 else 0.5 * speed
        points = [(x, 0.0, height, yaw), (x, 0.0, low, yaw), (-x, 0.0, low, yaw), (-x, 0.0, height, yaw)]
        segments += path(points[:2], 1.0, ACCELERATION, 0.5)
        segments += path(points[1:3], pace, ACCELERATION, 0.5)
        segments += path(points[2:], 1.5, ACCELERATION, 0.3)
        x = -x
    return segments


@_kind(
    "excitation",
    "a survey of about 45 s that shows every effect: heights down to `low`, fast and slow along both axes, "
    "at two yaws, and hard vertical moves",
    Parameter("low", 0.3, 0.08, 5.0, "m", "lowest height above ground"),
    Parameter("size", 2.2, 0.5, 20.0, "m", "half the length of the passes"),
    Parameter("speed", 4.0, 0.5, 12.0, "m/s", "greatest reference speed"),
    Parameter("height", 1.3, 0.5, 30.0, "m", "height of the fast passes"),
)
def _excitation(low: float, size: float, speed: float, height: float) -> list[Segment]:
    quarter, hard = 0.5 * math.pi, 6.0
    base: Waypoint = (0.0, 0.0, height, 0.0)
    turned: Waypoint = (0.0, 0.0, height, quarter)
    segments: list[Segment] = [hold(base, 1.0)]

    # Fast along both axes: drag, its shape over speed, and the exact rotation of thrust.
    along = [(-size, 0.0, height, 0.0), (size, 0.0, height, 0.0)]
    across = [(0.0, -size, height, 0.0), (0.0, size, height, 0.0)]
    segments += path([base, *along, base, *across, base], speed, hard)
    # Hard vertical moves at no horizontal speed: thrust gain, thrust curve, lag and delay.
    top = (0.0, 0.0, height + 1.2, 0.0)
    bottom = (0.0, 0.0, max(low + 0.4, 0.5), 0.0)
    segments += path([base, top, bottom, top, base], 3.0, hard)
    # Down in stairs, standing still on each: thrust against height near the ground, and nothing else.
    stairs = [height, low + 0.5, low + 0.25, low + 0.1, low]
    segments += path([(0.0, 0.0, z, 0.0) for z in stairs], 0.8, 2.0, 0.6)
    # Along the ground, slow and fast: tells ground effect from a loss of lift with speed.
    left, right = (-0.6 * size, 0.0, low, 0.0), (0.6 * size, 0.0, low, 0.0)
    segments += path([(0.0, 0.0, low, 0.0), right], 1.0, 2.0) + path([right, left], 2.5, 4.0)
    segments += path([left, base], 1.5, 3.0)
    # Yawed a quarter turn: wind stays in the world, drag and a tilted thrust axis turn with the body.
    segments += [min_jerk(base, turned, 1.5), hold(turned, 0.7)]
    near, away = (-size, -size, height, quarter), (size, size, height, quarter)
    segments += path([turned, away, near, turned], speed, hard)
    # A slow climb and a slow pass: the steady part of everything.
    far = (0.5 * size, 0.5 * size, height + 0.8, 0.0)
    segments += [*path([turned, far], 0.8, 2.0), *path([far, base], 1.2, 2.0), hold(base, 1.0)]
    return segments


_OPTIONAL = ("vx", "vy", "vz", "ax", "ay", "az", "yaw")


def trajectory_from_csv(text: str, where: str = "setpoints") -> Trajectory:
    """A trajectory from setpoints: columns `t,x,y,z`, optionally `vx,vy,vz`, `ax,ay,az`, `yaw` (SI, rad, home
    frame).

    Between two rows it runs along a quintic. Where velocities or accelerations are not given they are central
    differences of the rows, and zero at both ends. Raises `InputError` with line and column for what cannot
    be used.
    """
    if len(text) > REQUEST_BYTES["mission"]:
        most = REQUEST_BYTES["mission"]
        raise InputError(f"{where}: {len(text)} characters; at most {most} are flown at once, split the file")
    try:
        rows = list(csv.reader(io.StringIO(text.lstrip("\ufeff"))))
    except csv.Error as error:
        raise InputError(f"{where}: not a table of comma-separated values ({error})") from None
    rows = [row for row in rows if row and not row[0].lstrip().startswith("#")]
    if not rows:
        raise InputError(
            f"{where}: empty; the first line must name the columns t,x,y,z[,vx,vy,vz,ax,ay,az,yaw]"
        )
    names = [name.strip() for name in rows[0]]
    missing = [name for name in ("t", "x", "y", "z") if name not in names]
    if missing:
        raise InputError(f"{where}: column '{missing[0]}' is missing; the first line must name t,x,y,z")
    for name in names:
        if name not in ("t", "x", "y", "z", *_OPTIONAL):
            raise InputError(
                f"{where}: unknown column {shown(name)}; {_suggest(name, ['t', 'x', 'y', 'z', *_OPTIONAL])}"
            )
    if len(set(names)) != len(names):
        raise InputError(f"{where}: a column is named twice in {shown(','.join(names))}; keep one")
    for trio in ("vx vy vz", "ax ay az"):
        given = [n for n in trio.split() if n in names]
        if given and len(given) != 3:
            raise InputError(f"{where}: only {', '.join(given)} of {trio}; give all three or none")
    values = _numbers(rows[1:], names, where)
    column = {name: values[:, i] for i, name in enumerate(names)}
    with np.errstate(over="ignore"):
        t = column["t"] - column["t"][0]
    if np.any(np.diff(t) <= 0):
        line = int(np.argmax(np.diff(t) <= 0)) + 3
        raise InputError(f"{where}: time does not increase at row {line}; sort the rows and drop duplicates")
    if np.any(np.diff(t) < CLOSEST):
        line = int(np.argmax(np.diff(t) < CLOSEST)) + 3
        raise InputError(
            f"{where}: row {line} comes {t[line - 2] - t[line - 3]:.3g} s after the one before; at least "
            f"{CLOSEST:g} s must lie between two setpoints"
        )
    check_duration(float(t[-1]), where)
    position = np.stack(
        [column["x"], column["y"], column["z"], np.unwrap(column.get("yaw", np.zeros_like(t)))], -1
    )
    velocity, acceleration = _differences(t, position), None
    if "vx" in column:
        velocity[:, :3] = np.stack([column["vx"], column["vy"], column["vz"]], -1)
    acceleration = _differences(t, velocity)
    if "ax" in column:
        acceleration[:, :3] = np.stack([column["ax"], column["ay"], column["az"]], -1)
    state = np.stack([position, velocity, acceleration], -1)
    return Trajectory("setpoints", quintics(np.diff(t), state), {"rows": float(len(t))})


def _numbers(rows: list[list[str]], names: list[str], where: str) -> np.ndarray:
    if len(rows) < 2:
        raise InputError(f"{where}: {len(rows)} rows of numbers; at least 2 are needed")
    if len(rows) > MOST_ROWS:
        raise InputError(f"{where}: {len(rows)} rows; at most {MOST_ROWS} are flown at once, split the file")
    out = np.empty((len(rows), len(names)))
    for i, row in enumerate(rows):
        if len(row) != len(names):
            raise InputError(f"{where}: row {i + 2} has {len(row)} values for {len(names)} columns")
        for j, cell in enumerate(row):
            try:
                out[i, j] = float(cell)
            except ValueError:
                raise InputError(
                    f"{where}: row {i + 2}, column '{names[j]}': {shown(cell)} is not a number"
                ) from None
            if not math.isfinite(out[i, j]):
                raise InputError(f"{where}: row {i + 2}, column '{names[j]}': {shown(cell)} is not finite")
            if names[j] != "t" and abs(out[i, j]) > _FARTHEST:
                raise InputError(
                    f"{where}: row {i + 2}, column '{names[j]}': {shown(cell)} is beyond {_FARTHEST:g}"
                )
    return out


def _differences(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Central differences (second order on uneven spacing), zero at both ends: setpoints begin and end at
    rest.
    """
    slope = np.gradient(values, t, axis=0) if len(t) > 1 else np.zeros_like(values)
    slope[0] = slope[-1] = 0.0
    return slope
