"""The paper's recipe beside the project's own, on the same flights, the same split and one thread.

    python benchmarks/training_recipes.py FOLDER... [--seeds 0,1,2] [--recipes default,paper] [--epochs N]

Each FOLDER holds the records of one vehicle (`sim-bridge collect --hidden rich --seed 1 -o FOLDER`). Prints the
held-out RMS, wall and processor time, and when the first recipe reached the final loss of the last.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from trueflight.groundstation.learn.training import recipe_named, train, with_epochs
from trueflight.groundstation.learn.training_data import samples_of_flights
from trueflight.groundstation.reading.several import read_flights
from trueflight.models.model import rigid_body_model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--recipes", default="default,paper")
    parser.add_argument("--epochs", type=int)
    asked = parser.parse_args()
    for folder in asked.folders:
        flights = read_flights([folder])
        samples = samples_of_flights(flights, rigid_body_model(flights[0].vehicle))
        print(f"{folder}: {samples.seconds / 60:.1f} min, noise floor {samples.noise_floor:.4f} m/s^2")
        for seed in map(int, asked.seeds.split(",")):
            done = []
            for name in asked.recipes.split(","):
                begin = time.process_time()
                result = train(samples, with_epochs(recipe_named(name), asked.epochs), seed=seed)
                cpu, fit = time.process_time() - begin, result.network.fit
                print(
                    f"  seed {seed} {name:8s} held out {fit['validation_rms']:.4f} m/s^2, epoch {result.best} of "
                    f"{len(result.history)}, {result.seconds:.1f} s, processor {cpu:.1f} s",
                    flush=True,
                )
                done.append(result)
            goal, seconds = done[-1].network.fit["validation_rms"], 0.0
            for number, epoch in enumerate(done[0].history, 1):
                seconds += epoch.seconds
                if epoch.validation_rms <= goal:
                    print(f"  the first reaches the last one's loss in epoch {number}, after {seconds:.1f} s")
                    break


if __name__ == "__main__":
    main()
