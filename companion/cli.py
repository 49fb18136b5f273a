"""`companion`: flies a vehicle by its linear design and lets the ground compare, correct and fly again."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from trueflight.companion import onboard_commands
from trueflight.models.errors import InputError, run_command_line
from trueflight.models.printed import print_json_line
from trueflight.models.program import offer_version

app = typer.Typer(
    name="companion",
    help="Runs on the vehicle: flies missions over MAVLink, records them, and answers the ground over Zenoh.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)

Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Connect = Annotated[
    str | None,
    typer.Option(help="MAVSDK address of the autopilot, such as udpin://127.0.0.1:14540 or serial://..."),
]
Rate = Annotated[float | None, typer.Option(help="Control rate, Hz: the odometry's.")]
System = Annotated[
    int | None, typer.Option(help="MAVLink system id of the autopilot (MAV_SYS_ID), where several are heard.")
]
Battery = Annotated[
    int | None,
    typer.Option(help="PX4's number of the flight's battery (BAT1_*: 1), where there are several."),
]
Timeout = Annotated[float | None, typer.Option(help="Seconds to wait for an autopilot.")]


@app.command(epilog="Example: companion run --vehicle models/vehicles/quad5/vehicle.toml --rate 100")
def run(
    vehicle: Annotated[Path | None, typer.Option(help="Vehicle file (vehicle.toml).")] = None,
    design: Annotated[
        Path | None, typer.Option(help="Design file; otherwise design.json beside the vehicle.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="Configuration (companion.toml); flags override it.")
    ] = None,
    connect: Connect = None,
    system: System = None,
    battery: Battery = None,
    rate: Rate = None,
    timeout: Timeout = None,
    records: Annotated[Path | None, typer.Option(help="Folder of the flight records.")] = None,
    models: Annotated[Path | None, typer.Option(help="Folder of the deployed models.")] = None,
    zenoh_mode: Annotated[
        str | None, typer.Option("-m", "--mode", help="Zenoh mode: peer, client, router.")
    ] = None,
    zenoh_connect: Annotated[
        list[str] | None, typer.Option("-e", "--zenoh-connect", help="Zenoh endpoint.")
    ] = None,
    zenoh_listen: Annotated[
        list[str] | None, typer.Option("-l", "--listen", help="Zenoh endpoint to listen on.")
    ] = None,
    zenoh_config: Annotated[
        Path | None, typer.Option("-c", "--zenoh-config", help="Zenoh configuration file.")
    ] = None,
    zenoh_cfg: Annotated[list[str] | None, typer.Option("--cfg", help="Zenoh setting, KEY:VALUE.")] = None,
    keys: Annotated[
        Path | None,
        typer.Option(help="The vehicle's folder of `groundstation keys`: TLS, and who may do what."),
    ] = None,
    insecure: Annotated[
        bool,
        typer.Option("--insecure", help="Without keys: let anybody on the network read, fly and deploy."),
    ] = False,
) -> None:
    """Connect, wait for missions, fly them.

    Prints one line `ready: ...` when it can take missions. On SIGINT or SIGTERM it asks the autopilot to
    land, falls silent once that has taken over, closes the record and exits; a second signal ends it at once,
    and then the autopilot's offboard-loss failsafe is what lands the vehicle.
    """
    from trueflight.companion.flying import fly_instead, request

    given: dict[str, Any] = {
        "vehicle": vehicle,
        "design": design,
        "connect": connect,
        "system": system,
        "battery": battery,
        "rate": rate,
        "timeout": timeout,
        "records": records,
        "models": models,
        "keys": keys,
    }
    zenoh: dict[str, Any] = {
        "mode": zenoh_mode,
        "connect": tuple(zenoh_connect) if zenoh_connect else None,
        "listen": tuple(zenoh_listen) if zenoh_listen else None,
        "config": str(zenoh_config) if zenoh_config else None,
        "cfg": tuple(zenoh_cfg) if zenoh_cfg else None,
        "insecure": insecure or None,
    }
    flags: dict[str, Any] = {
        name: value if isinstance(value, (int, float)) else str(value) for name, value in _set(given).items()
    }
    fly_instead(request(str(config) if config is not None else "", flags, _set(zenoh)))


def _set(flags: dict[str, Any]) -> dict[str, Any]:
    """Those that were given."""
    return {name: value for name, value in flags.items() if value is not None}


@app.command(epilog="Example: companion check --connect udpin://127.0.0.1:14540 --json")
def check(
    connect: Connect = None,
    system: System = None,
    battery: Battery = None,
    rate: Rate = None,
    timeout: Timeout = None,
    as_json: Json = False,
) -> None:
    """Connect and tell what arrives: rates, mode, battery, and the parameters that matter in trouble."""
    from trueflight.companion.batteries import Batteries
    from trueflight.companion.settings import Settings
    from trueflight.companion.vehicle_link import VehicleLink

    defaults = Settings()
    wait = timeout if timeout is not None else defaults.timeout
    link = VehicleLink(connect or defaults.connect, wait, system or 0, Batteries(battery or 0))
    try:
        wanted = rate if rate is not None else defaults.rate
        link.commands.request_rates(wanted)
        link.measure(0.5)  # the new rates take a moment
        rates = link.measure(2.0)
        if link.ambiguous:
            raise InputError(link.ambiguous)
        link.read_capacities()
        names = ("COM_OF_LOSS_T", "COM_OBL_RC_ACT", "COM_RC_IN_MODE", "EKF2_PREDICT_US")
        report: dict[str, Any] = {
            "address": link.address,
            "wanted_rate": wanted,
            "rates": asdict(rates),
            "flight_mode": link.latest.flight_mode,
            "armed": link.latest.armed,
            "landed": link.latest.landed,
            "battery_voltage": link.latest.battery_voltage,
            "batteries": link.latest.batteries.describe(),
            "rotor_speeds": len(link.latest.rotor_speed),
            "accelerometer": link.latest.specific_force is not None,
            "parameters": {name: link.parameters.read(name) for name in names},
            "malformed_messages": link.malformed,
            "others": link.others.describe(),
        }
    finally:
        link.close()
    if as_json:
        print_json_line(report)
        return
    _print_checked(report)


def _print_checked(report: dict[str, Any]) -> None:
    from rich.markup import escape

    from trueflight.models.terminal import Table, Terminal

    table = Table("", "", show_header=False)
    for key, value in report.items():
        if isinstance(value, dict):
            value = ", ".join(
                f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in value.items()
            )
        table.add_row(key.replace("_", " "), escape(str(value)))
    Terminal().print(table)


@app.command(epilog="Example: companion trajectories --json")
def trajectories(as_json: Json = False) -> None:
    """List the trajectories that can be flown by name, with their parameters."""
    from rich.markup import escape

    from trueflight.models.reference import KINDS
    from trueflight.models.terminal import Table, Terminal

    if as_json:
        listing = {
            name: {
                "text": kind.text,
                "parameters": {p.name: {"default": p.default, "unit": p.unit} for p in kind.parameters},
            }
            for name, kind in KINDS.items()
        }
        print_json_line(listing)
        return
    table = Table("trajectory", "what it does", "parameters")
    for name, kind in KINDS.items():
        parameters = [
            f"{p.name} {p.default:g} {p.unit}".strip()
            if isinstance(p.default, float)
            else f"{p.name} {p.default}"
            for p in kind.parameters
        ]
        table.add_row(name, kind.text, escape(", ".join(parameters)))
    Terminal().print(table)


onboard_commands.register(app)
offer_version(app, "companion")


def main() -> None:
    """Entry point: bad input becomes one line and exit code 2."""
    run_command_line(lambda: app(standalone_mode=False), "companion")


if __name__ == "__main__":
    main()
