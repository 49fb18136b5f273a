"""Numbers as people write them, with their unit: "450 g", "5 in", "20 ms"."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from trueflight.models.errors import InputError, shown

UNITS: Mapping[str, Mapping[str, float]] = {
    "kg": {"kg": 1.0, "g": 1e-3, "lb": 0.45359237, "oz": 0.028349523125},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, '"': 0.0254, "ft": 0.3048},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6},
    "V": {"V": 1.0, "mV": 1e-3},
    "kg m^2": {"kg m^2": 1.0, "kg m²": 1.0, "kg m2": 1.0, "g m^2": 1e-3, "g m²": 1e-3, "kg cm^2": 1e-4,
               "kg cm²": 1e-4, "g cm^2": 1e-7, "g cm²": 1e-7},
    "of full collective": {"": 1.0, "%": 1e-2, "of full collective": 1.0},
}  # fmt: skip
"""What a number may be given in, and how much of the vehicle file's unit that is."""
_NUMBER = re.compile(r"\s*([+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")


def in_unit(text: str, unit: str) -> float:
    """The number that `text` says, in `unit` of the vehicle file (one of `UNITS`, or "" for a bare number); without a
    unit of its own it is taken to be in that one.

    Raises `InputError` for what is no number, and for a unit of another kind.
    """
    found = _NUMBER.fullmatch(text)
    if found is None:
        raise InputError(f"{shown(text)} is no number")
    number, given = float(found[1].replace(",", ".")), " ".join(found[2].split())
    if not math.isfinite(number):
        raise InputError(f"{shown(text)} is no number")
    known = UNITS.get(unit, {})
    if not given or given == unit:
        return number
    if given in known:
        return number * known[given]
    others = [own for own, every in UNITS.items() if given in every]
    kinds = f"; '{given}' is a unit of {_KINDS[others[0]]}" if others else ""
    usable = ", ".join(name for name in known if name and name != '"') or "a bare number"
    raise InputError(f"'{given}' is no unit of {_KINDS.get(unit, 'this')}{kinds}: give it in {usable}")


_KINDS = {
    "kg": "mass",
    "m": "length",
    "s": "time",
    "V": "voltage",
    "kg m^2": "inertia",
    "of full collective": "a share of the full collective",
}
