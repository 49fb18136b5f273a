"""Hidden here, found, exported, flown there, found there: the table of docs/export.md.

    python tests/groundstation/round_trips.py [--itself] [TARGET ...]

The vehicle flies by the formulas of each simulator, with the numbers of its file; MuJoCo is itself. `--itself` flies
RotorPy and drone-models themselves, where they are installed (`SCIPY_ARRAY_API=1` for drone-models).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import elsewhere

from trueflight.groundstation.versions.store import refit
from trueflight.models.model import Model

FORMULAS = ("mujoco", "rotorpy", "crazyflow", "gazebo", "px4-sih")


def told(model: Model) -> str:
    """The fitted numbers of a model."""
    return "; ".join(
        f"{term.effect} {', '.join(f'{value:.3g}' for value in term.values.values())}"
        for term in model.terms
        if term.values
    )


def main() -> None:
    """Print one row a simulator and a set of hidden effects."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("targets", nargs="*", default=FORMULAS)
    parser.add_argument("--itself", action="store_true")
    asked = parser.parse_args()
    print("| flown in | found here, of what the file holds | fitted there | missing there |")  # noqa: T201
    print("|---|---|---|---|")  # noqa: T201
    with TemporaryDirectory() as name:
        folder = Path(name)
        for number, hidden in enumerate(elsewhere.HIDDEN.values()):
            model = elsewhere.found_in(elsewhere.flown(folder / f"ours{number}.mcap", 1, hidden))
            for to in asked.targets:
                made = elsewhere.itself if asked.itself or to == "mujoco" else elsewhere.formulas
                there = elsewhere.flown(folder / f"{to}{number}.mcap", 2, plant=made(model, to, folder))
                carried = elsewhere.held(model, to)
                left = ", ".join(elsewhere.missing(there, carried)) or "nothing"
                row = (to + " itself" * asked.itself, told(carried), told(refit(carried, [there])), left)
                print("| " + " | ".join(row) + " |", flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
