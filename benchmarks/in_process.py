"""How fast flights in-process are: one by one and many at once, against bare MuJoCo stepping the same model here.

    python benchmarks/in_process.py [--vehicle FILE] [--repeat 3] [--together 10,100,1000] [--json]

One core, by its processor's time. Physics at 500 Hz, the companion's control law at 100 Hz, sensor noise on, every
tick recorded where it says so. The best of several runs is shown, since a busy machine only ever makes them slower.
`corrected` flies the effects and network of `correction_models.py`. Exit code 1 where a flight alone without a record
misses `--target` times real time.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import mujoco

from trueflight.models.design import load_design
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.in_process import fly, record
from trueflight.sim_bridge.many.flight import fly_many
from trueflight.sim_bridge.many.records import record_many
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.simulator import Simulator
from trueflight.sim_bridge.truth.effects import EFFECTS
from trueflight.sim_bridge.truth.hidden import choose
from trueflight.sim_bridge.world import PHYSICS_STEP, World

QUAD5 = Path(__file__).parents[1] / "models/vehicles/quad5/vehicle.toml"


def best(repeat: int, run: Callable[[], float]) -> float:
    """The greatest of several measurements of simulated over wall time."""
    return max(run() for _ in range(repeat))


def bare(world: World, steps: int) -> float:
    """Simulated over wall time of MuJoCo alone, from a Python loop, with the wrench that carries the
    weight.
    """
    world.place((0.0, 0.0, 5.0))
    world.wrench[2] = float(world.model.body_mass[1]) * 9.81
    step, model, data = mujoco.mj_step, world.model, world.data
    begin = time.process_time()
    for _ in range(steps):
        step(model, data)
    return steps * PHYSICS_STEP / (time.process_time() - begin)


def vehicle_alone(simulator: Simulator, steps: int, command: float) -> float:
    """World, truth and inner loop without control law, estimate or record."""
    simulator.start_in_hover((0.0, 0.0, 5.0))
    begin = time.process_time()
    for _ in range(steps):
        simulator.step(command, 0.0, 0.0, 0.0)
    return steps * PHYSICS_STEP / (time.process_time() - begin)


def alone(plan: Plan) -> float:
    """Simulated over processor's time of one flight."""
    begin = time.process_time()
    return fly(plan, lambda sample: None).simulated / (time.process_time() - begin)


def together(plans: list[Plan], keep: bool) -> float:
    """Vehicle-seconds a second of processor's time of many flights at once, into files where they are kept."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.process_time()
        if keep:
            flown = record_many(plans, [Path(folder) / f"{i}.mcap" for i in range(len(plans))])
        else:
            flown = fly_many(plans)
        return sum(one.simulated for one in flown) / (time.process_time() - begin)


def recorded(plan: Plan) -> float:
    """Simulated over wall time of a flight into a file, opening and closing included."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.process_time()
        flown = record(plan, Path(folder) / "flight.mcap")
        return flown.simulated / (time.process_time() - begin)


def measure(
    vehicle_file: Path, repeat: int, counts: list[int], models: Path, effects: bool
) -> Iterator[tuple[str, float]]:
    """What is measured, by name, in vehicle-seconds a second, one after the other."""
    vehicle = load_vehicle(vehicle_file)
    design = load_design(vehicle_file.with_name("design.json"), vehicle)
    # Well above the ground, where MuJoCo has no contact to solve; the same flight for every line.
    plan = Plan(vehicle, design, trajectory("lemniscate", height=1.2), seed=1)
    corrected = replace(plan, model=(models / "both.onnx").read_bytes(), controller="corrected")
    world = World(vehicle)
    steps = 20_000
    yield "bare MuJoCo", best(repeat, lambda: bare(world, steps))
    yield "vehicle", best(repeat, lambda: vehicle_alone(Simulator(vehicle), steps, vehicle.hover_thrust))
    yield "flight", best(repeat, lambda: alone(plan))
    yield "flight, recorded", best(repeat, lambda: recorded(plan))
    yield "flight, corrected", best(repeat, lambda: alone(corrected))
    for name in (*EFFECTS, "rich") if effects else ():
        hiding = replace(plan, hidden=choose([name], vehicle, 1))
        yield f"flight, {name}", best(repeat, lambda p=hiding: alone(p))
    short = trajectory("steps", count=1.0, time=2.0)
    for count in counts:
        for name, kind, hides, keep in (
            ("plain", plan, "none", False),
            ("any effect", plan, "any", False),
            ("any effect, recorded", plan, "any", True),
            ("corrected, rich", corrected, "rich", False),
        ):
            many = [
                replace(kind, trajectory=short, seed=i, hidden=choose([hides], vehicle, i))
                for i in range(count)
            ]
            yield f"{count} at once, {name}", best(repeat, lambda m=many, k=keep: together(m, k))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicle", type=Path, default=QUAD5)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--target", type=float, default=100.0)
    parser.add_argument("--together", default="10,100,1000", help="flights at once, with commas")
    parser.add_argument("--models", type=Path, default=Path("build/correction_models"))
    parser.add_argument("--no-effects", action="store_true", help="leave out a flight with each effect")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    if not (arguments.models / "both.onnx").exists():
        arguments.models.mkdir(parents=True, exist_ok=True)
        script = Path(__file__).with_name("correction_models.py")
        subprocess.run([sys.executable, script, arguments.models], check=True)
    counts = [int(count) for count in arguments.together.split(",") if count]
    times = {}
    for name, value in measure(
        arguments.vehicle, arguments.repeat, counts, arguments.models, not arguments.no_effects
    ):
        times[name] = value
        if not arguments.json:
            print(f"{name:36} {value:7.0f} vehicle-seconds a second", flush=True)
    if arguments.json:
        print(json.dumps({"vehicle_seconds_a_second": times, "core": sorted(os.sched_getaffinity(0))}))
    raise SystemExit(0 if times["flight"] >= arguments.target else 1)


if __name__ == "__main__":
    main()
