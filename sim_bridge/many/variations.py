"""Many flights from one command: a table with a row a flight, or seeds; what a row leaves empty is as the command
says."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

from trueflight.companion.law.controllers import TrimLimits
from trueflight.companion.law.residual import ObserverLimits
from trueflight.models.design import Design, load_design
from trueflight.models.errors import InputError, shown
from trueflight.models.outside import read_text
from trueflight.models.trajectory import Trajectory
from trueflight.models.vehicle import Vehicle, load_vehicle
from trueflight.sim_bridge.plan import Plan, bytes_of, trajectory_of
from trueflight.sim_bridge.settings import Settings, check_limits
from trueflight.sim_bridge.truth.hidden import choose

MOST = 100_000
"""Flights of one command."""


@dataclass(frozen=True)
class Row:
    """One flight as asked for: names of its options are those of `sim-bridge fly`, texts and numbers."""

    name: str = ""
    trajectory: str = ""
    set: tuple[str, ...] = ()
    vehicle: str = ""
    design: str = ""
    hidden: tuple[str, ...] = ("none",)
    hidden_count: int = 1
    strength: float = 1.0
    seed: int = 0
    noise: float = 1.0
    charge: float = 0.97
    battery_age: float = 1.0
    controller: str = ""
    model: str = ""
    trim: float = TrimLimits().bandwidth
    observer: float = ObserverLimits().frequency
    settle: float = 0.0
    repeat: int = 1
    rate: float = 100.0
    rotor_speeds: bool = True


@dataclass(frozen=True)
class Variation:
    """One of many flights: its `name`, which is that of its record, the `row` that asked for it, and its `plan`."""

    name: str
    row: Row
    plan: Plan


def rows_of(table: Path, usual: Row) -> list[Row]:
    """The flights of a CSV file with the names of options in its first row. Raises `InputError`.

    Lists (`hidden`, `set`) are separated by `;`, files are relative to the table's folder.
    """
    text = read_text(table, "the table of flights", "pass --flights FILE")
    lines = list(csv.reader(io.StringIO(text)))
    if not lines or not lines[0]:
        raise InputError(f"{table}: is empty; its first row names the columns: {', '.join(_COLUMNS)}")
    names = [name.strip().lstrip("-").replace("-", "_") for name in lines[0]]
    for name in names:
        if name not in _COLUMNS or names.count(name) > 1:
            wrong = "stands there twice" if name in _COLUMNS else "is no option of a flight"
            raise InputError(f"{table}: column {shown(name)} {wrong}; use {', '.join(_COLUMNS)}")
    found = []
    for number, cells in enumerate(lines[1:], 2):
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(names):
            raise InputError(f"{table}, row {number}: has {len(cells)} cells, the first row {len(names)}")
        where = f"{table}, row {number}"
        given = {n: _read(where, n, c.strip()) for n, c in zip(names, cells, strict=True) if c.strip()}
        found.append(replace(usual, **_beside(table.parent, given)))
    if not 1 <= len(found) <= MOST:
        raise InputError(f"{table}: has {len(found)} flights; give 1 to {MOST}")
    return found


def of_seeds(usual: Row, count: int) -> list[Row]:
    """As many flights that differ in their seed alone, which counts up."""
    return [replace(usual, seed=usual.seed + i) for i in range(count)]


def varied(rows: Sequence[Row]) -> list[Variation]:
    """The flights with their plans; files that several name are read once. Raises `InputError` before any is flown."""
    vehicle, design = cache(load_vehicle), cache(load_design)
    path, model = cache(trajectory_of), cache(bytes_of)
    width = max(len(str(len(rows))), 4)
    found: list[Variation] = []
    taken: set[str] = set()
    for number, row in enumerate(rows, 1):
        name = row.name or f"{number:0{width}d}"
        if not re.fullmatch(r"\w[\w.+-]{0,99}", name):
            raise InputError(
                f"flight {number}: name {shown(name)} is no file's; use letters, digits, '.', '_', '+', '-'"
            )
        if name in taken:
            raise InputError(f"flight {number}: the name '{name}' is taken by an earlier one; give another")
        taken.add(name)
        try:
            found.append(Variation(name, row, _plan(row, vehicle, design, path, model)))
        except InputError as error:
            raise InputError(f"flight '{name}': {error}") from None
    return found


def _plan(
    row: Row,
    vehicle: Callable[[str], Vehicle],
    design: Callable[[Path, Vehicle], Design],
    path: Callable[[str, tuple[str, ...]], Trajectory],
    model: Callable[[Path], bytes],
) -> Plan:
    for given, option in ((row.vehicle, "vehicle"), (row.trajectory, "trajectory")):
        if not given:
            raise InputError(f"no {option}; pass --{option}, or a column of that name")
    settings = Settings(
        vehicle=row.vehicle, hidden_count=row.hidden_count, seed=row.seed, noise=row.noise, charge=row.charge,
        battery_age=row.battery_age,
    )  # fmt: skip
    check_limits(settings)
    for value, low, high, option in (
        (row.strength, 0.0, 1e3, "strength"), (row.trim, 0.0, 1.0, "trim"), (row.observer, 0.0, 20.0, "observer"),
        (row.settle, 0.0, 60.0, "settle"),
        (row.repeat, 1, 10_000, "repeat"),
    ):  # fmt: skip
        if not low <= value <= high:
            raise InputError(f"--{option} {value:g} is outside {low:g} to {high:g}")
    believed = vehicle(row.vehicle)
    plan = Plan(
        believed,
        design(Path(row.design) if row.design else Path(row.vehicle).with_name("design.json"), believed),
        path(row.trajectory, row.set),
        choose(list(row.hidden), believed, row.seed, row.hidden_count, row.strength),
        row.seed,
        row.repeat,
        row.rate,
        model(Path(row.model)) if row.model else None,
        settings.sensor_noise,
        settings.battery,
        row.controller,
        row.settle,
        TrimLimits(bandwidth=row.trim),
        ObserverLimits(row.observer),
        row.rotor_speeds,
    )
    _ = plan.steps_per_tick  # a rate that cannot be flown is told before anything is written
    return plan


_COLUMNS: dict[str, Any] = {field.name: field.default for field in fields(Row)}
_WORDS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


def _read(where: str, name: str, cell: str) -> Any:
    usual = _COLUMNS[name]
    if isinstance(usual, tuple):
        return tuple(word.strip() for word in cell.split(";") if word.strip())
    if isinstance(usual, bool):
        if cell.lower() not in _WORDS:
            raise InputError(f"{where}: {name} is {shown(cell)}; write true or false")
        return _WORDS[cell.lower()]
    if isinstance(usual, str):
        return cell
    try:
        return type(usual)(cell)
    except ValueError:
        kind = "a whole number" if isinstance(usual, int) else "a number"
        raise InputError(f"{where}: {name} is {shown(cell)}; it must be {kind}") from None


def _beside(folder: Path, given: Mapping[str, Any]) -> dict[str, Any]:
    """With paths relative to the table's folder."""
    found = dict(given)
    for name in ("vehicle", "design", "model"):
        if name in found:
            found[name] = str(folder / found[name])
    if str(found.get("trajectory", "")).endswith(".csv"):
        found["trajectory"] = str(folder / found["trajectory"])
    return found
