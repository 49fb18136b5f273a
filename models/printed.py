"""What every command prints with `--json`: documents that say which schema they follow."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import typer

SCHEMA = 1
"""The number of the schema; it rises when a key changes its meaning or goes away, not when one is added."""

Document = Mapping[str, Any] | Sequence[Mapping[str, Any]]
"""An object, or a list of them."""


def print_json(document: Document) -> None:
    """One document on standard output, indented. `schema` stands first in it; of a list, in each of its objects."""
    typer.echo(json.dumps(_with_schema(document), indent=1))


def print_json_line(document: Document) -> None:
    """As `print_json`, on one line: for what is read line by line."""
    typer.echo(json.dumps(_with_schema(document)))


def _with_schema(document: Document) -> Any:
    if isinstance(document, Mapping):
        return {"schema": SCHEMA, **_finite(document)}
    return [{"schema": SCHEMA, **_finite(one)} for one in document]


def _finite(value: Any) -> Any:
    """`value` with null for numbers that JSON does not have."""
    if isinstance(value, Mapping):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
