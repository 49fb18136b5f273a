"""The metadata of a deployed model's file, which anybody may have written: read, or refused in one line.

Every function raises `Refused` for what does not follow `models.contract`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from trueflight.companion.law.actuation import ACTS_AT_ONCE, Actuation
from trueflight.companion.law.inference import Refused
from trueflight.companion.law.watch import ZERO, Range, Vector
from trueflight.models import contract
from trueflight.models.errors import shown
from trueflight.models.learnable import MOST, Learnable
from trueflight.models.vehicle import Vehicle


def json_of(meta: dict[str, str], key: str, kind: type) -> Any:
    """The JSON of a text, of this kind."""
    try:
        value = json.loads(meta[key])
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, kind):
        raise Refused(f"its metadata '{key}' is not a JSON {'object' if kind is dict else 'list'}")
    return value


def word(meta: dict[str, str], key: str) -> str:
    """A metadata text that people are shown: short, and one line."""
    if len(meta[key]) > contract.LONGEST_WORD or not meta[key].isprintable():
        raise Refused(f"its metadata '{key}' is not one line of at most {contract.LONGEST_WORD} characters")
    return meta[key]


def chain(meta: dict[str, str]) -> tuple[dict[str, Any], ...]:
    """The effects that a model says it is made of: objects with a name and named numbers (or lists of them)."""
    chain = json_of(meta, contract.KEY_CHAIN, list)
    for entry in chain:
        if not isinstance(entry, dict) or not isinstance(entry.get("effect"), str):
            raise Refused(
                f"its metadata '{contract.KEY_CHAIN}' must hold objects with 'effect' and 'parameters', not "
                f"{shown(entry)}"
            )
        if not isinstance(entry.get("parameters", {}), dict):
            raise Refused(
                f"its metadata '{contract.KEY_CHAIN}': the parameters of {shown(entry['effect'])} are no object"
            )
    return tuple(chain)


def actuation(meta: dict[str, str]) -> Actuation:
    """What was measured of the path from command to motion; nothing where the file tells nothing."""
    if contract.KEY_ACTUATION not in meta:
        return ACTS_AT_ONCE
    numbers = json_of(meta, contract.KEY_ACTUATION, dict)
    try:
        return Actuation(**{str(name): _real(value) for name, value in numbers.items()})
    except (TypeError, ValueError, OverflowError) as error:
        raise Refused(f"its metadata '{contract.KEY_ACTUATION}': {str(error)[:160]}") from None


def _real(value: object) -> float:
    """A number of JSON as a float; raises `TypeError` for anything else, `OverflowError` for what is too large."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{shown(value)} is no number")
    return float(value)


def check_vehicle(stated: dict[str, Any], vehicle: Vehicle) -> None:
    """Whether the vehicle that the file states is this one: name, mass (kg) and hover thrust."""
    name = stated.get("name")
    if name != vehicle.name:
        raise Refused(f"made for vehicle {shown(name)}, this one is '{vehicle.name}'")
    for key, ours in (("mass", vehicle.mass), ("hover_thrust", vehicle.hover_thrust)):
        value = stated.get(key)
        try:
            fits = abs(_real(value) - ours) <= 0.01 * ours
        except (TypeError, OverflowError):
            fits = False
        if not fits:
            raise Refused(f"made for {key} {shown(value)}, this vehicle has {ours:g}; refit it")


def ranges(entries: list[Any]) -> tuple[Range, ...]:
    """The training range of each feature, in the order of the model."""
    ranges = []
    for entry in entries:
        try:
            one = Range(str(entry["name"]), str(entry["unit"]), _real(entry["low"]), _real(entry["high"]))
        except (KeyError, TypeError, ValueError, OverflowError):
            raise Refused("its metadata 'features' need name, unit, low and high in each entry") from None
        if not (math.isfinite(one.low) and math.isfinite(one.high) and one.low <= one.high):
            raise Refused(f"the training range of feature {shown(one.name)} is {one.low} to {one.high}")
        ranges.append(one)
    given = {one.name: one.unit for one in ranges}
    base = list(contract.FEATURES.items())
    if list(given.items()) not in (base, base + list(contract.YAW_FEATURES.items())):
        raise Refused(
            f"its features are {shown(', '.join(given)) if given else 'none'}; expected {', '.join(contract.FEATURES)} "
            f"with their units, and optionally {', '.join(contract.YAW_FEATURES)}"
        )
    return tuple(ranges)


def learnables(meta: dict[str, str]) -> tuple[tuple[Learnable, ...], Vector]:
    """What the model says may be learnt in flight, and what it leaves of flights that it knows; nothing where there is
    nothing to learn."""
    if contract.KEY_ADAPTIVE not in meta:
        return (), ZERO
    found = []
    for entry in json_of(meta, contract.KEY_ADAPTIVE, list):
        try:
            words = [entry.pop(key) for key in ("effect", "parameter", "unit")]
            if not all(isinstance(w, str) and w.isprintable() and 0 < len(w) <= 60 for w in words):
                raise ValueError("effect, parameter and unit must be words")
            effect, parameter, unit = words
            numbers = [_real(entry[key]) for key in ("value", "low", "high", "spread", "drift")]
            found.append(Learnable(effect, parameter, unit, *numbers))
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
            raise Refused(f"its metadata '{contract.KEY_ADAPTIVE}': {str(error)[:160]}") from None
    if not 0 < len(found) <= MOST or len({one.name for one in found}) < len(found):
        raise Refused(
            f"its metadata '{contract.KEY_ADAPTIVE}' must name 1 to {MOST} different parameters, not {len(found)}"
        )
    for key in (contract.KEY_NOISE, contract.KEY_GOLDEN_PARAMETERS, contract.KEY_GOLDEN_SENSITIVITY):
        if key not in meta:
            raise Refused(f"its metadata lack '{key}'; export it again with --adaptive")
    try:
        x, y, z = (_real(one) for one in json_of(meta, contract.KEY_NOISE, list))
    except (TypeError, ValueError, OverflowError):
        x = y = z = math.nan
    if not all(0.0 < one < math.inf for one in (x, y, z)):
        raise Refused(f"its metadata '{contract.KEY_NOISE}' must be three numbers above 0")
    return tuple(found), (x, y, z)


def golden(meta: dict[str, str], tables: Sequence[tuple[str, int]]) -> list[np.ndarray]:
    """Tables of golden vectors with so many columns each, all of one length."""
    golden = []
    for key, columns in tables:
        try:
            values = np.array(json_of(meta, key, list), dtype=float)
        except (TypeError, ValueError, OverflowError):
            values = np.empty(0)
        if (
            values.ndim != 2
            or values.shape[1] != columns
            or len(values) < 3
            or not np.all(np.isfinite(values))
        ):
            raise Refused(f"its metadata '{key}' must hold at least 3 rows of {columns} finite numbers")
        golden.append(values)
    for other in golden[1:]:
        if len(golden[0]) != len(other):
            raise Refused(f"it has {len(golden[0])} golden inputs and {len(other)} golden outputs")
    return golden
