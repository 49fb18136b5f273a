"""Numbers in texts: every one is looked up in the table that `--json` prints, and says where it stands there."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape


class CitedValue:
    """A part of the JSON table that knows its place in it.

    Texts stand as they are; a number has to go through the filter `num`, which says how it is written.
    """

    __slots__ = ("_path", "_raw")

    def __init__(self, raw: Any, path: str = "") -> None:
        self._raw, self._path = raw, path

    def __getitem__(self, key: str | int) -> CitedValue:
        return CitedValue(self._raw[key], f"{self._path}.{key}" if self._path else str(key))

    def __getattr__(self, name: str) -> CitedValue:
        if isinstance(self._raw, dict) and name in self._raw:
            return self[name]
        raise AttributeError(f"nothing is told of '{self._path}.{name}'")

    def __iter__(self) -> Iterator[CitedValue]:
        return (self[k] for k in range(len(self._raw)))

    def __len__(self) -> int:
        return len(self._raw)

    def __bool__(self) -> bool:
        return bool(self._raw)

    def __eq__(self, other: object) -> bool:
        return bool(self._raw == (other._raw if isinstance(other, CitedValue) else other))

    def __hash__(self) -> int:
        return hash(self._path)

    def __contains__(self, item: object) -> bool:
        return item in self._raw

    def __str__(self) -> str:
        if isinstance(self._raw, str):
            return self._raw
        raise TypeError(f"'{self._path}' is no text: write it with the filter num")

    def __html__(self) -> str:
        return str(Markup('<span data-path="{}">{}</span>').format(self._path, str(self)))

    def each(self) -> Iterator[tuple[str, CitedValue]]:
        """Key and value of each entry."""
        return ((key, self[key]) for key in self._raw)


SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def written(value: float | None, spec: str, scale: float = 1.0) -> str:
    """A number as people read it: `spec` of `format`, or "percent", or "change" (a signed percentage)."""
    if value is None:
        return "–"
    x = scale * value
    if spec == "percent":
        return f"{100 * x:.0f} %" if abs(x) >= 0.01 or x == 0.0 else f"{100 * x:.1f} %"
    if spec == "change":
        return f"{100 * x:+.0f} %".replace("-", "−")
    mantissa, _, exponent = format(x, spec).partition("e")
    power = f"·10{str(int(exponent)).translate(SUPERSCRIPT)}" if exponent else ""
    return mantissa.replace("-", "−") + power


def _as_html(told: CitedValue, spec: str, scale: float = 1.0) -> Markup:
    return Markup('<data value="{}" data-path="{}" data-spec="{}" data-scale="{}">{}</data>').format(
        json.dumps(told._raw), told._path, spec, f"{scale:g}", written(told._raw, spec, scale)
    )


def _as_text(told: CitedValue, spec: str, scale: float = 1.0) -> str:
    return written(told._raw, spec, scale)


def _interval(number: Callable[..., str], parameter: CitedValue) -> str:
    """A parameter with its unit and interval, to two digits of the interval's width."""
    low, high = parameter._raw["low"], parameter._raw["high"]
    width = high - low
    decimals = int(np.clip(1 - np.floor(np.log10(width)), 0, 6)) if 0.0 < width < np.inf else 3
    spec = f".{decimals}f"
    frame = "{}{} [{}, {}]"
    parts = number(parameter.value, spec), unit(parameter.unit), number(parameter.low, spec)
    return type(parts[0])(frame).format(*parts, number(parameter.high, spec))


UNITS = {"m/s^2": "m/s²", "rad/s^2": "rad/s²", "m^2": "m²", "1": ""}


def unit(told: CitedValue | str) -> str:
    """A unit as people write it, with the space before it; nothing for a bare number."""
    name = str(told)
    name = UNITS.get(name, name)
    return f" {name}" if name else ""


def _code(text: CitedValue | str) -> Markup:
    """A text with what stands after "groundstation" as code."""
    found = re.sub(r"(groundstation [a-z_ -]+[a-z_])", r"<code>\1</code>", str(escape(str(text))))
    if isinstance(text, CitedValue):
        return Markup('<span data-path="{}">{}</span>').format(text._path, Markup(found))
    return Markup(found)


def environment(html: bool, *rooms: str) -> Environment:
    """The templates of this room and of further `rooms` (packages), for HTML or for Markdown; whatever a template
    names must be there."""
    made = Environment(
        loader=ChoiceLoader([PackageLoader(room) for room in (__package__, *rooms)]),
        autoescape=html,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["num"] = _as_html if html else _as_text
    made.filters["interval"] = partial(_interval, made.filters["num"])
    made.filters["unit"] = unit
    made.filters["code"] = _code
    made.filters["raw"] = lambda told: told._raw
    return made


def sentences(table: dict[str, Any], html: bool) -> list[str]:
    """The verdict of an analysis (its JSON table) in plain words, the outcome first."""
    text = environment(html).get_template("verdict.txt").render(t=CitedValue(table))
    lines = [" ".join(line.split()) for line in text.splitlines()]
    return [Markup(line) if html else line for line in lines if line]
