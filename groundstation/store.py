"""Model versions on disk: one folder a vehicle, one immutable JSON file a version."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from groundstation.fitting import Problem, fit, model_of
from groundstation.measurement import measure
from groundstation.rotation import fit_rotation
from models.effects import effect_named
from models.errors import InputError
from models.flight import Flight
from models.model import Model, Term, linear_model, read_model, rigid_body_model, write_model
from models.vehicle import Vehicle

DEFAULT_STORE = Path("trueflight-models")


def versions(store: Path, vehicle: str) -> list[Path]:
    """Files of the vehicle's model versions, oldest first."""
    found = [p for p in (store / vehicle).glob("v*.json") if re.match(r"v\d{4}", p.name)]
    return sorted(found)


def newest(store: Path, vehicle: Vehicle, effects_directory: str | None = None) -> Model | None:
    """The newest version of the vehicle's model; None where there is none yet."""
    files = versions(store, vehicle.name)
    return replace(read_model(files[-1]), effects_directory=effects_directory) if files else None


def find(store: Path, vehicle: str, which: str) -> Model:
    """A version by number (`3`, `v3`), or by path. Raises `InputError` where there is no such version."""
    path = Path(which)
    if path.suffix == ".json":
        return read_model(path)
    digits = which.lower().removeprefix("v")
    for file in versions(store, vehicle):
        if digits.isdigit() and file.name.startswith(f"v{int(digits):04d}"):
            return read_model(file)
    have = ", ".join(f.stem for f in versions(store, vehicle)) or "none yet"
    raise InputError(f"{store / vehicle}: no model version '{which}'; there are: {have}")


def lineage(store: Path, model: Model) -> list[Model]:
    """The models that led to `model`: the linear one, exact rotation, then every version."""
    by_number = {m.version: m for m in map(read_model, versions(store, model.vehicle.name))}
    line = [model]
    while line[-1].parent is not None and line[-1].parent in by_number:
        line.append(by_number[line[-1].parent])
    if line[-1].version != 0:
        line.append(rigid_body_model(model.vehicle, model.effects_directory))
    if line[-1].terms:
        line.append(linear_model(model.vehicle))
    return line[::-1]


def save(store: Path, model: Model, parent: Model | None) -> tuple[Model, Path]:
    """Write `model` as the next version, child of `parent`."""
    folder = store / model.vehicle.name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot make the model store ({error.strerror}); pass --store DIR"
        ) from None
    files = versions(store, model.vehicle.name)
    number = 1 + max((read_model(f).version for f in files[-1:]), default=0)
    stamped = replace(
        model,
        version=number,
        parent=None if parent is None else parent.version,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    last = model.terms[-1].effect if model.terms else "linear"
    if model.network is not None:
        last = "network"
    path = folder / f"v{number:04d}-{last}.json"
    write_model(stamped, path)
    return stamped, path


def add_effect(base: Model, effect: str, flights: Sequence[Flight], bandwidth: float | None = None) -> Model:
    """`base` with one more effect, every parameter refitted to `flights`; not yet saved.

    A network of `base` is dropped: it was trained on what the effects without this one leave over.

    Raises `InputError` for an effect that is there already, acts only through one that is not, or needs columns that
    a flight lacks.
    """
    known = effect_named(effect, base.effects_directory)
    if effect in base.names():
        raise InputError(f"{effect} is in {base.label} already; 'model refit' fits its parameters anew")
    if known.with_any and not set(known.with_any) & set(base.names()):
        raise InputError(f"{effect} acts only through {' or '.join(known.with_any)}; add one of these first")
    for flight in flights:
        for column in known.needs:
            flight.column(column)
        if known.lacks(flight):
            raise InputError(
                f"{flight.origin or flight.name}: {effect} needs {', '.join(known.lacks(flight))}; record it"
            )
    terms = (
        base.terms
        if "rigid_body" in base.names() or effect == "rigid_body"
        else (Term("rigid_body", {}), *base.terms)
    )
    made = base.with_network(None).with_terms((*terms, Term(effect, known.neutral(base.vehicle))))
    return refit(made, flights, bandwidth)


def _turned(term: Term, model: Model, flights: Sequence[Flight]) -> Term:
    """The term, fitted to the rotation of the first flight that tells, where its effect is a rotational one."""
    effect = effect_named(term.effect, model.effects_directory)
    if not effect.rotational:
        return term
    fitted = (fit_rotation(flight, effect) for flight in flights if not effect.lacks(flight))
    found = next((t for t in fitted if t is not None), None)
    if found is None:
        raise InputError(f"no flight here tells {term.effect}; fly {effect.manoeuvre}")
    return found


def refit(model: Model, flights: Sequence[Flight], bandwidth: float | None = None) -> Model:
    """The model with every parameter fitted anew to `flights`, beside its network where it has one."""
    problem = Problem(
        tuple(measure(f, bandwidth) for f in flights), model.effects_directory, model.network_chain()
    )
    model = model.with_terms(tuple(_turned(t, model, flights) for t in model.terms))
    fitted = fit(problem, model.terms)
    rms = float((fitted.sse / fitted.residual.size) ** 0.5)
    hashes = "+".join(f.data_hash for f in flights)
    return replace(model_of(fitted, model), data_hash=hashes, fit={"rms": rms})
