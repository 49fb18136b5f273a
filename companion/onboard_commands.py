"""`companion preflight`, `doctor` and `install-service`: before the first flight, and before every flight."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn

from trueflight.models.errors import InputError
from trueflight.models.printed import print_json_line
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.companion.pose import PoseFeed
    from trueflight.companion.preflight import Preflight
    from trueflight.companion.settings import Settings
    from trueflight.companion.vehicle_link import VehicleLink
    from trueflight.models.vehicle import Vehicle

console = Terminal()
_FAILED = 2

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
ConfigOption = Annotated[Path | None, typer.Option(help="Configuration (companion.toml); flags override it.")]
VehicleOption = Annotated[Path | None, typer.Option(help="Vehicle file (vehicle.toml).")]
ConnectOption = Annotated[
    str | None,
    typer.Option(help="MAVSDK address of the autopilot, such as udpin://127.0.0.1:14540 or serial://..."),
]
RateOption = Annotated[float | None, typer.Option(help="Control rate, Hz: the odometry's.")]
SystemOption = Annotated[
    int | None, typer.Option(help="MAVLink system id of the autopilot (MAV_SYS_ID), where several are heard.")
]
BatteryOption = Annotated[
    int | None,
    typer.Option(help="PX4's number of the flight's battery (BAT1_*: 1), where there are several."),
]
TimeoutOption = Annotated[float | None, typer.Option(help="Seconds to wait for an autopilot.")]


def register(app: typer.Typer) -> None:
    """Add these commands to the companion's application."""
    app.command(
        "preflight",
        epilog="Example: companion preflight --vehicle vehicle.toml --connect serial:///dev/ttyAMA0:921600",
    )(preflight_command)
    app.command("doctor", epilog="Example: companion doctor --config /etc/trueflight/companion.toml --json")(
        doctor_command
    )
    app.command(
        "install-service",
        epilog="Example: sudo companion install-service --vehicle vehicle.toml "
        "--connect serial:///dev/ttyAMA0:921600",
    )(install_command)


def preflight_command(
    config: ConfigOption = None,
    vehicle: VehicleOption = None,
    connect: ConnectOption = None,
    system: SystemOption = None,
    battery: BatteryOption = None,
    rate: RateOption = None,
    timeout: TimeoutOption = None,
    records: Annotated[
        Path | None, typer.Option(help="Folder of the flight records: hover thrust is learned from them.")
    ] = None,
    set_parameters: Annotated[
        bool, typer.Option("--set-params", help="Set the parameters that are not as they should be.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Ask the autopilot what stands against a flight: arming checks, parameters, rates, hover thrust.

    Nothing is changed without `--set-params`. While it runs it shows itself as a ground station, so that older
    PX4 tells its reasons; run it on the ground, disarmed. Exit code 2 where a flight would be refused or end badly.
    """
    from trueflight.companion import preflight
    from trueflight.companion.batteries import Batteries
    from trueflight.companion.vehicle_link import VehicleLink
    from trueflight.models.vehicle import load_vehicle

    settings = _settings(
        config, vehicle, connect, records, system=system, battery=battery, rate=rate, timeout=timeout
    )
    settings.check_address()
    believed = load_vehicle(settings.vehicle) if settings.vehicle else None
    link = VehicleLink(settings.connect, settings.timeout, settings.system, Batteries(settings.battery))
    changed: list[str] = []
    try:
        with _progress(as_json) as tell, _poses(settings, believed, link) as pose:
            report = preflight.look(link, settings, believed, tell, pose)
            if set_parameters:
                tell("setting parameters")
                changed = preflight.set_parameters(link.parameters, [*report.parameters, *report.hover])
                if changed:
                    report = preflight.look(link, settings, believed, tell, pose)
    finally:
        link.close()
    if as_json:
        print_json_line({**preflight.as_json(report), "changed": changed})
    else:
        _print_preflight(report, settings.connect, changed, set_parameters)
    raise typer.Exit(0 if report.ready else _FAILED)


def _print_preflight(report: Preflight, address: str, changed: Sequence[str], asked: bool) -> None:
    from trueflight.companion.findings import table_of

    console.print(f"{report.autopilot} on {escape(address)}")
    console.print(table_of("Arming", report.arming, "what to do"))
    console.print(table_of("Parameters", report.parameters))
    console.print(table_of("Message rates", report.rates))
    console.print(table_of("Hover thrust", report.hover))
    console.print(table_of("Who may fly it", report.access))
    for line in changed:
        console.print(escape(line), highlight=False)
    open_changes = [p.name for p in (*report.parameters, *report.hover) if p.change is not None]
    if open_changes and not asked:
        console.print(f"--set-params would set: {', '.join(open_changes)}")
    console.print("[green]ready for a flight[/]" if report.ready else "[bold red]not ready for a flight[/]")


def doctor_command(
    config: ConfigOption = None,
    vehicle: VehicleOption = None,
    connect: ConnectOption = None,
    system: SystemOption = None,
    rate: RateOption = None,
    timeout: TimeoutOption = None,
    root: Annotated[Path, typer.Option(help="Where the system's files are.", hidden=True)] = Path("/"),
    as_json: JsonOption = False,
) -> None:
    """Examine this machine: serial port, rates, clock, disk, processor, Zenoh endpoints, model.

    Says what to do about what it finds and changes nothing. Exit code 2 where something would keep a vehicle
    from flying.
    """
    from trueflight.companion import doctor
    from trueflight.companion.findings import FAIL, rows_of, table_of

    settings = _settings(config, vehicle, connect, None, system=system, rate=rate, timeout=timeout)
    with _progress(as_json) as tell:
        findings = doctor.examine(settings, root, tell)
    failed = [finding for finding in findings if finding.state == FAIL]
    if as_json:
        print_json_line({"ready": not failed, "findings": rows_of(findings)})
    else:
        console.print(table_of("This machine", findings, "what to do"))
        told = (
            f"[bold red]{len(failed)} to mend before a flight[/]"
            if failed
            else "[green]nothing against a flight[/]"
        )
        console.print(told)
    raise typer.Exit(_FAILED if failed else 0)


def install_command(
    vehicle: Annotated[Path, typer.Option(help="Vehicle file (vehicle.toml).")],
    design: Annotated[
        Path | None, typer.Option(help="Design file; otherwise design.json beside the vehicle.")
    ] = None,
    connect: Annotated[
        str, typer.Option(help="MAVSDK address of the autopilot.")
    ] = "serial:///dev/ttyAMA0:921600",
    listen: Annotated[
        str | None,
        typer.Option(help="Zenoh endpoint for the ground; default: with keys everywhere, without here."),
    ] = None,
    keys: Annotated[Path | None, typer.Option(help="The vehicle's folder of `groundstation keys`.")] = None,
    insecure: Annotated[
        bool,
        typer.Option("--insecure", help="Without keys: let anybody on the network read, fly and deploy."),
    ] = False,
    user: Annotated[str, typer.Option(help="User that the companion runs as.")] = "trueflight",
    realtime: Annotated[int, typer.Option(help="Priority of the control thread, 0 for none.")] = 20,
    output: Annotated[Path, typer.Option("--output", "-o", help="Root that the files are put below.")] = Path(
        "/"
    ),
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the files and write nothing.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write a systemd unit, its user and a commented configuration; print what to do next.

    The unit restarts the companion, watches its control tick, runs it as a user of its own and lets the control
    thread ask for a real-time priority. A file that you have changed is kept, and the new one put beside it.
    """
    from trueflight.companion.service import Service, install, next_steps, texts

    beside = design if design is not None else vehicle.with_name("design.json")
    service = Service(vehicle, beside, connect, user, listen or "", realtime, keys=keys, insecure=insecure)
    done = install(service, output, dry_run)
    if as_json:
        files = {str(path): state for path, state in done}
        print_json_line({"files": files, "next": list(next_steps(service)), "dry_run": dry_run})
        return
    if dry_run:
        for name, text in texts(service).items():
            console.print(f"[bold]# {escape(str(output / name))}[/]")
            console.print(escape(text), highlight=False, soft_wrap=True)
    for path, state in done:
        console.print(f"{escape(str(path))}: {'would be ' * dry_run}{state}", highlight=False, soft_wrap=True)
    if output == Path("/"):
        console.print("next:")
        for step in next_steps(service):
            console.print(f"  {step}", highlight=False, soft_wrap=True)


def _settings(
    config: Path | None,
    vehicle: Path | None,
    connect: str | None,
    records: Path | None,
    **numbers: float | None,
) -> Settings:
    from trueflight.companion.settings import load_settings

    settings = load_settings(config)
    given: dict[str, Any] = {"vehicle": vehicle, "connect": connect, "records": records}
    flags: dict[str, Any] = {name: str(value) for name, value in given.items() if value is not None}
    flags |= {name: value for name, value in numbers.items() if value is not None}
    settings = replace(settings, **flags)
    settings.check_numbers()
    settings.pose.checked()
    settings.check_signing()
    return settings


@contextmanager
def _poses(settings: Settings, vehicle: Vehicle | None, link: VehicleLink) -> Iterator[PoseFeed | None]:
    """Mocap poses passed on meanwhile, where the configuration wants them: the estimator has no position without."""
    if not settings.pose.enabled:
        yield None
        return
    if vehicle is None:
        raise InputError("[pose] is enabled: pass --vehicle, whose name is in the key of the poses")
    from trueflight.companion.pose import PoseFeed
    from trueflight.companion.zenoh_session import open_session
    from trueflight.models.contract import key

    session = open_session(settings.zenoh, settings.own_keys(), vehicle.name)
    feed = PoseFeed(settings.pose, link.send_pose, lambda level, kind, text: None)
    try:
        link.share_clock()
        subscriber = session.declare_subscriber(
            key(vehicle.name, "pose"), lambda sample: feed.take(sample.payload.to_bytes())
        )
        yield feed
        subscriber.undeclare()
    finally:
        feed.close()
        session.close()


@contextmanager
def _progress(quiet: bool) -> Iterator[Any]:
    """A line that tells what is being looked at, on a terminal that people see."""
    errors = Terminal(stderr=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=errors, transient=True, disable=quiet or not errors.is_terminal) as bar:
        task = bar.add_task("looking", total=None)
        yield lambda what: bar.update(task, description=f"looking at {what}")
