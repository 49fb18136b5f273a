"""What the worker does: the same functions as the commands, and their results as `--json` prints them, with the
drawings of the report."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from trueflight.groundstation.design.integral_design import with_integral
from trueflight.groundstation.design.linear_design import ATTITUDE_BANDWIDTH, POSITION_BANDWIDTH, make_design
from trueflight.groundstation.evaluate.analysis import Analysis, gather
from trueflight.groundstation.evaluate.compare import compare, waterfall
from trueflight.groundstation.evaluate.side_by_side import side_by_side
from trueflight.groundstation.evaluate.where import where_it_fails
from trueflight.groundstation.identify.flights import diagnose_flights
from trueflight.groundstation.output.as_json import (
    analysis_table,
    beside_table,
    comparison_table,
    model_table,
    plan_table,
    waterfall_table,
    where_table,
)
from trueflight.groundstation.reading.flight_file import NoVehicle, read_flight
from trueflight.groundstation.reading.several import check_held_out, told_apart
from trueflight.groundstation.report import charts, render, render_side_by_side, write_report
from trueflight.groundstation.report.svg import Drawing, style, to_svg
from trueflight.groundstation.versions.choice import choose_design, choose_line, choose_model, design_to_fly
from trueflight.groundstation.versions.several import add_effect_to
from trueflight.groundstation.versions.store import save, versions
from trueflight.groundstation.workbench.tasks import (
    Add,
    Beside,
    Diagnose,
    Ended,
    Message,
    Part,
    Plan,
    Read,
    Source,
    Step,
    Subject,
    Task,
)
from trueflight.groundstation.workbench.vehicle_form import drafted_form
from trueflight.models.design import Design, save_design
from trueflight.models.effects import effect_named
from trueflight.models.errors import InputError, plain_line
from trueflight.models.flight import Flight
from trueflight.models.model import read_model
from trueflight.models.whole_file import write_whole

RATE = 100.0
"""Hz of the controller of a design that is made for a plan."""
Tell = Callable[[Message], None]


@dataclass
class _Steps:
    """The steps of a task, counted as it comes to them."""

    tell: Tell
    number: int = 0

    def next(self, text: str) -> None:
        """The next step begins."""
        self.number += 1
        self.tell(Step(self.number, text))

    def on(self, text: str) -> None:
        """Within a step."""
        self.tell(Step(self.number, text))


def do(task: Task, tell: Tell) -> None:
    """Do a task, telling of each step and each part of the answer, and how it ended."""
    # what a report says it was made by: the command, not the page
    sys.argv[:] = shlex.split(task.command())
    steps = _Steps(tell)
    try:
        match task:
            case Read():
                _read(task, steps)
            case Diagnose():
                _diagnose(task.about, steps)
            case Add():
                _add(task, steps)
            case Beside():
                _beside(task, steps)
            case Plan():
                _plan(task, steps)
    except InputError as error:
        tell(Ended(_named(plain_line(str(error)), task)))
    except OSError as error:
        tell(
            Ended(
                f"{error.filename or 'a file'}: {error.strerror or error}; free space, or check the permissions"
            )
        )
    except MemoryError:
        tell(Ended("not enough memory; give fewer or shorter files"))
    except Exception as error:  # noqa: BLE001 the page has to say that it ended
        tell(
            Ended(
                f"a fault of trueflight itself ({type(error).__name__}: {error}); please report it with the log"
            )
        )
    else:
        tell(Ended())


def _named(problem: str, task: Task) -> str:
    """A problem with the names that people gave their files, not ours."""
    flights = (
        task.flights
        if isinstance(task, Beside)
        else (task.flight if isinstance(task, Read) else task.about.flight,)
    )
    for flight in flights:
        problem = problem.replace(str(flight.path), flight.name)
    return problem


def _read(task: Read, steps: _Steps) -> None:
    steps.next(f"reading {task.flight.name}")
    source = task.flight
    try:
        flight = _flight(source)
    except NoVehicle as error:
        form = drafted_form(source.path)
        steps.tell(Part("draft", {"flight": source.name, "problem": str(error)}, more={"form": form}))
        return
    made = [model_table(read_model(path)) for path in versions(task.store, flight.vehicle.name)]
    steps.tell(Part("read", _facts(flight), more={"vehicle": flight.vehicle, "versions": made}))


def _facts(flight: Flight) -> dict[str, Any]:
    from trueflight.groundstation.output.as_json import consistency_table, plain
    from trueflight.groundstation.reading.listing import SENSORS

    flying = 1.0 if flight.flying is None else float(flight.flying.mean())
    return plain(
        {
            "flight": flight.name,
            "vehicle": flight.vehicle.name,
            "duration": flight.duration,
            "flying": flying * len(flight) * flight.dt,
            "rate": 1.0 / flight.dt,
            "measured": [word for name, word in SENSORS.items() if flight.has(name)],
            "notes": list(flight.notes),
            "consistency": consistency_table(flight),
        }
    )


def _diagnose(about: Subject, steps: _Steps) -> None:
    steps.next("reading the flight")
    flight, held_out = _flights(about)
    line = choose_line(flight, about.model, about.store)
    steps.next("comparing the model with the flight")
    results = [compare(flight, m) for m in line]
    where = where_it_fails(results[-1])
    fell = waterfall(flight, held_out, line)
    about.results.mkdir(parents=True, exist_ok=True)
    from trueflight.groundstation.views import write_narrow

    recording = about.results / f"{about.model}-flight.rrd"
    write_narrow(recording, results, where)
    table = {
        **comparison_table(results[-1]),
        "versions": [comparison_table(c) for c in results],
        "where": where_table(where),
        "waterfall": waterfall_table(fell),
        "version": model_table(line[-1]),
    }
    drawn = _drawn(
        window=lambda: charts.prediction(results[-1], results[-1], where.worst),
        over_time=lambda: charts.over_time(results[-1], results[-1], where.worst),
        path=lambda: charts.path(results[-1], where.worst),
        maps=lambda: charts.maps(table["where"], table["where"], (results[-1].label,) * 2),
        place=lambda: charts.place(results[-1], table["where"]),
        bars=lambda: charts.waterfall(table["waterfall"]),
    )
    steps.tell(Part("compared", table, drawn, {"recording": recording}))
    steps.next("looking for what is missing")
    found = diagnose_flights([flight], line[-1], held_out, progress=steps.on)
    whole = gather(found, line, held_out, None, choose_design(found.flight), progress=steps.on)
    steps.next("drawing, and writing the report")
    _tell_diagnosis(about, whole, steps.tell)


def _tell_diagnosis(about: Subject, whole: Analysis, tell: Tell) -> None:
    from trueflight.groundstation.output.cited import sentences
    from trueflight.groundstation.views import write_analysis

    table = analysis_table(whole)
    report = about.results / f"{about.model}-report.html"
    recording = about.results / f"{about.model}-analysis.rrd"
    write_report(report, render(whole, table))
    write_analysis(recording, whole)
    drawn = _drawn(
        over_time=lambda: charts.courses(whole.diagnosis.effects),
        window=lambda: charts.prediction(whole.before, whole.after, whole.where.worst),
        bars=lambda: charts.waterfall(table["waterfall"]),
    )
    known = {
        e.name: effect_named(e.name, whole.diagnosis.base.effects_directory) for e in whole.diagnosis.effects
    }
    more = {
        "to_add": list(whole.diagnosis.to_add),
        "verdict": sentences(table, html=True),
        "manoeuvres": {name: effect.manoeuvre for name, effect in known.items()},
    }
    tell(Part("diagnosed", table, drawn, {"recording": recording, "report": report}, more))


def _add(task: Add, steps: _Steps) -> None:
    about = task.about
    steps.next("reading the flight")
    flight, _ = _flights(about)
    base = choose_model(flight, about.model, about.store)
    steps.next(f"fitting {' and '.join(task.effects)}")
    told = add_effect_to(base, list(task.effects), [flight])
    made, path = save(about.store, told.model, base if base.version else None)
    courses = {name: list(course.lines) for name, course in told.courses.items()}
    steps.tell(Part("added", model_table(made), files={"model": path}, more={"courses": courses}))
    _diagnose(replace(about, model=f"v{made.version}"), steps)


def _beside(task: Beside, steps: _Steps) -> None:
    steps.next("reading the flights")
    flights = told_apart([_flight(source) for source in task.flights])
    models = [[choose_model(f, which, task.store) for which in task.models] for f in flights]
    steps.next("comparing")
    beside = side_by_side(flights, models)
    table = beside_table(beside)
    task.results.mkdir(parents=True, exist_ok=True)
    from trueflight.groundstation.views import write_side_by_side

    report, recording = task.results / "side-by-side.html", task.results / "side-by-side.rrd"
    write_report(report, render_side_by_side(beside, table))
    write_side_by_side(recording, beside)
    drawn = _drawn(
        maps=lambda: charts.beside_maps(table["side_by_side"]),
        over_time=lambda: charts.beside_over_time(beside),
    )
    steps.tell(Part("beside", table, drawn, {"recording": recording, "report": report}))


def _plan(task: Plan, steps: _Steps) -> None:
    from trueflight.groundstation.identify.planning import Limits, plan_flight, setpoints
    from trueflight.groundstation.identify.translation import diagnose
    from trueflight.groundstation.versions.choice import choose_start

    about = task.about
    steps.next("reading the flight")
    flight = _flight(about.flight)
    about.results.mkdir(parents=True, exist_ok=True)
    gains, made = _gains(flight, about.results / "design.json")
    steps.next("looking for what is open")
    start = choose_start(flight, about.model, about.store)
    found = diagnose(flight, start, progress=steps.on)
    plan = plan_flight(gains, flight.vehicle, Limits(), found, task.between, progress=steps.on)
    path = about.results / "plan.csv"
    write_whole(path, setpoints(plan.trajectory), "the plan", "choose another --folder")
    drawn = _drawn(flown=lambda: charts.planned(plan.trajectory))
    steps.tell(Part("plan", plan_table(plan, path), drawn, {"plan": path}, {"designed": made}))


def _gains(flight: Flight, path: Path) -> tuple[Design, str]:
    """The design that the vehicle will fly by; where there is none, one with the usual bandwidths, written to `path`,
    and the command that makes it."""
    try:
        return design_to_fly(flight.vehicle, flight), ""
    except InputError:
        made = with_integral(
            make_design(flight.vehicle, POSITION_BANDWIDTH, ATTITUDE_BANDWIDTH, RATE), flight.vehicle
        )
        save_design(made, path)
        return made, shlex.join(["groundstation", "design", flight.vehicle.source, "-o", str(path)])


def _flights(about: Subject) -> tuple[Flight, Flight | None]:
    flight = _flight(about.flight)
    held_out = about.held_out
    if held_out is None:
        return flight, None
    if held_out.vehicle is None:
        held_out = replace(held_out, vehicle=about.flight.vehicle)
    checked_on = _flight(held_out)
    check_held_out(checked_on, [flight])
    return flight, checked_on


def _flight(source: Source) -> Flight:
    """The flight, read once for as long as its files are as they were."""
    files = [source.path, *(p for p in (source.vehicle, source.mapping) if p is not None)]
    try:
        stamps = tuple(file.stat().st_mtime_ns for file in files)
    except OSError:
        stamps = ()
    flight = _read_once(source, stamps)
    return flight if flight.name == source.name else replace(flight, name=source.name)


@lru_cache(maxsize=6)
def _read_once(source: Source, stamps: tuple[int, ...]) -> Flight:
    mapping = None if source.mapping is None else [str(source.mapping)]
    return read_flight(source.path, source.vehicle, mapping)


def _drawn(**drawings: Callable[[], Drawing | None]) -> Mapping[str, str | None]:
    """Each drawing as SVG in the colours of the page; None where the flight has no columns for it."""
    with style():
        made = {name: draw() for name, draw in drawings.items()}
        return {name: None if drawing is None else str(to_svg(drawing)) for name, drawing in made.items()}
