"""Seeded flights of known truth for the calibration of the diagnosis: drawn, flown and diagnosed, one folder a study.

The flights are drawn here (what is hidden, how noisy the sensors are, where and how long the vehicle flies), flown by
`sim-bridge fly-many` as another program, and diagnosed as any flight. What is done stays in the folder, one file a
step.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import random
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trueflight.groundstation.evaluate.calibration import Case
from trueflight.groundstation.operate.processes import run_json
from trueflight.groundstation.study.batch import Row, fly_rows
from trueflight.groundstation.study.cases import case_from_table
from trueflight.models.contract import LQR, LQR_INTEGRAL
from trueflight.models.database import database
from trueflight.models.design import load_design
from trueflight.models.effect import BELOW_CEILING, DESCENT
from trueflight.models.effects import catalogue
from trueflight.models.errors import InputError
from trueflight.models.outside import json_object, read_text
from trueflight.models.reference import trajectory
from trueflight.models.trajectory import Segment, Trajectory, transfer
from trueflight.models.vehicle import GRAVITY, Vehicle, load_vehicle
from trueflight.models.whole_file import write_whole
from trueflight.models.workers import interrupts_held, worker_pool

SHARES = {0: 0.3, 1: 0.3, 2: 0.2, 3: 0.1, 4: 0.1}
"""Share of the flights with so many effects hidden in them."""
STRENGTHS = (0.25, 0.5, 1.0, 1.0)
"""Factors on the usual sizes of what is hidden, a quarter of the flights each."""
BEGINS = 0.5, (0.3, 0.75)
"""Of flights with an effect that may begin in flight, the share in which one does, and within which parts of it."""
LATE = 0.2, (0.03, 0.09)
"""Share of the flights whose position and velocity are logged through a first-order lag, and its time constants, s."""
RATES = {100.0: 0.8, 25.0: 0.2}
"""Share of the flights that are logged at so many Hz."""
DRAWN = 2
"""Which draws these are: with others a seed flies other flights, so that a folder does not go on with them."""
NOISE = (1.0, 2.0)
"""Scales of the sensors' noise, half of the flights each."""
LENGTHS = (0.5, 1.0, 1.0, 1.5)
"""Lengths of the flights, of the length asked for, a quarter each."""
KINDS = {"survey": 0.5, "task": 0.3, "gentle": 0.1, "descent": 0.1}
"""Share of each kind of flight: the excitation survey, a mixture of trajectories as for training, slow flight near a
hover, and fast descents."""
CHARGE = (0.6, 0.97)
"""The battery's state of charge at the start."""
CONTROLLERS = (LQR, LQR_INTEGRAL)
"""Half of the flights each, where the design has an integral."""
TOP = 2.5
"""m above ground: flights but descents stay below, for a ceiling may hang at 2.78 m."""
BETWEEN = (1.5, 3.0)
"""m/s and m/s² from the end of one trajectory to the start of the next."""
SETPOINTS = 50.0
"""Hz of the setpoints that are handed to the simulator; quintics join them."""
AIR_DENSITY = 1.225
"""kg/m³ at sea level."""
EVENTS = ("payload", "estimator_delay")
"""What the simulator can hide and no effect of the catalogue stands for."""


@dataclass(frozen=True)
class Sortie:
    """One flight of a study, before it is flown: `number` from 1, `seed` of the simulator, `rotor_speeds` whether its
    record has them; one effect `begins` so many s after take-off, by name; its log has `rate` rows a second and an
    estimate `late` by so many s."""

    number: int
    seed: int
    hidden: tuple[str, ...]
    kind: str
    seconds: float
    noise: float
    charge: float
    controller: str
    rotor_speeds: bool
    strength: float
    begins: dict[str, float]
    late: float
    rate: float

    @property
    def name(self) -> str:
        """Stem of its files."""
        return f"{self.number:04d}"


@dataclass(frozen=True)
class Study:
    """A folder of flights: the files of vehicle and design, `seed` of all draws, `seconds` of a flight of usual length,
    `names` of the effects that may be hidden, `beginners` those that may begin in flight, `strength` a factor on all
    sizes."""

    folder: Path
    vehicle: Path
    design: Path
    seed: int
    seconds: float
    names: tuple[str, ...]
    strength: float = 1.0
    beginners: tuple[str, ...] = ()

    def settings(self) -> dict[str, Any]:
        """All that the flights depend on, but their number."""
        return {
            "drawn": DRAWN,
            "seed": self.seed,
            "seconds": self.seconds,
            "effects": list(self.names),
            "beginners": list(self.beginners),
            "strength": self.strength,
            "vehicle": self.vehicle.read_text(encoding="utf-8"),
            "design": self.design.read_text(encoding="utf-8"),
        }

    def open(self) -> None:
        """Begin the folder or go on with it; raises `InputError` where it holds another study or foreign files."""
        index = self.folder / "study.json"
        text = json.dumps(self.settings(), indent=1)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if index.exists() and any(self.folder.glob("*.flight.json")):
                self._same(_read(index), index)
            elif not index.exists() and any(self.folder.iterdir()):
                raise InputError(f"{self.folder}: holds files that are no study's; choose another --output")
            else:
                _write(index, text)
        except (OSError, ValueError) as error:
            raise InputError(f"{index}: cannot be used ({error}); choose another --output") from None

    def _same(self, before: dict[str, Any], index: Path) -> None:
        for key, now in self.settings().items():
            if before.get(key) != now:
                was = (
                    f"{key} {before.get(key)}, now {now}" if key in ("seed", "seconds") else f"another {key}"
                )
                raise InputError(
                    f"{self.folder}: begun with {was} (see {index.name}); go on with the same, or choose another "
                    "--output"
                )


def study_of(
    folder: Path, vehicle: Path, design: Path | None, seed: int, seconds: float, strength: float
) -> Study:
    """A study of all that can be hidden; the design is that beside the vehicle file unless given. Raises `InputError`
    for files that are not there, and for flights too short to be held out in blocks."""
    if not 40.0 <= seconds <= 1800.0:
        raise InputError(
            f"--seconds {seconds:g}: must be 40 to 1800, shorter flights cannot be held out in blocks"
        )
    if not vehicle.is_file():
        raise InputError(f"{vehicle}: no such vehicle file")
    believed = design or vehicle.with_name("design.json")
    if not believed.is_file():
        raise InputError(
            f"{believed}: no design to fly by; make one: groundstation design {vehicle}, or pass --design"
        )
    may_begin = hideable()
    beginners = tuple(name for name, begins in may_begin.items() if begins)
    return Study(folder, vehicle, believed, seed, seconds, tuple(may_begin), strength, beginners)


def hideable() -> dict[str, bool]:
    """Names that the simulator can hide and the catalogue knows, with whether they may begin in flight; asks
    `sim-bridge effects`."""
    told = run_json(["sim-bridge", "effects", "--json"])["effects"]
    known = catalogue()
    return {
        row["name"]: row["may_begin"] for row in told if row["name"] in known and row["name"] not in EVENTS
    }


def sorties(study: Study, count: int) -> tuple[Sortie, ...]:
    """The first `count` flights of a study; more of them begin with the same.

    Every effect is hidden equally often: they are dealt from shuffled packs. How many a flight has follows `SHARES`
    within every ten.
    """
    generator = random.Random(f"trueflight calibrate {study.seed}")
    integral = load_design(study.design, load_vehicle(study.vehicle)).integral is not None
    names = study.names
    pack: list[str] = []

    def deal(number: int) -> tuple[str, ...]:
        nonlocal pack
        dealt: list[str] = []
        while len(dealt) < number:
            if not set(pack) - set(dealt):
                pack += generator.sample(list(names), len(names))
            dealt.append(pack.pop(next(i for i, name in enumerate(pack) if name not in dealt)))
        return tuple(dealt)

    tens: list[int] = []
    found = []
    for number in range(1, count + 1):
        if not tens:
            tens = [n for n, share in SHARES.items() for _ in range(round(10 * share))]
            generator.shuffle(tens)
        hidden = deal(min(tens.pop(), len(names)))
        # in the simulator's order, for there a later effect may act on what an earlier one has made of the thrust
        ordered = tuple(sorted(hidden, key=names.index))
        found.append(_sortie(generator, number, ordered, study, integral))
    return tuple(found)


def _sortie(
    generator: random.Random, number: int, hidden: tuple[str, ...], study: Study, integral: bool
) -> Sortie:
    (kind,) = generator.choices(list(KINDS), list(KINDS.values()))
    descends = generator.random() < 0.7
    if _shown_in(DESCENT, hidden) and descends:
        kind = "descent"  # no other flight can show it
    if _shown_in(BELOW_CEILING, hidden) and kind == "descent":
        kind = "survey"  # it would begin above the ceiling
    seconds = study.seconds * generator.choice(LENGTHS)
    share, (early, by_then) = BEGINS
    able = [name for name in hidden if name in study.beginners]
    changing = generator.random() < share
    moment = round(seconds * generator.uniform(early, by_then), 1)
    lags, (least, most) = LATE
    lag = round(generator.uniform(least, most), 3)
    return Sortie(
        number=number,
        seed=generator.randrange(2**31),
        hidden=hidden,
        kind=kind,
        seconds=seconds,
        noise=generator.choice(NOISE),
        charge=round(generator.uniform(*CHARGE), 3),
        controller=generator.choice(CONTROLLERS if integral else CONTROLLERS[:1]),
        rotor_speeds=generator.random() < 0.5,
        strength=generator.choice(STRENGTHS),
        begins={generator.choice(able): moment} if able and changing else {},
        late=lag if generator.random() < lags else 0.0,
        rate=generator.choices(list(RATES), list(RATES.values()))[0],
    )


def _shown_in(flight: str, hidden: Sequence[str]) -> bool:
    """Whether something is hidden that this kind of flight alone shows."""
    known = catalogue()
    return any(name in known and known[name].shown_in == flight for name in hidden)


# --- where a flight goes --------------------------------------------------------------------------------------------


def path_of(sortie: Sortie, vehicle: Vehicle) -> Trajectory:
    """The trajectory of a flight, at least as long as asked."""
    generator = random.Random(f"trueflight calibrate path {sortie.seed}")
    segments: list[Segment] = []
    here = None
    flown = 0.0
    for leg in _legs(sortie, vehicle, generator):
        if here is not None:
            between = transfer(here, leg.start, *BETWEEN)
            # the leg after it begins with a yaw of its own, a turn away at most: heading is the same
            segments += between.segments
            flown += between.duration
        segments += leg.segments
        flown += leg.duration
        here = leg.end
        if flown >= sortie.seconds:
            break
    return Trajectory(sortie.kind, tuple(segments))


def _legs(sortie: Sortie, vehicle: Vehicle, generator: random.Random) -> Iterator[Trajectory]:
    if sortie.kind == "task":
        for one in database(sortie.seed, 1000.0 if sortie.seconds > 600 else 30.0):
            if one.trajectory != "excitation" and one.path.bounds[1][2] <= TOP:
                yield one.path
    while True:
        if sortie.kind == "descent":
            yield _descent(vehicle, generator)
        elif sortie.kind == "gentle":
            yield _gentle(generator)
        else:
            yield _survey(sortie, generator)


def _survey(sortie: Sortie, generator: random.Random) -> Trajectory:
    low, speed = generator.uniform(0.15, 0.4), generator.uniform(2.5, 4.5)
    height = generator.uniform(1.0, TOP - 1.2)
    if _shown_in(BELOW_CEILING, sortie.hidden):
        height = TOP - 1.2
    return trajectory("excitation", low=low, speed=speed, height=height)


def _gentle(generator: random.Random) -> Trajectory:
    """Slow flight near a hover, which shows little: what a flight cannot show must not be named."""
    height = generator.uniform(0.8, 1.8)
    kind = generator.choice(("hover", "steps", "rotation", "translation"))
    if kind == "hover":
        return trajectory("hover", height=height, duration=generator.uniform(8.0, 15.0))
    if kind == "steps":
        seed = float(generator.randrange(10**6))
        return trajectory("steps", size=0.3, height=height, time=4.0, count=3.0, seed=seed)
    if kind == "rotation":
        return trajectory("rotation", angle=generator.uniform(-3.0, 3.0), rate=0.8, height=height)
    plane = generator.choice(("x", "y", "xy"))
    return trajectory("translation", plane=plane, size=1.0, speed=generator.uniform(0.4, 0.8), height=height)


def _descent(vehicle: Vehicle, generator: random.Random) -> Trajectory:
    """Up and down again at up to 1.4 times the rotors' induced velocity, where the vortex ring is."""
    area = max(len(vehicle.rotor_positions), 1) * math.pi * vehicle.rotor_radius**2
    induced = math.sqrt(vehicle.mass * GRAVITY / (2.0 * AIR_DENSITY * area))
    speed = generator.uniform(0.6, 1.4) * induced
    acceleration = 4.0
    # a minimum-jerk transfer that reaches both peaks
    size = 1.64 * speed**2 / acceleration
    plane = generator.choice(("z", "z", "xz", "yz"))
    return trajectory(
        "translation", plane=plane, size=float(np.clip(size, 1.0, 50.0)), speed=speed, height=1.5
    )


def setpoints(path: Trajectory) -> str:
    """The CSV that `sim-bridge fly --trajectory` reads."""
    t = np.arange(round(path.duration * SETPOINTS) + 1) / SETPOINTS
    sampled = path.sample(t)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["t", "x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "yaw"])
    rows = np.column_stack(
        [t, sampled.position, sampled.velocity, sampled.acceleration, np.unwrap(sampled.yaw)]
    )
    writer.writerows([[f"{value:.6g}" for value in row] for row in rows])
    return out.getvalue()


# --- flying and diagnosing ------------------------------------------------------------------------------------------


TOGETHER = 256
"""Flights that are flown at once; what an interruption loses at most."""


def flight_rows(study: Study, some: Sequence[Sortie]) -> list[Row]:
    """Each flight as a row for `sim-bridge fly-many`; setpoints lie beside the table."""
    return [
        {
            "name": sortie.name,
            "trajectory": f"{sortie.name}.setpoints.csv",
            "hidden": ";".join(
                f"{n}@{sortie.begins[n]}" if n in sortie.begins else n for n in sortie.hidden or ("none",)
            ),
            "strength": study.strength * sortie.strength,
            "seed": sortie.seed,
            "noise": sortie.noise,
            "charge": sortie.charge,
            "controller": sortie.controller,
            "rotor_speeds": str(sortie.rotor_speeds).lower(),
        }
        for sortie in some
    ]


def fly(
    study: Study, wanted: Sequence[Sortie], jobs: int, done: Callable[[int], None]
) -> list[dict[str, Any]]:
    """Fly all sorties that have not been flown, many at once: of each how it went, and what was hidden.

    `done` hears how many more have been flown.
    """
    kept = {sortie.name: _kept(study, sortie) for sortie in wanted}
    missing = [sortie for sortie in wanted if kept[sortie.name] is None]
    done(len(wanted) - len(missing))
    vehicle = load_vehicle(study.vehicle)
    for begin in range(0, len(missing), TOGETHER):
        some = missing[begin : begin + TOGETHER]
        for sortie in some:
            path = (study.folder / sortie.name).with_suffix(".setpoints.csv")
            _write(path, setpoints(path_of(sortie, vehicle)))
        more = ["--design", study.design, "--tell-hidden", "--jobs", jobs]
        reports = fly_rows(flight_rows(study, some), study.folder, study.vehicle, *more)
        for sortie in some:
            kept[sortie.name] = told = _told(sortie, reports[sortie.name], vehicle)
            _write(study.folder / f"{sortie.name}.flight.json", json.dumps(told, indent=1))
        done(len(some))
    return [told for told in kept.values() if told is not None]


def _kept(study: Study, sortie: Sortie) -> dict[str, Any] | None:
    """What is told of a sortie that has been flown."""
    path = (study.folder / sortie.name).with_suffix(".flight.json")
    if not path.exists():
        return None
    told = _read(path)
    if told.get("sortie") != json.loads(json.dumps(asdict(sortie))):
        raise InputError(f"{path}: was flown for another study; choose another --output")
    return told


def _told(sortie: Sortie, report: dict[str, Any], vehicle: Vehicle) -> dict[str, Any]:
    return {
        "sortie": asdict(sortie),
        "outcome": report["outcome"],
        "seconds": report["simulated"],
        "ticks_on_ground": report["ticks_on_ground"],
        "hidden": report["hidden"],
        "vehicle": vehicle.name,
        "command_delay": vehicle.command_delay,
    }


def diagnose_record(study: Study, sortie: Sortie) -> dict[str, Any]:
    """Diagnose a record as any flight, or tell what was found before; its failure is told under "error"."""
    from trueflight.groundstation.identify.translation import diagnose
    from trueflight.groundstation.output.as_json import diagnosis_table
    from trueflight.groundstation.study.logged import read_logged
    from trueflight.models.model import rigid_body_model

    kept = (study.folder / sortie.name).with_suffix(".diagnosis.json")
    if kept.exists():
        told = _read(kept)
        return told
    begin = time.perf_counter()
    try:
        record = (study.folder / sortie.name).with_suffix(".mcap")
        flight = read_logged(record, sortie.late, sortie.rate)
        told = diagnosis_table(diagnose(flight, rigid_body_model(flight.vehicle)))
    except Exception as error:  # noqa: BLE001 - one flight that ends in an error is a finding, not the end
        told = {"error": f"{type(error).__name__}: {error}"}
    told["diagnosis_seconds"] = time.perf_counter() - begin
    _write(kept, json.dumps(told, indent=1))
    return told


def _work(study: Study, sortie: Sortie, flown: dict[str, Any]) -> Case:
    finished = flown["outcome"] == "finished"
    diagnosis = diagnose_record(study, sortie) if finished else None
    return case_from_table(flown, diagnosis, load_vehicle(study.vehicle))


def run(
    study: Study,
    wanted: Sequence[Sortie],
    jobs: int,
    done: Callable[[Case], None],
    flown: Callable[[int], None] = lambda more: None,
) -> tuple[Case, ...]:
    """Fly what the folder lacks, then diagnose; `flown` hears how many more have been flown, `done` of each diagnosis.
    In the order of `wanted`.

    With `jobs` 1 here, otherwise in so many processes. When interrupted, flights under way are finished and kept, and
    the rest is not begun.
    """
    cases: dict[int, Case] = {}
    try:
        told = fly(study, wanted, jobs, flown)
        for case in _each(study, list(zip(wanted, told, strict=True)), min(jobs, len(wanted))):
            cases[case.number] = case
            done(case)
    except BrokenProcessPool:
        raise InputError(
            f"{study.folder}: a process was ended from outside (out of memory?); the same command goes on, with fewer "
            "--jobs if need be"
        ) from None
    except KeyboardInterrupt:
        raise InputError(
            f"interrupted: {len(cases)} of {len(wanted)} flights are done in {study.folder}; the same command goes on"
        ) from None
    return tuple(cases[sortie.number] for sortie in wanted)


def _each(study: Study, flown: Sequence[tuple[Sortie, dict[str, Any]]], jobs: int) -> Iterator[Case]:
    if jobs == 1:
        yield from (_work(study, sortie, told) for sortie, told in flown)
        return
    # each worker uses one core; the variables are read when the workers' numpy is loaded
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    with worker_pool(jobs) as pool:
        with interrupts_held():
            begun = [pool.submit(_work, study, sortie, told) for sortie, told in flown]
        yield from (one.result() for one in as_completed(begun))


def forget_diagnoses(study: Study) -> None:
    """Let every flight be diagnosed anew; the flights stay."""
    for path in study.folder.glob("*.diagnosis.json"):
        path.unlink()


def _read(path: Path) -> dict[str, Any]:
    advice = "remove it, and the same command goes on"
    return json_object(read_text(path, "the study", advice), str(path), advice)


def _write(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    write_whole(path, text, "the study", "choose another --output")
