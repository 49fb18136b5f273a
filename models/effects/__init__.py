"""The catalogue of physical effects, one file each."""

from __future__ import annotations

import importlib
import importlib.util
import os
import pkgutil
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from trueflight.models.effect import Effect
from trueflight.models.effects import rigid_body, transport_delay
from trueflight.models.errors import InputError
from trueflight.models.outside import shown

EXACT_ROTATION: Effect = rigid_body.EFFECT
"""What every diagnosis starts from: the exact rotation of thrust, instead of the hover linearisation."""
CLOCK: Effect = transport_delay.EFFECT
"""The shift in time that every fit is given where its model has none: no log's clock is better than a sample."""


@cache
def catalogue(directory: str | None = None) -> dict[str, Effect]:
    """All known effects by name: the project's own, those of installed entry points (group `trueflight.effects`),
    and every `*.py` of `directory`, the user's own.

    Raises `InputError` where a user's file cannot be used or takes a name that is already there.
    """
    found: dict[str, Effect] = {}
    for module in sorted(m.name for m in pkgutil.iter_modules(__path__)):
        effect = importlib.import_module(f"{__name__}.{module}").EFFECT
        found[effect.name] = effect
    for entry in entry_points(group="trueflight.effects"):
        _add(found, entry.load(), f"entry point {entry.name}")
    if directory is not None:
        folder = Path(directory)
        if not os.path.isdir(directory):  # Path.is_dir raises for a name that no folder can have
            raise InputError(
                f"{shown(directory)}: no such folder of effects; pass --effects DIR with *.py files in it"
            )
        files = sorted(folder.glob("*.py"))
        if not files:
            raise InputError(
                f"{directory}: holds no effects (*.py); 'groundstation effect new NAME --output DIR' writes one"
            )
        for path in files:
            _add(found, _load(path), str(path))
    return found


def _load(path: Path) -> object:
    spec = importlib.util.spec_from_file_location(f"user_effect_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except ModuleNotFoundError as error:
        folder = (error.name or "").split(".")[0]
        if folder not in ("models", "companion", "groundstation", "sim_bridge"):
            raise InputError(f"{path}: cannot be loaded: {type(error).__name__}: {error}") from None
        raise InputError(
            f"{path}: no module '{error.name}'; import it from trueflight.{error.name}"
        ) from None
    except Exception as error:  # noqa: BLE001 - a user's file may fail in any way; it is told in one line
        raise InputError(f"{path}: cannot be loaded: {type(error).__name__}: {error}") from None
    return getattr(module, "EFFECT", None)


def _add(found: dict[str, Effect], effect: object, where: str) -> None:
    if not isinstance(effect, Effect):
        raise InputError(f"{where}: defines no EFFECT (an object of models.effect.Effect); add it")
    if effect.name in found:
        raise InputError(f"{where}: an effect named '{effect.name}' exists already; choose another name")
    found[effect.name] = effect


def effect_named(name: str, directory: str | None = None) -> Effect:
    """One effect by name; raises `InputError` with the nearest names for an unknown one."""
    import difflib

    known = catalogue(directory)
    if name not in known:
        close = difflib.get_close_matches(name, known, 3)
        hint = f"did you mean {' or '.join(close)}?" if close else f"known: {', '.join(known)}"
        raise InputError(f"unknown effect '{name}'; {hint}")
    return known[name]
