"""A model: the linear hover model, an ordered chain of effects and a network, as one immutable version."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from trueflight.models.effect import Effect
from trueflight.models.effects import EXACT_ROTATION, catalogue, effect_named
from trueflight.models.errors import InputError
from trueflight.models.network import Network, network_effect, network_from_table, network_table
from trueflight.models.outside import is_number, json_object, read_text, shown
from trueflight.models.vehicle import Vehicle, vehicle_from_table
from trueflight.models.whole_file import whole_file

_RESTORE = "restore it from a copy"


class Unfinished(InputError):
    """A file that a killed writer left in the place of a model version: it is not a version and never becomes one."""


@dataclass(frozen=True)
class Term:
    """One effect of a model with its fitted values, and 95 % intervals (low, high) where they were estimated."""

    effect: str
    values: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Model:
    """One version of a model of one vehicle.

    `terms` in the order in which they were added; `parent` is the version it was made from; `data_hash` the SHA-256
    of the data that its effects were fitted to, `fitted_to` the names of those flights; `fit` holds the figures of that
    fit (residual RMS, m/s²). `network` was trained on what exactly these effects leave unexplained.
    """

    vehicle: Vehicle
    terms: tuple[Term, ...] = ()
    name: str = ""
    version: int = 0
    parent: int | None = None
    data_hash: str = ""
    created: str = ""
    fit: Mapping[str, float] = field(default_factory=dict)
    effects_directory: str | None = None
    network: Network | None = None
    fitted_to: tuple[str, ...] = ()

    def chain(self) -> list[tuple[Effect, Mapping[str, float]]]:
        """All of the model, ready for `models.prediction`: the effects with their values, then the network."""
        return [*self.effect_chain(), *self.network_chain()]

    def effect_chain(self) -> list[tuple[Effect, Mapping[str, float]]]:
        """The effects alone, with their values."""
        return [(effect_named(t.effect, self.effects_directory), t.values) for t in self.terms]

    def network_chain(self) -> list[tuple[Effect, Mapping[str, float]]]:
        """The network alone, as a link of a chain; empty where there is none."""
        return [] if self.network is None else [(network_effect(self.network), {})]

    def names(self) -> tuple[str, ...]:
        """Names of the effects in the model."""
        return tuple(t.effect for t in self.terms)

    @property
    def rotates_exactly(self) -> bool:
        """Whether thrust is turned exactly, as a diagnosis needs it, instead of by the hover linearisation."""
        return any(effect.exact_rotation for effect, _ in self.effect_chain())

    def with_terms(self, terms: tuple[Term, ...]) -> Model:
        """The model with other terms; a network stays as it is."""
        return replace(self, terms=terms)

    def with_network(self, network: Network | None) -> Model:
        """The model with another network, or none."""
        return replace(self, network=network)

    @property
    def label(self) -> str:
        """What people see: version and what was added last."""
        last = "linear" if not self.terms else f"+ {self.terms[-1].effect}"
        if self.network is not None:
            last = f"+ {self.network.label}"
        return f"v{self.version} {last}" if self.version else last


def linear_model(vehicle: Vehicle) -> Model:
    """The hover linearisation alone."""
    return Model(vehicle=vehicle)


def rigid_body_model(vehicle: Vehicle, effects_directory: str | None = None) -> Model:
    """The hover linearisation with exact rotation of thrust: where every diagnosis starts."""
    return Model(vehicle=vehicle, terms=(Term(EXACT_ROTATION.name, {}),), effects_directory=effects_directory)


def write_model(model: Model, path: Path) -> None:
    """Write a model version as JSON, whole or not at all; raises `InputError` where the file exists: versions are never
    overwritten."""
    table = asdict(replace(model, network=None))
    del table["network"]
    if model.network is not None:
        table["network"] = network_table(model.network)
    table["vehicle"] = {k: v for k, v in table["vehicle"].items() if k != "source" and v != ()}
    text = json.dumps({"trueflight_model": 1, **table}, indent=1)
    with whole_file(path, "the model version", "pass --store DIR", new=True) as partial:
        partial.write_text(text + "\n", encoding="utf-8")
        partial.chmod(0o444)


def read_model(path: Path) -> Model:
    """Read a model version; raises `InputError` for a missing, damaged or foreign file or an unknown effect."""
    text = read_text(path, "the model", "list what is there with 'model list'")
    if not text.strip("\0 \n"):
        raise Unfinished(
            f"{path}: empty, its writer was interrupted; remove it, other versions are not touched"
        )
    if not text.rstrip().endswith("}"):
        raise Unfinished(f"{path}: ends in mid-write; remove it, other versions are not touched")
    table = json_object(text, f"{path}: not a model file", _RESTORE)
    if table.pop("trueflight_model", None) != 1:
        raise InputError(f"{path}: not a trueflight model file; pass one that 'model add' wrote")
    unknown = set(table) - {f.name for f in fields(Model)}
    if unknown or "vehicle" not in table:
        what = f"unknown key {shown(min(unknown))}" if unknown else "no vehicle"
        raise InputError(f"{path}: damaged model file ({what}); {_RESTORE}")
    if not isinstance(table["vehicle"], dict):
        raise InputError(f"{path}: 'vehicle' must be an object, not {shown(table['vehicle'])}; {_RESTORE}")
    learnt = table.get("network")
    directory = _typed(path, table, "effects_directory", (str, type(None)), None)
    terms = tuple(_term(path, one) for one in _typed(path, table, "terms", (list,), []))
    _check_terms(path, terms, directory)
    return Model(
        vehicle=vehicle_from_table(table["vehicle"], f"{path}: vehicle"),
        terms=terms,
        name=_typed(path, table, "name", (str,), ""),
        version=_typed(path, table, "version", (int,), 0),
        parent=_typed(path, table, "parent", (int, type(None)), None),
        data_hash=_typed(path, table, "data_hash", (str,), ""),
        created=_typed(path, table, "created", (str,), ""),
        fit=_figures(path, table),
        effects_directory=directory,
        network=None if learnt is None else network_from_table(learnt, f"{path}: network"),
        fitted_to=tuple(_name(path, one) for one in _typed(path, table, "fitted_to", (list,), [])),
    )


def _name(path: Path, name: object) -> str:
    if not isinstance(name, str):
        raise InputError(f"{path}: 'fitted_to' holds {shown(name)}, which is no name of a flight; {_RESTORE}")
    return name


def _figures(path: Path, table: dict[str, Any]) -> dict[str, float]:
    fit = _typed(path, table, "fit", (dict,), {})
    if any(isinstance(value, bool) or not isinstance(value, int | float) for value in fit.values()):
        raise InputError(f"{path}: 'fit' is {shown(fit)}, not an object of numbers; {_RESTORE}")
    return {name: float(value) for name, value in fit.items()}


def _typed(path: Path, table: dict[str, Any], key: str, kinds: tuple[type, ...], default: Any) -> Any:
    value = table.get(key, default)
    if not isinstance(value, kinds) or isinstance(value, bool):
        raise InputError(
            f"{path}: '{key}' is {shown(value)}, not {' or '.join(k.__name__ for k in kinds)}; {_RESTORE}"
        )
    return value


def _term(path: Path, table: object) -> Term:
    """One effect of the file. An end of an interval may be infinite or unknown, a value may not."""
    if not isinstance(table, dict) or set(table) != {"effect", "values", "intervals"}:
        raise InputError(f"{path}: damaged model file (an effect is {shown(table)}); {_RESTORE}")
    effect, values, intervals = table["effect"], table["values"], table["intervals"]
    if not isinstance(effect, str) or not isinstance(values, dict) or not isinstance(intervals, dict):
        raise InputError(f"{path}: damaged model file (an effect is {shown(table)}); {_RESTORE}")
    for name, value in values.items():
        if not is_number(value):
            raise InputError(
                f"{path}: {shown(effect)}: '{name}' is {shown(value)}, which is no number; {_RESTORE}"
            )
    for name, ends in intervals.items():
        if (
            not isinstance(ends, list)
            or len(ends) != 2
            or any(isinstance(end, bool) or not isinstance(end, int | float) for end in ends)
        ):
            raise InputError(
                f"{path}: {shown(effect)}: the interval of '{name}' is {shown(ends)}; {_RESTORE}"
            )
    return Term(
        effect,
        {name: float(value) for name, value in values.items()},
        {name: (float(low), float(high)) for name, (low, high) in intervals.items()},
    )


def _check_terms(path: Path, terms: tuple[Term, ...], directory: str | None) -> None:
    """Every effect must be known, and have a number for each of its parameters and for nothing else."""
    known = catalogue(directory)
    for term in terms:
        if term.effect not in known:
            raise InputError(f"{path}: unknown effect {shown(term.effect)}; pass --effects DIR with its file")
        wanted = {p.name for p in known[term.effect].parameters}
        always = {p.name for p in known[term.effect].parameters if not p.rotor}
        if missing := always - set(term.values):
            raise InputError(
                f"{path}: effect '{term.effect}' lacks the parameter {', '.join(sorted(missing))}"
            )
        if extra := set(term.values) - wanted:
            raise InputError(
                f"{path}: effect '{term.effect}' has no parameter {shown(min(extra))}; {_RESTORE}"
            )
    names = [term.effect for term in terms]
    if len(set(names)) < len(names):
        raise InputError(f"{path}: an effect stands in it twice; {_RESTORE}")
