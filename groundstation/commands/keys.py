"""`groundstation keys`: TLS, roles and signing keys for vehicles and people, in one command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from trueflight.models.access import ENGINEER, OBSERVER, OPERATOR
from trueflight.models.printed import print_json_line
from trueflight.models.terminal import Terminal

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command(
        "keys", epilog="Example: groundstation keys keys --vehicle quad5 --engineer anna --observer eve"
    )(keys_command)


def keys_command(
    folder: Annotated[Path, typer.Argument(help="Where the keys are, or will be.")],
    vehicle: Annotated[
        list[str] | None, typer.Option(help="Vehicle, by the name in its vehicle.toml.")
    ] = None,
    observer: Annotated[list[str] | None, typer.Option(help="Somebody who reads.")] = None,
    operator: Annotated[
        list[str] | None, typer.Option(help="Somebody who flies as well (or a mocap).")
    ] = None,
    engineer: Annotated[
        list[str] | None, typer.Option(help="Somebody who deploys and signs models as well.")
    ] = None,
    remove: Annotated[
        list[str] | None, typer.Option(help="Somebody, or a vehicle, that is let in no longer.")
    ] = None,
    days: Annotated[float, typer.Option(help="How long the new certificates hold.")] = 365,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """Make a certificate authority and keys for vehicles and people, or add some to those that are there.

    Every option may be repeated. Prints what to copy where. FOLDER/ca is what makes new keys: keep it on this machine,
    and a copy of it where it is safe.
    """
    from trueflight.groundstation.operate.keys import make_keys, next_steps

    people = [
        (name, role)
        for role, names in ((OBSERVER, observer), (OPERATOR, operator), (ENGINEER, engineer))
        for name in names or []
    ]
    made = make_keys(folder, vehicle or [], people, remove or [], days)
    steps = next_steps(made)
    if as_json:
        print_json_line(
            {
                "made": [str(path) for path in made.made],
                "changed": [str(path) for path in made.changed],
                "removed": list(made.removed),
                "authority": str(folder / "ca"),
                "new_authority": made.new_authority,
                "until": made.until.isoformat(timespec="seconds"),
                "next": steps,
            }
        )
        return
    if made.new_authority:
        console.print(
            escape(f"{folder / 'ca'}: a new authority; keep it here, and let nobody have it"), highlight=False
        )
    for path in made.made:
        console.print(escape(f"{path}: until {made.until:%Y-%m-%d}"), highlight=False)
    for name in made.removed:
        console.print(
            escape(f"{name}: no longer let in, once every vehicle has its new access.toml"), highlight=False
        )
    console.print("next:")
    for step in steps:
        console.print(escape(f"  {step}"), highlight=False, soft_wrap=True)
