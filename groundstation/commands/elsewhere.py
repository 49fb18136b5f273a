"""`groundstation model export --to ...`: a version as the file of another simulator, autopilot or solver."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape

from trueflight.models.errors import InputError
from trueflight.models.printed import print_json

if TYPE_CHECKING:
    from trueflight.groundstation.export.target import Line, Written
    from trueflight.models.model import Model

BELIEVED = "linear"
"""In place of a version: the vehicle file alone, as everywhere."""
_COLOURS = {"whole": "green", "roughly": "yellow", "not": "red"}


def chosen(to: str, which: str, vehicle: Path | None, name: str, store: Path) -> Model:
    """The version `which` of a vehicle, given by its file, by its name, or as the only one in the store; for "linear"
    the vehicle file alone. Raises `InputError` where there is no such version, no way to tell of which vehicle, or no
    target named `to`."""
    from trueflight.groundstation.export.targets import target_named
    from trueflight.groundstation.versions.store import find
    from trueflight.models.model import rigid_body_model
    from trueflight.models.vehicle import load_vehicle

    target_named(to)
    if which == BELIEVED:
        if vehicle is None:
            raise InputError("'linear' is the vehicle file alone; pass it with --vehicle FILE")
        return rigid_body_model(load_vehicle(vehicle))
    if not name and Path(which).suffix != ".json":
        name = only_vehicle(store) if vehicle is None else load_vehicle(vehicle).name
    return find(store, name, which)


def only_vehicle(store: Path) -> str:
    """The vehicle of a store that has one. Raises `InputError` where it has none, or several."""
    names = sorted(p.name for p in store.iterdir() if p.is_dir()) if store.is_dir() else []
    if len(names) != 1:
        raise InputError(f"{store}: holds {len(names)} vehicles; say which with --vehicle-name")
    return names[0]


def export_elsewhere(
    console: Console,
    model: Model,
    to: str,
    output: Path,
    hover_speed: float | None,
    torque_length: float | None,
    as_json: bool,
) -> None:
    """Write the file of a target, and tell what became of each effect. Raises `InputError` for an unknown target, for
    numbers without sense, and where the file cannot be written."""
    from trueflight.groundstation.export.target import Known
    from trueflight.groundstation.export.targets import export, target_named
    from trueflight.models.contract import model_hash

    written = export(model, to, output, Known(hover_speed, torque_length))
    if as_json:
        data = written.text.encode()
        print_json(
            {
                "path": str(output),
                "to": to,
                "hash": model_hash(data),
                "bytes": len(data),
                "not_exported": [line.effect for line in written.lines if line.held == "not"],
                "actuation": {},
                "effects": [row_of(line) for line in written.lines],
                "notes": list(written.notes),
            }
        )
        return
    console.print(f"{escape(str(output))}: {model.label} for {target_named(to).title}")
    print_lines(console, written)


def row_of(line: Line) -> dict[str, str]:
    """What became of an effect, as JSON has it."""
    return {"effect": line.effect, "held": line.held, "how": line.how}


def print_lines(console: Console, written: Written) -> None:
    """What became of each effect, and what was assumed."""
    for line in written.lines:
        held = f"[{_COLOURS[line.held]}]{line.held:8}[/]"
        console.print(f"  {held}{escape(line.effect)}: {escape(line.how)}", highlight=False)
    for note in written.notes:
        console.print(f"  {escape(note)}", highlight=False, style="dim")
