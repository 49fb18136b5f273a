"""`groundstation deploy`: a model sent to the companion, or taken back."""

from __future__ import annotations

import queue
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from trueflight.groundstation.commands.linked import linked
from trueflight.groundstation.commands.options import (
    JsonOption,
)
from trueflight.groundstation.output.terminal import print_event, print_warning
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json_line
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.groundstation.operate.link import Link
    from trueflight.groundstation.operate.settings import Settings
    from trueflight.models.record_pb2 import Event

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add this command to the ground station's application."""
    app.command(
        "deploy",
        epilog="Example: groundstation deploy quad5-v3.onnx --shadow 5 --wait, and to take it back: "
        "groundstation deploy --roll-back",
    )(linked(deploy_command))


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
    *,
    settings: Settings,
    as_json: JsonOption = False,
) -> None:
    """Send a model to the companion, which checks it and lets it prove itself, or says why not.

    It is evaluated beside the flight first, in the shadow, and takes over only where it predicts no worse than the
    plain linear model: at once in flight; deployed on the ground, in the first seconds of the next corrected flight,
    before the mission begins. A model that has proved itself before is live at once. With --roll-back a model in the
    shadow, or one that waits for it, is withdrawn; without one, the previous model becomes live again.
    """
    from trueflight.groundstation.operate.deployment import read_onnx
    from trueflight.groundstation.operate.link import Link

    if roll_back and (model is not None or shadow is not None):
        raise InputError("--roll-back goes back to the previous model; leave the file and --shadow out")
    onnx = b"" if roll_back else read_onnx(model)
    with Link(settings) as link:
        print_warning(link.warning)
        vehicle = link.vehicle
        result = link.roll_back() if roll_back else _deploy(link, onnx, shadow, wait, as_json)
    if as_json:
        print_json_line({"vehicle": vehicle, **result})
    elif roll_back or model is None:
        console.print(escape(f"'{vehicle}': {result['reason']}"), highlight=False)
    else:
        _print_deployed(model.name, vehicle, result)


def _deploy(link: Link, onnx: bytes, shadow: float | None, wait: bool, quiet: bool) -> dict[str, Any]:
    """Send a model, and follow it to its end where that is wanted: the companion's answer and its hash."""
    from trueflight.models.contract import model_hash

    events: queue.SimpleQueue[Event] = queue.SimpleQueue()
    if wait:
        link.follow(on_event=events.put)
    result = {"hash": model_hash(onnx), **link.deploy(onnx, shadow)}
    if wait and result.get("state") == "shadow":
        result |= _follow(link, result["hash"], events, quiet)
    return result


def _follow(link: Link, model: str, events: queue.SimpleQueue[Event], quiet: bool) -> dict[str, Any]:
    """A bar while the model is in the shadow; the `state` it came to. Raises `InputError` where it is refused."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from trueflight.groundstation.operate.deployment import follow_candidate

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(
        *columns, console=console, transient=True, disable=quiet or not console.is_terminal
    ) as progress:
        task = progress.add_task(f"{model} in the shadow", total=None)

        def tell(event: Event) -> None:
            if not quiet:
                print_event(progress.console, event)

        def waiting(left: float) -> None:
            seconds = max(left, progress.tasks[task].total or 0.0)
            progress.update(task, total=seconds, completed=seconds - left)

        return follow_candidate(link, model, events, tell, waiting)


def _print_deployed(name: str, vehicle: str, result: dict[str, Any]) -> None:
    states = {
        "live": "is live as",
        "shadow": "is in the shadow as",
        "staged": "is staged, and flies its first seconds of the next corrected flight in the shadow, as",
    }
    what = states.get(str(result.get("state", "live")), "is there as")
    console.print(escape(f"accepted by '{vehicle}': {name} {what} {result['hash']}"), highlight=False)
    if result.get("reason"):
        console.print(escape(str(result["reason"])))
