"""Command lines that talk to a companion over Zenoh: fly, deploy, status, monitor."""

from __future__ import annotations

import json
import queue
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from trueflight.groundstation.commands.options import (
    CfgOption,
    ConfigOption,
    ConnectOption,
    ControllerOption,
    JsonOption,
    KeysOption,
    ListenOption,
    ModeOption,
    NameOption,
    TimeoutOption,
    ZenohOption,
)
from trueflight.models.contract import CONTROLLERS, too_large
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json, print_json_line

if TYPE_CHECKING:
    from trueflight.groundstation.operate.link import Link
    from trueflight.groundstation.operate.settings import Settings
    from trueflight.models.record_pb2 import Event

console = Console()

STYLES = {"warning": "yellow", "error": "red"}


def register(app: typer.Typer) -> None:
    """Add these commands to the ground station's application."""
    app.command(
        "fly", epilog="Example: groundstation fly lemniscate --set speed=2 --controller corrected --wait"
    )(fly_command)
    app.command(
        "deploy",
        epilog="Example: groundstation deploy quad5-v3.onnx --shadow 5 --wait, and to take it back: "
        "groundstation deploy --roll-back",
    )(deploy_command)
    app.command("status", epilog="Example: groundstation status -e tcp/192.168.1.7:7447 --json")(
        status_command
    )
    app.command("monitor", epilog="Example: groundstation monitor --save flight.rrd")(monitor_command)


def link_settings(
    config: Path | None,
    name: str | None,
    connect: list[str] | None,
    mode: str | None,
    listen: list[str] | None,
    zenoh_config: Path | None,
    cfg: list[str] | None,
    timeout: float | None,
    keys: Path | None = None,
) -> Settings:
    """The settings of a link: those of the file, overridden by the options given."""
    from trueflight.groundstation.operate.settings import load_settings

    given: dict[str, Any] = {
        "name": name,
        "connect": tuple(connect) if connect else None,
        "mode": mode,
        "listen": tuple(listen) if listen else None,
        "zenoh_config": str(zenoh_config) if zenoh_config else None,
        "cfg": tuple(cfg) if cfg else None,
        "timeout": timeout,
        "keys": str(keys) if keys is not None else None,
    }
    return replace(load_settings(config), **{key: value for key, value in given.items() if value is not None})


def warn(link: Link) -> None:
    """Tell in red, beside what is printed, where anybody on the network could do the same."""
    if link.warning:
        Console(stderr=True).print(
            f"[bold red]{escape(link.warning)}[/] (groundstation keys)", highlight=False
        )


def check_controller(controller: str) -> None:
    """Raise `InputError` for a controller that no companion knows."""
    if controller not in CONTROLLERS:
        raise InputError(f"--controller is '{controller}'; choose one of {', '.join(CONTROLLERS)}")


def fly_command(
    trajectory: Annotated[
        str, typer.Argument(help="Name of a trajectory (`groundstation fly list`), or a CSV of setpoints.")
    ],
    controller: ControllerOption = "lqr",
    parameters: Annotated[
        list[str] | None, typer.Option("--set", help="Parameter of the trajectory, NAME=VALUE.")
    ] = None,
    repeat: Annotated[int, typer.Option(help="How often.", min=1, max=100)] = 1,
    wait: Annotated[
        bool, typer.Option("--wait", help="Follow the flight to its end and fetch its record.")
    ] = False,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder for the record.")] = None,
    config: ConfigOption = None,
    name: NameOption = None,
    connect: ConnectOption = None,
    mode: ModeOption = None,
    listen: ListenOption = None,
    zenoh_config: ZenohOption = None,
    cfg: CfgOption = None,
    timeout: TimeoutOption = None,
    keys: KeysOption = None,
    as_json: JsonOption = False,
) -> None:
    """Ask the companion to fly a trajectory; with --wait, follow it and fetch the flight record."""
    if trajectory == "list":
        _list_trajectories(as_json)
        return
    check_controller(controller)
    mission = {**_mission(trajectory, parameters or [], repeat), "controller": controller, "repeat": repeat}
    reason = too_large("mission", len(json.dumps(mission)))
    if reason:
        raise InputError(f"{trajectory}: {reason}; split the file")
    settings = link_settings(config, name, connect, mode, listen, zenoh_config, cfg, timeout, keys)
    from trueflight.groundstation.operate.link import Link

    with Link(settings) as link:
        warn(link)
        events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        if wait:
            link.follow(on_event=events.put)
        answer = link.request("mission", mission)
        if not wait:
            if as_json:
                print_json_line(answer)
            else:
                console.print(
                    f"accepted as {answer['mission']}, {answer['duration']:.0f} s ({answer['reason']})"
                )
            return
        ended = _accompany(link, answer, events, as_json)
        record = ""
        if ended["record"]:
            record = str(_fetch(link, ended["record"], output or Path(settings.flights), as_json))
        result = {
            "mission": answer["mission"],
            "state": ended["state"],
            "reason": ended["reason"],
            "record": record,
        }
    if as_json:
        print_json_line(result)
    elif ended["state"] == "finished":
        console.print(f"flown: {escape(record)}")
    if ended["state"] != "finished":
        kept = f" (record: {record})" if record else ""
        raise InputError(
            f"mission {answer['mission']} {ended['state']}: {ended['reason']}{kept}; see "
            "`groundstation status`"
        )


def _mission(trajectory: str, parameters: list[str], repeat: int) -> dict[str, Any]:
    """The mission's trajectory, checked here so that a typing error needs no vehicle."""
    from trueflight.models.reference import check_duration, trajectory_from_csv
    from trueflight.models.reference import trajectory as named

    if trajectory.lower().endswith(".csv"):
        try:
            reason = too_large("mission", Path(trajectory).stat().st_size)
            if reason:
                raise InputError(f"{trajectory}: {reason}; split the file")
            text = Path(trajectory).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{trajectory}: cannot read the setpoints ({error}); check the path") from None
        if parameters:
            raise InputError(f"{trajectory}: a table of setpoints has no parameters; leave --set out")
        path = trajectory_from_csv(text, trajectory)
        check_duration(path.duration * repeat, f"{trajectory}, {repeat} times,")
        return {"setpoints": text}
    values: dict[str, float | str] = {}
    for pair in parameters:
        key, equals, value = pair.partition("=")
        if not equals:
            raise InputError(f"--set '{pair}': write NAME=VALUE, such as speed=2")
        try:
            values[key.strip()] = float(value)
        except ValueError:
            values[key.strip()] = value.strip()
    path = named(trajectory, **values)
    check_duration(path.duration * repeat, f"trajectory '{trajectory}', {repeat} times,")
    return {"trajectory": trajectory, "parameters": values}


def _list_trajectories(as_json: bool) -> None:
    from trueflight.models.reference import KINDS

    if as_json:
        print_json(
            {
                k.name: {"text": k.text, "parameters": {p.name: p.default for p in k.parameters}}
                for k in KINDS.values()
            }
        )
        return
    from rich.table import Table

    table = Table()
    table.add_column("trajectory", no_wrap=True)
    table.add_column("what it is")
    table.add_column("parameters (--set NAME=VALUE)")
    for kind in KINDS.values():
        words = [
            f"{p.name}={p.default:g} {p.unit}".strip()
            if isinstance(p.default, float)
            else f"{p.name}={p.default}"
            for p in kind.parameters
        ]
        table.add_row(kind.name, escape(kind.text), escape(", ".join(words)))
    console.print(table)


def _accompany(
    link: Link, answer: dict[str, Any], events: queue.SimpleQueue[Event], quiet: bool
) -> dict[str, Any]:
    """Print events until the mission has ended; returns its entry of the companion's status."""
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(
        *columns, console=console, transient=True, disable=quiet or not console.is_terminal
    ) as progress:
        task = progress.add_task(f"{answer['mission']}: waiting", total=None)

        def tell(status: dict[str, Any], entry: dict[str, Any]) -> None:
            _print_events(events, progress.console, quiet)
            phase = status["phase"] if entry["state"] == "flying" else entry["state"]
            progress.update(
                task,
                description=f"{answer['mission']} {entry['trajectory']} {entry['controller']}: {phase}, "
                f"{status['battery_voltage']:.1f} V, guard {status['guard']}",
            )

        ended = link.end_of(answer["mission"], tell)
        time.sleep(0.2)  # the event that says why is on its way
        _print_events(events, progress.console, quiet)
        return ended


def _print_events(events: queue.SimpleQueue[Event], to: Console, quiet: bool) -> None:
    while not events.empty():
        event = events.get()
        if not quiet:
            to.print(f"{event.kind}: {escape(event.text)}", style=STYLES.get(event.level, ""))


def _fetch(link: Link, record: str, folder: Path, quiet: bool) -> Path:
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn

    with Progress(
        TextColumn("fetching the record"),
        BarColumn(),
        DownloadColumn(),
        console=console,
        transient=True,
        disable=quiet or not console.is_terminal,
    ) as progress:
        task = progress.add_task("", total=None)
        return link.fetch_record(
            record, folder, lambda done, size: progress.update(task, completed=done, total=size)
        )


def deploy_command(
    model: Annotated[
        Path | None, typer.Argument(help="ONNX file of `groundstation model export`.", show_default=False)
    ] = None,
    shadow: Annotated[
        float | None,
        typer.Option(help="Seconds of flight to evaluate it before it is applied.", min=0.5, max=600.0),
    ] = None,
    wait: Annotated[
        bool, typer.Option("--wait", help="In flight: follow it until it is live or refused.")
    ] = False,
    roll_back: Annotated[
        bool, typer.Option("--roll-back", help="Go back to the model before the live one, also in flight.")
    ] = False,
    config: ConfigOption = None,
    name: NameOption = None,
    connect: ConnectOption = None,
    mode: ModeOption = None,
    listen: ListenOption = None,
    zenoh_config: ZenohOption = None,
    cfg: CfgOption = None,
    timeout: TimeoutOption = None,
    keys: KeysOption = None,
    as_json: JsonOption = False,
) -> None:
    """Send a model to the companion, which checks it and lets it prove itself, or says why not.

    It is evaluated beside the flight first, in the shadow, and takes over only where it predicts no worse than the
    plain linear model: at once in flight; deployed on the ground, in the first seconds of the next corrected flight,
    before the mission begins. A model that has proved itself before is live at once. With --roll-back a model in the
    shadow, or one that waits for it, is withdrawn; without one, the previous model becomes live again.
    """
    from trueflight.groundstation.operate.link import Link

    if roll_back and (model is not None or shadow is not None):
        raise InputError("--roll-back goes back to the previous model; leave the file and --shadow out")
    onnx = b"" if roll_back else _read_onnx(model)
    settings = link_settings(config, name, connect, mode, listen, zenoh_config, cfg, timeout, keys)
    with Link(settings) as link:
        warn(link)
        vehicle = link.vehicle
        events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        if roll_back:
            result = {"vehicle": vehicle, **link.roll_back()}
        else:
            if wait:
                link.follow(on_event=events.put)
            result = {"hash": _hash(onnx), "vehicle": vehicle, **link.deploy(onnx, shadow)}
            if wait and result.get("state") == "shadow":
                result |= _follow_candidate(link, result["hash"], events, as_json)
    if as_json:
        print_json_line(result)
        return
    if roll_back:
        console.print(escape(f"'{vehicle}': {result['reason']}"), highlight=False)
        return
    assert model is not None
    states = {
        "live": "is live as",
        "shadow": "is in the shadow as",
        "staged": "is staged, and flies its first seconds of the next corrected flight in the shadow, as",
    }
    what = states.get(str(result.get("state", "live")), "is there as")
    console.print(escape(f"accepted by '{vehicle}': {model.name} {what} {result['hash']}"), highlight=False)
    if result.get("reason"):
        console.print(escape(str(result["reason"])))


def _hash(onnx: bytes) -> str:
    from trueflight.models.contract import model_hash

    return model_hash(onnx)


def _read_onnx(model: Path | None) -> bytes:
    if model is None:
        raise InputError("which model? Pass the file that `groundstation model export` wrote, or --roll-back")
    try:
        reason = too_large("model", model.stat().st_size)
        if reason:
            raise InputError(f"{model}: {reason}; pass the one that `groundstation model export` wrote")
        onnx = model.read_bytes()
    except OSError as error:
        raise InputError(
            f"{model}: cannot read the model ({error.strerror}); `groundstation model export` makes one"
        ) from None
    if not onnx or onnx[:1] == b"{":
        raise InputError(f"{model}: not an ONNX file; pass the one that `groundstation model export` wrote")
    return onnx


def _follow_candidate(
    link: Link, model: str, events: queue.SimpleQueue[Event], quiet: bool
) -> dict[str, Any]:
    """Follow a model from the shadow to its end: the `state` it came to. Raises `InputError` where refused."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    told: list[Event] = []
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(
        *columns, console=console, transient=True, disable=quiet or not console.is_terminal
    ) as progress:
        task = progress.add_task(f"{model} in the shadow", total=None)
        missed = 0
        while True:
            time.sleep(0.1)
            try:
                status = link.status()
                missed = 0
            except InputError:  # a link may drop for a while in flight; the flight goes on without it
                missed += 1
                if missed > 5:
                    raise
                continue
            while not events.empty():
                event = events.get()
                told.append(event)
                if not quiet:
                    progress.console.print(
                        f"{event.kind}: {escape(event.text)}", style=STYLES.get(event.level, "")
                    )
            about = status.get("shadow") or {}
            if about.get("hash") == model:
                left = float(about["remaining"])
                seconds = max(left, progress.tasks[task].total or 0.0)
                progress.update(task, total=seconds, completed=seconds - left)
                continue
            own = [event for event in told if model in event.text]
            outcome = next((e for e in own if e.kind in ("model_live", "model_refused")), None)
            if outcome is not None and outcome.kind == "model_refused":
                raise InputError(f"companion '{link.vehicle}' refused: {outcome.text}")
            if status["live"] == model:
                return {"state": "live", "reason": outcome.text if outcome is not None else ""}
            if status["phase"] == "idle":
                waits = (status.get("staged") or {}).get("hash") == model
                if not waits:
                    raise InputError(
                        f"companion '{link.vehicle}' does not have {model} any more; see its events"
                    )
                return {"state": "staged", "reason": own[-1].text if own else ""}


def _position(position: dict[str, Any]) -> str:
    """What the autopilot's estimator says of its position."""
    if not position:
        return "the autopilot has told nothing of it"
    told = "none" if not position["valid"] else "valid"
    return f"{told} (received: {position['received']})"


def _mocap(pose: dict[str, Any]) -> str:
    """Poses that the companion passes on; '' where it expects none."""
    if not pose:
        return ""
    refused = ", ".join(f"{count} {kind}" for kind, count in pose["refused"].items())
    told = f"{pose['rate']:.0f} Hz, refused: {refused or 'none'}"
    if pose["latency_ms"]:
        told += f", {pose['latency_ms']['median']:.1f} ms old when passed on"
    return told if pose["good"] else f"no good pose; {told}"


def status_command(
    config: ConfigOption = None,
    name: NameOption = None,
    connect: ConnectOption = None,
    mode: ModeOption = None,
    listen: ListenOption = None,
    zenoh_config: ZenohOption = None,
    cfg: CfgOption = None,
    timeout: TimeoutOption = None,
    keys: KeysOption = None,
    as_json: JsonOption = False,
) -> None:
    """What the companion is doing, and whether it could fly now."""
    from trueflight.groundstation.operate.link import Link

    with Link(link_settings(config, name, connect, mode, listen, zenoh_config, cfg, timeout, keys)) as link:
        status = link.status()
        records = link.records()
        warn(link)
    if as_json:
        print_json({**status, "records": records})
        return
    from rich.table import Table

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    ready = (
        "[green]ready to fly[/green]"
        if status["ready"]
        else f"[yellow]{escape(status['not_ready'])}[/yellow]"
    )
    rates = ", ".join(f"{key} {value:.0f} Hz" for key, value in status.get("rates", {}).items())
    titles = {
        entry["hash"]: f"{entry['hash']} ({entry['name']} {entry['version']})" for entry in status["models"]
    }
    for model, signer in status.get("access", {}).get("signers", {}).items():
        titles[model] = f"{titles.get(model, model)}, {f'signed by {signer}' if signer else 'not signed'}"
    shadow, staged = status["shadow"], status["staged"]
    waiting = ""
    if shadow:
        waiting = f"{shadow['title']}, {shadow['remaining']:.1f} s to go"
    elif staged:
        waiting = f"{staged['hash']} ({staged['name']} {staged['version']}), in the next corrected flight"
    for what, value in (
        ("vehicle", f"{escape(status['vehicle'])}: {ready}"),
        (
            "phase",
            f"{status['phase']}, {status['flight_mode'] or 'no mode'}, "
            f"{'armed' if status['armed'] else 'disarmed'}",
        ),
        ("battery", f"{status['battery_voltage']:.2f} V"),
        ("position", escape(_position(status.get("position") or {}))),
        ("received", rates or "not measured"),
        ("mocap", escape(_mocap(status.get("pose") or {}))),
        ("live model", escape(titles.get(status["live"], status["live"]))),
        ("in the shadow", escape(waiting)),
        ("last good", escape(titles.get(status["last_good"], status["last_good"]))),
        ("guard", escape(status["guard"])),
        ("records", f"{len(records)} on board"),
    ):
        table.add_row(what, value or "none")
    console.print(table)
    for mission in status["missions"]:
        reason = f" ({mission['reason']})" if mission["reason"] not in ("", mission["state"]) else ""
        what = f"{mission['mission']} {mission['trajectory']} {mission['controller']}"
        console.print(escape(f"{what}: {mission['state']}{reason}"), highlight=False)


def monitor_command(
    save: Annotated[
        Path | None, typer.Option("--save", help="Write a Rerun recording instead of opening the viewer.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", help="Stop after this long; default: until Ctrl-C.", min=0.1)
    ] = None,
    config: ConfigOption = None,
    name: NameOption = None,
    connect: ConnectOption = None,
    mode: ModeOption = None,
    listen: ListenOption = None,
    zenoh_config: ZenohOption = None,
    cfg: CfgOption = None,
    timeout: TimeoutOption = None,
    keys: KeysOption = None,
) -> None:
    """Watch a vehicle live in Rerun: path, reference, commands, correction, guard, latency."""
    from trueflight.groundstation.operate.link import Link
    from trueflight.groundstation.views import monitor

    with Link(link_settings(config, name, connect, mode, listen, zenoh_config, cfg, timeout, keys)) as link:
        warn(link)
        console.print(f"watching '{link.vehicle}'; Ctrl-C ends", highlight=False)
        seen = monitor(link, save, seconds)
    console.print(f"{seen} ticks seen" + (f", written to {escape(str(save))}" if save is not None else ""))
