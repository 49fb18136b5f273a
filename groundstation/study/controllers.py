"""Controllers beside each other: on the same vehicles, winds, payloads, batteries and paths, what each keeps to.

Two measures, since two camps use them: the distance to the *reference*, which everybody else reports, and the distance
to the expected *linear behaviour*, which Carvalho et al. (ICUAS 2022) report.

Disturbances after AdaptiveQuadBench (wind, force, torque, uncertainty, a weaker rotor); the winds and the figure eight
(x 1.25 sin t, z 0.75 sin 2t) of O'Connell et al., "Neural-Fly enables rapid learning for agile flight in strong winds",
Science Robotics 7 (2022).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass

import numpy as np

from trueflight.groundstation.evaluate.tracking import track_file
from trueflight.groundstation.operate.processes import run_json
from trueflight.groundstation.study.reproduce import BOTH, EFFECTS, SETTLE, Asked, Prepared, prepare
from trueflight.models.contract import CORRECTED
from trueflight.models.controllers import check_controller, controllers
from trueflight.models.errors import InputError
from trueflight.models.outside import json_object, read_text
from trueflight.models.whole_file import write_whole

UNSEEN = 100
"""Added to a seed for the trajectories: no training database holds them."""
_CHARGE = ("--charge", "0.6")


@dataclass(frozen=True)
class Disturbance:
    """What happens beside the vehicle's own truth, as words for `sim-bridge fly`, and on which trajectory."""

    name: str
    title: str
    truth: tuple[str, ...] = ()
    trajectory: tuple[str, ...] = ("lemniscate", "--set", "speed=3", "--set", "climb=0.8")

    def words(self, seed: int) -> list[str]:
        """The words for `sim-bridge fly` with this seed."""
        drawn = ["--set", f"seed={UNSEEN + seed}"] if self.trajectory[0] == "scenario" else []
        return ["--trajectory", *self.trajectory, *drawn, *self.truth]


_SLEEK = ("--hidden", "rotor_drag:0.15", "--hidden", "parasitic_drag:0.018")
"""Drag as Neural-Fly's vehicle has it. In the flights that its authors published (`custom_figure8_baseline_*`) it tilts
by 0.12, 0.25, 0.50 rad on average in 4.2, 8.5, 12.1 m/s; with these numbers the vehicle here by 0.14, 0.31, 0.50. With
the drag of `rich` it would need 0.73 to 0.78 rad at 12.1 m/s, which is beyond every controller's limit of 0.7."""


def _eight(wind: float) -> Disturbance:
    hidden = ("--hidden", f"wind:{wind:g}") if wind else ()
    return Disturbance(
        f"eight-{wind:g}",
        f"Neural-Fly's figure eight, and its vehicle's drag, in a wind of {wind:g} m/s",
        (*_CHARGE, *_SLEEK, *hidden),
        ("vertical_eight",),
    )


DISTURBANCES = (
    Disturbance("none", "the vehicle's own truth alone", _CHARGE),
    Disturbance("steps", "steps and translations, own truth", _CHARGE, ("scenario", "--set", "speed=3")),
    Disturbance("wind", "steady wind of 3 m/s", (*_CHARGE, "--hidden", "wind:3")),
    Disturbance("payload", "12 % of the mass carried", (*_CHARGE, "--hidden", "payload:0.12")),
    Disturbance("uncertainty", "thrust 15 % lower than believed", (*_CHARGE, "--hidden", "thrust_gain:0.85")),
    Disturbance(
        "rotor", "one rotor loses 15 % of its thrust after 6 s", (*_CHARGE, "--hidden", "rotor_damage:0.15@6")
    ),
    Disturbance("torque", "centre of mass 8 mm off", (*_CHARGE, "--hidden", "com_offset:0.008")),
    Disturbance("old", "battery of 1.5 times the resistance", (*_CHARGE, "--battery-age", "1.5")),
    *(_eight(wind) for wind in (0.0, 4.2, 8.5, 12.1)),
)
EFFECTS_ALONE = "corrected, effects"
"""The corrected controller with the effects alone; `corrected` has the network beside them."""


@dataclass(frozen=True)
class Cell:
    """One flight: RMSE (m, over three axes) to the `reference` and the `linear` behaviour, and how it ended; NaN where
    that was early."""

    seed: int
    disturbance: str
    controller: str
    reference: float
    linear: float
    outcome: str


def chosen_disturbances(names: Sequence[str] | None) -> list[Disturbance]:
    """Those of these names, all where none is named; raises `InputError` for a name that is none."""
    known = {one.name: one for one in DISTURBANCES}
    for name in names or ():
        if name not in known:
            raise InputError(f"--disturbance {name}: unknown; choose from {', '.join(known)}")
    return [known[name] for name in dict.fromkeys(names or known)]


def chosen_controllers(names: Sequence[str] | None) -> list[str]:
    """Controllers of these names, all that are installed where none is named; raises `InputError`."""
    every = [name for own in controllers() for name in ((EFFECTS_ALONE, own) if own == CORRECTED else (own,))]
    for name in names or ():
        if name != EFFECTS_ALONE:
            check_controller(name, "--controller")
    return list(dict.fromkeys(names or every))


def compare(
    asked: Asked,
    seeds: Sequence[int],
    disturbances: Sequence[Disturbance],
    names: Sequence[str],
    jobs: int,
    tell: Callable[[str, int], None],
) -> list[Cell]:
    """Prepare a vehicle for each seed, where a controller needs a model, and fly everything; what the folder holds is
    kept. `tell` is called with what is done now, and how many pieces are done with it."""
    cells: list[Cell] = []
    for seed in seeds:
        folder = asked.folder / f"vehicle-{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        prepared = None
        if any(name in (CORRECTED, EFFECTS_ALONE) for name in names):
            tell(f"vehicle {seed}: learn", 0)
            prepared = prepare(folder, asked.vehicle, seed, asked.truth, asked.minutes, lambda what: None)
        tell(f"vehicle {seed}: fly", 0)

        def one(
            task: tuple[Disturbance, str], seed: int = seed, prepared: Prepared | None = prepared
        ) -> Cell:
            cell = _flown(asked, seed, prepared, *task)
            tell(f"vehicle {seed}: fly", 1)
            return cell

        with ThreadPoolExecutor(jobs) as pool:
            cells += pool.map(one, [(d, name) for d in disturbances for name in names])
    return cells


def _flown(asked: Asked, seed: int, prepared: Prepared | None, disturbance: Disturbance, name: str) -> Cell:
    stem = f"controllers-{disturbance.name}-{name.replace(', ', '-')}"
    kept = asked.folder / f"vehicle-{seed}" / f"{stem}.json"
    if kept.is_file():
        try:
            return Cell(
                **json_object(read_text(kept, "a flight", "it is flown again"), str(kept), "flown again")
            )
        except (InputError, TypeError):  # damaged, or of another version: fly again
            pass
    record = kept.with_suffix(".mcap")
    record.unlink(missing_ok=True)
    command: list[object] = ["sim-bridge", "fly", "--vehicle", asked.vehicle, *asked.truth, "--seed", seed]
    command += [*disturbance.words(seed), "--settle", SETTLE, "-o", record, "--json"]
    if name in (CORRECTED, EFFECTS_ALONE):
        assert prepared is not None
        command += [
            "--controller",
            CORRECTED,
            "--model",
            prepared.files[BOTH if name == CORRECTED else EFFECTS],
        ]
    else:
        command += ["--controller", name]
    report = run_json(command)
    reference = linear = math.nan
    if report["outcome"] == "finished":
        tracked = track_file(record)
        off = np.linalg.norm(tracked.position - tracked.reference, axis=1)
        reference, linear = float(np.sqrt(np.mean(off**2))), tracked.rms
    cell = Cell(seed, disturbance.name, name, reference, linear, report["outcome"])
    write_whole(kept, json.dumps(asdict(cell)), "what was flown")
    record.unlink()
    record.with_suffix(".sealed").unlink(missing_ok=True)  # the simulator's answer is not looked at here
    return cell
