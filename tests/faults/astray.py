"""Odometry that is late, frozen, reset or another's, in a hover and along a path: how far the vehicle strays."""

from __future__ import annotations

import math
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from inject import inject
from mitm import HIGHRES_IMU, ODOMETRY, Fault, Passing, delayed, frozen, nothing, reset
from promise import Row, counted, spread
from scene import FOREVER, Place, Scene

FAR, HARD = 1.0, 1.0
"""m from its place or path while a flight ends, and m/s into the ground: beyond either it was led astray."""
_SIZE = {"speed": 1.0, "width": 3.0, "depth": 1.5}
FIGURE = {"trajectory": "lemniscate", "parameters": {"laps": 20.0, **_SIZE}}
_WATCHED = 6.0
"""s for which a fault goes on where it does not end the flight."""
_OF_OTHERS = ("autopilot", "landing")
"""Events that tell of something else than the fault."""


@dataclass(frozen=True)
class Went:
    """One flight with a fault: greatest distance (m), speed into the ground (m/s), what the companion said first."""

    away: float
    impact: float
    told: str

    @property
    def astray(self) -> bool:
        """Whether it was led astray."""
        return self.away > FAR or self.impact > HARD


def without(*numbers: int) -> Fault:
    """These messages of the vehicle are lost."""

    def fault(passing: Passing, now: float) -> Iterable[tuple[float, bytes]]:
        return [] if passing.from_vehicle and passing.number in numbers else [(0.0, passing.data)]

    return fault


_MOVES = ("x", "y", "z", "vx", "vy", "vz")
_TURNS = ("q", "rollspeed", "pitchspeed", "yawspeed")

FAULTS: dict[str, Callable[[], Fault]] = {
    "odometry 0.15 s late": lambda: delayed(0.15, ODOMETRY),
    "odometry 0.3 s late": lambda: delayed(0.3, ODOMETRY),
    "odometry 0.6 s late": lambda: delayed(0.6, ODOMETRY),
    "everything 0.3 s late": lambda: delayed(0.3),
    "odometry frozen, its time goes on": lambda: frozen(),
    "odometry frozen with its time": lambda: frozen(stamp=True),
    "odometry frozen, with noise of 2 mm and mm/s": lambda: frozen(noise=0.002),
    "position and velocity frozen": lambda: frozen(only=_MOVES),
    "position frozen": lambda: frozen(only=("x", "y", "z")),
    "attitude and rates frozen": lambda: frozen(only=_TURNS),
    "reset by 0.95 m downwards, told": lambda: reset(down=0.9, east=-0.3),
    "reset by 3 m, told": lambda: reset(down=3.0),
    "jump of 0.9 m upwards, untold": lambda: reset(down=-0.9, told=False),
    "heading reset by 0.8 rad, told": lambda: reset(turn=0.8),
    "heading jumps by 0.8 rad, untold": lambda: reset(turn=-0.8, told=False),
    "accelerometer and gyroscope lost": lambda: without(HIGHRES_IMU),
}
INJECTED = {
    "a camera's odometry beside (same vehicle)": "vio",
    "another vehicle's odometry beside": "vehicle2",
    "a second battery of 5.1 V, by the autopilot": "battery2",
    "a second battery of 5.1 V, by itself": "smartbattery",
}


def astray(folder: Path, times: int, only: tuple[str, ...] = ()) -> Iterator[Row]:
    """Each fault `times` times, in a hover and along a figure of eight by turns; `only` names some of them."""
    scene: Scene | None = None
    try:
        path: list[Place] = []
        for name in [*FAULTS, *INJECTED]:
            if only and name not in only:
                continue
            went: list[Went] = []
            trouble = ""
            for number in range(times):
                if scene is None:
                    scene = Scene(Path(tempfile.mkdtemp(dir=folder)))
                    path = path or _flown(scene)
                figure = bool((number + len(name)) % 2)  # with few times, half of the faults still meet each
                try:
                    went.append(_one(scene, name, path if figure else []))
                except AssertionError as error:
                    trouble = f"; and then: {str(error)[:200]}"
                if trouble or went[-1].astray:
                    # The vehicle may lie on its side now: the next fault gets another one.
                    scene.close()
                    scene = None
            yield _row(name, went, trouble)
    finally:
        if scene is not None:
            scene.close()


def _row(name: str, went: list[Went], trouble: str) -> Row:
    lost = sum(one.astray for one in went)
    away, impact = spread((one.away for one in went), "m"), spread((one.impact for one in went), "m/s")
    seen = f"{away} away, into the ground at {impact}; told: {counted(one.told for one in went)}"
    seen += trouble
    return Row(
        name, len(went), f"within {FAR:g} m, down at {HARD:g} m/s or less", seen, lost == 0 and not trouble
    )


def _flown(scene: Scene) -> list[Place]:
    """A lap of the figure as it is flown without a fault, from takeoff on, relative to home."""
    home = scene.middle.seen[-1]
    begin = time.monotonic()
    scene.fly({**FIGURE, "parameters": {"laps": 1.0, **_SIZE}})
    scene.companion.done(scene.mission)
    scene.down()
    return relative(scene.places(begin), home)


def relative(places: list[Place], home: Place) -> list[Place]:
    return [(t, n - home[1], e - home[2], d - home[3]) for t, n, e, d in places]


def _one(scene: Scene, name: str, path: list[Place]) -> Went:
    """A flight with a fault, until the vehicle stands again; along `path`, or in a hover without one."""
    home = scene.middle.seen[-1]
    scene.fly(FIGURE if path else FOREVER)
    time.sleep(2.0 if path else 0.5)
    begin, known = time.monotonic(), len(scene.companion.events)
    if name in INJECTED:
        port = scene.middle.companion_port
        threading.Thread(target=inject, args=(INJECTED[name], port), daemon=True).start()
    else:
        scene.middle.fault = FAULTS[name]()
    _until(lambda: scene.middle.mode != "OFFBOARD", _WATCHED if name in FAULTS else 3.0)
    new = [
        e.kind for e in list(scene.companion.events)[known:] if e.level != "info" and e.kind not in _OF_OTHERS
    ]
    told = new[0] if new else "nothing"
    if scene.middle.mode == "OFFBOARD":
        told += ", flies on"
        scene.companion.ask("mission", {"command": "abort"})
    scene.down()
    after = scene.places(begin)
    scene.middle.fault = nothing
    time.sleep(0.7)  # what was delayed is through
    scene.land()
    places = relative(after, home)
    return Went(away(places, path), impact(places), told)


def _until(condition: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end and not condition():
        time.sleep(0.01)


def away(places: list[Place], path: list[Place]) -> float:
    """Greatest distance from the path beside it or above it; from the first place without one."""
    path = path[::5] or places[:1]
    ceiling = min(row[3] for row in path)
    worst = 0.0
    for _, north, east, down in places[::5]:
        beside = min(math.hypot(north - row[1], east - row[2]) for row in path)
        worst = max(worst, beside, ceiling - down)
    return worst


def impact(places: list[Place]) -> float:
    """Speed in m/s at which the vehicle came down to where it stood in the end."""
    ground = places[-1][3]
    touch = next((i for i, row in enumerate(places) if row[3] > ground - 0.05), len(places) - 1)
    before = next((row for row in reversed(places[:touch]) if places[touch][0] - row[0] > 0.1), places[0])
    return max((places[touch][3] - before[3]) / max(places[touch][0] - before[0], 1e-3), 0.0)
