"""The main job, end to end: fly, compare, see where, name the missing effect, add it, fly again, reveal.

Simulator and companion run as processes of their own, as they would on a desk and on a vehicle; nothing here knows
what is hidden until `sim-bridge reveal` prints it at the end.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from trueflight.groundstation.evaluate.analysis import analyse
from trueflight.groundstation.evaluate.compare import compare, waterfall
from trueflight.groundstation.evaluate.tracking import Tracking, track_file
from trueflight.groundstation.evaluate.where import where_it_fails
from trueflight.groundstation.identify.actuation import actuation_of
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.operate.link import Link
from trueflight.groundstation.operate.processes import program, running_rig
from trueflight.groundstation.operate.settings import Settings
from trueflight.groundstation.output.as_json import analysis_table
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.report import render, write_report
from trueflight.groundstation.results import Comparison, Diagnosis, WaterfallStep, WhereItFails
from trueflight.groundstation.versions.store import add_effect, lineage, save
from trueflight.groundstation.views import write_analysis, write_before_after, write_tracking
from trueflight.models.errors import InputError
from trueflight.models.export import export_onnx, not_exported
from trueflight.models.model import Model, rigid_body_model
from trueflight.models.vehicle import Vehicle, load_vehicle
from trueflight.models.whole_file import write_whole

SURVEY: tuple[str, dict[str, float]] = ("excitation", {})
TASK: tuple[str, dict[str, float]] = ("lemniscate", {"speed": 2.5, "height": 0.8})
MARK = ".trueflight-demo"


class Audience(Protocol):
    """Whoever watches a demonstration: told of each step, and of what it showed."""

    def step(self, title: str, command: str) -> None:
        """A step begins; `command` is what does the same by hand."""

    def busy(self, text: str) -> AbstractContextManager[object]:
        """For as long as this is done."""

    def said(self, text: str, warning: bool = False) -> None:
        """One line of what came of it."""

    def compared(self, comparisons: Sequence[Comparison], where: WhereItFails) -> None:
        """Models against the flight."""

    def diagnosed(self, diagnosis: Diagnosis, held_out: Path) -> None:
        """What is missing; `held_out` is the file of the flight held out."""

    def fell(self, steps: tuple[WaterfallStep, ...], fitted: str, held_out: str) -> None:
        """The error as effects were added."""


@dataclass(frozen=True)
class Outcome:
    """What a demonstration measured."""

    folder: Path
    diagnosis: Diagnosis
    before: Comparison
    after: Comparison
    tracking: tuple[Tracking, Tracking]
    revealed: str
    recordings: tuple[Path, ...]
    seconds: float


def demonstrate(
    folder: Path, vehicle_file: Path, seed: int, hidden: Sequence[str], audience: Audience
) -> Outcome:
    """Run the whole job in `folder` on an effect drawn from `seed` (or on the effects in `hidden`)."""
    started = time.monotonic()
    _make(folder)
    vehicle = load_vehicle(vehicle_file)
    sealed = folder / "answer.sealed"
    truth = [word for name in (hidden or ["random"]) for word in ("--hidden", name)]
    truth += ["--seed", str(seed), "--sealed", str(sealed)]
    with running_rig(folder, vehicle_file, truth) as (endpoint, pids):
        audience.step(
            "Three processes", f"bridge {pids[0]}, companion {pids[1]}, ground station {os.getpid()}"
        )
        settings = Settings(connect=(endpoint,), name=vehicle.name)
        with Link(settings) as link:
            survey = _fly(audience, link, folder, *SURVEY, "lqr")
            task = _fly(audience, link, folder, *TASK, "lqr")
            model, diagnosis, before, after, recordings = _analyse(audience, folder, vehicle, survey, task)
            corrected = _deploy_and_fly(audience, link, folder, model, survey)
    audience.step("The answer", shlex.join(["sim-bridge", "reveal", str(sealed)]))
    revealed = _reveal(sealed, hidden)
    audience.said(f"hidden was: {revealed}")
    tracking = (track_file(task), track_file(corrected))
    write_tracking(folder / "tracking.rrd", tracking)
    recordings += (folder / "tracking.rrd",)
    return Outcome(
        folder, diagnosis, before, after, tracking, revealed, recordings, time.monotonic() - started
    )


def _make(folder: Path) -> None:
    """An empty folder; only an earlier demonstration's is emptied."""
    mark = folder / MARK
    if folder.exists() and any(folder.iterdir()):
        if not mark.exists():
            raise InputError(
                f"{folder}: holds files that are no demonstration's; choose another folder with --output"
            )
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(
        mark, "made by groundstation demo, which may empty this folder\n", "the mark of a demonstration"
    )


# --- the job -----------------------------------------------------------------------------------------------------


def _fly(
    audience: Audience, link: Link, folder: Path, name: str, parameters: dict[str, float], controller: str
) -> Path:
    """One mission from takeoff to landing; the path of its record on the ground."""
    audience.step(
        f"Fly {name}, controller {controller}",
        f"groundstation fly {name} --controller {controller} --wait",
    )
    mission = {"trajectory": name, "parameters": parameters, "controller": controller, "repeat": 1}
    answer = link.request("mission", mission)
    with audience.busy(f"flying {name}: {answer['duration']:.0f} s and takeoff and landing"):
        entry = link.end_of(answer["mission"])
    if entry["state"] != "finished":
        raise InputError(
            f"mission {name} {entry['state']}: {entry['reason']}; see {folder / 'companion.log'}"
        )
    record = link.fetch_record(entry["record"], folder)
    named = record.with_name(f"{name}-{controller}.mcap")
    record.replace(named)
    audience.said(f"flown and fetched: {named}")
    return named


def _analyse(
    audience: Audience, folder: Path, vehicle: Vehicle, survey: Path, task: Path
) -> tuple[Model, Diagnosis, Comparison, Comparison, tuple[Path, ...]]:
    """Compare, see where, diagnose, add what is missing. Returns the last model and what was measured."""
    fitted, held_out = read_flight(survey), read_flight(task)
    base = rigid_body_model(vehicle)
    store = folder / "models"
    files = shlex.join(map(str, (survey, "--validate", task)))
    audience.step("Compare the model with the flight", shlex.join(["groundstation", "compare", str(survey)]))
    before = compare(fitted, base)
    audience.compared([compare(fitted, m) for m in lineage(store, base)], where_it_fails(before))
    audience.step("Diagnose", f"groundstation diagnose {files}")
    diagnosis = diagnose(fitted, base, held_out)
    audience.diagnosed(diagnosis, task)
    model, parent = base, None
    for name in diagnosis.named("missing") or diagnosis.named("possible")[:1]:
        audience.step(
            f"Add {name}",
            f"groundstation model add {name} --flight {files}",
        )
        model, path = save(store, add_effect(model, name, [fitted]), parent)
        parent = model
        audience.said(f"new model version: {path}")
    line = lineage(store, model)
    steps = waterfall(fitted, held_out, line)
    audience.fell(steps, fitted.name, held_out.name)
    after = compare(fitted, model)
    recordings = folder / "analysis.rrd", folder / "before-after.rrd"
    whole = analyse(fitted, lineage(store, base), held_out)
    write_analysis(recordings[0], whole)
    first, last = (compare(held_out, m, horizons=False) for m in (line[0], model))
    write_before_after(recordings[1], first, last, steps)
    report = folder / "report.html"
    write_report(report, render(whole, analysis_table(whole)))
    audience.said(f"report: {report}")
    return model, diagnosis, before, after, recordings


def _deploy_and_fly(audience: Audience, link: Link, folder: Path, model: Model, survey: Path) -> Path:
    """Export, deploy, and fly the task corrected."""
    audience.step("Deploy", "groundstation model export; groundstation deploy")
    file = folder / "correction.onnx"
    with audience.busy("exporting to ONNX"):
        flight = read_flight(survey)
        onnx = export_onnx(model, flight, actuation=actuation_of(model, [flight]))
        write_whole(file, onnx, "the model", "choose another --output")
    answer = link.request("model", file.read_bytes(), 30.0)
    audience.said(f"accepted by the companion: {answer.get('reason') or file.name}")
    for effect in not_exported(model):
        audience.said(
            f"{effect} stays on the ground: a static correction has neither memory nor a sensor, so tracking gains "
            "only from the rest of the model",
            warning=True,
        )
    return _fly(audience, link, folder, *TASK, "corrected")


def _reveal(sealed: Path, hidden: Sequence[str]) -> str:
    if hidden:
        return ", ".join(hidden)
    done = subprocess.run(
        [program("sim-bridge"), "reveal", str(sealed)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise InputError(f"sim-bridge reveal failed: {done.stderr.strip()}")
    return " ".join(done.stdout.split())


REAL = (
    ("crazyswarm2_log08.csv", "upgraded motors"),
    ("crazyswarm2_log44.csv", "upgraded motors"),
    ("crazyswarm2_log201.csv", "carries a payload"),
)
"""Real flights in the repository, and what is known of them."""


def real_flights(folder: Path, audience: Audience) -> Iterator[tuple[str, Diagnosis]]:
    """The same analysis on the real Crazyflie flights in `folder`: what is known of each, and what is found."""
    for file, known in REAL:
        with audience.busy(f"diagnosing {file}"):
            flight = read_flight(folder / file)
            found = diagnose(flight, rigid_body_model(flight.vehicle))
        yield known, found
