"""`groundstation effects` and `effect new`: the catalogue, and a user's own effects."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trueflight.groundstation.commands.options import EffectsOption, JsonOption
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.models.effect import Effect

console = Terminal()
effect_app = typer.Typer(no_args_is_help=True, help="Write an effect of your own.")


def register(app: typer.Typer) -> None:
    """Add the commands for own effects to the ground station's application."""
    app.command("effects")(effects_command)
    app.add_typer(effect_app, name="effect")


def effects_command(
    name: Annotated[str | None, typer.Argument(help="One effect, in full.")] = None,
    effects: EffectsOption = None,
    as_json: JsonOption = False,
) -> None:
    """The catalogue of effects: what each is, what excites it, what it is confounded with.

    Example: groundstation effects ground_effect
    """
    from trueflight.groundstation.output.as_json import effect_table
    from trueflight.models.effects import catalogue, effect_named

    directory = None if effects is None else str(effects)
    shown = list(catalogue(directory).values()) if name is None else [effect_named(name, directory)]
    if as_json:
        print_json([effect_table(e) for e in shown])
    elif name is None:
        _print_catalogue(shown)
    else:
        _print_effect(shown[0])


def _print_catalogue(effects: Sequence[Effect]) -> None:
    from trueflight.models.terminal import Table

    table = Table()
    table.add_column("effect", no_wrap=True)
    table.add_column("what it is")
    table.add_column("parameters")
    for e in effects:
        told = ", ".join(p.name if p.unit == "1" else f"{p.name} ({p.unit})" for p in e.parameters)
        table.add_row(e.name, e.title, told)
    console.print(table)


def _print_effect(e: Effect) -> None:
    from trueflight.models.effect import FLIGHT

    console.print(f"[bold]{e.name}[/bold]: {e.title}")
    console.print(" ".join((e.formula.__doc__ or "").split()), highlight=False, markup=False)
    for p in e.parameters:
        unit = "" if p.unit == "1" else f" {p.unit}"
        own = ", each flight's own" if p.belongs_to == FLIGHT else ""
        console.print(f"  {p.name}: {p.meaning}, {p.low:g} to {p.high:g}{unit}{own}")
    either = f"{', ' if e.needs else ''}{' or '.join(e.needs_any)}" if e.needs_any else ""
    sensor = ", from an accelerometer" if e.needs_accelerometer else ""
    console.print(f"needs: {', '.join(e.needs)}{either}{sensor}")
    console.print(f"fly: {e.manoeuvre}")
    console.print(f"confounded with: {', '.join((*e.confounded_with, *e.aliases)) or e.unconfounded}")
    console.print(f"source: {e.citation}")


@effect_app.command("new")
def effect_new(
    name: Annotated[str, typer.Argument(help="Name of the effect: lower case, digits, underscores.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the file.")] = Path("effects"),
) -> None:
    """Write a commented template of an effect: one file, yours to change, that works as it stands.

    Example: groundstation effect new tether --output my-effects
    """
    from trueflight.groundstation.versions.effect_file import write_template

    path = write_template(name, output)
    console.print(f"{path}: put your formula in, then", highlight=False)
    console.print(f"  groundstation effects {name} --effects {output}", highlight=False)
    console.print(f"  groundstation diagnose FLIGHT --effects {output}", highlight=False)
    console.print(f"  groundstation model add {name} --flight FLIGHT --effects {output}", highlight=False)
