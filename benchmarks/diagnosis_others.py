"""Which effect is missing: trueflight's diagnosis beside what else one would use, on the same flights in the same run.

    python benchmarks/diagnosis_others.py [--flights 24] [--first 1] [--json]

Flights of the simulator with nothing, one or two effects hidden, drawn by the seed; every method sees the same flight
and the same candidate terms:

* PySINDy: STLSQ (Brunton, Proctor & Kutz 2016) on the candidates' columns at their typical size, with its default
  threshold of 0.1 (a tenth of a typical effect), and with the threshold that predicts held-out blocks best.
* Stepwise regression: forward by the F-test at 1 % shared by all candidates, backward in between (Draper & Smith 1998).
* mujoco.sysid: its optimiser on the same prediction with every candidate free, and its 95 % intervals: an effect is
  missing where the interval leaves out "no effect". (Its extras must be installed: pip install "mujoco[sysid]".)

A method is right where the set it calls missing is the hidden one. Seconds are those of the processor and include
everything from the flight in memory to the answer; columns that several methods share are counted for each. Effects
seen in the rotation alone are left out: the others have no data for them.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import random
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy import stats

from trueflight.groundstation.identify.fitting import BLOCK, MeasuredFlights
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.measured.measurement import measure
from trueflight.groundstation.reading import read_flight
from trueflight.models.design import load_design
from trueflight.models.effect import Effect, Stage
from trueflight.models.effects import catalogue, effect_named
from trueflight.models.flight import Flight
from trueflight.models.model import rigid_body_model
from trueflight.models.reference import trajectory
from trueflight.models.vehicle import load_vehicle
from trueflight.sim_bridge.in_process import record
from trueflight.sim_bridge.plan import Plan
from trueflight.sim_bridge.truth.hidden import choose
from trueflight.sim_bridge.truth.sensors import Noise

VEHICLE = Path(__file__).parents[1] / "models/vehicles/quad5/vehicle.toml"
HIDDEN = (
    "thrust_gain", "thrust_curve", "battery_sag", "motor_lag", "transport_delay", "rotor_drag", "parasitic_drag",
    "ground_effect", "wind", "accelerometer_bias",
)  # fmt: skip
DRAGS = {"rotor_drag", "parasitic_drag"}


def flight_of(seed: int) -> tuple[Flight, frozenset[str]]:
    """A flight and what is hidden in it: nothing in a quarter of them, two effects in another."""
    generator = random.Random(f"others {seed}")
    names = generator.sample(HIDDEN, (0, 1, 1, 2)[seed % 4])
    vehicle = load_vehicle(VEHICLE)
    design = load_design(VEHICLE.with_name("design.json"), vehicle)
    hidden = choose(names or ["none"], vehicle, seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{seed}.mcap"
        record(Plan(vehicle, design, trajectory("excitation"), hidden, seed, noise=Noise()), path)
        flight = read_flight(path)
    truth = set(names)
    if "wind" in truth and not truth & DRAGS:
        truth.add("rotor_drag")  # the simulator's wind brings the drag that it acts through
    return flight, frozenset(truth)


class Columns:
    """What each candidate at its typical size adds to the predicted specific force: `matrix` (K A, C), the `owner` of
    each column, and the `target` (K A,): what exact rotation leaves."""

    def __init__(self, flight: Flight) -> None:
        self.problem = problem = MeasuredFlights((measure(flight),))
        self.body = (effect_named("rigid_body"), {})
        base = problem.predict([self.body])
        self.target = (problem.measured() - base).ravel()
        self.candidates = [
            e
            for e in catalogue().values()
            if e.parameters and not e.rotational and e.stage is not Stage.RATE and not e.lacks(flight)
        ]
        columns, self.owner = [], []
        for e in self.candidates:
            through = [effect_named(e.acts_through[0])] if e.acts_through else []
            chain = [self.body, *((t, t.typical(problem.survey)) for t in through)]
            without = problem.predict(chain) if through else base
            placed = {**e.neutral(problem.vehicle), **self.places(e)}
            for p in e.parameters:
                if not p.structural:
                    sized = e.typical(problem.survey)[p.name]
                    columns.append(
                        (problem.predict([*chain, (e, {**placed, p.name: sized})]) - without).ravel()
                    )
                    self.owner.append(e.name)
        self.matrix = np.column_stack(columns)
        m = problem.measurements[0]
        self.block = np.repeat(((m.t[m.used] - m.t[0]) / BLOCK).astype(int), len(m.axes))

    def places(self, effect: Effect) -> dict[str, float]:
        """Where an effect acts, for the parameters that say so."""
        typical = effect.typical(self.problem.survey)
        return {p.name: typical[p.name] for p in effect.parameters if p.structural}

    def owners(self, chosen: np.ndarray) -> frozenset[str]:
        """The effects of the chosen columns."""
        return frozenset(name for name, c in zip(self.owner, chosen, strict=True) if c)


def trueflight(flight: Flight) -> frozenset[str]:
    """What `groundstation diagnose` calls missing."""
    d = diagnose(flight, rigid_body_model(flight.vehicle))
    return frozenset(
        e.name for e in d.effects if e.verdict == "missing" and not catalogue()[e.name].rotational
    )


def stlsq(columns: Columns, rows: np.ndarray, threshold: float) -> np.ndarray:
    """Coefficients (C,) of PySINDy's STLSQ."""
    from pysindy import STLSQ

    used = np.any(columns.matrix != 0.0, axis=0)
    coefficients = np.zeros(columns.matrix.shape[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a threshold that removes every term is an answer
        fitted = STLSQ(threshold=threshold).fit(columns.matrix[rows][:, used], columns.target[rows, None])
    coefficients[used] = np.ravel(fitted.coef_)
    return coefficients


def pysindy(flight: Flight) -> frozenset[str]:
    """STLSQ with its default threshold."""
    columns = Columns(flight)
    return columns.owners(stlsq(columns, np.ones(len(columns.target), dtype=bool), 0.1) != 0.0)


def pysindy_held_out(flight: Flight) -> frozenset[str]:
    """STLSQ with the threshold that predicts held-out blocks best."""
    columns = Columns(flight)
    everything = np.ones(len(columns.target), dtype=bool)

    def error(threshold: float) -> float:
        total = 0.0
        for b in np.unique(columns.block):
            left = columns.block == b
            found = stlsq(columns, ~left, threshold)
            total += float(np.sum((columns.target[left] - columns.matrix[left] @ found) ** 2))
        return total

    best = min(np.geomspace(0.02, 1.0, 9), key=error)
    return columns.owners(stlsq(columns, everything, best) != 0.0)


def stepwise(flight: Flight) -> frozenset[str]:
    """Forward and backward by F-tests of whole effects."""
    columns = Columns(flight)
    x, y = columns.matrix, columns.target
    owner = np.array(columns.owner)
    alpha = 0.01 / len(columns.candidates)

    def error(names: list[str]) -> tuple[float, int]:
        part = x[:, np.isin(owner, names)]
        if not part.shape[1]:
            return float(y @ y), 0
        solution, _, rank, _ = np.linalg.lstsq(part, y, rcond=None)
        return float(np.sum((y - part @ solution) ** 2)), int(rank)

    def p_value(larger: list[str], smaller: list[str]) -> float:
        (full, p), (less, q) = error(larger), error(smaller)
        if p == q:
            return 1.0
        return float(stats.f.sf((less - full) / (p - q) / (full / (len(y) - p)), p - q, len(y) - p))

    chosen: list[str] = []
    for _ in range(2 * len(columns.candidates)):
        rest = [e.name for e in columns.candidates if e.name not in chosen]
        if not rest:
            break
        best = min(rest, key=lambda name: error([*chosen, name])[0])
        if p_value([*chosen, best], chosen) >= alpha:
            break
        chosen.append(best)
        for name in list(chosen):
            if p_value(chosen, [n for n in chosen if n != name]) >= alpha:
                chosen.remove(name)
    return frozenset(chosen)


def mujoco_sysid(flight: Flight) -> frozenset[str]:
    """Every candidate free at once, in the optimiser of mujoco.sysid; missing is what its interval parts from none."""
    from mujoco import sysid

    columns = Columns(flight)
    problem, vehicle = columns.problem, columns.problem.vehicle
    measured = problem.measured()
    free = [(e, p) for e in columns.candidates for p in e.parameters]
    parameters = sysid.ParameterDict()
    for e, p in free:
        if not p.structural:
            rest = p.neutral_for(vehicle)
            reach = 2.0 * abs(p.typical - rest)
            parameters.add(
                sysid.Parameter(
                    f"{e.name}.{p.name}", rest + 0.1 * (p.typical - rest), min(p.low, rest) - reach, p.high
                )
            )
    names = list(parameters.parameters)

    def residual(x: np.ndarray, _: object) -> tuple[list[np.ndarray], None, None]:
        values = dict(zip(names, np.ravel(x), strict=True))
        chain = [columns.body]
        for e in columns.candidates:
            given = {p.name: values.get(f"{e.name}.{p.name}") for p in e.parameters}
            chain.append((e, {**columns.places(e), **{k: v for k, v in given.items() if v is not None}}))
        return [(measured - problem.predict(chain)).ravel()], None, None

    with contextlib.redirect_stdout(io.StringIO()):  # it tells every iteration
        found, result = sysid.optimize(parameters, residual, optimizer="scipy", verbose=False)
    _, half = sysid.calculate_intervals(residual(result.x, found)[0], result.jac)
    rest = {f"{e.name}.{p.name}": p.neutral_for(vehicle) for e, p in free if not p.structural}
    differs = [abs(x - rest[n]) > h for n, x, h in zip(names, result.x, np.ravel(half), strict=True)]
    return frozenset(name.split(".")[0] for name, d in zip(names, differs, strict=True) if d)


def methods() -> dict[str, Callable[[Flight], frozenset[str]]]:
    found: dict[str, Callable[[Flight], frozenset[str]]] = {
        "trueflight": trueflight,
        "stepwise regression": stepwise,
    }
    try:
        import pysindy as _  # noqa: F401

        found |= {"PySINDy STLSQ 0.1": pysindy, "PySINDy STLSQ, held out": pysindy_held_out}
    except ImportError:
        print("PySINDy is not installed: left out (pip install pysindy)")
    try:
        from mujoco import sysid

        if not hasattr(sysid, "optimize"):
            raise ImportError
        found["mujoco.sysid"] = mujoco_sysid
    except ImportError:
        print('mujoco.sysid cannot be imported: left out (pip install "mujoco[sysid]")')
    return found


def measure_all(first: int, count: int) -> dict[str, dict[str, float]]:
    """Right answers, false alarms, effects found and seconds of each method."""
    tried = methods()
    table = {
        name: {"right": 0, "false_alarms": 0, "found": 0, "extra": 0, "seconds": 0.0, "failed": 0}
        for name in tried
    }
    clean = hidden = 0
    for number, seed in enumerate(range(first, first + count)):
        flight, truth = flight_of(seed)
        clean, hidden = clean + (not truth), hidden + len(truth)
        if number == 0:
            for method in tried.values():  # imports and caches are no part of anybody's time
                method(flight)
        for name, method in tried.items():
            begin = time.process_time()
            try:
                said = method(flight)
            except (ValueError, RuntimeError, np.linalg.LinAlgError):
                said = frozenset({"(failed)"})
                table[name]["failed"] += 1
            row = table[name]
            row["seconds"] += time.process_time() - begin
            row["right"] += said == truth
            row["false_alarms"] += bool(said) and not truth
            row["found"] += len(said & truth)
            row["extra"] += len(said - truth)
    for row in table.values():
        row |= {"flights": count, "clean": clean, "hidden": hidden, "seconds": row["seconds"] / count}
    return table


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", type=int, default=24)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    table = measure_all(arguments.first, arguments.flights)
    if arguments.json:
        print(json.dumps(table))
        return
    ours = table["trueflight"]["seconds"]
    one = next(iter(table.values()))
    print(
        f"{one['flights']} flights of 45 s, {one['clean']} with nothing hidden, {one['hidden']} effects in the others"
    )
    print(
        f"{'':26} {'exact set':>10} {'found':>8} {'wrong':>6} {'alarms on clean':>16} {'s/flight':>9} {'ratio':>6}"
    )
    for name, row in table.items():
        print(
            f"{name:26} {row['right']:>4}/{row['flights']:<5} {row['found']:>4}/{row['hidden']:<3} {row['extra']:>6} "
            f"{row['false_alarms']:>8}/{row['clean']:<7} {row['seconds']:>9.2f} {row['seconds'] / ours:>6.2f}"
        )


if __name__ == "__main__":
    main()
