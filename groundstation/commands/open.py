"""`groundstation open`: the workbench, a local page."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trueflight.groundstation.commands.options import (
    DEFAULT_STORE,
    StoreOption,
    ValidateOption,
    VehicleOption,
)
from trueflight.models.errors import InputError
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.groundstation.workbench.tasks import Source

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command("open", epilog="Example: groundstation open flight.ulg")(open_command)


def open_command(
    flights: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="FLIGHT...",
            help="Flights, or folders of flights; more can be dropped.",
            show_default=False,
        ),
    ] = None,
    vehicle: VehicleOption = None,
    validate: ValidateOption = None,
    store: StoreOption = DEFAULT_STORE,
    folder: Annotated[Path, typer.Option(help="Where what is dropped and made is kept.")] = Path(
        "trueflight-workbench"
    ),
    port: Annotated[int, typer.Option(help="0: a free one.", min=0, max=65535)] = 0,
    host: Annotated[
        str, typer.Option(help="Serve other machines under this name or address; only with --keys.")
    ] = "127.0.0.1",
    keys: Annotated[
        Path | None,
        typer.Option(help="Folder of `groundstation keys`, with its authority: who may open the page."),
    ] = None,
    most: Annotated[float, typer.Option(help="MB of a dropped file at most.", min=0.001)] = 2048.0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open it in the browser.")] = True,
) -> None:
    """Open the workbench: compare, see where the model fails, add what is missing, watch the error fall.

    A page on this machine alone, opened by the link that is printed. It ends with Ctrl-C.
    """
    from trueflight.groundstation.workbench.serving import Serving, serve

    def ready(link: str, first: bool) -> None:
        if not first:
            console.print(f"opened; for another browser: {link}", highlight=False, soft_wrap=True)
            return
        console.print(f"workbench: [bold]{link}[/bold]  (Ctrl-C ends it)", highlight=False, soft_wrap=True)
        if browser:
            _show(link)

    opened = _opened(flights or [], vehicle)
    held_out = None if validate is None else _opened([validate], vehicle)[0]
    with suppress(KeyboardInterrupt):  # how it is ended
        serve(Serving(folder, store, opened, held_out, port, int(1e6 * most), host, keys), ready)


def _opened(paths: list[Path], vehicle: Path | None) -> tuple[Source, ...]:
    from trueflight.groundstation.reading.several import flights_in
    from trueflight.groundstation.workbench.tasks import Source

    for path in paths:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder; check the path")
    return tuple(Source(file, file.name, vehicle) for file in flights_in(paths))


def _show(link: str) -> None:
    import webbrowser

    from trueflight.groundstation.operate.processes import has_display

    if has_display():
        webbrowser.open(link)
