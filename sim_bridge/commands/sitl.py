"""`sim-bridge sitl`: the simulator of a real PX4."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any

import typer

from trueflight.models.errors import InputError
from trueflight.models.printed import print_json_line
from trueflight.models.vehicle import Vehicle, load_vehicle
from trueflight.sim_bridge.commands.options import (
    DrawAndBattery,
    Json,
    Owner,
    Wanted,
    WithPx4,
    settings_of,
    with_groups,
)
from trueflight.sim_bridge.commands.output import tell, until_interrupted


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog="Example: sim-bridge sitl --vehicle vehicle.toml --hidden rotor_drag --set-params")(
        with_groups(sitl)
    )


def sitl(
    owner: Owner,
    wanted: Wanted,
    draw: DrawAndBattery,
    px4: WithPx4,
    speed: Annotated[
        float | None, typer.Option(help="Simulated over wall time; 0: as fast as it goes.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(help="End after so many s of simulated time; 0: never.")
    ] = None,
    truth: Annotated[Path | None, typer.Option(help="CSV to write the true motion to, 125 Hz.")] = None,
    as_json: Json = False,
) -> None:
    """Be the simulator of a real PX4 (SITL): the same vehicle, world and hidden effects as `run`, flown by PX4 itself.

    PX4 connects to a TCP port and both advance in lockstep: its clock is simulated time. Start PX4 in a working
    folder of its own with PX4_SIM_MODEL=none_iris. Before it arms, its control allocation is compared with the vehicle
    file; a difference ends with exit code 2. docs/px4.md tells the whole way.
    """
    settings = settings_of(owner, wanted, draw, free_speed=speed, duration=duration)
    believed = load_vehicle(settings.vehicle)
    from trueflight.sim_bridge.sitl.messages import Position
    from trueflight.sim_bridge.sitl.session import Request, fly, parameter_lines
    from trueflight.sim_bridge.truth.hidden import choose
    from trueflight.sim_bridge.world import check_vehicle

    check_vehicle(believed)
    kinds = [kind.value for kind in Position]
    if px4.position not in kinds:
        raise InputError(f"--position {px4.position}: choose one of {', '.join(kinds)}")
    position = Position(px4.position)
    if px4.show_params:
        lines = parameter_lines(believed, position)
        tell({"commands": lines}, "\n".join(lines), as_json)
        return
    hidden = choose(list(settings.hidden), believed, settings.seed, settings.hidden_count)
    request = Request(px4.host, px4.port, px4.link_port, position, px4.vision_rate, px4.set_params, truth)
    with _Teller(as_json) as teller:
        fly(believed, hidden, settings, request, until_interrupted(), teller)


class _Teller:
    """Tells a user what happens: lines on standard output (JSON objects where asked), a live line on a terminal."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._status: Any = None
        self._told = 0.0
        if not as_json and sys.stderr.isatty():
            from trueflight.models.terminal import Terminal

            self._status = Terminal(stderr=True).status("")

    def __enter__(self) -> _Teller:
        if self._status is not None:
            self._status.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._status is not None:
            self._status.stop()

    def tell(self, event: str, text: str, **more: Any) -> None:
        """One thing that happened."""
        if self._as_json:
            print_json_line({"event": event, "text": text, **more})
        else:
            typer.echo(text)
        sys.stdout.flush()

    def note(self, text: str) -> None:
        """A remark."""
        self.tell("note", text)

    def differences(self, vehicle: Vehicle, values: dict[str, int | float]) -> None:
        """What PX4's control allocation must be for a vehicle, beside what PX4 has: a table, for people."""
        if self._as_json:
            return
        from trueflight.models.terminal import Table, Terminal
        from trueflight.sim_bridge.sitl.allocation import expected_parameters

        table = Table()
        for column in ("parameter", "vehicle file", "PX4", "what"):
            left = column in ("parameter", "what")
            table.add_column(column, justify="left" if left else "right", no_wrap=True)
        for one in expected_parameters(vehicle):
            has = f"{values[one.name]:.4g}" if one.name in values else "not told"
            table.add_row(one.name, f"{one.value:.4g}", has, one.what)
        Terminal().print(table)

    def live(self, text: str) -> None:
        """What is going on, on a terminal's last line, twice a second."""
        now = time.monotonic()
        if self._status is not None and now - self._told > 0.5:
            self._told = now
            self._status.update(text)
