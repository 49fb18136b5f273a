"""The way to a companion, which every command has that talks to one: the same options, handed on as `Settings`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

_PANEL = "The way to the companion"
ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config", help="Settings (groundstation.toml); flags override it.", rich_help_panel=_PANEL
    ),
]
OPTIONS: dict[str, Any] = {
    "name": Annotated[
        str | None,
        typer.Option("--name", help="Vehicle; default: the only one that answers.", rich_help_panel=_PANEL),
    ],
    "connect": Annotated[
        list[str] | None,
        typer.Option("-e", "--connect", help="Zenoh endpoint of the companion.", rich_help_panel=_PANEL),
    ],
    "mode": Annotated[
        str | None,
        typer.Option("-m", "--mode", help="Zenoh mode: peer, client, router.", rich_help_panel=_PANEL),
    ],
    "listen": Annotated[
        list[str] | None,
        typer.Option("-l", "--listen", help="Zenoh endpoint to listen on.", rich_help_panel=_PANEL),
    ],
    "zenoh_config": Annotated[
        Path | None,
        typer.Option("-c", "--zenoh-config", help="Zenoh configuration file.", rich_help_panel=_PANEL),
    ],
    "cfg": Annotated[
        list[str] | None, typer.Option("--cfg", help="Zenoh setting, KEY:VALUE.", rich_help_panel=_PANEL)
    ],
    "timeout": Annotated[
        float | None,
        typer.Option("--timeout", help="Seconds to wait for an answer.", rich_help_panel=_PANEL, min=0.1),
    ],
    "keys": Annotated[
        Path | None,
        typer.Option(
            "--keys",
            help="Your folder of `groundstation keys`: TLS, and what you may do.",
            rich_help_panel=_PANEL,
        ),
    ],
}
"""By the fields of `operate.settings.Settings` that they override."""


def linked(command: Callable[..., None]) -> Callable[..., None]:
    """The `command`, which takes `settings`, with the options above in the place of it."""
    plain = inspect.signature(command)
    hints = get_type_hints(command, localns={"Settings": object}, include_extras=True)
    hints = {name: hint for name, hint in hints.items() if name != "settings"}
    hints |= {"config": ConfigOption, **OPTIONS}

    def parameter(name: str, default: Any) -> inspect.Parameter:
        return inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hints[name]
        )

    parameters = []
    for name, given in plain.parameters.items():
        if name == "settings":
            parameters += [parameter(option, None) for option in ("config", *OPTIONS)]
        else:
            parameters.append(parameter(name, given.default))

    def with_settings(*, config: Path | None, **others: Any) -> None:
        from trueflight.groundstation.operate.settings import settings_with

        flags = {name: others.pop(name) for name in OPTIONS}
        command(settings=settings_with(config, **flags), **others)

    with_settings.__name__, with_settings.__doc__ = command.__name__, command.__doc__
    with_settings.__annotations__ = hints
    with_settings.__signature__ = plain.replace(parameters=parameters)  # type: ignore[attr-defined]
    return with_settings
