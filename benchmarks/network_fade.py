"""How a network should fade outside the flights that it was trained on: candidates beside each other, offline.

    groundstation compare-controllers --seeds 5 --controller corrected --disturbance none -o FOLDER
    python benchmarks/network_fade.py FOLDER [--json]

Each `FOLDER/vehicle-N` holds a simulated vehicle's training flights, its effects, and the network beside them. Flights
like those of training and unlike them are flown with the effects alone (and kept there); then it is told what of their
error acceleration is left by the effects alone, and how much more (+) or less (-) is left when a network is added that
fades as a candidate says: RMS over three axes in mm/s^2, median of the vehicles, the worst in brackets, and the
mean share of the network that acts. The candidates know the training flights' features alone.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.cluster.vq import kmeans2

from trueflight.groundstation.learn import training_data
from trueflight.groundstation.learn.training import OWN, train
from trueflight.groundstation.learn.training_data import Samples, samples_of_flights, split
from trueflight.groundstation.reading import read_flight
from trueflight.models.model import read_model
from trueflight.models.network import Network, error_acceleration_of

VEHICLE = Path(__file__).parents[1] / "models" / "vehicles" / "quad5" / "vehicle.toml"
_EIGHT = ("--trajectory", "lemniscate", "--set", "climb=0.8", "--set")
_STEPS = ("--trajectory", "scenario", "--set", "speed=3", "--set", "seed=107")
FLIGHTS: dict[str, tuple[str, ...]] = {
    "none": (*_EIGHT, "speed=3"),
    "steps": _STEPS,
    "wind 3": (*_EIGHT, "speed=3", "--hidden", "wind:3"),
    "payload 12 %": (*_EIGHT, "speed=3", "--hidden", "payload:0.12"),
    "payload 40 %": (*_EIGHT, "speed=3", "--hidden", "payload:0.4"),
    "thrust 0.85": (*_EIGHT, "speed=3", "--hidden", "thrust_gain:0.85"),
    "old, steps": (*_STEPS, "--battery-age", "1.5"),
    "very old": (*_STEPS, "--battery-age", "2.5"),
    "empty": (*_EIGHT, "speed=3", "--charge", "0.12"),
    "fast 4.5": (*_EIGHT, "speed=4.5"),
    "fast 6": (*_EIGHT, "speed=6", "--set", "width=10", "--set", "depth=5"),
    "high 8 m": (*_EIGHT, "speed=3", "--set", "height=8"),
    "high 20 m": (*_EIGHT, "speed=3", "--set", "height=20"),
}
Fade = Callable[[np.ndarray], np.ndarray]
"""From features (N, F) to the share (N,) of the network that acts."""
HELD = ", held at the border"
"""Ends the name of a candidate whose network is asked at the nearest point of the training range."""
QUANTILE = 0.999
"""Share of the training samples at which a candidate's distance begins to fade."""


def between(distance: np.ndarray, begins: float, multiple: float) -> np.ndarray:
    """1 up to a distance, nothing at `multiple` times it."""
    return np.clip((multiple * begins - distance) / ((multiple - 1.0) * begins), 0.0, 1.0)


def candidates(x: np.ndarray, network: Network, others: list[Network], boxes: bool) -> dict[str, Fade]:
    """Every candidate, from the training features `x` (N, F) in the order of the network's."""
    found: dict[str, Fade] = {"never": lambda f: np.ones(len(f))}
    low, high = np.quantile(x, (1.0 - QUANTILE, QUANTILE), axis=0)

    def by_distance(name: str, distance: Fade, multiples: tuple[float, ...] = (1.25, 2.0)) -> None:
        begins = float(np.quantile(distance(x), QUANTILE))
        for m in multiples:
            found[f"{name}, {m:g}"] = lambda f, m=m: between(distance(f), begins, m)

    found[f"never{HELD}"] = found["never"]
    angles = np.array([not name.startswith("cos_") for name in network.features])
    for share in (0.1, 0.25, 0.5, 1.0):
        margin = share * (high - low)

        def outside(f: np.ndarray, m: np.ndarray = margin) -> np.ndarray:
            return np.asarray(np.maximum(np.maximum(low - f, f - high), 0.0) / m)

        found[f"box, worst feature, {share:g}"] = lambda f, o=outside: np.clip(1.0 - o(f).max(axis=1), 0, 1)
        found[f"box, sum, {share:g}"] = lambda f, o=outside: np.clip(1.0 - o(f).sum(axis=1), 0, 1)
        found[f"box, sum without cosines, {share:g}"] = lambda f, o=outside: np.clip(
            1.0 - o(f)[:, angles].sum(axis=1), 0, 1
        )
        found[f"box, sum, {share:g}{HELD}"] = found[f"box, sum, {share:g}"]
    if boxes:
        return found
    centre, inverse = x.mean(axis=0), np.linalg.inv(np.cov(x.T))
    by_distance("Mahalanobis", lambda f: np.sqrt(np.einsum("ni,ij,nj->n", f - centre, inverse, f - centre)))
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    by_distance("ellipsoid of the ranges", lambda f: np.sqrt((((f - middle) / half) ** 2).sum(axis=1)))
    y = (x - middle) / half
    points, _ = kmeans2(y[:: max(1, len(y) // 20000)], 64, seed=0, minit="++")
    by_distance(
        "nearest of 64 means",
        lambda f: np.sqrt((((f - middle) / half)[:, None] - points).__pow__(2).sum(axis=2).min(axis=1)),
    )

    def hidden(f: np.ndarray) -> np.ndarray:
        h = (f - network.centre) / network.scale
        for weights, biases in network.layers[:-1]:
            h = np.maximum(h @ weights.T + biases, 0.0)
        return h

    h = hidden(x)
    mean, cov = h.mean(axis=0), np.cov(h.T) + 1e-3 * np.eye(h.shape[1]) * h.var(axis=0).mean()
    whitening = np.linalg.inv(cov)
    by_distance(
        "last hidden layer",
        lambda f: np.sqrt(np.einsum("ni,ij,nj->n", hidden(f) - mean, whitening, hidden(f) - mean)),
    )
    draw = np.random.default_rng(0)
    project, offset = draw.normal(size=(x.shape[1], 64)), draw.normal(size=64)

    def embedded(f: np.ndarray) -> np.ndarray:
        return np.asarray(np.maximum(((f - middle) / half) @ project + offset, 0.0))

    e = embedded(x)
    e_mean, e_white = e.mean(axis=0), np.linalg.inv(np.cov(e.T) + 1e-3 * np.eye(64) * e.var(axis=0).mean())
    by_distance(
        "random features",
        lambda f: np.sqrt(np.einsum("ni,ij,nj->n", embedded(f) - e_mean, e_white, embedded(f) - e_mean)),
    )
    if others:

        def spread(f: np.ndarray) -> np.ndarray:
            said = np.stack([error_acceleration_of(one, f.astype(np.float32)) for one in (network, *others)])
            return np.sqrt(said.var(axis=0).sum(axis=1))

        by_distance("ensemble of 4", spread)
    return found


def flown(folder: Path, seed: int, name: str) -> Path:
    """The record of one of `FLIGHTS`, with the effects alone; kept."""
    path = folder / f"fade-{name.replace(' ', '-').replace(',', '').replace('%', '')}.mcap"
    if not path.exists():
        words = ["sim-bridge", "fly", "--vehicle", VEHICLE, "--hidden", "rich", "--seed", seed, "--settle", 4]
        words += [] if "--charge" in FLIGHTS[name] else ["--charge", 0.6]
        words += [*FLIGHTS[name], "-o", path, "--controller", "corrected", "--model", folder / "effects.onnx"]
        subprocess.run(list(map(str, words)), check=True, capture_output=True)
    return path


def one_vehicle(
    folder: Path, ensemble: bool, alone: bool, boxes: bool
) -> dict[str, dict[str, tuple[float, float, float]]]:
    """By flight and candidate: RMS without network, with it, and its mean share; m/s²."""
    seed = int(folder.name.rsplit("-", 1)[1])
    both = read_model(folder / ("network.json" if alone else "effects-and-network.json"))
    assert both.network is not None
    effects, network = both.with_network(None), replace(both.network, margin=None)
    trained = samples_of_flights(
        [read_flight(p) for p in sorted((folder / "flights").glob("*.mcap"))], effects
    )
    trained = trained.with_features(network.features)
    sides = split(trained, network.seed)
    others = []
    if ensemble:
        recipe = replace(OWN, epochs=30)
        trainings = [train(trained, recipe, seed=network.seed + 10 * k) for k in (1, 2, 3)]
        others = [replace(one.network, margin=None) for one in trainings]
    fades = candidates(trained.features[sides[0]].astype(float), network, others, boxes)
    parts = {"held out": trained.only(sides[1])}
    training_data.LEAST_SECONDS = 5.0  # a flight to look at may be short
    for name in FLIGHTS:
        flight = read_flight(flown(folder, seed, name))
        if len(flight) * flight.dt > 10.0 and flight.battery_voltage is not None:  # one may be lost at once
            parts[name] = samples_of_flights([flight], effects).with_features(network.features)
    return {name: _left(part, network, fades) for name, part in parts.items()}


def _left(part: Samples, network: Network, fades: dict[str, Fade]) -> dict[str, tuple[float, float, float]]:
    said = error_acceleration_of(network, part.features)
    held = error_acceleration_of(network, np.clip(part.features, network.low, network.high))
    before = _rms(part.target)
    found = {}
    for name, fade in fades.items():
        share = fade(part.features.astype(float))
        found[name] = (
            before,
            _rms(part.target - share[:, None] * (held if name.endswith(HELD) else said)),
            float(share.mean()),
        )
    return found


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error.astype(float) ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--no-ensemble", action="store_true", help="leave out the candidate that is trained")
    parser.add_argument("--boxes", action="store_true", help="the boxes alone")
    parser.add_argument(
        "--alone", action="store_true", help="the network beside the linear model, without effects"
    )
    parser.add_argument("--json", action="store_true")
    a = parser.parse_args()
    vehicles = [
        one_vehicle(f, not (a.no_ensemble or a.boxes), a.alone, a.boxes)
        for f in sorted(a.folder.glob("vehicle-*"))
    ]
    if a.json:
        print(json.dumps(vehicles))
        return
    flights = [name for name in vehicles[0] if all(name in one for one in vehicles)]
    print("| " + " | ".join(["mm/s^2", *flights]) + " |")
    print("|" + "---|" * (len(flights) + 1))
    alone = [[1e3 * v[flight]["never"][0] for v in vehicles] for flight in flights]
    print("| effects alone | " + " | ".join(f"{np.median(a):.0f}" for a in alone) + " |")
    for name in vehicles[0][flights[0]]:
        cells = []
        for flight in flights:
            more = [1e3 * (v[flight][name][1] - v[flight][name][0]) for v in vehicles]
            share = np.mean([v[flight][name][2] for v in vehicles])
            cells.append(f"{np.median(more):+.0f} ({max(more):+.0f}) {share:.2f}")
        print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
