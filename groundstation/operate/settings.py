"""The ground station's settings: a commented TOML file, overridden by flags."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from trueflight.models.errors import InputError
from trueflight.models.outside import is_number, read_toml, shown
from trueflight.models.vehicle import check_name

TEXTS = ("name", "mode", "zenoh_config", "flights", "keys")


@dataclass(frozen=True)
class Settings:
    """What the ground needs to find a companion.

    `name` of the vehicle (empty: the only one that answers), Zenoh's `mode`, endpoints to `connect` and
    `listen` to (none: `default_connect`), a `zenoh_config` file and further `cfg` pairs `KEY:VALUE`; `timeout` in s
    to wait for an answer; `flights` is the folder that records are fetched to; `keys` one's folder of
    `groundstation keys`.
    """

    name: str = ""
    mode: str = ""
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    zenoh_config: str = ""
    cfg: tuple[str, ...] = ()
    timeout: float = 5.0
    flights: str = "flights"
    keys: str = ""

    @property
    def default_connect(self) -> str:
        """Where a companion is looked for when nobody says where."""
        return f"{'tls' if self.keys else 'tcp'}/127.0.0.1:7447"


def load_settings(path: Path | None) -> Settings:
    """Read `groundstation.toml`; the defaults without a file. File names in it are relative to it.

    Raises `InputError` for a file that cannot be read and for a key or value that does not fit.
    """
    if path is None:
        return Settings()
    known = {f.name for f in fields(Settings)}
    changes: dict[str, Any] = {}
    for key, value in read_toml(path, "the configuration").items():
        if key not in known:
            close = difflib.get_close_matches(key, known, 1)
            hint = f"did you mean '{close[0]}'?" if close else f"known keys: {', '.join(sorted(known))}"
            raise InputError(f"{path}: unknown key '{key}'; {hint}")
        if key == "timeout":
            if not is_number(value) or not 0.1 <= value <= 600:
                raise InputError(f"{path}: 'timeout' must be 0.1 to 600 s, not {shown(value)}")
            changes[key] = float(value)
        elif key in TEXTS:
            if not isinstance(value, str):
                raise InputError(f"{path}: '{key}' must be a text, not {shown(value)}")
            if key == "name" and value:
                check_name(value, f"{path}: 'name'")
            in_file = key in ("zenoh_config", "flights", "keys") and value
            changes[key] = str(path.parent / value) if in_file else value
        else:
            if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
                raise InputError(f"{path}: '{key}' must be a list of texts, not {shown(value)}")
            changes[key] = tuple(value)
    return replace(Settings(), **changes)


def settings_with(config: Path | None, **flags: object) -> Settings:
    """The settings of a file, overridden by flags of the same names; None, or nothing of a list, overrides nothing.

    Raises `InputError` as `load_settings`.
    """
    given: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else str(value) if isinstance(value, Path) else value
        for name, value in flags.items()
        if value is not None and value != []
    }
    return replace(load_settings(config), **given)
