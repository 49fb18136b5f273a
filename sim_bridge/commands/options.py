"""Options that several commands share, as groups; a group is one dataclass in a command's parameters."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from trueflight.models.contract import CONTROLLERS
from trueflight.sim_bridge.settings import Settings, load_settings

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@dataclass(frozen=True)
class Owner:
    """What the vehicle's owner believes of it."""

    vehicle: Annotated[
        Path | None, typer.Option(help="Vehicle file (vehicle.toml): what its owner believes.")
    ] = None
    config: Annotated[
        Path | None, typer.Option(help="Configuration (sim-bridge.toml); flags override it.")
    ] = None


@dataclass(frozen=True)
class OwnerAndDesign(Owner):
    """What the owner believes, with the design that flies it."""

    design: Annotated[
        Path | None, typer.Option(help="Design file; otherwise design.json beside the vehicle.")
    ] = None


@dataclass(frozen=True)
class Wanted:
    """What to hide."""

    hidden: Annotated[
        list[str] | None,
        typer.Option(
            help="Effect to hide: NAME, NAME:SIZE, rich, random, any, none; NAME@SECONDS begins in flight. "
            "Repeatable."
        ),
    ] = None
    hidden_count: Annotated[int | None, typer.Option(help="How many effects `random` or `any` draws.")] = None


@dataclass(frozen=True)
class Drawn:
    """What is drawn."""

    seed: Annotated[int | None, typer.Option(help="Of the draw and of the noise.")] = None
    noise: Annotated[
        float | None, typer.Option(help="Scale of sensor noise and estimator errors; 0: none.")
    ] = None


@dataclass(frozen=True)
class Draw(Drawn):
    """What is drawn, and where the answer goes."""

    sealed: Annotated[
        Path | None, typer.Option(help="Where the answer to `random`, `any` or `rich` goes, for `reveal`.")
    ] = None


BatteryAge = Annotated[
    float | None, typer.Option(help="Factor on the battery's internal resistance: 1 new, 2 worn out.")
]


@dataclass(frozen=True)
class Battery:
    """The battery at the start."""

    charge: Annotated[
        float | None, typer.Option(help="The battery's state of charge at the start, 0 to 1.")
    ] = None
    battery_age: BatteryAge = None


@dataclass(frozen=True)
class DrawAndBattery(Battery, Draw):
    """What is drawn, and the battery at the start."""


@dataclass(frozen=True)
class DrawnAndBattery(Battery, Drawn):
    """What is drawn without a file for its answer, and the battery at the start."""


@dataclass(frozen=True)
class OnMavlink:
    """Where and how fast the stand-in serves MAVLink, and its simulated pilot."""

    mavlink: Annotated[str | None, typer.Option(help="The companion's address: udpout:HOST:PORT.")] = None
    port: Annotated[int | None, typer.Option(help="The vehicle's own UDP port on 127.0.0.1.")] = None
    pilot_port: Annotated[int | None, typer.Option(help="UDP port of the simulated pilot; 0: none.")] = None
    speed: Annotated[float | None, typer.Option(help="Simulated over wall time.")] = None
    pilot_takes_over_at: Annotated[float | None, typer.Option(help="s after arming; 0: never.")] = None
    pilot_mode: Annotated[str | None, typer.Option(help="Mode the pilot then takes over with.")] = None
    duration: Annotated[
        float | None, typer.Option(help="End after so many s of simulated time; 0: never.")
    ] = None


@dataclass(frozen=True)
class WithPx4:
    """How a real PX4 connects, and what it must have."""

    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 for a PX4 on another machine.")] = (
        "127.0.0.1"
    )
    port: Annotated[
        int, typer.Option(help="TCP port; PX4's instance i (`px4 -i 1`) connects to 4560 + i.")
    ] = 4560
    link_port: Annotated[
        int | None,
        typer.Option(help="UDP port for PX4's parameters; default 14030 + i; 0: none.", min=0, max=65535),
    ] = None
    set_params: Annotated[
        bool, typer.Option("--set-params", help="Set PX4's control allocation to the vehicle's.")
    ] = False
    show_params: Annotated[
        bool, typer.Option("--show-params", help="Print what PX4 must have, as its commands, and end.")
    ] = False
    position: Annotated[
        str, typer.Option(help="What tells PX4 where it is: gps, vision (ODOMETRY) or both.")
    ] = "gps"
    vision_rate: Annotated[float, typer.Option(help="Rate of vision, Hz.", min=1, max=250)] = 50.0


@dataclass(frozen=True)
class Flying:
    """What flies a trajectory in-process, and how often."""

    parameter: Annotated[
        list[str] | None, typer.Option("--set", help="Parameter of the trajectory, NAME=VALUE. Repeatable.")
    ] = None
    model: Annotated[
        Path | None, typer.Option(help="ONNX model; the guarded correction then flies with it.")
    ] = None
    controller: Annotated[
        str,
        typer.Option(
            help=f"One of {', '.join(CONTROLLERS)}; without it corrected where a model is given, otherwise lqr."
        ),
    ] = ""
    trim: Annotated[
        float | None,
        typer.Option(help="Bandwidth of the slow trim of `corrected`, rad/s; 0: none.", min=0, max=1),
    ] = None
    observer: Annotated[
        float | None,
        typer.Option(help="Low-pass of the disturbance observer of `corrected`, Hz; 0: none.", min=0, max=20),
    ] = None
    settle: Annotated[
        float, typer.Option(help="s to hold the start before the trajectory begins.", min=0, max=60)
    ] = 0.0
    repeat: Annotated[int, typer.Option(help="How often the trajectory is flown.", min=1)] = 1
    rate: Annotated[float, typer.Option(help="Control rate, Hz.")] = 100.0


def settings_of(
    owner: Owner, *groups: Wanted | Drawn | OnMavlink, free_speed: float | None = None, **more: Any
) -> Settings:
    """The settings by the configuration file and the flags of these groups; `free_speed` as in `load_settings`."""
    flags = asdict(owner)
    config = flags.pop("config")
    for group in groups:
        flags |= asdict(group)
    return load_settings(config, flags | more, free_speed)


def with_groups(command: Callable[..., None]) -> Callable[..., None]:
    """The command as typer can read it: every field of a dataclass among its parameters is a parameter of its own."""
    groups: dict[str, Any] = {}
    flat: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
        if not is_dataclass(parameter.annotation):
            flat.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
            continue
        groups[name] = group = parameter.annotation
        hints = get_type_hints(group, include_extras=True)
        flat += [
            inspect.Parameter(
                field.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=field.default,
                annotation=hints[field.name],
            )
            for field in fields(group)
        ]

    def flattened(**given: Any) -> None:
        for name, group in groups.items():
            given[name] = group(**{field.name: given.pop(field.name) for field in fields(group)})
        command(**given)

    flattened.__name__, flattened.__doc__ = command.__name__, command.__doc__
    flattened.__annotations__ = {parameter.name: parameter.annotation for parameter in flat}
    flattened.__signature__ = inspect.Signature(flat)  # type: ignore[attr-defined]
    return flattened
