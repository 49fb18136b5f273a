"""What a wrong model does in flight before the guard takes it back: the vehicle's own model, scaled and turned round.

    groundstation compare-controllers --seeds 1 --controller corrected --disturbance none -o FOLDER
    python benchmarks/wrong_models.py FOLDER [--vehicles 1]

Each `FOLDER/vehicle-N` holds what a simulated vehicle has taught. Its model, that times a factor, and constants are
flown in-process with `corrected`: on a lemniscate at 3 m/s, also in wind and with a payload, and on fast ones of 40 m.
Told are how the flight ended, the greatest distance from the reference, beside that of `lqr`, and when and why the
guard gave the model up, in s from the moment from which the model acted wholly.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import numpy as np
import onnx
from onnx import helper, numpy_helper

from trueflight.groundstation.study.disturbances import CHARGE
from trueflight.models import contract
from trueflight.models.contract import CORRECTED
from trueflight.models.design import load_design
from trueflight.models.reference import trajectory
from trueflight.models.shipped import QUAD5
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.in_process import Sample, fly
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.truth.battery import BatteryState
from trueflight.sim_bridge.truth.hidden import choose

FADE = 1.0
"""s until a model acts wholly."""
FAST = {"width": 40.0, "depth": 10.0, "height": 3.0, "laps": 1.0}
COURSES: dict[str, tuple[dict[str, float], tuple[str, ...]]] = {
    "lemniscate 3 m/s": ({"speed": 3.0, "climb": 0.8}, ()),
    "and wind of 3 m/s": ({"speed": 3.0, "climb": 0.8}, ("wind:3",)),
    "and payload of 40 %": ({"speed": 3.0, "climb": 0.8}, ("payload:0.4",)),
    "fast, 7.5 m/s": ({**FAST, "speed": 7.5}, ()),
    "fast, 10 m/s": ({**FAST, "speed": 10.0}, ()),
}
FACTORS = (1.0, 2.0, 3.0, 5.0, -1.0, -3.0)
CONSTANTS = ((4.0, 0.0, 0.0), (10.0, 0.0, 0.0), (0.0, 0.0, 6.0))


def changed(file: bytes, factor: float, added: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> bytes:
    """The model of a file, its answers times `factor` and with `added` (m/s²) to them, its golden vectors as well."""
    model = onnx.load_from_string(file)
    graph = model.graph
    for node in graph.node:
        for i, name in enumerate(node.output):
            if name == contract.OUTPUT_NAME:
                node.output[i] = "right"
    graph.initializer.append(numpy_helper.from_array(np.array(factor, np.float32), "wrong_factor"))
    graph.initializer.append(numpy_helper.from_array(np.array(added, np.float32), "wrong_added"))
    graph.node.append(helper.make_node("Mul", ["right", "wrong_factor"], ["scaled"]))
    graph.node.append(helper.make_node("Add", ["scaled", "wrong_added"], [contract.OUTPUT_NAME]))
    for entry in model.metadata_props:
        if entry.key == contract.KEY_GOLDEN_DELTA:
            golden = [
                [factor * x + a for x, a in zip(row, added, strict=True)] for row in json.loads(entry.value)
            ]
            entry.value = json.dumps(golden)
    return bytes(model.SerializeToString())


def flown(seed: int, course: str, model: bytes | None) -> tuple[str, float, float, str]:
    """How the flight ended, the greatest distance from the reference (m), and when and why the model was given up."""
    vehicle = load_vehicle(QUAD5)
    settings, hidden = COURSES[course]
    plan = Plan(
        vehicle,
        load_design(Path(QUAD5).with_name("design.json"), vehicle),
        trajectory("lemniscate", **settings),
        choose(["rich", *hidden], vehicle, seed),
        seed,
        model=model,
        battery=BatteryState(charge=CHARGE),
        controller=CORRECTED if model else "lqr",
    )
    furthest, when, why, begun = 0.0, math.nan, "", -1

    def each(sample: Sample) -> None:
        nonlocal furthest, when, why, begun
        begun = sample.estimate.time_us if begun < 0 else begun
        furthest = max(furthest, math.dist(sample.position, sample.reference.position))
        if sample.guard.startswith("tripped") and not why:
            when, why = (
                1e-6 * (sample.estimate.time_us - begun) - FADE,
                sample.guard.removeprefix("tripped: "),
            )

    return fly(plan, each).outcome, furthest, when, why


def main() -> None:
    """Fly and tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--vehicles", type=int, default=1)
    asked = parser.parse_args()
    for seed in range(1, asked.vehicles + 1):
        right = (asked.folder / f"vehicle-{seed}" / "effects-and-network.onnx").read_bytes()
        wrong = {f"times {factor:g}": changed(right, factor) for factor in FACTORS}
        wrong |= {f"constant {c}": changed(right, 0.0, c) for c in CONSTANTS}
        for course in COURSES:
            _, plain, _, _ = flown(seed, course, None)
            for name, model in wrong.items():
                outcome, furthest, when, why = flown(seed, course, model)
                told = f"after {when:5.2f} s: {why}" if why else "never"
                print(
                    f"{course:20s} {name:26s} {outcome:9s} {furthest:5.2f} m (lqr {plain:4.2f})  {told}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
