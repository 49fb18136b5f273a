"""An effect of the user's own as a file: the one place that writes it."""

from __future__ import annotations

import re
from pathlib import Path

from trueflight.models.effects import catalogue
from trueflight.models.errors import InputError
from trueflight.models.whole_file import write_whole


def write_effect_file(name: str, source: str, folder: Path) -> Path:
    """Write `source` of effect `name` as `folder`/`name`.py.

    Raises `InputError` for a name that is none or taken, and where the file exists or cannot be written.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise InputError(f"'{name}' is no name for an effect; use lower-case letters, digits and underscores")
    if name in catalogue():
        raise InputError(f"an effect named '{name}' exists already; choose another name")
    path = folder / f"{name}.py"
    if path.exists():
        raise InputError(f"{path} exists already; choose another name or folder")
    write_whole(path, source, "the effect", "choose another folder", new=True)
    return path
