"""The schemas of what commands print with `--json`, for every test that has such a document at hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from jsonschema import Draft202012Validator
from referencing import Registry, Resource

FOLDER = Path(__file__).parents[1] / "groundstation" / "output" / "schemas"
SCHEMAS: dict[str, Any] = {file.name: json.loads(file.read_text()) for file in FOLDER.glob("*.json")}
_KNOWN: Registry[Any] = Registry().with_resources(
    (name, Resource.from_contents(schema)) for name, schema in SCHEMAS.items()
)


def schema_of(command: str) -> str:
    """The file of a command: "groundstation model add" has groundstation-model-add.json."""
    return f"{command.replace(' ', '-')}.json"


def valid(command: str, document: Any) -> Any:
    """The document, which must follow the schema of the command."""
    validator = Draft202012Validator(SCHEMAS[schema_of(command)], registry=_KNOWN)
    wrong = [
        f"{'/'.join(map(str, e.absolute_path))}: {e.message[:300]}" for e in validator.iter_errors(document)
    ]
    assert not wrong, f"{command}: {wrong[:5]}"
    return document
