"""TOML files with errors in one line."""

from __future__ import annotations

import tomllib
from pathlib import Path

from models.errors import InputError


def read_toml(path: Path, what: str) -> dict[str, object]:
    """A TOML file's table; `what` names it in messages. Raises `InputError` for a missing file or bad
    syntax."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot read the {what} ({error.strerror}); check the path") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}; correct that line") from None
