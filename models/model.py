"""A model: the linear hover model, an ordered chain of effects and a network, as one immutable version."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from models.effect import Effect
from models.effects import catalogue, effect_named
from models.errors import InputError
from models.network import Network, network_effect, network_from_table, network_table
from models.vehicle import Vehicle, vehicle_from_table


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
    of the data that its effects were fitted to; `fit` holds the figures of that fit (residual RMS, m/s²). `network`
    is what was learnt of the remainder that these very effects leave.
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
    return Model(vehicle=vehicle, terms=(Term("rigid_body", {}),), effects_directory=effects_directory)


def write_model(model: Model, path: Path) -> None:
    """Write a model version as JSON; raises `InputError` where the file exists: versions are never overwritten."""
    table = asdict(replace(model, network=None))
    del table["network"]
    if model.network is not None:
        table["network"] = network_table(model.network)
    table["vehicle"] = {k: v for k, v in table["vehicle"].items() if k != "source" and v != ()}
    text = json.dumps({"trueflight_model": 1, **table}, indent=1)
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text + "\n")
    except FileExistsError:
        raise InputError(f"{path}: this model version exists already and is never overwritten") from None
    path.chmod(0o444)


def read_model(path: Path) -> Model:
    """Read a model version; raises `InputError` for a missing, damaged or foreign file or an unknown effect."""
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"{path}: cannot read the model ({error.strerror}); list what is there with 'model list'"
        ) from None
    except ValueError as error:
        raise InputError(f"{path}: not a model file: {error}; restore it from a copy") from None
    if not isinstance(table, dict) or table.pop("trueflight_model", None) != 1:
        raise InputError(f"{path}: not a trueflight model file; pass one that 'model add' wrote")
    try:
        vehicle = vehicle_from_table(table.pop("vehicle"), f"{path}: vehicle")
        terms = tuple(
            Term(t["effect"], t["values"], {k: (v[0], v[1]) for k, v in t["intervals"].items()})
            for t in table.pop("terms")
        )
        learnt = table.pop("network", None)
        network = None if learnt is None else network_from_table(learnt, f"{path}: network")
        model = Model(vehicle=vehicle, terms=terms, network=network, **table)
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise InputError(f"{path}: damaged model file ({error}); restore it from a copy") from None
    known = catalogue(model.effects_directory)
    for term in terms:
        if term.effect not in known:
            raise InputError(f"{path}: unknown effect '{term.effect}'; pass --effects DIR with its file")
        missing = {p.name for p in known[term.effect].parameters} - set(term.values)
        if missing:
            raise InputError(
                f"{path}: effect '{term.effect}' lacks the parameter {', '.join(sorted(missing))}"
            )
    return model
