"""Hangs, takeovers, lost links and kills: how soon the companion is silent, and what it leaves behind."""

from __future__ import annotations

import json
import math
import random
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import zenoh
from mitm import lost, nothing
from onnx_models import drag_model
from promise import Row, spread
from rig import wait_for
from scene import FOREVER, Scene

from trueflight.models import contract
from trueflight.models.errors import InputError
from trueflight.models.record import read_record

GOAL = 0.05
"""s after which no setpoint may leave any more."""
HANG = 2.0
"""s for which a control thread sleeps or spins before it comes back."""

HANGS = f"""
import signal, time
from trueflight.companion.law.control import ControlLaw
hangs = []
signal.signal(signal.SIGUSR1, lambda *_: hangs.append(0.1))
signal.signal(signal.SIGUSR2, lambda *_: hangs.append(0.0))
step = ControlLaw.step
def hanging(self, *arguments, **named):
    if hangs:
        rest, end = hangs.pop(), time.monotonic() + {HANG}
        while time.monotonic() < end:
            if rest:
                time.sleep(rest)
    return step(self, *arguments, **named)
ControlLaw.step = hanging
"""


@dataclass(frozen=True)
class Silence:
    """One of them: s to the last setpoint, setpoints that left after `GOAL`, s until the vehicle left Offboard."""

    last: float
    late: int
    left: float


def _signal(number: int) -> Callable[[Scene], float]:
    def trouble(scene: Scene) -> float:
        begin = time.monotonic()
        scene.companion.send(number)
        wait_for(lambda: scene.middle.left("OFFBOARD", begin) < 60.0, "the offboard-loss failsafe")
        if number == signal.SIGSTOP:
            time.sleep(max(HANG - (time.monotonic() - begin), 0.0))
            scene.companion.send(signal.SIGCONT)
        time.sleep(max(begin + HANG + 0.5 - time.monotonic(), 0.0))
        return begin

    return trouble


def _mode_of_a_ground_station(scene: Scene) -> float:
    begin = time.monotonic()
    scene.command_mode(4, 3)
    return begin


def _pilot(mode: str) -> Callable[[Scene], float]:
    def trouble(scene: Scene) -> float:
        begin = time.monotonic()
        scene.bridge.pilot(mode)
        return begin

    return trouble


def _link(*directions: bool) -> Callable[[Scene], float]:
    def trouble(scene: Scene) -> float:
        begin = time.monotonic()
        scene.middle.fault = lost(*directions)
        wait_for(lambda: scene.middle.left("OFFBOARD", begin) < 60.0, "the offboard-loss failsafe")
        if directions == (False,):
            # The companion hears everything and cannot know before the vehicle tells of its failsafe.
            begin += scene.middle.left("OFFBOARD", begin)
        time.sleep(0.5)
        scene.middle.fault = nothing
        return begin

    return trouble


KINDS: dict[str, Callable[[Scene], float]] = {
    "control thread asleep for 2 s": _signal(signal.SIGUSR1),
    "control thread spinning for 2 s": _signal(signal.SIGUSR2),
    "process stopped (SIGSTOP), then continued": _signal(signal.SIGSTOP),
    "a ground station chooses Hold": _mode_of_a_ground_station,
    "the pilot takes over (Position)": _pilot("POSCTL"),
    "kill switch": _pilot("KILL"),
    "link lost from the vehicle": _link(True),
    "link lost to the vehicle (from its failsafe on)": _link(False),
    "link lost both ways": _link(True, False),
}
"""Each begins a trouble in a flight, and returns from when on (monotonic s) the companion should be silent."""


def silences(folder: Path, times: int, seed: int) -> Iterator[Row]:
    """`times` of each kind, with a companion that lives on: not one setpoint may come later."""
    draw = random.Random(seed)
    with Scene(folder, before=HANGS) as scene:
        for name, trouble in KINDS.items():
            found = [_one(scene, trouble, draw.uniform(0.3, 1.5)) for _ in range(times)]
            yield _row(name, found)


def _one(scene: Scene, trouble: Callable[[Scene], float], wait: float) -> Silence:
    scene.fly()
    time.sleep(wait)
    begin = trouble(scene)
    time.sleep(0.5)
    if scene.middle.mode == "UNKNOWN" or not scene.middle.armed:
        scene.down()
    scene.land()
    scene.bridge.pilot("RELEASE_KILL")
    after = scene.middle.setpoints_since(begin)
    return Silence(
        max(after, default=0.0), sum(t > GOAL for t in after), scene.middle.left("OFFBOARD", begin)
    )


def _row(name: str, found: list[Silence]) -> Row:
    left = [one.left for one in found if math.isfinite(one.left)]
    seen = f"last after {spread((one.last for one in found), 'ms', 1e3)}; later ones: {sum(one.late for one in found)}"
    if left and max(left) > 0.2:
        seen += f"; out of Offboard after {spread(left, 's')}"
    promised = f"the last setpoint within {1e3 * GOAL:.0f} ms, none later, also after waking up"
    return Row(name, len(found), promised, seen, all(one.last <= GOAL for one in found))


def kills(folder: Path, times: int, seed: int) -> Iterator[Row]:
    """SIGKILL at random moments of a flight, every second time while a model is deployed and kept."""
    draw = random.Random(seed)
    silent: list[Silence] = []
    woken = 0
    unusable: list[str] = []
    networks = {""}
    with Scene(folder) as scene:
        for number in range(times):
            onnx = drag_model(round(draw.uniform(0.01, 0.2), 6)) if number % 2 else b""
            networks.add(contract.model_hash(onnx) if onnx else "")
            silent.append(_kill(scene, draw.uniform(1.5, 9.0), onnx, draw.uniform(0.0, 1.0)))
            begin = time.monotonic()
            scene.restart()
            scene.down()
            woken += len(scene.middle.setpoints_since(begin))
            unusable += _unusable(scene, networks)
        records = sorted(scene.companion.records.glob("*.mcap"))
        # The last restart must be able to fly.
        scene.fly()
        flew = scene.middle.mode == "OFFBOARD"
        scene.land()
    yield _row("process killed (SIGKILL) at a random moment", silent)
    yield _readable(records, times)
    promised = "usable, the live model one that was deployed"
    seen = "; ".join(sorted(set(unusable))) or "usable each time"
    yield Row("store of models after a kill", times, promised, seen, not unusable)
    promised = "sends nothing before the landing; the last one flies again"
    seen = f"{woken} setpoints; the last one {'flew' if flew else 'did not fly'}"
    yield Row("started again at once", times, promised, seen, flew and not woken)


def _readable(records: list[Path], times: int) -> Row:
    unreadable, ticks = [], []
    for path in records:
        try:
            ticks.append(len(read_record(path).ticks["t"]))
        except InputError as error:
            unreadable.append(str(error))
    seen = f"{len(records)} records, {len(unreadable)} unreadable; {min(ticks, default=0)} to "
    seen += f"{max(ticks, default=0)} ticks recovered"
    return Row("records of the killed flights", times, "every one readable", seen, not unreadable)


def _kill(scene: Scene, moment: float, onnx: bytes, earlier: float) -> Silence:
    scene.companion.fly(**FOREVER)
    deploying = threading.Thread(target=_deploy, args=(scene.companion.session, onnx))
    time.sleep(max(moment - earlier, 0.0))
    if onnx:
        deploying.start()
    time.sleep(min(earlier, moment))
    flying = scene.middle.mode == "OFFBOARD"
    begin = time.monotonic()
    scene.companion.send(signal.SIGKILL)
    if flying:
        wait_for(lambda: scene.middle.left("OFFBOARD", begin) < 60.0, "the offboard-loss failsafe")
    time.sleep(0.2)
    if onnx:
        deploying.join()
    after = scene.middle.setpoints_since(begin)
    left = scene.middle.left("OFFBOARD", begin) if flying else math.inf
    return Silence(max(after, default=0.0), sum(t > GOAL for t in after), left)


def _deploy(session: zenoh.Session, onnx: bytes) -> None:
    list(session.get(contract.key("quad5", "model") + "?shadow=0.5", payload=onnx, timeout=3.0))


def _unusable(scene: Scene, networks: set[str]) -> list[str]:
    """What is wrong with the store of models after a restart."""
    told = [text for text in scene.companion.told("model_refused") if "no longer accepted" in text]
    answer = json.loads(scene.companion.query("model", {"command": "list"}).payload.to_string())
    if not answer["accepted"]:
        told.append(answer["reason"])
    elif answer["live"] not in networks:
        told.append(f"live is {answer['live']}, which nobody deployed")
    return told
