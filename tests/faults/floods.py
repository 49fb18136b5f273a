"""Floods of messages, and too little processor and memory, while a flight is under way."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
from astray import FAR, Went, away, impact, relative
from flood import ASKED, DATAGRAMS, PUBLISHED
from processes import with_parent
from promise import Row, spread
from rig import Companion
from scene import Scene

from trueflight.models import contract
from trueflight.models.errors import InputError
from trueflight.models.pose import Pose, pose_to_json
from trueflight.models.record import FlightRecord, read_record

GAP = 0.25
"""s without a setpoint that no flood may make: half of `scene.LOSS_TIME`."""
GROWTH = 64.0
"""MB by which no flood may let the companion grow."""
_POSES = "[pose]\nenabled = true\n"


@dataclass
class Flooded:
    """What a flight did between `begin` and `end` (monotonic s)."""

    name: str
    count: int
    begin: float
    end: float = 0.0
    answers: dict[str, float] = field(default_factory=dict)
    unanswered: int = 0
    gap: float = 0.0
    grown: float = 0.0
    flew_on: bool = True
    why: str = ""


def floods(folder: Path, count: int, seed: int, gap: float = GAP, settings: str = "") -> Iterator[Row]:
    """`count` messages on every Zenoh key and `count` MAVLink datagrams of each kind; one flight goes on throughout.

    `gap` in s is what may pass without a setpoint.
    """
    every = [("zenoh", leaf) for leaf in (*ASKED, *PUBLISHED)] + [("mavlink", kind) for kind in DATAGRAMS]
    every.remove(("zenoh", "pose"))
    (folder / "poses").mkdir()
    with Scene(folder, settings=settings) as scene:
        scene.fly()
        time.sleep(1.0)
        quiet = Flooded("quiet", 0, time.monotonic())
        time.sleep(3.0)
        seen = f"age of odometry {_shown(_latency(scene, _finished(scene, quiet)))}"
        yield Row("quiet flight, to compare", 1, "told", seen, True)
        yield from _one_by_one(scene, every, count, seed, gap)
    with Scene(folder / "poses", settings=_POSES + settings) as scene, _poses(scene.companion):
        scene.fly()
        yield from _one_by_one(scene, [("zenoh", "pose")], count, seed, gap)


def _one_by_one(
    scene: Scene, every: list[tuple[str, str]], count: int, seed: int, gap: float
) -> Iterator[Row]:
    for number, (what, which) in enumerate(every):
        if scene.middle.mode != "OFFBOARD":
            scene.land()
            scene.fly()
        one = _flood(scene, what, which, count, seed + number)
        yield _flood_row(one, _latency(scene, one), gap)
    scene.land()


def _flood(scene: Scene, what: str, which: str, count: int, seed: int) -> Flooded:
    port = scene.companion.zenoh_port if what == "zenoh" else scene.middle.companion_port
    name = f"Zenoh key `{which}`" if what == "zenoh" else f"MAVLink, {which}"
    before = _resident(scene.companion)
    program = [sys.executable, str(Path(__file__).with_name("flood.py")), what, str(port), which]
    out = Flooded(name, count, time.monotonic())
    child = subprocess.Popen(
        [*program, str(count), str(seed)], stdout=subprocess.PIPE, text=True, preexec_fn=with_parent
    )
    try:
        largest = before
        while child.poll() is None:
            largest = max(largest, _resident(scene.companion))
            time.sleep(0.1)
        assert child.stdout is not None
        out.answers = json.loads(child.stdout.read() or "{}")
    finally:
        child.kill()
        child.wait()
    out.grown = max(largest, _resident(scene.companion)) - before
    return _finished(scene, out)


def _finished(scene: Scene, out: Flooded) -> Flooded:
    out.end = time.monotonic()
    out.unanswered, out.gap = scene.unanswered(out.begin, out.end)
    out.flew_on = scene.middle.mode == "OFFBOARD" and scene.middle.armed
    told = [e for e in list(scene.companion.events) if e.host_time_ns > 1e9 * out.begin and e.level != "info"]
    out.why = "" if out.flew_on else "; ".join(f"{e.kind}: {e.text[:100]}" for e in told[:3])
    return out


def _flood_row(one: Flooded, latency: tuple[float, float, float], gap: float) -> Row:
    obeyed = int(one.answers.get("accepted", 0)) if one.name != "Zenoh key `status`" else 0
    rate = one.count / max(one.answers.get("seconds", 0.0), 1e-3)
    seen = f"{rate:.0f} a second; {'flew on' if one.flew_on else f'the flight ended ({one.why})'}; obeyed {obeyed}; "
    seen += f"{one.unanswered} odometry messages unanswered, longest gap {1e3 * one.gap:.0f} ms; "
    seen += f"age of odometry {_shown(latency)}; {one.grown:+.0f} MB"
    promised = f"flies on, no gap of {1e3 * gap:.0f} ms, nothing obeyed, below {GROWTH:+.0f} MB"
    kept = one.flew_on and one.gap < gap and not obeyed and one.grown < GROWTH and bool(one.answers)
    return Row(one.name, one.count, promised, seen, kept)


def _latency(scene: Scene, one: Flooded) -> tuple[float, float, float]:
    """Median, 99th percentile and worst age of the odometry when its setpoint left, in s, by the companion's ticks."""
    begin, end = int(1e9 * one.begin), int(1e9 * one.end)
    ticks = list(scene.companion.ticks)
    values = [t.age for t in ticks if begin < t.host_time_ns < end and t.setpoint_sent]
    if not values:
        return (float("nan"),) * 3
    return float(np.median(values)), float(np.percentile(values, 99)), max(values)


def _shown(latency: tuple[float, float, float]) -> str:
    return "{:.2g}, p99 {:.2g}, worst {:.2g} ms".format(*(1e3 * x for x in latency))


@contextlib.contextmanager
def _poses(companion: Companion) -> Iterator[None]:
    """Good poses of motion capture at 50 Hz, which a companion with `[pose]` wants before it flies."""
    stop = threading.Event()

    def send() -> None:
        with contextlib.suppress(Exception):
            while not stop.wait(0.02):
                pose = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), time.time_ns())
                companion.session.put(contract.key("quad5", "pose"), pose_to_json(pose))

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _resident(companion: Companion) -> float:
    try:
        return float(psutil.Process(companion.child.pid).memory_info().rss / 1e6)
    except psutil.NoSuchProcess:
        return 0.0


# Too little of the machine


def starved(
    folder: Path,
    seconds: float,
    processors: tuple[int, ...] = (2, 4, 8, 16),
    spares: tuple[int, ...] = (0, 4, 16),
) -> Iterator[Row]:
    """Flights on one processor with so many busy programs of equal rank, and with so many MB of memory left."""
    for busy in processors:
        yield _without_processor(folder / f"busy{busy}", busy, seconds)
    for spare in spares:
        yield _without_memory(folder / f"memory{spare}", spare, seconds)


def _without_processor(folder: Path, busy: int, seconds: float) -> Row:
    folder.mkdir()
    with Scene(folder) as scene:
        home = scene.middle.seen[-1]
        scene.fly()
        _pin(scene.companion.child.pid, 0)
        # The vehicle, and we who look at it, keep the rest of the machine.
        _pin(scene.bridge.child.pid, (os.cpu_count() or 1) - 1)
        began = time.monotonic()
        spinning = [
            subprocess.Popen([sys.executable, "-c", "while True: pass"], preexec_fn=with_parent)
            for _ in range(busy)
        ]
        try:
            for one in spinning:
                _pin(one.pid, 0)
            time.sleep(seconds)
            flown = _finished(scene, Flooded("", 0, began))
            latency = _latency(scene, flown)
            if flown.flew_on:
                scene.companion.ask("mission", {"command": "abort"})
            scene.down()
        finally:
            for one in spinning:
                one.kill()
                one.wait()
        end = time.monotonic()
        status = scene.land()
        why = _record(scene)[1]
        stopped = _away_and_down(scene, home, began, end)
    how = "flew on" if flown.flew_on else f"ended: {status['reason'][:90]}"
    seen = f"{how}; longest gap {1e3 * flown.gap:.0f} ms; age of odometry {_shown(latency)}; {_told(stopped, why)}"
    return Row(
        f"{busy} busy programs on its one processor", 1, _PROMISED, seen, not stopped.astray and not why
    )


_PROMISED = f"flies on or lands within {FAR:g} m, the record readable"


def _without_memory(folder: Path, spare: int, seconds: float) -> Row:
    """The limit of address space is set to what the companion has in flight, and so many MB."""
    folder.mkdir()
    with Scene(folder) as scene:
        home = scene.middle.seen[-1]
        scene.fly()
        process = psutil.Process(scene.companion.child.pid)
        most = process.memory_info().vms + (spare << 20)
        began = time.monotonic()
        resource.prlimit(process.pid, resource.RLIMIT_AS, (most, most))
        _ask_for_much(scene.companion)
        time.sleep(seconds)
        alive = scene.companion.child.poll() is None
        flown = _finished(scene, Flooded("", 0, began))
        if flown.flew_on and alive:
            with contextlib.suppress(Exception):
                list(
                    scene.companion.session.get(
                        contract.key("quad5", "mission"), payload=b'{"command": "abort"}', timeout=3.0
                    )
                )
        time.sleep(0.5)
        if scene.middle.mode == "OFFBOARD" and alive:
            scene.companion.send(signal.SIGKILL)  # an order cannot be heard any more: the failsafe must do
        scene.down()
        end = time.monotonic()
        record, why = _record(scene)
        stopped = _away_and_down(scene, home, began, end)
    how = (
        ("flew on" if flown.flew_on else f"ended the flight ({flown.why})") if alive else "the process ended"
    )
    ticks = len(record.ticks["t"]) if record else 0
    seen = f"{how}; longest gap {1e3 * flown.gap:.0f} ms; {ticks} ticks recorded; {_told(stopped, why)}"
    return Row(f"no memory in flight but {spare} MB", 1, _PROMISED, seen, not stopped.astray and not why)


def _ask_for_much(companion: Companion) -> None:
    """Requests that need memory on board."""
    replies = []
    for leaf, size in (("mission", 400_000), ("model", 2_000_000), ("record", 1000)):
        data = b'{"setpoints": "' + b"0" * size + b'"}'
        replies.append(companion.session.get(contract.key("quad5", leaf), payload=data, timeout=2.0))
    for reply in replies:
        list(reply)


def _record(scene: Scene) -> tuple[FlightRecord | None, str]:
    """The last record, and what is wrong with it."""
    paths = sorted(scene.companion.records.glob("*.mcap"))
    if not paths:
        return None, "no record"
    try:
        return read_record(paths[-1]), ""
    except InputError as error:
        return None, str(error)


def _away_and_down(scene: Scene, home: tuple[float, float, float, float], begin: float, end: float) -> Went:
    places = relative(scene.places(begin, end), home)
    return Went(away(places, []), impact(places), "")


def _told(went: Went, why: str) -> str:
    out = f"{spread([went.away], 'm')} away, down at {spread([went.impact], 'm/s')}"
    return f"{out}; {why}" if why else out


def _pin(pid: int, processor: int) -> None:
    """Every thread of a process on one processor."""
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):
            os.sched_setaffinity(int(thread.name), {processor})
