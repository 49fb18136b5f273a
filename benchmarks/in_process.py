"""How fast flights in-process are: against real time, and against bare MuJoCo stepping the same model in this
run.

    python benchmarks/in_process.py [--vehicle FILE] [--repeat 3] [--json]

One core. Physics at 500 Hz, the companion's control law at 100 Hz, sensor noise on, every tick recorded where
it says so. The best of several runs is shown, since a busy machine only ever makes them slower. Exit code 1
where the flight without a record misses `--target` times real time.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import mujoco

from trueflight.models.design import load_design
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.in_process import fly, record
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
    begin = time.perf_counter()
    for _ in range(steps):
        step(model, data)
    return steps * PHYSICS_STEP / (time.perf_counter() - begin)


def vehicle_alone(simulator: Simulator, steps: int, command: float) -> float:
    """World, truth and inner loop without control law, estimate or record."""
    simulator.start_in_hover((0.0, 0.0, 5.0))
    begin = time.perf_counter()
    for _ in range(steps):
        simulator.step(command, 0.0, 0.0, 0.0)
    return steps * PHYSICS_STEP / (time.perf_counter() - begin)


def recorded(plan: Plan) -> float:
    """Simulated over wall time of a flight into a file, opening and closing included."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        flown = record(plan, Path(folder) / "flight.mcap")
        return flown.simulated / (time.perf_counter() - begin)


def measure(vehicle_file: Path, repeat: int) -> dict[str, object]:
    vehicle = load_vehicle(vehicle_file)
    design = load_design(vehicle_file.with_name("design.json"), vehicle)
    # Well above the ground, where MuJoCo has no contact to solve; the same flight for every line.
    plan = Plan(vehicle, design, trajectory("excitation", low=0.5), seed=1)
    world = World(vehicle)
    steps = 20_000
    times: dict[str, float] = {
        "bare MuJoCo": best(repeat, lambda: bare(world, steps)),
        "vehicle": best(repeat, lambda: vehicle_alone(Simulator(vehicle), steps, vehicle.hover_thrust)),
        "flight": best(repeat, lambda: fly(plan, lambda sample: None).times_real_time),
        "flight, recorded": best(repeat, lambda: recorded(plan)),
    }
    for name in (*EFFECTS, "rich"):
        hiding = Plan(vehicle, design, plan.trajectory, choose([name], vehicle, 1), 1)
        times[f"flight, {name}"] = best(repeat, lambda p=hiding: fly(p, lambda sample: None).times_real_time)
    ratio = times["flight"] / times["bare MuJoCo"]
    return {"times_real_time": times, "share_of_bare_mujoco": ratio, "core": sorted(os.sched_getaffinity(0))}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicle", type=Path, default=QUAD5)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--target", type=float, default=100.0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    report = measure(arguments.vehicle, arguments.repeat)
    times: dict[str, float] = report["times_real_time"]  # type: ignore[assignment]
    if arguments.json:
        print(json.dumps(report))
    else:
        for name, value in times.items():
            print(f"{name:30} {value:7.0f} times real time")
        print(
            f"a flight is {report['share_of_bare_mujoco']:.2f} times as fast as bare MuJoCo (target 0.14: 100 of 740)"
        )
    raise SystemExit(0 if times["flight"] >= arguments.target else 1)


if __name__ == "__main__":
    main()
