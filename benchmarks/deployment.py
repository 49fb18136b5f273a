"""Deploying in flight: what it costs the control loop, and what bad networks do to the vehicle.

    python benchmarks/deployment.py [--seconds 20] [--json]

A companion flies the simulated vehicle in real time. First the latency from odometry to setpoint is taken
from its ticks, in quiet flight and while models are checked one after the other without a pause (each in a
process of its own) and evaluated in the shadow. Then deliberately bad networks are deployed in flight; the table
tells what became of each, and how far the vehicle was from its reference meanwhile: the greatest distance from
the deployment until 3 s after the outcome. For comparison the same trajectory with the plain cascade and with the
good model that was live before.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "companion"))

import numpy as np
from onnx_models import constant_model, deep_model, drag_model, linear_model, nan_model
from rig import Bridge, Companion, free_port, wait_for

from trueflight.models import contract
from trueflight.models.record_pb2 import Tick

FLIGHT = {"trajectory": "lemniscate", "parameters": {"laps": 30.0, "speed": 2.0}}
GOOD = drag_model(0.05)
OTHER = {"name": "quad7", "mass": 0.9, "hover_thrust": 0.38}
TEN = [{"name": n, "unit": u, "low": -1.0, "high": 1.0} for n, u in contract.FEATURES.items()]

BAD: dict[str, bytes] = {
    "garbage bytes": bytes(range(256)) * 8,
    "wrong shape (12 inputs)": linear_model(np.zeros((12, 3)), metadata={contract.KEY_FEATURES: TEN}),
    "other vehicle": constant_model(0, 0, 0, metadata={contract.KEY_VEHICLE: OTHER}),
    "slow (400 layers of 800)": deep_model(800, 400),
    "constant 50 m/s^2": constant_model(50.0, 0.0, 0.0),
    "constant 10 m/s^2": constant_model(10.0, 0.0, 0.0),
    "constant 2.9 m/s^2": constant_model(0.0, 2.9, 0.0),
    "NaN above 0.5 m/s": nan_model(0.1, 0.5),
    "wrong sign of drag": drag_model(-0.8),
}


def distance(ticks: list[Tick]) -> float:
    """Greatest distance from the reference, m."""
    return max(
        np.linalg.norm(
            [getattr(t.position, a) - getattr(t.position_reference, a) for a in ("x", "y", "z")]
        ).item()
        for t in ticks
        if t.phase == "mission"
    )


def latency(ticks: list[Tick]) -> dict[str, float]:
    values = 1e3 * np.array([tick.latency for tick in ticks if tick.setpoint_sent])
    gaps = np.array([tick.interval for tick in ticks])
    return {
        "ticks": len(values),
        "median_ms": float(np.median(values)),
        "p99_ms": float(np.percentile(values, 99)),
        "max_ms": float(values.max()),
        "longest_interval_ms": 1e3 * float(gaps.max()),
    }


def flying(companion: Companion, controller: str) -> str:
    mission = companion.fly(**FLIGHT, controller=controller)
    companion.phase("mission")
    time.sleep(3.0)
    return mission


def land(companion: Companion, mission: str) -> None:
    companion.ask("mission", {"command": "land"})
    companion.done(mission)


def deploy(companion: Companion, onnx: bytes, shadow: float) -> dict[str, Any]:
    key = f"{contract.key('quad5', 'model')}?shadow={shadow:g}"
    (reply,) = companion.session.get(key, payload=onnx, timeout=60.0)
    return dict(json.loads(reply.ok.payload.to_string()))


def outcome(companion: Companion, onnx: bytes, events: int) -> tuple[str, str]:
    """What became of a model in the shadow: the last event's kind and its text."""
    name = contract.model_hash(onnx)

    def found() -> list[Any]:
        new = companion.events[events:]
        return [e for e in new if e.kind in ("model_refused", "model_live", "guard_trip") and name in e.text]

    last = wait_for(found, f"what became of {name}")[-1]
    return last.kind, last.text.partition(": ")[2] or last.text


def measure_latency(companion: Companion, seconds: float) -> dict[str, Any]:
    mission = flying(companion, "corrected")
    begin = len(companion.ticks)
    time.sleep(seconds)
    quiet = latency(companion.ticks[begin:])
    begin, end, checks = len(companion.ticks), time.monotonic() + seconds, 0
    while time.monotonic() < end:
        events = len(companion.events)
        onnx = constant_model(2.0, 0.0, 0.001 * checks)
        if deploy(companion, onnx, 0.5)["accepted"]:
            outcome(companion, onnx, events)
        checks += 1
    busy = latency(companion.ticks[begin:])
    land(companion, mission)
    status = Path(f"/proc/{companion.child.pid}/status").read_text()
    resident = int(status.split("VmRSS:")[1].split()[0]) / 1024
    return {"quiet": quiet, "while_deploying": busy, "models": checks, "resident_mb": resident}


def measure_bad(companion: Companion) -> list[dict[str, Any]]:
    rows = []
    mission = flying(companion, "lqr")
    begin = len(companion.ticks)
    time.sleep(8.0)
    rows.append({"network": "(plain cascade)", "distance_m": distance(companion.ticks[begin:])})
    land(companion, mission)
    mission = flying(companion, "corrected")
    begin = len(companion.ticks)
    time.sleep(8.0)
    rows.append({"network": "(the good model alone)", "distance_m": distance(companion.ticks[begin:])})
    for name, onnx in BAD.items():
        begin, events = len(companion.ticks), len(companion.events)
        answer = deploy(companion, onnx, 3.0)
        if answer["accepted"]:
            kind, text = outcome(companion, onnx, events)
        else:
            kind, text = "refused by its check", answer["reason"]
        rows.append(row(companion, name, kind, text, begin))
    land(companion, mission)
    rows.append(turning_bad(companion))
    return rows


def row(companion: Companion, name: str, kind: str, text: str, begin: int) -> dict[str, Any]:
    time.sleep(3.0)
    words = {"model_refused": "refused in the shadow", "guard_trip": "tripped, rolled back"}
    ticks = companion.ticks[begin:]
    return {
        "network": name,
        "outcome": words.get(kind, kind),
        "reason": text,
        "distance_m": distance(ticks),
        "live_after": ticks[-1].model == contract.model_hash(GOOD),
    }


def turning_bad(companion: Companion) -> dict[str, Any]:
    """Good while the vehicle hovers through the shadow, NaN as soon as it moves: after it took over."""
    points = [(0.0, 0.0, 1.0)] * 9 + [(1.2, 0.0, 1.0), (2.4, 0.0, 1.0), (2.4, 0.0, 1.0), (2.4, 0.0, 1.0)]
    lines = [f"{t},{x},{y},{z},0,0,0,0,0,0,0" for t, (x, y, z) in enumerate(points)]
    csv = "t,x,y,z,vx,vy,vz,ax,ay,az,yaw\n" + "\n".join(lines)
    plain = companion.fly(setpoints=csv, controller="corrected")
    companion.phase("mission")
    begin = len(companion.ticks)
    companion.phase("landing")
    alone = distance(companion.ticks[begin:])
    companion.done(plain)
    mission = companion.fly(setpoints=csv, controller="corrected")
    companion.phase("mission")
    begin, events, onnx = len(companion.ticks), len(companion.events), nan_model(0.1, 0.6)
    deploy(companion, onnx, 2.0)
    wait_for(lambda: [e for e in companion.events[events:] if e.kind == "guard_trip"], "the trip")
    kind, text = outcome(companion, onnx, events)
    out = row(companion, "NaN only after it took over", kind, text, begin)
    companion.done(mission)
    return {**out, "reason": f"{text} (the good model alone on the same path: {alone:.3f} m)"}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--json", action="store_true")
    a = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        port = free_port()
        bridge = Bridge(port)
        try:
            companion = Companion(Path(folder), port)
            try:
                deploy(companion, GOOD, 3.0)
                result = {"latency": measure_latency(companion, a.seconds), "bad": measure_bad(companion)}
            finally:
                companion.end()
        finally:
            bridge.end()
    if a.json:
        print(json.dumps(result))
        return
    costs = result["latency"]
    for name in ("quiet", "while_deploying"):
        print(name, {key: round(value, 3) for key, value in costs[name].items()})
    print(f"{costs['models']} models checked and shadowed, {costs['resident_mb']:.0f} MB resident afterwards")
    for one in result["bad"]:
        print(
            f"{one['network']:28s} {one['distance_m']:.3f} m  {one.get('outcome', '')}: {one.get('reason', '')}"
        )


if __name__ == "__main__":
    main()
