"""The short flight that best tells apart what a flight left open.

Manoeuvres (`identify.manoeuvres`) begin and end at rest in one place, so that what they tell (`identify.information`)
adds up, and a flight is chosen one manoeuvre at a time: the one that answers most a second (Fedorov's exchange without
exchanges, Theory of Optimal Experiments 1972).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from trueflight.groundstation.identify.fitting import BLOCK
from trueflight.groundstation.identify.information import Precision, Question, Study
from trueflight.groundstation.identify.manoeuvres import Limits, Manoeuvre, as_flown, base_of, library
from trueflight.groundstation.identify.questions import open_questions
from trueflight.groundstation.identify.search import STRONG_EVIDENCE
from trueflight.groundstation.results import Diagnosis
from trueflight.models.design import Design
from trueflight.models.effects import effect_named
from trueflight.models.errors import InputError
from trueflight.models.trajectory import Segment, Trajectory, hold
from trueflight.models.vehicle import Vehicle

LEAST = 3.5 * BLOCK
"""s of flight, so that every manoeuvre is seen again on a part that was held out."""
SAMPLING = 0.1
"""s between two setpoints of the file."""

__all__ = ["FlightPlan", "Limits", "Precision", "Question", "plan_flight", "setpoints"]


@dataclass(frozen=True)
class FlightPlan:
    """A flight to be flown: its trajectory (home frame), what it is made of, and what it will tell.

    `left_out` says why a candidate could not be planned for.
    """

    trajectory: Trajectory
    manoeuvres: tuple[str, ...]
    questions: tuple[Question, ...]
    precision: tuple[Precision, ...]
    left_out: dict[str, str] = field(default_factory=dict)


def plan_flight(
    design: Design,
    vehicle: Vehicle,
    limits: Limits,
    diagnosis: Diagnosis | None = None,
    between: Sequence[str] = (),
    effects_directory: str | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> FlightPlan:
    """Design the flight that best tells the effects of `between` apart; without them, what `diagnosis` left open.

    Raises `InputError` where nothing is open, or a name is unknown.
    """
    for name in between:
        effect_named(name, effects_directory)
    questions = open_questions(diagnosis, between, effects_directory)
    study = Study(vehicle, questions, diagnosis, effects_directory)
    manoeuvres = library(limits)
    voltage = vehicle.nominal_voltage
    if diagnosis is not None and diagnosis.flight.battery_voltage is not None:
        voltage = float(np.median(diagnosis.flight.battery_voltage))
    before = None if diagnosis is None else study.information(diagnosis.flight)
    if diagnosis is not None and before is not None and not between and not diagnosis.named("possible"):
        questions = open_questions(diagnosis, (), effects_directory, _told_already(study, before))
        study = Study(vehicle, questions, diagnosis, effects_directory)
        before = study.information(diagnosis.flight)
    known = []
    for number, one in enumerate(manoeuvres, 1):
        progress(f"predicting manoeuvre {number} of {len(manoeuvres)}")
        known.append(study.information(as_flown(one.trajectory, design, vehicle, voltage)))
    progress("choosing")
    chosen = _choose(study, manoeuvres, known, limits)
    if not chosen:
        names = _listed([c.names[-1] for c in questions.candidates])
        raise InputError(
            f"no manoeuvre within these limits tells {names} apart; raise --radius, --speed, --high or --duration, "
            "or lower --low"
        )
    after = sum((known[i] for i in chosen), study.nothing())
    base = base_of(limits)
    segments: list[Segment] = [hold(base, 1.0)]
    for i in chosen:
        segments += manoeuvres[i].segments
    flown = Trajectory("planned", (*segments, hold(base, 1.0)))
    return FlightPlan(
        flown,
        tuple(manoeuvres[i].text for i in chosen),
        study.answers(before, after),
        study.precision(
            before, after, None if diagnosis is None else diagnosis.flight.duration, flown.duration
        ),
        questions.left_out,
    )


def _told_already(study: Study, before: np.ndarray) -> dict[str, str]:
    """What the flight at hand could not show beside its error, and yet tells: at the size planned for it would be
    seen."""
    found = {}
    for i, j in study.questions.pairs:
        if j is None and (evidence := study.evidence(before, i, None)) > STRONG_EVIDENCE:
            found[study.candidates[i].names[-1]] = (
                "this flight tells already that there is not as much of it as a plan looks for "
                f"(evidence {evidence:.0f})"
            )
    return found


def _listed(names: Sequence[str]) -> str:
    return " and ".join(names) if len(names) < 3 else f"{', '.join(names[:-1])} and {names[-1]}"


def _choose(
    study: Study, manoeuvres: Sequence[Manoeuvre], known: Sequence[np.ndarray], limits: Limits
) -> list[int]:
    """The manoeuvres, in order: each the one that answers most a second, until all is answered or time is up."""
    total, chosen = study.nothing(), []
    left = limits.duration - 2.0
    while not study.answered(total):
        here = study.worth(total)
        best, rate = None, 1e-3
        for i, one in enumerate(manoeuvres):
            seconds = one.trajectory.duration
            if seconds > left:
                continue
            gain = (study.worth(total + known[i]) - here) / seconds
            if gain > rate:
                best, rate = i, gain
        if best is None:
            break
        chosen.append(best)
        total = total + known[best]
        left -= manoeuvres[best].trajectory.duration
    once = list(chosen)
    while once and limits.duration - left < LEAST:
        again = once[(len(chosen) - len(once)) % len(once)]
        if manoeuvres[again].trajectory.duration > left:
            break
        chosen.append(again)
        left -= manoeuvres[again].trajectory.duration
    return chosen


def setpoints(flown: Trajectory) -> str:
    """The trajectory as a table of setpoints that the companion and the simulator fly."""
    t = np.append(np.arange(0.0, flown.duration, SAMPLING), flown.duration)
    t = t[np.append(np.diff(t) > 1e-6, True)]
    c = flown.sample(t)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["t", *"xyz", "vx", "vy", "vz", "ax", "ay", "az", "yaw"])
    rows = np.column_stack([c.t, c.position, c.velocity, c.acceleration, c.yaw])
    writer.writerows([f"{value:.6f}" for value in row] for row in rows)
    return out.getvalue()
