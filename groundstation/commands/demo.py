"""The main job, end to end: fly, compare, see where, name the missing effect, add it, fly again, reveal.

Simulator and companion run as processes of their own, as they would on a desk and on a vehicle; nothing here knows
what is hidden until `sim-bridge reveal` prints it at the end.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from trueflight.groundstation.evaluate.compare import compare, waterfall
from trueflight.groundstation.evaluate.tracking import Tracking, track_file
from trueflight.groundstation.evaluate.where import where_it_fails
from trueflight.groundstation.identify.actuation import actuation_of
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.operate.link import Link
from trueflight.groundstation.operate.processes import program, running_rig
from trueflight.groundstation.operate.settings import Settings
from trueflight.groundstation.output.tables import (
    SAID,
    percent,
    print_comparisons,
    print_diagnosis,
    print_waterfall,
    print_where,
)
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.results import Comparison, Diagnosis
from trueflight.groundstation.versions.store import add_effect, lineage, save
from trueflight.models.errors import InputError
from trueflight.models.export import export_onnx, not_exported
from trueflight.models.flight import Flight
from trueflight.models.model import Model, rigid_body_model
from trueflight.models.vehicle import QUAD5, Vehicle, load_vehicle
from trueflight.models.whole_file import write_whole

SURVEY: tuple[str, dict[str, float]] = ("excitation", {})
TASK: tuple[str, dict[str, float]] = ("lemniscate", {"speed": 2.5, "height": 0.8})
MARK = ".trueflight-demo"


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
    folder: Path, seed: int, hidden: Sequence[str], console: Console, open_viewer: bool = True
) -> Outcome:
    """Run the whole job in `folder` on an effect drawn from `seed` (or on the effects in `hidden`)."""
    started = time.monotonic()
    _make(folder)
    vehicle = load_vehicle(QUAD5)
    sealed = folder / "answer.sealed"
    truth = [word for name in (hidden or ["random"]) for word in ("--hidden", name)]
    truth += ["--seed", str(seed), "--sealed", str(sealed)]
    with running_rig(folder, QUAD5, truth) as (endpoint, pids):
        _step(
            console, "Three processes", f"bridge {pids[0]}, companion {pids[1]}, ground station {os.getpid()}"
        )
        settings = Settings(connect=(endpoint,), name=vehicle.name)
        with Link(settings) as link:
            survey = _fly(console, link, folder, *SURVEY, "lqr")
            task = _fly(console, link, folder, *TASK, "lqr")
            model, diagnosis, before, after, recordings = _analyse(console, folder, vehicle, survey, task)
            corrected = _deploy_and_fly(console, link, folder, model, survey)
    _step(console, "The answer", "sim-bridge reveal")
    revealed = _reveal(sealed, hidden)
    console.print(f"hidden was: {revealed}", highlight=False)
    tracking = (track_file(task), track_file(corrected))
    recordings += _tracking_recording(folder, tracking)
    outcome = Outcome(
        folder, diagnosis, before, after, tracking, revealed, recordings, time.monotonic() - started
    )
    _summary(console, outcome)
    if open_viewer and (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform == "darwin"
    ):
        subprocess.Popen([program("rerun"), *map(str, recordings)], start_new_session=True)
    return outcome


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


def _step(console: Console, title: str, command: str) -> None:
    console.print()
    console.rule(f"[bold]{title}[/bold]  [dim]{command}[/dim]", align="left")


# --- the job -----------------------------------------------------------------------------------------------------


def _fly(
    console: Console, link: Link, folder: Path, name: str, parameters: dict[str, float], controller: str
) -> Path:
    """One mission from takeoff to landing; the path of its record on the ground."""
    _step(
        console,
        f"Fly {name}, controller {controller}",
        f"groundstation fly {name} --controller {controller} --wait",
    )
    mission = {"trajectory": name, "parameters": parameters, "controller": controller, "repeat": 1}
    answer = link.request("mission", mission)
    with console.status(f"flying {name}: {answer['duration']:.0f} s and takeoff and landing"):
        entry = link.end_of(answer["mission"])
    if entry["state"] != "finished":
        raise InputError(
            f"mission {name} {entry['state']}: {entry['reason']}; see {folder / 'companion.log'}"
        )
    record = link.fetch_record(entry["record"], folder)
    named = record.with_name(f"{name}-{controller}.mcap")
    record.replace(named)
    console.print(f"flown and fetched: {named}", highlight=False)
    return named


def _analyse(
    console: Console, folder: Path, vehicle: Vehicle, survey: Path, task: Path
) -> tuple[Model, Diagnosis, Comparison, Comparison, tuple[Path, ...]]:
    """Compare, see where, diagnose, add what is missing. Returns the last model and what was measured."""
    from trueflight.groundstation.evaluate.analysis import analyse
    from trueflight.groundstation.output.as_json import analysis_table
    from trueflight.groundstation.report import render, write_report
    from trueflight.groundstation.views import write_analysis, write_before_after

    fitted, held_out = read_flight(survey), read_flight(task)
    base = rigid_body_model(vehicle)
    store = folder / "models"
    _step(console, "Compare the model with the flight", f"groundstation compare {survey.name}")
    before = compare(fitted, base)
    print_comparisons(console, [compare(fitted, m) for m in lineage(store, base)])
    where = where_it_fails(before)
    print_where(console, where)
    _step(console, "Diagnose", f"groundstation diagnose {survey.name} --validate {task.name}")
    diagnosis = diagnose(fitted, base, held_out)
    print_diagnosis(console, diagnosis)
    model, parent = base, None
    for name in diagnosis.named("missing") or diagnosis.named("possible")[:1]:
        _step(
            console,
            f"Add {name}",
            f"groundstation model add {name} --flight {survey.name} --validate {task.name}",
        )
        model, path = save(store, add_effect(model, name, [fitted]), parent)
        parent = model
        console.print(f"new model version: {path}", highlight=False)
    line = lineage(store, model)
    steps = waterfall(fitted, held_out, line)
    print_waterfall(console, steps, fitted.name, held_out.name)
    after = compare(fitted, model)
    recordings = folder / "analysis.rrd", folder / "before-after.rrd"
    whole = analyse(fitted, lineage(store, base), held_out)
    write_analysis(recordings[0], whole)
    first, last = (compare(held_out, m, horizons=False) for m in (line[0], model))
    write_before_after(recordings[1], first, last, steps)
    report = folder / "report.html"
    write_report(report, render(whole, analysis_table(whole)))
    console.print(f"report: {report}", highlight=False)
    return model, diagnosis, before, after, recordings


def _deploy_and_fly(console: Console, link: Link, folder: Path, model: Model, survey: Path) -> Path:
    """Export, deploy, and fly the task corrected."""
    _step(console, "Deploy", "groundstation model export; groundstation deploy")
    file = folder / "correction.onnx"
    with console.status("exporting to ONNX"):
        flight = read_flight(survey)
        onnx = export_onnx(model, flight, actuation=actuation_of(model, [flight]))
        write_whole(file, onnx, "the model", "choose another --output")
    answer = link.request("model", file.read_bytes(), 30.0)
    console.print(f"accepted by the companion: {answer.get('reason') or file.name}", highlight=False)
    for effect in not_exported(model):
        console.print(
            f"{effect} stays on the ground: a static correction has neither memory nor a sensor, so tracking gains "
            "only from the rest of the model",
            style="yellow",
        )
    return _fly(console, link, folder, *TASK, "corrected")


def _reveal(sealed: Path, hidden: Sequence[str]) -> str:
    if hidden:
        return ", ".join(hidden)
    done = subprocess.run(
        [program("sim-bridge"), "reveal", str(sealed)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise InputError(f"sim-bridge reveal failed: {done.stderr.strip()}")
    return " ".join(done.stdout.split())


def _tracking_recording(folder: Path, tracking: tuple[Tracking, Tracking]) -> tuple[Path, ...]:
    from trueflight.groundstation.views import write_tracking

    path = folder / "tracking.rrd"
    write_tracking(path, tracking)
    return (path,)


# --- what comes out ----------------------------------------------------------------------------------------------


def _summary(console: Console, o: Outcome) -> None:
    _step(console, "Before and after", str(o.folder))
    table = Table(show_header=True)
    for column, side in (
        ("error", "left"),
        ("unit", "left"),
        ("before", "right"),
        ("after", "right"),
        ("", "right"),
    ):
        table.add_column(column, justify=side)  # type: ignore[arg-type]
    d = o.diagnosis

    def row(what: str, unit: str, before: float, after: float) -> None:
        ratio = f"÷ {before / after:.1f}" if before >= after else f"× {after / before:.1f}"
        table.add_row(what, unit, f"{before:.3g}", f"{after:.3g}", ratio)

    row("model, fitted flight (residual RMS)", "m/s²", d.rms_before, d.rms_after)
    table.add_row("  of which sensor noise", "m/s²", "", f"{d.noise_floor:.3g}", "", style="dim")
    if d.validation_before is not None and d.validation_after is not None:
        row("model, held-out flight (residual RMS)", "m/s²", d.validation_before, d.validation_after)
    for b, a in zip(o.before.horizons[-1:], o.after.horizons[-1:], strict=True):
        row(
            f"open-loop position after {b.horizon:g} s",
            "m",
            sum(x * x for x in b.position) ** 0.5,
            sum(x * x for x in a.position) ** 0.5,
        )
    lqr, corrected = o.tracking
    for i, axis in enumerate("xyz"):
        row(f"tracking the linear behaviour, {axis} (MSE)", "m²", lqr.mse[i], corrected.mse[i])
    console.print(table)
    found = d.named("missing") or d.named("possible")
    console.print(
        f"found: [bold]{', '.join(found) or 'nothing missing'}[/bold]; hidden was: {o.revealed}",
        highlight=False,
    )
    for note in corrected.flight.notes:
        if note.startswith("correction"):
            console.print(f"the corrected flight: {note}", style="yellow", highlight=False)
    console.print(
        f"Rerun recordings: {' '.join(str(p) for p in o.recordings)}", highlight=False, soft_wrap=True
    )
    console.print(f"{o.seconds:.0f} s", style="dim")


# Resolved: the samples lie beside the folders, not beside the links to them.
SAMPLES = Path(__file__).resolve().parents[2] / "samples" / "crazyflie"
REAL = (
    ("crazyswarm2_log08.csv", "upgraded motors"),
    ("crazyswarm2_log44.csv", "upgraded motors"),
    ("crazyswarm2_log201.csv", "carries a payload"),
)
"""Real flights in the repository, and what is known of them."""


def real_flights(console: Console) -> list[tuple[Flight, Diagnosis]]:
    """The same analysis on real Crazyflie flights: what it finds, in one table."""
    if not all((SAMPLES / file).is_file() for file, _ in REAL):
        console.print(
            "No real flights: samples/crazyflie is in the repository, not in this installation. For a flight of your "
            "own: groundstation diagnose FLIGHT",
            highlight=False,
            soft_wrap=True,
        )
        return []
    _step(console, "Real flights of Crazyflies", "groundstation diagnose samples/crazyflie/...")
    table = Table()
    for column in ("flight, and what is known", "found", "share", "parameters, 95 % interval"):
        table.add_column(column, no_wrap=column == "found", justify="right" if column == "share" else "left")
    results = []
    for file, known in REAL:
        with console.status(f"diagnosing {file}"):
            flight = read_flight(SAMPLES / file)
            result = diagnose(flight, rigid_body_model(flight.vehicle))
        results.append((flight, result))
        name = f"{flight.name}: {known}\nresidual {result.rms_before:.2f} -> {result.rms_after:.3f} m/s²"
        for e in (e for e in result.effects if e.rank):
            values = "\n".join(
                f"{p.name} = {p.value:.3g} [{p.low:.3g}, {p.high:.3g}] {p.unit}" for p in e.parameters
            )
            effect = e.name if e.verdict == "missing" else f"{e.name} ({SAID[e.verdict]})"
            table.add_row(
                name, effect, percent(e.variance_share), values.replace(" 1\n", "\n").removesuffix(" 1")
            )
            name = ""
        table.add_section()
    console.print(table)
    return results
