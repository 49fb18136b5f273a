"""What becomes of a good flight that a log holds wrongly: each fault in turn, with and without an IMU.

    python tests/groundstation/remedies.py [--every N] [FLIGHT ...]

Counted for each kind of fault: named (refused or undone, and what the reader says restores the flight), refused
(without it), told (a note or a warning), harmless (silent, and the diagnosis is what it was) and harmful (silent, and
it is not). Without flights the repository's own are taken; `--every 5` takes every fifth fault.
"""

from __future__ import annotations

import argparse
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.assemble import assemble
from trueflight.groundstation.reading.faults import CONJUGATE, SIGNED, Columns, about_z, enu_flu_from_ned_frd
from trueflight.groundstation.reading.held import MEASURED
from trueflight.groundstation.reading.mapping import merged, read_mappings
from trueflight.models.errors import InputError
from trueflight.models.flight import COLUMNS, Flight
from trueflight.models.frames import rotate_inverse
from trueflight.models.model import rigid_body_model
from trueflight.models.vehicle import GRAVITY

SAMPLES = Path(__file__).parents[2] / "samples"
FLIGHTS = (
    SAMPLES / "rotorpy" / "rotor_drag" / "identify.parquet",
    SAMPLES / "rotorpy" / "nothing_hidden" / "identify.parquet",
    SAMPLES / "px4" / "sih_lemniscate.ulg",
    SAMPLES / "crazyflie" / "crazyswarm2_log201.csv",
    SAMPLES / "crazyflie" / "crazyswarm2_log44.csv",
)
TRAJECTORY, IMU = ("position", "velocity"), ("angular_velocity", "specific_force")
OUTCOMES = ("named", "refused", "told", "harmless", "harmful")
SAME = 0.1
"""Share of a column's spread by which a restored one may differ: angles are told to the degree, delays to 5 ms."""


@dataclass(frozen=True)
class Case:
    """One fault: its kind, its own name, and the columns as a log would hold them."""

    kind: str
    name: str
    wrong: Callable[[np.ndarray, Columns], Columns]
    needs: tuple[str, ...]


def cases() -> Iterator[Case]:
    """Every fault."""
    yield from _axes()
    yield from _quaternions()
    yield from _turns()
    yield from _units()
    yield from _times()


def _axes() -> Iterator[Case]:
    for names in (TRAJECTORY, ("velocity",), ("position",), IMU, ("angular_velocity",), ("specific_force",)):
        for number, axes in enumerate(SIGNED[1:]):
            wrong = partial(_by_axes, names=names, axes=axes)
            yield Case(f"axes of {' and '.join(names)}", str(number), wrong, names)


def _quaternions() -> Iterator[Case]:
    ways: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "x, y, z, w": lambda q: q[:, [1, 2, 3, 0]],
        "world to body": lambda q: q * CONJUGATE,
        "x, y, z, w, world to body": lambda q: (q * CONJUGATE)[:, [1, 2, 3, 0]],
        "NED and FRD": enu_flu_from_ned_frd,
        "FRD body": lambda q: q * [1.0, 1.0, -1.0, -1.0],
    }
    for name, way in ways.items():
        wrong = partial(_changed, name="quaternion", change=way)
        yield Case("order and direction of the quaternion", name, wrong, ("quaternion",))
    yield Case("velocity in body axes", "FLU", _body_velocity, ("velocity", "quaternion"))


def _turns() -> Iterator[Case]:
    for names in (TRAJECTORY, ("velocity",), IMU, ("angular_velocity",), ("specific_force",)):
        for degrees in (10, 15, 20, 30, 45, 60, 90, 120, 180, -30):
            wrong = partial(_by_axes, names=names, axes=about_z(np.radians(degrees)))
            yield Case(f"{' and '.join(names)} turned about z", f"{degrees} degrees", wrong, names)


def _units() -> Iterator[Case]:
    for name, factor, unit in (
        ("angular_velocity", 180 / np.pi, "deg/s"),
        ("velocity", 100.0, "cm/s"),
        ("velocity", 1000.0, "mm/s"),
        ("velocity", 3.6, "km/h"),
        ("position", 100.0, "cm"),
        ("position", 1000.0, "mm"),
        ("specific_force", 1 / GRAVITY, "g"),
        ("specific_force", 1000 / GRAVITY, "mg"),
        ("battery_voltage", 1000.0, "mV"),
        ("battery_voltage", 0.25, "per cell of four"),
        ("battery_voltage", 6.0, "percent"),
        ("thrust_command", 100.0, "percent"),
        ("thrust_command", 65535.0, "u16"),
        ("thrust_command", -1.0, "down"),
    ):
        yield Case("units", f"{name} in {unit}", partial(_scaled, name=name, factor=factor), (name,))


def _times() -> Iterator[Case]:
    for names in (TRAJECTORY, ("quaternion",), IMU):  # all of it late is the same as an IMU that is early
        for late in (0.02, 0.05, 0.1, 0.15, 0.2):
            wrong = partial(_late, names=names, late=late)
            yield Case(f"{' and '.join(names)} late", f"{1e3 * late:.0f} ms", wrong, names)
    for name in MEASURED:
        for count in (2, 5, 10, 20):
            wrong = partial(_held, name=name, count=count)
            yield Case("values repeated", f"{name} {count} times", wrong, (name,))


def _changed(
    _t: np.ndarray, columns: Columns, name: str, change: Callable[[np.ndarray], np.ndarray]
) -> Columns:
    return {**columns, name: change(columns[name])}


def _by_axes(_t: np.ndarray, columns: Columns, names: tuple[str, ...], axes: np.ndarray) -> Columns:
    return {**columns, **{n: columns[n] @ axes.T for n in names}}


def _scaled(_t: np.ndarray, columns: Columns, name: str, factor: float) -> Columns:
    return {**columns, name: factor * columns[name]}


def _body_velocity(_t: np.ndarray, columns: Columns) -> Columns:
    return {**columns, "velocity": rotate_inverse(columns["quaternion"], columns["velocity"])}


def _late(t: np.ndarray, columns: Columns, names: tuple[str, ...], late: float) -> Columns:
    out = dict(columns)
    for name in names:
        column = np.stack([np.interp(t - late, t, one) for one in columns[name].T], -1)
        out[name] = column / np.linalg.norm(column, axis=1, keepdims=True) if name == "quaternion" else column
    return out


def _held(_t: np.ndarray, columns: Columns, name: str, count: int) -> Columns:
    rows = np.arange(len(columns[name])) // count * count
    return {**columns, name: columns[name][rows]}


# --- what becomes of it ---------------------------------------------------------------------------------------


def columns_of(flight: Flight, imu: bool) -> Columns:
    """Its columns, with or without an IMU."""
    left_out = {"t", "flying"} | (set() if imu else set(IMU))
    named = {n: getattr(flight, n, None) for n in COLUMNS if n not in left_out}
    if not flight.accelerometer:
        named.pop("specific_force", None)
    return {n: column for n, column in named.items() if column is not None}


def read(flight: Flight, columns: Columns, lines: Sequence[str] = ()) -> Flight:
    """A flight out of columns, as any log is read."""
    return assemble(
        Path(flight.origin),
        flight.vehicle,
        flight.t,
        columns,
        lambda row: f"row {row}",
        flying=flight.flying,
        mapping=merged(read_mappings(list(lines))),
    )


def findings(flight: Flight) -> dict[str, tuple[float, float, float]]:
    """Value and interval of every parameter of the effects found missing."""
    d = diagnose(flight, rigid_body_model(flight.vehicle))
    return {
        f"{e.name} {p.name}": (p.value, p.low, p.high)
        for e in d.effects
        if e.verdict == "missing"
        for p in e.parameters
    }


def same(before: dict[str, tuple[float, float, float]], after: dict[str, tuple[float, float, float]]) -> bool:
    """Whether the same effects were found, each value within twice the other's interval."""
    if set(before) != set(after):
        return False
    return all(
        abs(after[n][0] - value) <= max(high - low, 0.02 * abs(value))
        for n, (value, low, high) in before.items()
    )


def restored(right: Flight, got: Flight, names: tuple[str, ...]) -> bool:
    """Whether columns are as they were before the fault."""
    rows = np.searchsorted(got.t, right.t)
    rows = rows[(rows < len(got.t))]
    at = np.searchsorted(right.t, got.t[rows])
    rows, at = rows[at < len(right.t)], at[at < len(right.t)]
    for name in names:
        a, b = getattr(right, name)[at], getattr(got, name)
        if b is None:
            return False
        b = b[rows]
        if name == "quaternion":
            b = b * np.sign(np.sum(a * b, axis=1, keepdims=True))
        if np.sqrt(np.mean((a - b) ** 2)) > SAME * max(float(np.sqrt(np.mean(np.var(a, axis=0)))), 1e-3):
            return False
    return True


def outcome(
    flight: Flight, right: Flight, before: dict[str, tuple[float, float, float]], case: Case, imu: bool
) -> str:
    """One of `OUTCOMES`."""
    wrong = case.wrong(flight.t, columns_of(flight, imu))
    try:
        got = read(flight, wrong)
    except InputError as error:
        lines = re.findall(r"--mapping '([^']+)'", str(error))
        try:
            return "named" if lines and restored(right, read(flight, wrong, lines), case.needs) else "refused"
        except InputError:
            return "refused"
    plain = set(right.notes)
    if any(note not in plain for note in got.notes):
        return "named" if restored(right, got, case.needs) else "told"
    if "late" in case.kind and any("late: the flight moves too little" in note for note in got.notes):
        return "told"  # as it was before
    if "position" in case.needs and any("which way" in c.text for c in got.consistency):
        return "told"
    if "specific_force" in case.needs and any("too little along x and y" in c.text for c in got.consistency):
        return "told"
    try:
        return "harmless" if same(before, findings(got)) else "harmful"
    except InputError:
        return "refused"


def study(path: Path, imu: bool, every: int) -> list[tuple[str, str, str]]:
    """Kind, name and outcome of every fault that a flight can have."""
    warnings.simplefilter("ignore")
    flight = read_flight(path)
    columns = columns_of(flight, imu)
    right = read(flight, columns)
    before = findings(right)
    possible = [case for case in cases() if all(name in columns for name in case.needs)]
    return [
        (case.kind, case.name, outcome(flight, right, before, case, imu))
        for case in possible[:: max(every, 1)]
    ]


def main() -> None:
    """Study the flights of the command line and print a table for each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("flights", nargs="*", type=Path, default=list(FLIGHTS))
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    out = partial(Console(width=120, highlight=False).print, markup=False)
    with ProcessPoolExecutor(given.jobs) as pool:
        pairs = [(path, imu) for path in given.flights for imu in (True, False)]
        for (path, imu), found in zip(
            pairs, pool.map(study, *zip(*pairs, strict=True), [given.every] * len(pairs)), strict=True
        ):
            out(f"\n{path.parent.name}/{path.stem}, {'with' if imu else 'without'} IMU")
            out(f"{'':58}" + "".join(f"{word:>9}" for word in OUTCOMES))
            kinds = dict.fromkeys(kind for kind, _, _ in found)
            for kind in kinds:
                count = Counter(result for k, _, result in found if k == kind)
                out(f"{kind[:57]:58}" + "".join(f"{count[word] or '.':>9}" for word in OUTCOMES))
            for kind, name, result in found:
                if result == "harmful":
                    out(f"  harmful: {kind}, {name}")


if __name__ == "__main__":
    main()
