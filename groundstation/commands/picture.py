"""`--png`, which every command has that writes a Rerun recording: given to all of them here."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from trueflight.groundstation.commands.options import SaveOption
from trueflight.groundstation.output.terminal import working
from trueflight.models.terminal import Terminal

PngOption = Annotated[
    Path | None,
    typer.Option(
        "--png", help="Draw the recording as a picture here; without --rrd it is written beside it."
    ),
]


def offer_pictures(app: typer.Typer) -> None:
    """Add `--png` to every command of `app`, and of its groups, that takes a recording's name."""
    for command in app.registered_commands:
        if command.callback is not None and (name := _recording_of(command.callback)):
            command.callback = _drawing(command.callback, name)
    for group in app.registered_groups:
        if group.typer_instance is not None:
            offer_pictures(group.typer_instance)


def _recording_of(command: Callable[..., Any]) -> str:
    """The parameter that names the recording; '' where there is none, or the picture's is there already."""
    hints = get_type_hints(command, include_extras=True)
    return "" if "png" in hints else next((name for name, hint in hints.items() if hint == SaveOption), "")


def _drawing(command: Callable[..., Any], recording: str) -> Callable[..., Any]:
    """The command, which draws its recording where a picture is asked for."""
    plain = inspect.signature(command)
    hints = get_type_hints(command, include_extras=True) | {"png": PngOption}
    parameters = [
        p.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=hints[p.name])
        for p in plain.parameters.values()
    ]
    added = inspect.Parameter("png", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=PngOption)
    after = next(k for k, p in enumerate(parameters, 1) if p.name == recording)

    def drawing(*, png: Path | None, **given: Any) -> Any:
        if png is None:
            return command(**given)
        given[recording] = given[recording] or png.with_suffix(".rrd")
        done = command(**given)
        from trueflight.groundstation.operate.processes import program
        from trueflight.groundstation.views.picture import draw

        errors = Terminal(stderr=True)  # what is asked for with --json stays one document
        with working(errors, "drawing", not errors.is_terminal):
            draw(given[recording], png, program("rerun"))
        errors.print(f"picture: {png}", markup=False, highlight=False)
        return done

    drawing.__name__, drawing.__doc__, drawing.__annotations__ = command.__name__, command.__doc__, hints
    drawing.__signature__ = plain.replace(  # type: ignore[attr-defined]
        parameters=[*parameters[:after], added, *parameters[after:]]
    )
    return drawing
