"""Controllers beside each other: on the same vehicles, winds, payloads, batteries and paths, what each keeps to.

Two measures, since two camps use them: the distance to the *reference*, which everybody else reports, and the distance
to the expected *linear behaviour*, which Carvalho et al. (ICUAS 2022) report.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trueflight.groundstation.evaluate.tracking import read_designed, track
from trueflight.groundstation.study.batch import Row, fly_rows
from trueflight.groundstation.study.disturbances import CHARGE, Disturbance
from trueflight.groundstation.study.reproduce import (
    BOTH,
    EFFECTS,
    SETTLE,
    Asked,
    Prepared,
    prepare,
    through_companion,
)
from trueflight.models.contract import CORRECTED, CORRECTED_ADAPTIVE, INDI, LQR
from trueflight.models.controllers import check_controller, controllers
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.frames import rotation_matrix
from trueflight.models.outside import json_object, read_text
from trueflight.models.whole_file import write_whole

EFFECTS_ALONE = "corrected, effects"
"""The corrected controller with the effects alone; `corrected` has the network beside them."""
IN_PROCESS, COMPANION = "in-process", "companion"
FINISHED = "finished"
HEADLINE = ("none", "wind", "payload", "old")
HEADLINE_CONTROLLERS = (LQR, INDI, CORRECTED)
"""What is flown through the real companion as well."""
AT_ONCE = 64
"""Flights that one program flies, after which what they gave is kept."""
EXCEEDED = 0.95
"""Of the time: the tilt and the thrust that are told were exceeded in the rest of it."""


@dataclass(frozen=True)
class Cell:
    """One flight: RMSE (m, over three axes) to the `reference` and the `linear` behaviour, and how it ended; `tilt`
    (rad) and `thrust` (normalised command) were exceeded in a twentieth of it. NaN where it ended early."""

    seed: int
    disturbance: str
    controller: str
    reference: float
    linear: float
    outcome: str
    tilt: float
    thrust: float
    through: str = IN_PROCESS


def chosen_controllers(names: Sequence[str] | None) -> list[str]:
    """Controllers of these names, all that are installed where none is named, but the one that learns in flight: many
    flights at once do not learn. Raises `InputError`."""
    installed = [name for name in controllers() if name != CORRECTED_ADAPTIVE]
    every = [name for own in installed for name in ((EFFECTS_ALONE, own) if own == CORRECTED else (own,))]
    for name in names or ():
        if name == CORRECTED_ADAPTIVE:
            raise InputError(f"--controller {name}: it flies one by one; use `sim-bridge fly`")
        if name != EFFECTS_ALONE:
            check_controller(name, "--controller")
    return list(dict.fromkeys(names or every))


def learns(name: str) -> bool:
    """Whether a controller flies with a model of the vehicle."""
    return name in (CORRECTED, EFFECTS_ALONE)


def prepared_for(
    asked: Asked, seed: int, names: Iterable[str], tell: Callable[[str, int], None]
) -> Prepared | None:
    """What the vehicle of `seed` has taught, where one of these controllers needs it."""
    folder = asked.folder / f"vehicle-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    if not any(map(learns, names)):
        return None
    tell(f"vehicle {seed}: learn", 0)
    return prepare(folder, asked.vehicle, seed, asked.truth, asked.minutes, lambda what: None)


def compare(
    asked: Asked,
    seeds: Sequence[int],
    disturbances: Sequence[Disturbance],
    names: Sequence[str],
    jobs: int,
    tell: Callable[[str, int], None],
) -> list[Cell]:
    """Prepare a vehicle for each seed, where a controller needs a model, and fly everything; what the folder holds is
    kept. `tell` is called with what is done now, and how many flights are done with it."""
    cells: list[Cell] = []
    for seed in seeds:
        prepared = prepared_for(asked, seed, names, tell)
        folder = asked.folder / f"vehicle-{seed}"
        tasks = [(one, name) for one in disturbances for name in names]
        known = {task: _known(_kept(folder, task[0].name, task[1])) for task in tasks}
        missing = [task for task in tasks if known[task] is None]
        tell(f"vehicle {seed}: fly", len(tasks) - len(missing))
        for start in range(0, len(missing), AT_ONCE):
            here = missing[start : start + AT_ONCE]
            known |= zip(here, _fly(asked, seed, prepared, here, jobs), strict=True)
            tell(f"vehicle {seed}: fly", len(here))
        cells += [cell for task in tasks if (cell := known[task]) is not None]
    return cells


def compare_for_real(
    asked: Asked, seed: int, disturbances: Sequence[Disturbance], tell: Callable[[str, int], None]
) -> list[Cell]:
    """The headline rows through the real companion over MAVLink, in real time: a fresh battery, bridge and companion
    for each flight."""
    prepared = prepared_for(asked, seed, HEADLINE_CONTROLLERS, tell)
    folder, cells = asked.folder / f"vehicle-{seed}", []
    tell(f"vehicle {seed}: fly with the companion", 0)
    for one in (d for d in disturbances if d.name in HEADLINE):
        for name in HEADLINE_CONTROLLERS:
            kept = _kept(folder, f"companion-{one.name}", name)
            cell = _known(kept)
            if cell is None:
                entry, record = through_companion(
                    kept.with_suffix(""),
                    asked.vehicle,
                    _words(asked, seed, one),
                    {
                        "trajectory": one.trajectory,
                        "parameters": one.settings(seed),
                        "controller": _controller(name),
                        "repeat": 1,
                    },
                    _model(prepared, name),
                )
                cell = _cell(seed, one.name, name, record, entry["state"], COMPANION)
                write_whole(kept, json.dumps(asdict(cell)), "what was flown")
            cells.append(cell)
            tell(f"vehicle {seed}: fly with the companion", 1)
    return cells


def fly_table(asked: Asked, rows: Sequence[Row], folder: Path, jobs: int) -> dict[str, dict[str, Any]]:
    """Fly rows into `folder`: the simulator's report of each, by name."""
    return fly_rows(rows, folder, asked.vehicle, "--settle", SETTLE, "--jobs", jobs, "--tell-hidden")


def row_of(
    asked: Asked, seed: int, prepared: Prepared | None, disturbance: Disturbance, name: str, stem: str
) -> Row:
    """One flight as a row for `fly_table`; its record is named `stem`."""
    return {
        "name": stem,
        "seed": seed,
        "trajectory": disturbance.trajectory,
        "set": ";".join(f"{key}={value:g}" for key, value in disturbance.settings(seed).items()),
        "hidden": ";".join((*asked.hidden, *disturbance.hidden)),
        "charge": CHARGE,
        "battery_age": disturbance.battery_age,
        "controller": _controller(name),
        "model": _model(prepared, name) or "",
    }


def _controller(name: str) -> str:
    return CORRECTED if name == EFFECTS_ALONE else name


def _model(prepared: Prepared | None, name: str) -> Path | None:
    if not learns(name):
        return None
    assert prepared is not None
    return prepared.files[EFFECTS if name == EFFECTS_ALONE else BOTH].resolve()


def _words(asked: Asked, seed: int, disturbance: Disturbance) -> list[str]:
    """For `sim-bridge run`."""
    hidden = [word for name in disturbance.hidden for word in ("--hidden", name)]
    words = [*asked.truth, *hidden, "--seed", str(seed), "--charge", str(CHARGE)]
    return [*words, "--battery-age", str(disturbance.battery_age)]


def _kept(folder: Path, flight: str, name: str) -> Path:
    return folder / f"controllers-{flight}-{name.replace(', ', '-')}.json"


def _known(kept: Path) -> Cell | None:
    """What an earlier run kept of a flight; None where there is nothing, or of another version: it is flown again."""
    if not kept.is_file():
        return None
    try:
        return Cell(**json_object(read_text(kept, "a flight", "it is flown again"), str(kept), "flown again"))
    except (InputError, TypeError):
        return None


def _fly(
    asked: Asked, seed: int, prepared: Prepared | None, tasks: Sequence[tuple[Disturbance, str]], jobs: int
) -> list[Cell]:
    folder, cells = asked.folder / f"vehicle-{seed}", []
    stems = [_kept(folder, one.name, name).stem for one, name in tasks]
    rows = [row_of(asked, seed, prepared, *task, stem) for task, stem in zip(tasks, stems, strict=True)]
    reports = fly_table(asked, rows, folder, jobs)
    for (one, name), stem in zip(tasks, stems, strict=True):
        record = folder / f"{stem}.mcap"
        cell = _cell(seed, one.name, name, record, reports[stem]["outcome"], IN_PROCESS)
        write_whole(_kept(folder, one.name, name), json.dumps(asdict(cell)), "what was flown")
        record.unlink()
        cells.append(cell)
    return cells


def _cell(seed: int, disturbance: str, name: str, record: Path, outcome: str, through: str) -> Cell:
    if outcome != FINISHED:  # the record may be too short to be read as a flight
        return Cell(seed, disturbance, name, math.nan, math.nan, outcome, math.nan, math.nan, through)
    flight, design, _ = read_designed(record)
    tracked = track(flight, design)
    off = np.linalg.norm(tracked.position - tracked.reference, axis=1)
    reference = float(np.sqrt(np.mean(off**2)))
    return Cell(seed, disturbance, name, reference, tracked.rms, outcome, *_worked(flight), through)


def _worked(flight: Flight) -> tuple[float, float]:
    """Tilt (rad) and thrust command that were exceeded in a twentieth of a flight."""
    upright = rotation_matrix(flight.column("quaternion"))[:, 2, 2]
    tilt = np.arccos(np.clip(upright, -1.0, 1.0))
    return float(np.quantile(tilt, EXCEEDED)), float(np.quantile(flight.column("thrust_command"), EXCEEDED))
