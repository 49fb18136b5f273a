"""`sim-bridge reveal`, `pilot` and `effects`: what was hidden, what can be, and the pilot's orders."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from trueflight.models.errors import InputError
from trueflight.sim_bridge.commands.options import Json
from trueflight.sim_bridge.commands.output import tell


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command(epilog="Example: sim-bridge reveal hidden.sealed --json")(reveal)
    app.command(epilog="Example: sim-bridge pilot --mode POSCTL")(pilot)
    app.command(epilog="Example: sim-bridge effects --json")(effects)


def reveal(file: Path, as_json: Json = False) -> None:
    """Tell what was hidden, from its sealed file."""
    from trueflight.sim_bridge.seal import reveal as open_seal

    answer: dict[str, Any] = open_seal(file)
    lines = []
    for effect in answer["effects"]:
        numbers = (
            f"{key} {entry['value']:.4g}" + ("" if entry["unit"] == "1" else f" {entry['unit']}")
            for key, entry in effect["parameters"].items()
        )
        begins = f", from {effect['begins']['value']:g} s after take-off" if "begins" in effect else ""
        lines.append(f"{effect['name']}: " + ", ".join(numbers) + begins)
    tell(answer, "\n".join(lines) or "nothing was hidden", as_json)


def pilot(
    mode: Annotated[
        str, typer.Option(help="POSCTL, ALTCTL, STABILIZED, HOLD, LAND, RTL, KILL, RELEASE_KILL, ...")
    ],
    port: Annotated[
        int, typer.Option("--pilot-port", help="The pilot's UDP port of `sim-bridge run`.")
    ] = 14590,
    as_json: Json = False,
) -> None:
    """Take over a running simulation as its pilot: switch the flight mode, or kill."""
    from trueflight.sim_bridge.pilot import send_order

    answer = send_order(mode, port)
    if not answer.get("accepted"):
        raise InputError(f"--mode {mode}: not taken: {answer.get('reason')}")
    tell(answer, f"{answer['mode']}, {'armed' if answer['armed'] else 'disarmed'}", as_json)


def effects(as_json: Json = False) -> None:
    """List what can be hidden, with the range of its size when it is drawn, by name or `random`, and by `rich`."""
    from trueflight.sim_bridge.truth.effects import EFFECTS
    from trueflight.sim_bridge.truth.hidden import RICH, pool

    rows: list[dict[str, Any]] = [
        {
            "name": effect.name,
            "what": effect.what,
            "low": effect.low,
            "high": effect.high,
            "unit": next(iter(effect.units.values())),
            "random": effect.drawn,
            "any": effect.name in pool("any"),
            "rich": RICH.get(effect.name),
            "may_begin": effect.may_begin,
        }
        for effect in EFFECTS.values()
    ]
    if as_json:
        tell({"effects": rows}, "", as_json)
        return
    from trueflight.models.terminal import Table, Terminal

    table = Table()
    for column in ("effect", "drawn", "in rich", "unit", "what"):
        table.add_column(column, no_wrap=column != "what")
    for row in rows:
        span = f"{row['low']:g} to {row['high']:g}"
        rich = "{:g} to {:g}".format(*row["rich"]) if row["rich"] else ""
        table.add_row(row["name"], span, rich, row["unit"], row["what"])
    Terminal().print(table)
