"""Command line of the simulation bridge. Heavy imports wait until a command needs them."""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trueflight.models.errors import InputError, run_command_line
from trueflight.models.vehicle import Vehicle, load_vehicle
from trueflight.sim_bridge.settings import Settings, load_settings

if TYPE_CHECKING:
    from trueflight.sim_bridge.autopilot import Autopilot
    from trueflight.sim_bridge.truth.hidden import Hidden

app = typer.Typer(
    name="sim-bridge",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="A simulated vehicle that behaves as a PX4 would, with physical effects to hide in it.",
)

VehicleFile = Annotated[
    Path | None, typer.Option(help="Vehicle file (vehicle.toml): what its owner believes.")
]
Config = Annotated[Path | None, typer.Option(help="Configuration (sim-bridge.toml); flags override it.")]
HiddenNames = Annotated[
    list[str] | None,
    typer.Option(help="Effect to hide: NAME, NAME:SIZE, rich, random, any, none. Repeatable."),
]
HiddenCount = Annotated[int | None, typer.Option(help="How many effects `random` or `any` draws.")]
Seed = Annotated[int | None, typer.Option(help="Of the draw and of the noise.")]
Sealed = Annotated[
    Path | None, typer.Option(help="Where the answer to `random`, `any` or `rich` goes, for `reveal`.")
]
NoiseScale = Annotated[
    float | None, typer.Option(help="Scale of sensor noise and estimator errors; 0: none.")
]
Charge = Annotated[float | None, typer.Option(help="The battery's state of charge at the start, 0 to 1.")]
BatteryAge = Annotated[
    float | None, typer.Option(help="Factor on the battery's internal resistance: 1 new, 2 worn out.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def _tell(value: dict[str, Any], text: str, as_json: bool) -> None:
    typer.echo(json.dumps(value) if as_json else text)


def _seal(settings: Settings, hidden: tuple[Hidden, ...], vehicle: Vehicle, default: Path) -> Path | None:
    """Seal what is hidden and return where (None: the user knows it already). Last of all, when nothing can
    fail: the answer to an earlier flight must not be lost to a mistyped one.
    """
    from trueflight.sim_bridge.seal import seal

    if not settings.sealed and not {"random", "any", "rich"} & set(settings.hidden):
        return None
    path = Path(settings.sealed) if settings.sealed else default
    seal(hidden, vehicle.name, settings.seed, path)
    return path


def _told(settings: Settings, sealed: Path | None) -> str:
    names = ", ".join(settings.hidden)
    return f"hidden: {names}" + (f" (the answer is sealed in {sealed})" if sealed else "")


@app.command(
    epilog="Example: sim-bridge run --vehicle models/vehicles/quad5/vehicle.toml --hidden random --seed 7"
)
def run(
    vehicle: VehicleFile = None,
    config: Config = None,
    hidden: HiddenNames = None,
    hidden_count: HiddenCount = None,
    seed: Seed = None,
    sealed: Sealed = None,
    noise: NoiseScale = None,
    charge: Charge = None,
    battery_age: BatteryAge = None,
    mavlink: Annotated[str | None, typer.Option(help="The companion's address: udpout:HOST:PORT.")] = None,
    port: Annotated[int | None, typer.Option(help="The vehicle's own UDP port on 127.0.0.1.")] = None,
    pilot_port: Annotated[int | None, typer.Option(help="UDP port of the simulated pilot; 0: none.")] = None,
    speed: Annotated[float | None, typer.Option(help="Simulated over wall time.")] = None,
    pilot_takes_over_at: Annotated[float | None, typer.Option(help="s after arming; 0: never.")] = None,
    pilot_mode: Annotated[str | None, typer.Option(help="Mode the pilot then takes over with.")] = None,
    duration: Annotated[
        float | None, typer.Option(help="End after so many s of simulated time; 0: never.")
    ] = None,
    param: Annotated[
        list[str] | None, typer.Option(help="Parameter of the autopilot, NAME=VALUE. Repeatable.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Fly a simulated vehicle on MAVLink, as PX4 would, until interrupted.

    Prints a line that begins with `ready:` as soon as it can be connected to. Faster than real time
    (`--speed`) the vehicle's clock and all its messages run faster; MAVSDK's heartbeats, timeouts and re-sent
    setpoints do not, so with MAVSDK speeds above about 4 make Offboard's loss timeout too short.
    """
    names = ("vehicle", "hidden", "hidden_count", "seed", "sealed", "noise", "mavlink", "port", "pilot_port")
    flags = {name: value for name, value in locals().items() if name in names}
    flags |= {"speed": speed, "duration": duration, "pilot_mode": pilot_mode}
    flags |= {"charge": charge, "battery_age": battery_age}
    settings = load_settings(config, flags | {"pilot_takes_over_at": pilot_takes_over_at})
    believed = load_vehicle(settings.vehicle)
    from trueflight.sim_bridge.autopilot import Autopilot
    from trueflight.sim_bridge.mavlink.server import PILOT_MODES, Link, Server, pilot_order
    from trueflight.sim_bridge.parameters import Parameters
    from trueflight.sim_bridge.simulator import Simulator
    from trueflight.sim_bridge.truth.hidden import choose

    if settings.pilot_mode not in PILOT_MODES:
        raise InputError(f"--pilot-mode {settings.pilot_mode}: choose one of {', '.join(PILOT_MODES)}")
    parameters = Parameters(believed)
    for name, value in settings.parameters.items():
        parameters.set_text(f"{name}={value}")
    for assignment in param or ():
        parameters.set_text(assignment)
    link = Link(("127.0.0.1", settings.port), settings.remote, settings.pilot_port)
    effects = choose(list(settings.hidden), believed, settings.seed, settings.hidden_count)
    simulator = Simulator(believed, effects, settings.seed, settings.sensor_noise, settings.battery)
    autopilot = Autopilot(simulator, parameters)
    server = Server(autopilot, link, settings.speed)
    answer = _seal(settings, effects, believed, Path(f"hidden-seed-{settings.seed}.sealed"))
    stopped: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda caught, frame: stopped.append(caught))

    takeover_us = settings.pilot_takes_over_at * 1e6
    end_us = settings.duration * 1e6 or float("inf")
    pilot_waits = [takeover_us > 0]

    def each_step(time_us: int) -> None:
        if pilot_waits[0] and autopilot.armed and time_us - autopilot.armed_us >= takeover_us:
            pilot_waits[0] = False
            pilot_order(autopilot, settings.pilot_mode)
        if time_us >= end_us:
            stopped.append(0)

    ready = {
        "ready": True,
        "vehicle": believed.name,
        "mavlink": settings.mavlink,
        "port": settings.port,
        "pilot_port": settings.pilot_port,
        "speed": settings.speed,
        "sealed": str(answer) if answer else None,
    }
    pace = "" if settings.speed == 1 else f", {settings.speed:g} times real time"
    _tell(
        ready, f"ready: {believed.name} sends to {settings.mavlink}{pace}; {_told(settings, answer)}", as_json
    )
    sys.stdout.flush()
    try:
        server.run(lambda: not stopped, each_step)
    finally:
        server.close()
    _tell(_summary(autopilot), f"stopped after {autopilot.time_us * 1e-6:.1f} s of simulated time", as_json)


@app.command(epilog="Example: sim-bridge sitl --vehicle vehicle.toml --hidden rotor_drag --set-params")
def sitl(
    vehicle: VehicleFile = None,
    config: Config = None,
    hidden: HiddenNames = None,
    hidden_count: HiddenCount = None,
    seed: Seed = None,
    sealed: Sealed = None,
    noise: NoiseScale = None,
    charge: Charge = None,
    battery_age: BatteryAge = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on; 0.0.0.0 for a PX4 on another machine.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(help="TCP port; PX4's instance i (`px4 -i 1`) connects to 4560 + i.")
    ] = 4560,
    link_port: Annotated[
        int | None,
        typer.Option(help="UDP port for PX4's parameters; default 14030 + i; 0: none.", min=0, max=65535),
    ] = None,
    set_params: Annotated[
        bool, typer.Option("--set-params", help="Set PX4's control allocation to the vehicle's.")
    ] = False,
    show_params: Annotated[
        bool, typer.Option("--show-params", help="Print what PX4 must have, as its commands, and end.")
    ] = False,
    position: Annotated[
        str, typer.Option(help="What tells PX4 where it is: gps, vision (ODOMETRY) or both.")
    ] = "gps",
    vision_rate: Annotated[float, typer.Option(help="Rate of vision, Hz.", min=1, max=250)] = 50.0,
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
    names = (
        "vehicle",
        "hidden",
        "hidden_count",
        "seed",
        "sealed",
        "noise",
        "charge",
        "battery_age",
        "duration",
    )
    flags = {name: value for name, value in locals().items() if name in names}
    settings = load_settings(config, flags, free_speed=speed)
    believed = load_vehicle(settings.vehicle)
    from trueflight.sim_bridge.sitl.lockstep import Position
    from trueflight.sim_bridge.sitl.session import Request, fly, parameter_lines
    from trueflight.sim_bridge.truth.hidden import choose
    from trueflight.sim_bridge.world import check_vehicle

    check_vehicle(believed)
    kinds = [kind.value for kind in Position]
    if position not in kinds:
        raise InputError(f"--position {position}: choose one of {', '.join(kinds)}")
    if show_params:
        lines = parameter_lines(believed, Position(position))
        _tell({"commands": lines}, "\n".join(lines), as_json)
        return
    effects = choose(list(settings.hidden), believed, settings.seed, settings.hidden_count)
    stopped: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda caught, frame: stopped.append(caught))
    default = Path(f"hidden-seed-{settings.seed}.sealed")
    fly(
        believed,
        effects,
        settings,
        Request(host, port, link_port, Position(position), vision_rate, set_params, truth),
        lambda: _seal(settings, effects, believed, default),
        lambda answer: _told(settings, answer),
        lambda: bool(stopped),
        as_json,
    )


def _summary(autopilot: Autopilot) -> dict[str, Any]:
    return {"simulated": autopilot.time_us * 1e-6, "armed": autopilot.armed, "mode": autopilot.mode.name}


@app.command(
    epilog="Example: sim-bridge fly --trajectory excitation --vehicle vehicle.toml --hidden random -o 1.mcap"
)
def fly(
    trajectory: Annotated[str, typer.Option(help="Name of a trajectory, or a CSV file of setpoints.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The flight record to write (MCAP).")],
    vehicle: VehicleFile = None,
    config: Config = None,
    design: Annotated[
        Path | None, typer.Option(help="Design file; otherwise design.json beside the vehicle.")
    ] = None,
    parameter: Annotated[
        list[str] | None, typer.Option("--set", help="Parameter of the trajectory, NAME=VALUE. Repeatable.")
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="ONNX model; the guarded correction then flies with it.")
    ] = None,
    controller: Annotated[
        str, typer.Option(help="lqr, lqr_integral, corrected; corrected where a model is given.")
    ] = "",
    trim: Annotated[
        float | None,
        typer.Option(help="Bandwidth of the slow trim of `corrected`, rad/s; 0: none.", min=0, max=1),
    ] = None,
    settle: Annotated[
        float, typer.Option(help="s to hold the start before the trajectory begins.", min=0, max=60)
    ] = 0.0,
    repeat: Annotated[int, typer.Option(help="How often the trajectory is flown.", min=1)] = 1,
    rate: Annotated[float, typer.Option(help="Control rate, Hz.")] = 100.0,
    hidden: HiddenNames = None,
    hidden_count: HiddenCount = None,
    strength: Annotated[
        float, typer.Option(help="Factor on the sizes of what is hidden by name, `random` or `any`.", min=0.0)
    ] = 1.0,
    seed: Seed = None,
    sealed: Sealed = None,
    noise: NoiseScale = None,
    charge: Charge = None,
    battery_age: BatteryAge = None,
    rotor_speeds: Annotated[
        bool, typer.Option("--rotor-speeds/--no-rotor-speeds", help="Whether the record has rotor speeds.")
    ] = True,
    table: Annotated[bool, typer.Option("--csv", help="Write a CSV beside the record, too.")] = False,
    as_json: Json = False,
) -> None:
    """Fly in-process, without MAVLink, by the companion's own control law, and write the same flight
    record.
    """
    names = (
        "vehicle",
        "design",
        "hidden",
        "hidden_count",
        "seed",
        "sealed",
        "noise",
        "charge",
        "battery_age",
    )
    settings = load_settings(config, {name: value for name, value in locals().items() if name in names})
    believed = load_vehicle(settings.vehicle)
    from trueflight.companion.law.controllers import TrimLimits
    from trueflight.models.design import load_design
    from trueflight.sim_bridge.in_process import Plan, record
    from trueflight.sim_bridge.truth.hidden import choose

    gains = Path(settings.design) if settings.design else Path(settings.vehicle).with_name("design.json")
    plan = Plan(
        believed,
        load_design(gains, believed),
        _trajectory(trajectory, parameter or []),
        choose(list(settings.hidden), believed, settings.seed, settings.hidden_count, strength),
        settings.seed,
        repeat,
        rate,
        None if model is None else _bytes(model),
        settings.sensor_noise,
        settings.battery,
        controller,
        settle,
        TrimLimits() if trim is None else TrimLimits(bandwidth=trim),
        rotor_speeds,
    )
    csv_file = output.with_suffix(".csv") if table else None
    seconds = plan.repeat * plan.trajectory.duration
    with _Progress(seconds, as_json) as progress:
        flown = record(plan, output, csv_file, lambda sample: progress.add(1.0 / rate))
    told = _seal(settings, plan.hidden, believed, output.with_suffix(".sealed"))
    report = {
        "record": str(output),
        "csv": str(csv_file) if csv_file else None,
        "outcome": flown.outcome,
        "ticks": flown.ticks,
        "simulated": flown.simulated,
        "times_real_time": flown.times_real_time,
        "rms_error": {"x": flown.rms_error[0], "y": flown.rms_error[1], "z": flown.rms_error[2], "unit": "m"},
        "guard": flown.guard,
        "ticks_on_ground": flown.touching,
        "sealed": str(told) if told else None,
    }
    error = ", ".join(f"{axis} {value:.3f}" for axis, value in zip("xyz", flown.rms_error, strict=True))
    text = (
        f"{output}: {flown.outcome}, {flown.simulated:.1f} s in {flown.wall:.2f} s "
        f"({flown.times_real_time:.0f} times real time); "
        f"RMS error to the reference {error} m; {_told(settings, told)}"
    )
    if flown.touching:
        text += f"; touched the ground in {flown.touching} of {flown.ticks} ticks"
    _tell(report, text, as_json)


def _trajectory(name: str, assignments: list[str]) -> Any:
    from trueflight.models.reference import trajectory, trajectory_from_csv

    if name.endswith(".csv"):
        return trajectory_from_csv(_bytes(Path(name)).decode("utf-8", "replace"), name)
    parameters: dict[str, float | str] = {}
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        if not equals:
            raise InputError(f"--set {assignment}: write NAME=VALUE")
        parameters[key] = value
    return trajectory(name, **parameters)


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read it ({error.strerror})") from None


class _Progress:
    """A bar on standard error for long flights, in seconds of flight."""

    def __init__(self, seconds: float, quiet: bool) -> None:
        self._seconds, self._done, self._shown = seconds, 0.0, 0.0
        self._bar: Any = None
        # A hundred fly in a second: below that a bar would only flicker.
        if seconds > 100.0 and not quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import Progress

            self._bar = Progress(console=Console(stderr=True), transient=True)

    def __enter__(self) -> _Progress:
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task("flying", total=self._seconds)
        return self

    def __exit__(self, *caught: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def add(self, seconds: float) -> None:
        """So much more has been flown."""
        self._done += seconds
        if self._bar is not None and self._done - self._shown >= 10.0:
            self._shown = self._done
            self._bar.update(self._task, completed=self._done)


@app.command(
    epilog="Example: sim-bridge collect --vehicle vehicle.toml --hidden rich --seed 1 --minutes 30 -o database"
)
def collect(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the records: new, or to continue.")
    ],
    vehicle: VehicleFile = None,
    config: Config = None,
    design: Annotated[
        Path | None, typer.Option(help="Design file; otherwise design.json beside the vehicle.")
    ] = None,
    minutes: Annotated[float, typer.Option(help="Flight time to collect, at least.")] = 30.0,
    model: Annotated[
        Path | None, typer.Option(help="ONNX model; the guarded correction then flies with it.")
    ] = None,
    rate: Annotated[float, typer.Option(help="Control rate, Hz.")] = 100.0,
    hidden: HiddenNames = None,
    hidden_count: HiddenCount = None,
    seed: Seed = None,
    sealed: Sealed = None,
    noise: NoiseScale = None,
    battery_age: BatteryAge = None,
    jobs: Annotated[int, typer.Option(help="Processes; 0: one for each core.", min=0, max=256)] = 0,
    as_json: Json = False,
) -> None:
    """Fly a whole training database in-process: one record each of translations, steps, rotations, spirals, circles,
    lemniscates, low passes and surveys, on batteries from full to nearly empty.

    `--seed` draws the truth, the flights and their noise. What was flown stays when interrupted; the same command
    continues.
    """
    names = ("vehicle", "design", "hidden", "hidden_count", "seed", "sealed", "noise", "battery_age")
    settings = load_settings(config, {name: value for name, value in locals().items() if name in names})
    believed = load_vehicle(settings.vehicle)
    from trueflight.models.database import Collection, database
    from trueflight.models.design import load_design
    from trueflight.sim_bridge.collect import collect as fly_all
    from trueflight.sim_bridge.collect import fingerprint, flights
    from trueflight.sim_bridge.in_process import Plan
    from trueflight.sim_bridge.truth.hidden import choose

    gains = Path(settings.design) if settings.design else Path(settings.vehicle).with_name("design.json")
    sorties = database(settings.seed, minutes)
    plan = Plan(
        believed,
        load_design(gains, believed),
        sorties[0].path,
        choose(list(settings.hidden), believed, settings.seed, settings.hidden_count),
        settings.seed,
        rate=rate,
        model=None if model is None else _bytes(model),
        noise=settings.sensor_noise,
        battery=settings.battery,
    )
    _ = plan.steps_per_tick  # a rate that cannot be flown is told before anything is written
    asked = {"hidden": settings.hidden, "seed": settings.seed, "minutes": minutes, "rate": rate}
    asked |= {"noise": settings.noise, "battery_age": settings.battery_age, "fingerprint": fingerprint(plan)}
    collection = Collection(output, {"flown_by": "sim-bridge collect", "vehicle": believed.name, **asked})
    told = _seal(settings, plan.hidden, believed, output / "hidden.sealed")
    wanted = flights(sorties, plan)
    already, begin = len(collection.flown), time.perf_counter()
    total = sum(sortie.path.duration for sortie in sorties)
    with _Progress(total, as_json) as progress:
        progress.add(sum(entry["seconds"] for entry in collection.flown.values()))
        try:
            for _, entry in fly_all(wanted, collection, jobs or len(os.sched_getaffinity(0))):
                progress.add(entry["seconds"])
        except KeyboardInterrupt:
            raise InputError(
                f"interrupted: {len(collection.flown)} of {len(wanted)} flights are in {output}; the same command "
                "continues"
            ) from None
    wall = time.perf_counter() - begin
    entries = [collection.flown[flight.name] for flight in wanted]
    seconds = sum(entry["seconds"] for entry in entries)
    new = len(entries) - already
    report = {
        "folder": str(output),
        "flights": collection.flown,
        "seconds": seconds,
        "flown_now": new,
        "wall": wall,
        "sealed": str(told) if told else None,
    }
    text = (
        f"{output}: {len(entries)} flights, {seconds / 60:.1f} min, {new} of them now in {wall:.1f} s; "
        f"{_told(settings, told)}"
    )
    if as_json:
        _tell(report, text, as_json)
        return
    _print_collected(entries)
    typer.echo(text)


def _print_collected(entries: list[dict[str, Any]]) -> None:
    """One row for each trajectory: how often, how long, how far from the reference."""
    from rich.console import Console
    from rich.table import Table

    table = Table()
    for column in ("trajectory", "flights", "s", "charge", "RMS x, y, z (m)", "on ground", "not finished"):
        table.add_column(column, justify="left" if column == "trajectory" else "right", no_wrap=True)
    for name in sorted({entry["trajectory"] for entry in entries}):
        of = [entry for entry in entries if entry["trajectory"] == name]
        ticks = sum(entry["ticks"] for entry in of)
        errors = (
            math.sqrt(sum(entry["ticks"] * entry["rms_error"][i] ** 2 for entry in of) / ticks)
            for i in range(3)
        )
        charges = [entry["charge"] for entry in of]
        table.add_row(
            name,
            str(len(of)),
            f"{sum(entry['seconds'] for entry in of):.0f}",
            f"{min(charges):.2f} to {max(charges):.2f}",
            ", ".join(f"{error:.3f}" for error in errors),
            f"{sum(entry['ticks_on_ground'] for entry in of) / ticks:.1%}",
            str(sum(entry["outcome"] != "finished" for entry in of) or ""),
        )
    Console(width=100).print(table)


@app.command(epilog="Example: sim-bridge reveal hidden.sealed --json")
def reveal(file: Path, as_json: Json = False) -> None:
    """Tell what was hidden, from its sealed file."""
    from trueflight.sim_bridge.seal import reveal as open_seal

    answer: dict[str, Any] = open_seal(file)
    lines = []
    for effect in answer["effects"]:
        numbers = (
            f"{key} {entry['value']:.4g} {entry['unit']}" for key, entry in effect["parameters"].items()
        )
        lines.append(f"{effect['name']}: " + ", ".join(numbers))
    _tell(answer, "\n".join(lines) or "nothing was hidden", as_json)


@app.command(epilog="Example: sim-bridge pilot --mode POSCTL")
def pilot(
    mode: Annotated[
        str, typer.Option(help="POSCTL, ALTCTL, STABILIZED, HOLD, LAND, RTL, KILL, RELEASE_KILL, ...")
    ],
    port: Annotated[
        int, typer.Option("--pilot-port", help="The pilot's UDP port of `sim-bridge run`.")
    ] = 14590,
    as_json: Json = False,
) -> None:
    """Take over a running simulation as its pilot: switch the flight mode, or kill."""
    from trueflight.sim_bridge.pilot import send_order

    answer = send_order(mode, port)
    if not answer.get("accepted"):
        raise InputError(f"--mode {mode}: not taken: {answer.get('reason')}")
    _tell(answer, f"{answer['mode']}, {'armed' if answer['armed'] else 'disarmed'}", as_json)


@app.command(epilog="Example: sim-bridge effects --json")
def effects(as_json: Json = False) -> None:
    """List what can be hidden, with the range of its size when it is drawn, by name or `random`, and by `rich`."""
    from trueflight.sim_bridge.truth.effects import EFFECTS
    from trueflight.sim_bridge.truth.hidden import RICH, pool

    rows: list[dict[str, Any]] = [
        {
            "name": effect.name,
            "what": effect.what,
            "low": effect.low,
            "high": effect.high,
            "unit": next(iter(effect.units.values())),
            "random": effect.drawn,
            "any": effect.name in pool("any"),
            "rich": RICH.get(effect.name),
        }
        for effect in EFFECTS.values()
    ]
    if as_json:
        _tell({"effects": rows}, "", as_json)
        return
    from rich.console import Console
    from rich.table import Table

    table = Table()
    for column in ("effect", "drawn", "in rich", "unit", "what"):
        table.add_column(column, no_wrap=column != "what")
    for row in rows:
        span = f"{row['low']:g} to {row['high']:g}"
        rich = "{:g} to {:g}".format(*row["rich"]) if row["rich"] else ""
        table.add_row(row["name"], span, rich, row["unit"], row["what"])
    Console(width=100).print(table)


def main() -> None:
    """Entry point of `sim-bridge`."""
    run_command_line(app)
