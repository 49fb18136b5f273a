"""The one number of each controller after another paper, by one rule: the value with the least geometric mean, over
the training flights, of its RMSE to the reference over that of `lqr`; a value that loses a flight, or whose body rates
jump from tick to tick more than twice as much as those of `lqr` in still air, is out.

Training flights are other trajectories and seeds than `groundstation compare-controllers` flies.

    python benchmarks/tune_controllers.py [--corrected FOLDER]

With `--corrected` the disturbance observer of `corrected` instead: two vehicles are prepared in the folder (two
minutes), all flights have the rich truth, and the distance is that to the expected linear behaviour, which it is for.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from trueflight.companion.law.behaviour import LinearBehaviour
from trueflight.companion.law.control import ControlLaw, euler
from trueflight.companion.law.controllers import Lqr
from trueflight.companion.law.geometric import Geometric
from trueflight.companion.law.indi import Indi
from trueflight.companion.law.l1_adaptive import L1Adaptive
from trueflight.companion.law.residual import ObserverLimits
from trueflight.companion.law.steps import Controller
from trueflight.models.design import load_design
from trueflight.models.shipped import QUAD5
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge import in_process
from trueflight.sim_bridge.plan import Plan, trajectory_of
from trueflight.sim_bridge.truth.hidden import choose

Make = Callable[[ControlLaw], Controller]
TRIED: dict[str, tuple[Callable[..., Controller], str, tuple[float, ...]]] = {
    "indi": (Indi, "frequency", (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)),
    "l1_adaptive": (L1Adaptive, "frequency", (0.025, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)),
    "geometric": (Geometric, "adaptation", (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)),
}
TRUTHS = (["none"], ["wind:3"], ["payload:0.1"], ["thrust_gain:0.88"], ["rotor_drag:0.5"], ["rich"])
SEEDS = (201, 202)
PUSHES = ([], ["wind:3"], ["payload:0.1"], ["thrust_gain:0.88"], ["rotor_damage:0.15@6"])
FREQUENCIES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
JUMPS = 2.0


def flown(make: Make, truth: list[str], seed: int) -> tuple[str, float, float]:
    """Outcome, RMSE (m) to the reference, and RMS of what the body rates jump by from tick to tick (rad/s)."""
    plan = _plan(truth, seed, controller="lqr")
    errors, rates = [], []

    def take(sample: in_process.Sample) -> None:
        if sample.mission:
            errors.append([p - r for p, r in zip(sample.position, sample.reference.position, strict=True)])
            rates.append(sample.step.command.body_rate[:2])

    with mock.patch.object(in_process, "make_controller", lambda name, law, *more: make(law)):
        done = in_process.fly(plan, take)
    square = np.square(errors).sum(axis=1)
    return done.outcome, float(np.sqrt(square.mean())), float(np.sqrt(np.mean(np.diff(rates, axis=0) ** 2)))


def _plan(truth: list[str], seed: int, **more: Any) -> Plan:
    vehicle = load_vehicle(QUAD5)
    design = load_design(Path(QUAD5).with_name("design.json"), vehicle)
    trajectory = trajectory_of("spiral", ["speed=2.5"])
    return Plan(vehicle, design, trajectory, choose(truth, vehicle, seed), seed, settle=4.0, **more)


def beside_the_linear_one(plan: Plan) -> tuple[str, float, float]:
    """Outcome, RMSE (m) to the expected linear behaviour, and what the body rates jump by (rad/s)."""
    errors, rates = [], []
    behaviours: list[LinearBehaviour] = []

    def take(sample: in_process.Sample) -> None:
        if not sample.mission:
            return
        now = sample.estimate
        if behaviours:
            behaviours[0].step(sample.reference, 1.0 / plan.rate)
        else:
            start = sample.position, now.velocity, euler(now.quaternion)
            behaviours.append(LinearBehaviour(plan.design, *start, sample.reference))
        errors.append(np.subtract(sample.position, behaviours[0].position))
        rates.append(sample.step.command.body_rate[:2])

    done = in_process.fly(plan, take)
    rms = float(np.sqrt(np.square(errors).sum(axis=1).mean()))
    return done.outcome, rms, float(np.sqrt(np.mean(np.diff(rates, axis=0) ** 2)))


def observer(folder: Path) -> None:
    """Print the table of the disturbance observer."""
    from trueflight.groundstation.study.reproduce import BOTH, prepare

    files = {}
    for seed in SEEDS:
        one = prepare(
            folder / f"vehicle-{seed}", Path(QUAD5), seed, ["--hidden", "rich"], 20.0, lambda what: None
        )
        files[seed] = one.files[BOTH].read_bytes()
    flights = [(["rich", *push], seed) for push in PUSHES for seed in SEEDS]
    base = [beside_the_linear_one(_plan(truth, seed, controller="lqr")) for truth, seed in flights]
    sys.stdout.write("| observer, Hz | RMSE over lqr's | jumps over lqr's | lost |\n|---|---|---|---|\n")
    for frequency in FREQUENCIES:
        limits = ObserverLimits(frequency)
        done = [
            beside_the_linear_one(_plan(truth, seed, model=files[seed], observer=limits))
            for truth, seed in flights
        ]
        ratio = np.exp(np.mean([np.log(d[1] / b[1]) for d, b in zip(done, base, strict=True)]))
        lost = sum(d[0] != "finished" for d in done)
        sys.stdout.write(f"| {frequency:g} | {ratio:.4f} | {done[0][2] / base[0][2]:.2f} | {lost} |\n")
        sys.stdout.flush()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--corrected", type=Path, help="folder for the vehicles that the observer is tuned with"
    )
    asked = parser.parse_args()
    if asked.corrected is not None:
        observer(asked.corrected)
        return
    flights = [(truth, seed) for truth in TRUTHS for seed in SEEDS]
    base = [flown(Lqr, *flight) for flight in flights]
    sys.stdout.write(
        "| controller | value | RMSE over lqr's | jumps over lqr's | lost |\n|---|---|---|---|---|\n"
    )
    for name, (make, parameter, values) in TRIED.items():
        for value in values:
            done = [flown(partial(make, **{parameter: value}), *flight) for flight in flights]
            ratio = np.exp(np.mean([np.log(d[1] / b[1]) for d, b in zip(done, base, strict=True)]))
            jumps = done[0][2] / base[0][2]
            lost = sum(d[0] != "finished" for d in done)
            out = " (out)" if lost or jumps > JUMPS else ""
            sys.stdout.write(
                f"| {name} | {parameter} {value:g} | {ratio:.3f} | {jumps:.2f}{out} | {lost} |\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main()
