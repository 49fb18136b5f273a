"""Everything that one analysis of a flight has to say, in one object: report, recording and `--json` print from it."""

from __future__ import annotations

import hashlib
import platform
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from trueflight.groundstation.evaluate.compare import compare
from trueflight.groundstation.evaluate.side_by_side import SideBySide
from trueflight.groundstation.evaluate.side_by_side import side_by_side as beside
from trueflight.groundstation.evaluate.tracking import Tracking, missions, track
from trueflight.groundstation.evaluate.where import where_it_fails
from trueflight.groundstation.identify.airframe import identify
from trueflight.groundstation.identify.fitting import MeasuredFlights, fit, model_of
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.measured.measurement import measure
from trueflight.groundstation.results import (
    Comparison,
    Diagnosis,
    Identified,
    WaterfallStep,
    WhereItFails,
)
from trueflight.models.design import Design
from trueflight.models.effects import effect_named
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.model import Model, Term, linear_model

LIBRARIES = ("trueflight", "numpy", "scipy")
"""What the figures depend on, besides the data."""


@dataclass(frozen=True)
class SourceFile:
    """A file that an analysis read: what it was for, its path as given, its SHA-256."""

    role: str
    path: str
    sha256: str


@dataclass(frozen=True)
class Provenance:
    """How to make an analysis again: when it was made (ISO 8601, UTC), by which command, from which files, with which
    versions."""

    made: str
    command: str
    files: tuple[SourceFile, ...]
    versions: dict[str, str]


@dataclass(frozen=True)
class ReferenceDistance:
    """Distance to the reference position over the missions of a flight, RMS per world axis, m."""

    rms: tuple[float, float, float]
    seconds: float


@dataclass(frozen=True)
class Analysis:
    """One flight against the models of its vehicle.

    `comparisons` are the model versions on the flight, the linear model first, then those that led to the diagnosis'
    base, then one for each effect found, the most important first; `held_out` the same on the held-out flight, empty
    without one. `first` is the place of the base among them. `where` tells where the base fails, `where_left` where
    the last model still does, in the same bins. `tracking` is there where the flight has references and a design,
    `reference` where it has references; `identified` are the vehicle's numbers, where it has rotor data.
    """

    diagnosis: Diagnosis
    comparisons: tuple[Comparison, ...]
    held_out: tuple[Comparison, ...]
    first: int
    waterfall: tuple[WaterfallStep, ...]
    where: WhereItFails
    where_left: WhereItFails
    tracking: Tracking | None
    reference: ReferenceDistance | None
    side_by_side: SideBySide | None
    provenance: Provenance
    identified: Identified | None = None

    @property
    def flight(self) -> Flight:
        """The flight that was analysed."""
        return self.diagnosis.flight

    @property
    def before(self) -> Comparison:
        """The model that the diagnosis started from."""
        return self.comparisons[self.first]

    @property
    def after(self) -> Comparison:
        """The model with every effect found."""
        return self.comparisons[-1]


def analyse(
    flight: Flight,
    line: Sequence[Model],
    validation: Flight | None = None,
    bandwidth: float | None = None,
    design: Design | None = None,
    side_by_side: SideBySide | None = None,
    progress: Callable[[str], None] = lambda _: None,
    healthy: Sequence[Flight] = (),
) -> Analysis:
    """Diagnose `flight` from the last model of `line` (the models that led to it before), and gather all there is to
    see: every version on the flight and on `validation`, where they fail, and how the flight was tracked. What each
    rotor carries is compared with the flights in `healthy`.

    Raises `InputError` where the flight lacks what a comparison needs.
    """
    diagnosis = diagnose(flight, line[-1], validation, bandwidth, progress, healthy)
    return gather(diagnosis, line, validation, bandwidth, design, side_by_side, progress)


def gather(
    diagnosis: Diagnosis,
    line: Sequence[Model],
    validation: Flight | None = None,
    bandwidth: float | None = None,
    design: Design | None = None,
    side_by_side: SideBySide | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Analysis:
    """All there is to see beside a `diagnosis` that was made from the last model of `line`, as `analyse` has it."""
    flight, base, flights = diagnosis.flight, line[-1], [f.flight for f in diagnosis.flights]
    progress("adding the effects one by one")
    models = [*line, *steps_to(diagnosis, bandwidth)]
    if side_by_side is None and flights:
        side_by_side = beside(flights, [[_unnumbered(f.model)] for f in diagnosis.flights], bandwidth)
    if models[0].terms or models[0].network is not None:
        models.insert(0, linear_model(flight.vehicle))
    comparisons = []
    for number, model in enumerate(models, 1):
        progress(f"comparing model {number} of {len(models)}")
        comparisons.append(compare(flight, model, bandwidth))
    progress("comparing with the held-out flight")
    held_out = (
        ()
        if validation is None
        else tuple(
            compare(validation, _on_held_out(model, models, diagnosis), bandwidth, horizons=False)
            for model in models
        )
    )
    first = next(k for k, m in enumerate(models) if m is base)
    where = where_it_fails(comparisons[first])
    return Analysis(
        diagnosis,
        tuple(comparisons),
        held_out,
        first,
        tuple(
            WaterfallStep(c.label, c.rms, held_out[k].rms if held_out else None, c.noise_floor)
            for k, c in enumerate(comparisons)
        ),
        where,
        where_it_fails(comparisons[-1], {m.variable: m.edges for m in where.maps}),
        _tracked(flight, design),
        _reference(flight),
        side_by_side,
        provenance(*_roles(flights or [flight], validation, side_by_side)),
        identify(flight),
    )


def _on_held_out(model: Model, models: Sequence[Model], diagnosis: Diagnosis) -> Model:
    """The model for the held-out flight: with its own wind where several flights had each their own."""
    own = diagnosis.held_out_model if model is models[-1] else None
    return model if own is None else _unnumbered(own)


def _roles(
    flights: Sequence[Flight], validation: Flight | None, side_by_side: SideBySide | None
) -> list[tuple[str, Flight]]:
    roles = [("flight", flight) for flight in flights]
    if validation is not None:
        roles.append(("held-out flight", validation))
    if side_by_side is not None:
        roles += [("beside", c.flight) for c in side_by_side.comparisons]
    return roles


def steps_to(diagnosis: Diagnosis, bandwidth: float | None = None) -> list[Model]:
    """The models from the base to the diagnosed one, one more effect each, the most important first; what was found
    before is fitted anew with each. Effects seen in the rotation alone change no acceleration and are no step. Where
    several flights were fitted together, all is added in one step, with the numbers of the last flight."""
    base, last = diagnosis.base, diagnosis.model
    if diagnosis.flights:
        whole = diagnosis.flights[-1].model
        return [_unnumbered(whole)] if whole.names() != base.names() else []
    ranked = [
        e.name
        for e in sorted(diagnosis.effects, key=lambda e: e.rank or 0)
        if e.rank and e.seen_in != "rotation"
    ]
    waiting = [n for n in ranked if n in last.names() and n not in base.names()]
    order: list[str] = []
    while waiting:
        present = {*base.names(), *order}
        through = {n: effect_named(n, base.effects_directory).acts_through for n in waiting}
        order.append(next((n for n in waiting if not through[n] or present & set(through[n])), waiting[0]))
        waiting.remove(order[-1])
    problem = MeasuredFlights(
        (measure(diagnosis.flight, bandwidth),), base.effects_directory, base.network_chain()
    )
    steps = []
    for count in range(1, len(order)):
        terms = [*base.terms, *(Term(name, {}) for name in order[:count])]
        steps.append(model_of(fit(problem, terms, refit=order[:count]), base))
    if order:
        by_name = {t.effect: t for t in last.terms}
        steps.append(last.with_terms((*base.terms, *(by_name[name] for name in order))))
    return [_unnumbered(m) for m in steps]


def _unnumbered(model: Model) -> Model:
    """The model as what it is: no version of the store."""
    return replace(model, version=0, parent=None)


def _tracked(flight: Flight, design: Design | None) -> Tracking | None:
    """The flight against its design; None where it lacks references, states, or a mission."""
    if design is None or not flight.has("position_reference"):
        return None
    try:
        return track(flight, design)
    except InputError:
        return None


def _reference(flight: Flight) -> ReferenceDistance | None:
    if not flight.has("position", "position_reference"):
        return None
    try:
        rows = np.concatenate(missions(flight))
    except InputError:
        return None
    miss = flight.column("position")[rows] - flight.column("position_reference")[rows]
    x, y, z = (float(v) for v in np.sqrt(np.mean(miss**2, axis=0)))
    return ReferenceDistance((x, y, z), float(len(rows) * flight.dt))


def provenance(*flights: tuple[str, Flight]) -> Provenance:
    """The files of `flights` (role, flight) and of their vehicles, the running command and the versions that make the
    figures."""
    files: dict[str, SourceFile] = {}
    for role, flight in flights:
        files.setdefault(flight.origin, SourceFile(role, flight.origin, flight.data_hash))
        vehicle = Path(flight.vehicle.source)
        if str(vehicle) not in files and vehicle.is_file():
            digest = hashlib.sha256(vehicle.read_bytes()).hexdigest()
            files[str(vehicle)] = SourceFile("vehicle", str(vehicle), digest)
    versions = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    program = Path(sys.argv[0]).stem
    # run as a module, the program has the name of its file
    command = shlex.join(["groundstation" if program == "cli" else program, *sys.argv[1:]])
    return Provenance(
        datetime.now(UTC).isoformat(timespec="seconds"), command, tuple(files.values()), versions
    )
