"""Model versions on disk: one folder a vehicle, one immutable JSON file a version."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from trueflight.groundstation.identify.fitting import MeasuredFlights, fit, model_of
from trueflight.groundstation.identify.rotation import fit_rotation
from trueflight.groundstation.measured.measurement import measure
from trueflight.models.effects import EXACT_ROTATION, effect_named
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.model import (
    Model,
    Term,
    Unfinished,
    linear_model,
    read_model,
    rigid_body_model,
    write_model,
)
from trueflight.models.vehicle import Vehicle

DEFAULT_STORE = Path("trueflight-models")


def versions(store: Path, vehicle: str) -> list[Path]:
    """Files of the vehicle's model versions, oldest first; none of a store that is not there yet.

    Raises `InputError` for a file in the place of the store.
    """
    if store.exists() and not store.is_dir():
        raise InputError(f"{store}: is a file and no model store; pass its folder with --store")
    found = [p for p in (store / vehicle).glob("v*.json") if _number(p)]
    return sorted(found, key=lambda path: (_number(path), path.name))


def newest(store: Path, vehicle: Vehicle, effects_directory: str | None = None) -> Model | None:
    """The newest version of the vehicle's model; None where there is none yet. A file that a killed writer left is
    told and passed by; any other that cannot be read is an `InputError`."""
    for path in reversed(versions(store, vehicle.name)):
        try:
            return replace(read_model(path), effects_directory=effects_directory)
        except Unfinished as error:
            logging.getLogger(__name__).warning("%s", error)
    return None


def _number(path: Path) -> int:
    """The number of the version in a file of this name; 0 where it is none."""
    found = re.match(r"v([0-9]{4,6})[-.]", path.name)
    return int(found[1]) if found else 0


def find(store: Path, vehicle: str, which: str) -> Model:
    """A version by number (`3`, `v3`), or by path. Raises `InputError` where there is no such version."""
    path = Path(which)
    if path.suffix == ".json":
        return read_model(path)
    digits = which.lower().removeprefix("v")
    for file in versions(store, vehicle):
        if digits.isdecimal() and len(digits) < 7 and _number(file) == int(digits):
            return read_model(file)
    have = ", ".join(f.stem for f in versions(store, vehicle)) or "none yet"
    raise InputError(f"{store / vehicle}: no model version '{which}'; there are: {have}")


def lineage(store: Path, model: Model) -> list[Model]:
    """The models that led to `model`: the linear one, exact rotation, then every version."""
    by_number = {_number(path): path for path in versions(store, model.vehicle.name)}
    line, parent = [model], model.parent
    # A parent is always older: what a damaged file says of itself leads round in no circle.
    while parent in by_number and parent is not None and (parent < line[-1].version or not line[-1].version):
        line.append(replace(read_model(by_number[parent]), version=parent))
        parent = line[-1].parent
    if line[-1].version != 0:
        line.append(rigid_body_model(model.vehicle, model.effects_directory))
    if line[-1].terms:
        line.append(linear_model(model.vehicle))
    return line[::-1]


def save(store: Path, model: Model, parent: Model | None) -> tuple[Model, Path]:
    """Write `model` as the next version, child of `parent`."""
    folder = store / model.vehicle.name
    number = 1 + max(map(_number, versions(store, model.vehicle.name)), default=0)
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


def add_effect(
    base: Model, effect: str | Sequence[str], flights: Sequence[Flight], bandwidth: float | None = None
) -> Model:
    """`base` with one more effect, or several at once, every parameter refitted to `flights`; not yet saved.

    A network of `base` is dropped: it was trained on what the effects without these leave over.

    Raises `InputError` for an effect that is there already, acts only through one that is not, or needs columns that
    a flight lacks.
    """
    return refit(extended(base, effect, flights), flights, bandwidth)


def extended(base: Model, effect: str | Sequence[str], flights: Sequence[Flight]) -> Model:
    """`base` with effects more at "no effect", without its network. Raises `InputError` as `add_effect`."""
    names = [effect] if isinstance(effect, str) else list(effect)
    model = base
    # what acts through another comes after it
    for name in sorted(names, key=lambda n: bool(effect_named(n, base.effects_directory).acts_through)):
        model = _with_one_more(model, name, flights)
    return model


def _with_one_more(base: Model, effect: str, flights: Sequence[Flight]) -> Model:
    known = effect_named(effect, base.effects_directory)
    if effect in base.names():
        raise InputError(f"{effect} is in {base.label} already; 'model refit' fits its parameters anew")
    if known.acts_through and not set(known.acts_through) & set(base.names()):
        raise InputError(
            f"{effect} acts only through {' or '.join(known.acts_through)}; add one of these first"
        )
    for flight in flights:
        for column in known.needs:
            flight.column(column)
        if known.lacks(flight):
            raise InputError(
                f"{flight.origin or flight.name}: {effect} needs {', '.join(known.lacks(flight))}; record it"
            )
    terms = (
        base.terms
        if base.rotates_exactly or known.exact_rotation
        else (Term(EXACT_ROTATION.name, {}), *base.terms)
    )
    return base.with_network(None).with_terms((*terms, Term(effect, known.neutral(base.vehicle))))


def turned(term: Term, model: Model, flights: Sequence[Flight]) -> Term:
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
    problem = MeasuredFlights(
        tuple(measure(f, bandwidth) for f in flights), model.effects_directory, model.network_chain()
    )
    model = model.with_terms(tuple(turned(t, model, flights) for t in model.terms))
    fitted = fit(problem, model.terms)
    rms = float((fitted.sse / fitted.residual.size) ** 0.5)
    hashes = "+".join(f.data_hash for f in flights)
    return replace(
        model_of(fitted, model), data_hash=hashes, fit={"rms": rms}, fitted_to=tuple(f.name for f in flights)
    )
