"""The controllers that can be asked for here: the project's own, and those of installed packages."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from trueflight.models.contract import CONTROLLERS
from trueflight.models.errors import InputError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "trueflight.controllers"
"""Entry points: a name, and a callable that makes a `companion.law.steps.Controller` of a
`companion.law.control.ControlLaw`."""


@cache
def plug_ins() -> dict[str, EntryPoint]:
    """Entry points of controllers by name. Raises `InputError` for one that takes a name of the project's own."""
    from importlib.metadata import entry_points  # a process that flies the project's own needs none of it

    found = {}
    for entry in entry_points(group=GROUP):
        if entry.name in CONTROLLERS:
            raise InputError(
                f"controller '{entry.name}' of {entry.value}: the name is taken; choose another in its entry point"
            )
        found[entry.name] = entry
    return found


def controllers() -> tuple[str, ...]:
    """Names of all of them."""
    return (*CONTROLLERS, *plug_ins())


def check_controller(name: str, what: str = "controller") -> None:
    """Raise `InputError` for a name that is none; `what` tells where it stands."""
    if name not in CONTROLLERS and name not in plug_ins():
        raise InputError(f"{what} '{name}' is unknown; use one of {', '.join(controllers())}")
