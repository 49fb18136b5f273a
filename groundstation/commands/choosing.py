"""`--vehicle-namespace` and `--topic`, which every command has that reads flights: given to all of them here."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Annotated, Any, get_type_hints

import typer

NamespaceOption = Annotated[
    str | None,
    typer.Option(
        "--vehicle-namespace", help="Of several vehicles in a ROS 2 recording or a .tlog: the one to read."
    ),
]
TopicOption = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        metavar="QUANTITY=NAME",
        help="Topic to read a quantity from: position=/vrpn/drone/pose, battery_voltage=battery_status:1. Repeatable.",
    ),
]


def offer_sources(app: typer.Typer) -> None:
    """Add both options to every command of `app`, and of its groups, that takes a `mapping`."""
    for command in app.registered_commands:
        if command.callback is not None and "mapping" in inspect.signature(command.callback).parameters:
            command.callback = _choosing(command.callback)
    for group in app.registered_groups:
        if group.typer_instance is not None:
            offer_sources(group.typer_instance)


def _choosing(command: Callable[..., Any]) -> Callable[..., Any]:
    """A command that takes both options as well, and hands them on with its `mapping`."""
    plain = inspect.signature(command)
    if "topic" in plain.parameters:
        return command
    hints = get_type_hints(command, include_extras=True)
    hints |= {"vehicle_namespace": NamespaceOption, "topic": TopicOption}
    parameters = [p.replace(annotation=hints[p.name]) for p in plain.parameters.values()]
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=hints[name])
        for name in ("vehicle_namespace", "topic")
    ]
    after = next(k for k, p in enumerate(parameters, 1) if p.name == "mapping")
    together = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in parameters]

    def choosing(
        *, mapping: list[str] | None, vehicle_namespace: str | None, topic: list[str] | None, **others: Any
    ) -> Any:
        from trueflight.groundstation.reading.sources import as_lines

        lines = as_lines(vehicle_namespace, topic or ())
        return command(mapping=[*(mapping or ()), *lines] or None, **others)

    choosing.__name__, choosing.__doc__, choosing.__annotations__ = command.__name__, command.__doc__, hints
    choosing.__signature__ = plain.replace(  # type: ignore[attr-defined]
        parameters=[*together[:after], *added, *together[after:]]
    )
    return choosing
