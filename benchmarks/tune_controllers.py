"""The one number of each controller after another paper, by one rule: the value with the least geometric mean, over
the training flights, of its RMSE to the reference over that of `lqr`; a value that loses a flight, or whose body rates
jump from tick to tick more than twice as much as those of `lqr` in still air, is out.

Training flights are other trajectories and seeds than `groundstation compare-controllers` flies.

    python benchmarks/tune_controllers.py
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np

from trueflight.companion.law.control import ControlLaw
from trueflight.companion.law.controllers import Lqr
from trueflight.companion.law.geometric import Geometric
from trueflight.companion.law.indi import Indi
from trueflight.companion.law.l1_adaptive import L1Adaptive
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
JUMPS = 2.0


def flown(make: Make, truth: list[str], seed: int) -> tuple[str, float, float]:
    """Outcome, RMSE (m) to the reference, and RMS of what the body rates jump by from tick to tick (rad/s)."""
    vehicle = load_vehicle(QUAD5)
    design = load_design(Path(QUAD5).with_name("design.json"), vehicle)
    trajectory = trajectory_of("spiral", ["speed=2.5"])
    plan = Plan(
        vehicle,
        design,
        trajectory,
        choose(truth, vehicle, seed),
        seed,
        controller="lqr",
        settle=4.0,
    )
    errors, rates = [], []

    def take(sample: in_process.Sample) -> None:
        if sample.mission:
            errors.append([p - r for p, r in zip(sample.position, sample.reference.position, strict=True)])
            rates.append(sample.step.command.body_rate[:2])

    with mock.patch.object(in_process, "make_controller", lambda name, law, guard, trim: make(law)):
        done = in_process.fly(plan, take)
    square = np.square(errors).sum(axis=1)
    return done.outcome, float(np.sqrt(square.mean())), float(np.sqrt(np.mean(np.diff(rates, axis=0) ** 2)))


def main() -> None:
    """Print the table."""
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
