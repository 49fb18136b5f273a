"""`groundstation status`, `ros2-bridge`, `foxglove`: what a companion is doing, for a person, ROS 2 and viewers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from trueflight.groundstation.commands.linked import linked
from trueflight.groundstation.commands.options import (
    JsonOption,
)
from trueflight.groundstation.output.terminal import print_warning
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.groundstation.operate.settings import Settings

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add these commands to the ground station's application."""
    app.command("status", epilog="Example: groundstation status -e tcp/192.168.1.7:7447 --json")(
        linked(status_command)
    )
    app.command(
        "ros2-bridge",
        epilog="Example: groundstation ros2-bridge -e tcp/192.168.1.7:7447; then, with "
        "RMW_IMPLEMENTATION=rmw_zenoh_cpp: ros2 topic list, rviz2, PlotJuggler, foxglove_bridge",
    )(linked(ros2_command))
    app.command(
        "foxglove",
        epilog="Example: groundstation foxglove -e tcp/192.168.1.7:7447 --layout quad5.json; then, in Foxglove, "
        "Lichtblick or PlotJuggler, open ws://127.0.0.1:8765",
    )(linked(foxglove_command))


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
    *,
    settings: Settings,
    as_json: JsonOption = False,
) -> None:
    """What the companion is doing, and whether it could fly now."""
    from trueflight.groundstation.operate.link import Link

    with Link(settings) as link:
        status = link.status()
        records = link.records()
        print_warning(link.warning)
    if as_json:
        print_json({**status, "records": records})
        return
    _print_status(status, len(records))


def _print_status(status: dict[str, Any], records: int) -> None:
    from trueflight.models.terminal import Table

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
        ("battery", f"{status['battery_voltage']:.2f} V{escape(_several(status.get('batteries') or []))}"),
        ("position", escape(_position(status.get("position") or {}))),
        ("received", rates or "not measured"),
        ("mocap", escape(_mocap(status.get("pose") or {}))),
        ("live model", escape(titles.get(status["live"], status["live"]))),
        ("in the shadow", escape(waiting)),
        ("last good", escape(titles.get(status["last_good"], status["last_good"]))),
        ("guard", escape(status["guard"])),
        ("heard as well", escape("; ".join(status.get("others") or ()))),
        ("records", f"{records} on board"),
    ):
        table.add_row(what, value or "none")
    console.print(table)
    for mission in status["missions"]:
        reason = f" ({mission['reason']})" if mission["reason"] not in ("", mission["state"]) else ""
        what = f"{mission['mission']} {mission['trajectory']} {mission['controller']}"
        console.print(escape(f"{what}: {mission['state']}{reason}"), highlight=False)


def _several(batteries: list[dict[str, Any]]) -> str:
    """All of them, where there are several."""
    if len(batteries) < 2:
        return ""
    told = (
        f"{one['battery']}: {one['voltage']:.2f} V" + (f" ({one['left_out']})" if one["left_out"] else "")
        for one in batteries
    )
    return f"; of {', '.join(told)}"


def ros2_command(
    router: Annotated[
        str, typer.Option("--router", help="Where rmw_zenoh's router (rmw_zenohd) listens.")
    ] = "tcp/localhost:7447",
    domain: Annotated[int, typer.Option("--domain", help="ROS_DOMAIN_ID.", min=0, max=232)] = 0,
    distribution: Annotated[
        str, typer.Option("--ros", help="Release of ROS 2: humble, jazzy, kilted.")
    ] = "jazzy",
    seconds: Annotated[
        float | None, typer.Option("--seconds", help="Stop after this long; default: until Ctrl-C.", min=0.1)
    ] = None,
    *,
    settings: Settings,
) -> None:
    """Publish a vehicle to ROS 2 (rmw_zenoh): odometry, reference, command, IMU, battery, diagnostics. Needs no ROS."""
    from trueflight.groundstation.operate.link import Link
    from trueflight.groundstation.operate.ros2 import Messages, RosNode, topics_of
    from trueflight.groundstation.operate.ros2_bridge import Bridge, open_ros

    _check_release(distribution)
    with open_ros(router) as session, Link(settings) as link:
        print_warning(link.warning)
        messages = Messages(link.vehicle, distribution)
        node = RosNode(session, link.vehicle, messages, domain)
        names = ", ".join(topic.name for topic in topics_of(link.vehicle).values())
        console.print(f"publishing {names} on domain {domain}; Ctrl-C ends", highlight=False)
        seen = Bridge(node, messages).run(link, seconds)
        console.print(f"{seen} ticks seen, {node.sent} messages published", highlight=False)
        node.close()


def foxglove_command(
    port: Annotated[
        int, typer.Option("--port", help="Where to serve; 0: any that is free.", min=0, max=65535)
    ] = 8765,
    host: Annotated[
        str,
        typer.Option(
            "--host", help="Address to serve at; others than this machine's own show it to the network."
        ),
    ] = "127.0.0.1",
    layout: Annotated[
        Path | None,
        typer.Option(
            "--layout", help="Also write a layout for Foxglove and Lichtblick into this file (.json)."
        ),
    ] = None,
    distribution: Annotated[
        str, typer.Option("--ros", help="Release of ROS 2 whose messages are sent: humble, jazzy, kilted.")
    ] = "jazzy",
    seconds: Annotated[
        float | None, typer.Option("--seconds", help="Stop after this long; default: until Ctrl-C.", min=0.1)
    ] = None,
    *,
    settings: Settings,
) -> None:
    """Serve what ros2-bridge publishes to Foxglove, Lichtblick and PlotJuggler themselves, without any ROS."""
    import json

    from trueflight.groundstation.operate import foxglove
    from trueflight.groundstation.operate.link import Link
    from trueflight.groundstation.operate.ros2 import Messages, topics_of
    from trueflight.groundstation.operate.ros2_bridge import Bridge
    from trueflight.models.whole_file import write_whole

    _check_release(distribution)
    with Link(settings) as link:
        print_warning(link.warning)
        messages = Messages(link.vehicle, distribution)
        with foxglove.FoxgloveServer(link.vehicle, messages, host, port) as server:
            if layout is not None:
                text = json.dumps(foxglove.layout(link.vehicle), indent=1)
                write_whole(layout, text, "the layout", "choose another --layout")
            names = ", ".join(topic.name for topic in topics_of(link.vehicle).values())
            console.print(f"ws://{host}:{server.port} serves {names}; Ctrl-C ends", highlight=False)
            seen = Bridge(server, messages).run(link, seconds)
            console.print(f"{seen} ticks seen, {server.sent} messages served", highlight=False)


def _check_release(distribution: str) -> None:
    from trueflight.groundstation.operate.ros2 import DISTRIBUTIONS

    if distribution not in DISTRIBUTIONS:
        raise InputError(f"--ros {distribution}: it must be one of {', '.join(DISTRIBUTIONS)}")
