"""The paper's experiment, end to end and with any vehicle: collect, diagnose, train, fly every controller, compare.

The simulated vehicle is another program whose truth is drawn by a seed and not told to anything here: a training
database is flown with the plain cascade, effects are diagnosed and fitted, networks are trained, and each
controller flies trajectories that no model has seen. What counts is the mean squared error per axis against the
expected linear behaviour, as in Table I of Carvalho et al., ICUAS 2022.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from trueflight.groundstation.evaluate.tracking import track_file
from trueflight.groundstation.identify.actuation import actuation_of
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.learn.training import train
from trueflight.groundstation.learn.training_data import samples_of_flights
from trueflight.groundstation.operate.processes import run_json, running_rig
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.study.batch import Row, fly_rows
from trueflight.groundstation.versions.store import add_effect
from trueflight.groundstation.views import write_tracking
from trueflight.models.contract import CORRECTED, LQR, LQR_INTEGRAL
from trueflight.models.errors import InputError
from trueflight.models.export import export_onnx
from trueflight.models.flight import Flight
from trueflight.models.model import Model, linear_model, rigid_body_model, write_model
from trueflight.models.outside import json_object, read_text
from trueflight.models.vehicle import load_vehicle
from trueflight.models.whole_file import write_whole

UNSEEN = 100
"""Added to a seed for the trajectories of the scenarios: no training database holds them."""
CHARGE = 0.6
"""State of charge that the flights begin with: in the middle of what is flown, as no flight is on a full battery."""
EFFECTS, NETWORK, BOTH = "effects", "network", "effects + network"
MODELS = (EFFECTS, NETWORK, BOTH)
SETTLE = 4.0
"""s of hover before a scenario begins, as the companion waits at the start: integral and correction have settled."""
_SURVEYS = 4
"""Surveys that effects are diagnosed and fitted on: several batteries, several heights."""


@dataclass(frozen=True)
class Scenario:
    """One flight that no model has seen: its trajectory and the truth beside the seed's own, as words for
    `sim-bridge fly`; `seeded` where the trajectory itself is drawn."""

    name: str
    title: str
    trajectory: str
    parameters: tuple[tuple[str, float], ...] = ()
    truth: tuple[str, ...] = ()
    seeded: bool = True

    def settings(self, seed: int) -> dict[str, float]:
        """Parameters of the trajectory for this seed."""
        return dict(self.parameters) | ({"seed": float(UNSEEN + seed)} if self.seeded else {})


def _steps(name: str, title: str, *truth: str) -> Scenario:
    return Scenario(name, title, "scenario", (("speed", 3.0),), truth)


SCENARIOS = (
    _steps("unseen", "steps and translations, unseen (Fig. 6)", "--charge", str(CHARGE)),
    Scenario(
        "low",
        "lemniscate 15 cm above the ground (Fig. 10)",
        "lemniscate",
        (("height", 0.15),),
        ("--charge", str(CHARGE)),
        seeded=False,
    ),
    _steps("half", "battery half full (Fig. 8)", "--charge", "0.5"),
    _steps(
        "old",
        "old battery, 1.5 times the resistance (Fig. 8)",
        "--charge",
        str(CHARGE),
        "--battery-age",
        "1.5",
    ),
    _steps("wind", "steady wind of 3 m/s", "--charge", str(CHARGE), "--hidden", "wind:3"),
    _steps(
        "payload", "payload of 12 % picked up in flight", "--charge", str(CHARGE), "--hidden", "payload:0.12"
    ),
)


@dataclass(frozen=True)
class Flown:
    """One flight of the experiment: MSE per axis (m²) against the expected linear behaviour."""

    seed: int
    scenario: str
    controller: str
    mse: tuple[float, float, float]
    outcome: str
    guard: str
    through: str = "in-process"


@dataclass(frozen=True)
class Arm:
    """One way to fly: a controller of the companion, with one of the models or none, its trim and its
    observer."""

    name: str
    controller: str
    model: str = ""
    look_ahead: bool = True
    trim: float | None = None
    observer: float | None = None


ARMS = (
    Arm("lqr", LQR),
    Arm("lqr + integral", LQR_INTEGRAL),
    Arm(EFFECTS, CORRECTED, EFFECTS),
    Arm(NETWORK, CORRECTED, NETWORK),
    Arm(BOTH, CORRECTED, BOTH),
)
"""The columns of the table."""
ANATOMY = (
    Arm("at once, no trim", CORRECTED, BOTH, look_ahead=False, trim=0.0, observer=0.0),
    Arm("+ look-ahead", CORRECTED, BOTH, trim=0.0, observer=0.0),
    Arm("+ trim", CORRECTED, BOTH, observer=0.0),
    Arm("+ observer", CORRECTED, BOTH),
)
"""What each part of the corrected controller is worth, with effects and network."""
PAPER: dict[str, dict[str, tuple[float, float, float]]] = {
    "simulation": {
        "LQR": (0.0049, 0.0032, 0.0477),
        "LQR + integral": (0.0021, 0.030, 0.0259),
        "DNN": (0.00029, 0.00022, 0.00073),
    },
    "real flight": {
        "LQR": (0.0060, 0.0815, 0.0380),
        "LQR + integral": (0.0150, 0.0125, 0.0198),
        "DNN": (0.0016, 0.0017, 0.0046),
    },
}
"""Table I of the paper, m²."""


@dataclass(frozen=True)
class Prepared:
    """What one seed's vehicle has taught: ONNX files by model, with and without look-ahead, and the figures."""

    seed: int
    files: dict[str, Path]
    found: tuple[str, ...]
    figures: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Study:
    """All flights of the experiment, and what each seed's vehicle has taught."""

    flown: tuple[Flown, ...]
    prepared: tuple[Prepared, ...]

    def mse(self, scenario: str, controller: str, through: str = "in-process") -> np.ndarray:
        """MSE (seeds, 3) of the flights of one cell."""
        rows = [
            f.mse
            for f in self.flown
            if (f.scenario, f.controller, f.through) == (scenario, controller, through)
        ]
        return np.array(rows, dtype=float).reshape(-1, 3)


@dataclass(frozen=True)
class Asked:
    """What a study in `folder` is of: the vehicle file, what is hidden in it (names as `sim-bridge` takes them), and
    the minutes of flight to train on."""

    folder: Path
    vehicle: Path
    hidden: tuple[str, ...]
    minutes: float

    @property
    def truth(self) -> list[str]:
        """The words for `sim-bridge` that hide it."""
        return [word for name in self.hidden for word in ("--hidden", name)]

    def open(self) -> None:
        """Begin the folder or go on with it; raises `InputError` where it holds another study or foreign files."""
        if not self.vehicle.is_file():
            raise InputError(f"{self.vehicle}: no such vehicle file; give --vehicle")
        self.folder.mkdir(parents=True, exist_ok=True)
        vehicle = self.vehicle.read_text(encoding="utf-8")
        same_study(self.folder, {"hidden": list(self.hidden), "minutes": self.minutes, "vehicle": vehicle})


def one_vehicle(
    asked: Asked,
    seed: int,
    scenarios: Sequence[Scenario],
    real: Sequence[Scenario],
    jobs: int,
    tell: Callable[[str, int], None],
) -> tuple[Prepared, list[Flown]]:
    """Prepare the vehicle of `seed` and fly it: `scenarios` in-process, `jobs` at a time, and those that are `real`
    through the companion, too. `tell` is called with what is done now, and how many pieces are done with it."""
    folder = asked.folder / f"vehicle-{seed}"
    one = prepare(folder, asked.vehicle, seed, asked.truth, asked.minutes, lambda what: tell(what, 1))
    tell("fly", 0)
    flown = fly_all(folder, asked.vehicle, one, asked.truth, scenarios, jobs, lambda: tell("fly", 1))
    if real:
        tell("fly with the companion", 0)
    flown += fly_companion(
        folder, asked.vehicle, one, asked.truth, real, lambda: tell("fly with the companion", 1)
    )
    return one, flown


def prepare(
    folder: Path, vehicle: Path, seed: int, truth: Sequence[str], minutes: float, tell: Callable[[str], None]
) -> Prepared:
    """Collect, diagnose, fit, train and export for one seed's vehicle; what is in `folder` already is kept.

    `truth` are words for `sim-bridge` that hide what is to be found. `tell` is called with what is done now.
    """
    kept = folder / "prepared.json"
    if (table := _told(kept, {"files": dict, "found": list, "figures": dict})) is not None:
        files = {name: folder / str(file) for name, file in table["files"].items()}
        if all(file.is_file() for file in files.values()):
            return Prepared(seed, files, tuple(table["found"]), table["figures"])
    folder.mkdir(parents=True, exist_ok=True)
    tell("collect")
    collected = run_json(
        ["sim-bridge", "collect", "--vehicle", vehicle, *truth, "--seed", seed]
        + ["--minutes", minutes, "-o", folder / "flights", "--json"]
    )
    tell("read")
    paths = sorted((folder / "flights").glob("*.mcap"))
    flights = [read_flight(path) for path in paths]
    surveys = [f for f, path in zip(flights, paths, strict=True) if "excitation" in path.name][:_SURVEYS]
    if not surveys:
        raise InputError(f"{folder / 'flights'}: no survey in it; collect at least 5 minutes")
    tell("diagnose")
    base = rigid_body_model(load_vehicle(vehicle))
    model, found = fit_effects(base, surveys)
    tell("train")
    figures = {"minutes": collected["seconds"] / 60.0, "collect_s": collected["wall"]}
    versions = {EFFECTS: model}
    for name, below in ((NETWORK, linear_model(base.vehicle)), (BOTH, model)):
        samples = samples_of_flights(flights, below)
        done = train(samples, seed=seed)
        versions[name] = below.with_network(done.network)
        figures[f"{name}: held-out RMS before"] = float(
            np.sqrt(np.mean(samples.target[done.validation] ** 2))
        )
        figures[f"{name}: held-out RMS"] = done.history[done.best - 1].validation_rms
        figures["noise floor"] = samples.noise_floor
    tell("export")
    actuation = actuation_of(model, surveys)
    files = {}
    for name, version in versions.items():
        stem = name.replace(" + ", "-and-")
        (folder / f"{stem}.json").unlink(missing_ok=True)
        write_model(version, folder / f"{stem}.json")
        for tag, known in (("", actuation), (" at once", None)):
            if tag and name != BOTH:
                continue
            files[name + tag] = folder / f"{stem}{tag.replace(' ', '-')}.onnx"
            write_whole(files[name + tag], export_onnx(version, *flights, actuation=known), "the model")
    figures |= {f"actuation: {k}": v for k, v in actuation.items()}
    table = {"files": {k: v.name for k, v in files.items()}, "found": list(found), "figures": figures}
    write_whole(kept, json.dumps(table, indent=1), "what was prepared")
    return Prepared(seed, files, found, figures)


def fit_effects(base: Model, surveys: Sequence[Flight]) -> tuple[Model, tuple[str, ...]]:
    """The effects that the first survey misses, fitted to all of them in the order of their rank."""
    diagnosis = diagnose(surveys[0], base)
    ranked = sorted((e for e in diagnosis.effects if e.rank), key=lambda e: e.rank or 0)
    found = tuple(e.name for e in ranked)
    model = base
    for name in found:
        model = add_effect(model, name, surveys)
    return model, found


def fly_all(
    folder: Path,
    vehicle: Path,
    prepared: Prepared,
    truth: Sequence[str],
    scenarios: Sequence[Scenario],
    jobs: int,
    advance: Callable[[], None],
) -> list[Flown]:
    """Every scenario with every controller, in-process and all at once; flights that are in `folder` already are not
    flown again."""
    arms = [(scenario, arm) for scenario in scenarios for arm in ARMS]
    arms += [(scenarios[0], arm) for arm in ANATOMY[:-1]]
    known = {_stem(*task): _known(folder / _stem(*task)) for task in arms}
    missing = [task for task in arms if known[_stem(*task)] is None]
    reports: dict[str, dict[str, Any]] = {}
    if missing:
        for task in missing:
            _clear(folder / _stem(*task))
        rows = flight_rows(prepared, truth, missing)
        more = ["--seed", prepared.seed, "--settle", SETTLE, "--jobs", jobs]
        reports = fly_rows(rows, folder, vehicle, *more)

    def one(task: tuple[Scenario, Arm]) -> Flown:
        scenario, arm = task
        stem = _stem(scenario, arm)
        flown = known[stem]
        if flown is None:
            flown = _keep(folder / stem, _judged(folder, prepared, scenario, arm, reports[stem]))
        advance()
        return flown

    with ThreadPoolExecutor(jobs) as pool:
        return list(pool.map(one, arms))


def flight_rows(prepared: Prepared, truth: Sequence[str], tasks: Sequence[tuple[Scenario, Arm]]) -> list[Row]:
    """Each flight as a row for `sim-bridge fly-many`."""
    rows: list[Row] = []
    for scenario, arm in tasks:
        settings = (f"{key}={value:g}" for key, value in scenario.settings(prepared.seed).items())
        words = [*truth, *scenario.truth]
        told = list(zip(words[::2], words[1::2], strict=True))
        model = arm.model + ("" if arm.look_ahead else " at once")
        rows.append(
            {
                "name": _stem(scenario, arm),
                "trajectory": scenario.trajectory,
                "set": ";".join(settings),
                "hidden": ";".join(value for option, value in told if option == "--hidden"),
                "charge": dict(told).get("--charge", ""),
                "battery_age": dict(told).get("--battery-age", ""),
                "controller": arm.controller,
                "model": prepared.files[model].resolve() if arm.model else "",
                "trim": "" if arm.trim is None else arm.trim,
                "observer": "" if arm.observer is None else arm.observer,
            }
        )
    return rows


def _stem(scenario: Scenario, arm: Arm) -> str:
    return f"{scenario.name}-{arm.name.replace(' ', '-').replace(',', '')}"


def _kept(path: Path, fly: Callable[[Path], Flown]) -> Flown:
    """What is known of the flight at `path` (without suffix), flown now where nothing is."""
    if (known := _known(path)) is not None:
        return known
    _clear(path)
    return _keep(path, fly(path))


def _clear(path: Path) -> None:
    """Take away the record of a run that was killed before it could tell."""
    path.with_name(f"{path.name}.mcap").unlink(missing_ok=True)


def _keep(path: Path, flown: Flown) -> Flown:
    write_whole(path.with_name(f"{path.name}.json"), json.dumps(asdict(flown)), "what was flown")
    return flown


def _known(path: Path) -> Flown | None:
    """What an earlier run kept of the flight at `path` (without suffix)."""
    kinds = {
        "seed": int, "scenario": str, "controller": str, "mse": list, "outcome": str, "guard": str, "through": str,
    }  # fmt: skip
    table = _told(path.with_name(f"{path.name}.json"), kinds)
    return None if table is None else Flown(**{**table, "mse": tuple(table["mse"])})


def _told(kept: Path, kinds: dict[str, type]) -> dict[str, Any] | None:
    """What an earlier run kept in a file; None where there is none, or it is damaged: it is done again."""
    if not kept.exists():
        return None
    try:
        table = json_object(read_text(kept, "the study", "it is done again"), str(kept), "it is done again")
    except InputError:
        return None
    whole = set(table) == set(kinds) and all(isinstance(table[key], kind) for key, kind in kinds.items())
    return table if whole else None


def _judged(folder: Path, prepared: Prepared, scenario: Scenario, arm: Arm, report: dict[str, Any]) -> Flown:
    mse = track_file(folder / f"{_stem(scenario, arm)}.mcap").mse
    return Flown(prepared.seed, scenario.name, arm.name, mse, report["outcome"], report["guard"])


def fly_companion(
    folder: Path,
    vehicle: Path,
    prepared: Prepared,
    truth: Sequence[str],
    scenarios: Sequence[Scenario],
    advance: Callable[[], None],
) -> list[Flown]:
    """The same through the real companion over MAVLink, in real time: a fresh battery, bridge and companion each."""
    out = []
    for scenario in scenarios:
        for arm in (ARMS[0], ARMS[1], ARMS[4]):
            path = folder / f"companion-{_stem(scenario, arm)}"
            out.append(_kept(path, partial(_fly_companion, vehicle, prepared, truth, scenario, arm)))
            advance()
    return out


def _fly_companion(
    vehicle: Path, prepared: Prepared, truth: Sequence[str], scenario: Scenario, arm: Arm, rig: Path
) -> Flown:
    words = [*truth, "--seed", str(prepared.seed), *scenario.truth]
    mission = {
        "trajectory": scenario.trajectory,
        "parameters": scenario.settings(prepared.seed),
        "controller": arm.controller,
        "repeat": 1,
    }
    model = prepared.files[arm.model] if arm.model else None
    entry, record = through_companion(rig, vehicle, words, mission, model)
    if entry["state"] != "finished":
        raise InputError(
            f"{rig.name}, seed {prepared.seed}: {entry['state']}: {entry['reason']}; see {rig / 'companion.log'}"
        )
    guard = ""
    if arm.model:
        from trueflight.models.record import read_record

        flags = read_record(record).ticks["guard"]
        guard = next((str(g) for g in flags if "tripped" in str(g)), "active")
    return Flown(
        prepared.seed, scenario.name, arm.name, track_file(record).mse, "finished", guard, "companion"
    )


def through_companion(
    rig: Path, vehicle: Path, words: Sequence[str], mission: dict[str, Any], model: Path | None
) -> tuple[dict[str, Any], Path]:
    """Fly one mission in real time, by a bridge (`words` for `sim-bridge run`) and a companion of its own in the folder
    `rig`: the companion's entry of the mission, and its record."""
    from trueflight.groundstation.operate.link import Link
    from trueflight.groundstation.operate.settings import Settings

    rig.mkdir(exist_ok=True)
    name = load_vehicle(vehicle).name
    with (
        running_rig(rig, vehicle, words) as (endpoint, _),
        Link(Settings(connect=(endpoint,), name=name)) as link,
    ):
        if model is not None:
            link.request("model", model.read_bytes(), 60.0)
        answer = link.request("mission", mission, 30.0)
        entry = link.end_of(answer["mission"])
        return entry, link.fetch_record(entry["record"], rig)


def chosen_scenarios(names: Sequence[str] | None) -> list[Scenario]:
    """The scenarios of these names, all where none is named; raises `InputError` for a name that is none."""
    if not names:
        return list(SCENARIOS)
    by_name = {s.name: s for s in SCENARIOS}
    for name in names:
        if name not in by_name:
            raise InputError(f"--scenario {name}: unknown; choose from {', '.join(by_name)}")
    return [by_name[name] for name in dict.fromkeys(names)]


def same_study(output: Path, asked: dict[str, Any]) -> None:
    """Keep what was asked in the folder; raises `InputError` where it holds another study or foreign files."""
    path = output / "study.json"
    text = json.dumps(asked, indent=1)
    if path.exists() and path.stat().st_size:  # empty where an earlier version was killed
        if read_text(path, "the study", "choose another --output") != text:
            raise InputError(f"{output}: holds another study (see {path.name}); choose another --output")
    elif any(p != path and not p.name.startswith(".") for p in output.iterdir()):
        raise InputError(f"{output}: holds files that are no study's; choose another --output")
    else:
        write_whole(path, text, "the study", "choose another --output")


def write_unseen(path: Path, folder: Path, scenario: Scenario) -> None:
    """A recording of the three controllers of the paper on one scenario, from the records in `folder`."""
    names = {"lqr": "lqr", "lqr-+-integral": "lqr_integral", "effects-+-network": "corrected"}
    tracked = [
        replace(track_file(folder / f"{scenario.name}-{stem}.mcap"), label=label)
        for stem, label in names.items()
    ]
    write_tracking(path, tracked)
