"""Command lines of flights and of the linear design: import, flights, design, track."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from trueflight.groundstation.commands.options import (
    DesignOption,
    FlightArgument,
    JsonOption,
    MappingOption,
    SaveOption,
    VehicleOption,
)
from trueflight.models.errors import InputError
from trueflight.models.outside import toml_table
from trueflight.models.printed import print_json

if TYPE_CHECKING:
    from trueflight.groundstation.design.linear_design import Loop
    from trueflight.groundstation.evaluate.tracking import Tracking
    from trueflight.groundstation.versions.vehicle_draft import Draft
    from trueflight.models.flight import Flight

console = Console()


def register(app: typer.Typer) -> None:
    """Add these commands to the ground station's application."""
    app.command("flights", epilog="Example: groundstation flights samples")(flights_command)
    app.command(
        "import",
        epilog="Example: groundstation import log.csv --mapping mine.mapping.toml --vehicle vehicle.toml "
        "-o flight.csv; groundstation import log.ulg --draft-vehicle vehicle.toml",
    )(import_command)
    app.command(
        "design", epilog="Example: groundstation design models/vehicles/quad5/vehicle.toml -o design.json"
    )(design_command)
    app.command("track", epilog="Example: groundstation track before.mcap after.mcap")(track_command)


def flights_command(
    directory: Annotated[Path, typer.Argument(help="Folder to look through.")] = Path("flights"),
    as_json: JsonOption = False,
) -> None:
    """The flights in a folder: what was flown, how long, and what was measured."""
    from rich.progress import track as progress

    from trueflight.groundstation.reading.flight_file import RECORDS, TABLES, ULOGS
    from trueflight.models.whole_file import is_hidden

    if not directory.is_dir():
        raise InputError(f"{directory}: no such folder; pass the one that holds your flights")
    endings = (*TABLES, *RECORDS, *ULOGS)
    files = sorted(
        f
        for f in directory.rglob("*")
        if f.suffix.lower() in endings and f.is_file() and not is_hidden(f, directory)
    )
    shown = (
        files if as_json or len(files) < 4 else progress(files, "reading", console=console, transient=True)
    )
    rows = [_flight_row(file, directory) for file in shown]
    if as_json:
        print_json(rows)
        return
    from rich.table import Table

    table = Table(caption=f"{len(rows)} files in {directory}", caption_justify="left")
    table.add_column("flight", overflow="fold")
    table.add_column("date", no_wrap=True)
    for heading in ("length", "in air", "rate"):
        table.add_column(heading, justify="right", no_wrap=True)
    flown = any(row["trajectory"] for row in rows)
    if flown:
        table.add_column("flown")
    table.add_column("measured", overflow="fold")
    for row in rows:
        cells = [escape(str(row["flight"])), row["date"]]
        if row["error"]:
            reason = str(row["error"]).removeprefix(str(directory / str(row["flight"]))).lstrip(":, ")
            cells += ["", "", "", *[""] * flown, f"[red]{escape(reason)}[/red]"]
        else:
            cells += [f"{row['duration']:.1f} s", f"{row['flying']:.1f} s", f"{row['rate']:.0f} Hz"]
            words = (row["trajectory"], row["controller"], row["model"])
            cells += [escape(" ".join(word for word in words if word))] * flown
            cells.append(" ".join(SHORT[word] for word in row["measured"]))
        table.add_row(*cells)
    console.print(table)
    if not files:
        console.print(f"no flights in {directory} (known endings: {', '.join(endings)})")


SENSORS = {
    "specific_force": "accelerometer",
    "position": "position",
    "quaternion": "attitude",
    "angular_velocity": "gyroscope",
    "battery_voltage": "battery",
    "rotor_speed": "rotor speeds",
    "motor_command": "motor commands",
    "position_reference": "reference",
}

SHORT = {
    "accelerometer": "acc",
    "position": "pos",
    "attitude": "att",
    "gyroscope": "gyro",
    "battery": "batt",
    "rotor speeds": "rpm",
    "motor commands": "motors",
    "reference": "ref",
}


def _flight_row(file: Path, directory: Path) -> dict[str, Any]:
    """What the table tells of one file; a file that cannot be read tells why."""
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.reading.ros_bag import is_ros_bag

    stamp = datetime.fromtimestamp(file.stat().st_mtime, UTC)
    row: dict[str, Any] = {
        "flight": str(file.relative_to(directory)),
        "date": stamp.strftime("%Y-%m-%d"),
        "trajectory": "",
        "controller": "",
        "model": "",
        "error": "",
    }
    try:
        flight = read_flight(file)
        if file.suffix.lower() == ".mcap" and not is_ros_bag(file):
            row |= _record_facts(file)
    except InputError as error:
        return {**row, "error": str(error)}
    flying = 1.0 if flight.flying is None else float(flight.flying.mean())
    return {
        **row,
        "vehicle": flight.vehicle.name,
        "duration": round(flight.duration, 2),
        "flying": round(flying * len(flight) * flight.dt, 2),
        "rate": round(1.0 / flight.dt, 1),
        "measured": [word for name, word in SENSORS.items() if flight.has(name)],
        "notes": list(flight.notes),
    }


def _record_facts(file: Path) -> dict[str, Any]:
    from trueflight.models.record import read_record

    record = read_record(file)
    facts = {name: record.metadata.get(name, "") for name in ("trajectory", "controller", "model")}
    created = record.metadata.get("created_ns", "")
    if created.isdecimal() and len(created) < 20:
        facts["date"] = datetime.fromtimestamp(int(created) * 1e-9, UTC).strftime("%Y-%m-%d")
    return facts


def import_command(
    file: FlightArgument,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Where to: .csv or .parquet.")] = None,
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    draft: Annotated[
        Path | None,
        typer.Option("--draft-vehicle", help="Draft a vehicle file from a PX4 log; never replaces one."),
    ] = None,
    mass: Annotated[float | None, typer.Option(help="kg, for the draft: PX4 does not know it.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Read any flight, check it, and write it in the project's own format with its vehicle file beside it.

    From a PX4 ULog a vehicle file can be drafted first: `--draft-vehicle vehicle.toml`, with or without `-o`.
    """
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.reading.writing import own_table, write_flight

    if output is None and draft is None:
        raise InputError("import: say where to write the flight with -o FILE.csv, or draft its vehicle file")
    if output is not None and output.resolve() == file.resolve():
        raise InputError(f"{output}: that is the file itself; choose another -o, the original stays as it is")
    if mass is not None and draft is None:
        raise InputError("--mass goes with --draft-vehicle; a vehicle file of your own tells its mass itself")
    if draft is not None and vehicle is not None:
        raise InputError("--draft-vehicle: leave out --vehicle, the draft is what the log tells without it")
    if (
        output is not None
        and draft is not None
        and output.with_suffix(".vehicle.toml").resolve() == draft.resolve()
    ):
        raise InputError(f"{draft}: -o writes the vehicle as it was read there; name the draft otherwise")
    told: dict[str, Any] = {}
    with nullcontext() if as_json else console.status(f"reading {escape(file.name)}"):
        drafted = None if draft is None else _drafted(file, draft, mass)
        flight = None
        if output is not None:
            flight = read_flight(file, vehicle if drafted is None else drafted.vehicle, mapping)
            vehicle_path = write_flight(flight, output)
            told = {
                "flight": str(output),
                "vehicle": str(vehicle_path),
                "samples": len(flight),
                "duration": round(flight.duration, 3),
                "columns": list(own_table(flight)),
                "notes": list(flight.notes),
            }
    if drafted is not None and draft is not None:
        from trueflight.groundstation.versions.vehicle_draft import write_draft

        write_draft(drafted, draft)
        told |= {
            "vehicle_draft": str(draft),
            "values": toml_table(drafted.text, str(draft)),
            "sources": {line.key: line.source for line in drafted.lines},
            "to_complete": list(drafted.to_complete),
        }
    if as_json:
        print_json(told)
        return
    if drafted is not None and draft is not None:
        _print_draft(drafted, draft, file)
    if flight is not None:
        console.print(
            f"{escape(str(output))}: {len(flight)} samples, {flight.duration:.1f} s at {1 / flight.dt:.0f} Hz"
        )
        console.print(f"{escape(str(vehicle_path))}: the vehicle as it was believed to be")
        _print_notes(flight)


def _drafted(file: Path, target: Path, mass: float | None) -> Draft:
    """The vehicle file drafted from a PX4 log, not yet written."""
    from trueflight.groundstation.reading.flight_file import ULOGS
    from trueflight.groundstation.reading.px4_log import load_ulog
    from trueflight.groundstation.versions.vehicle_draft import draft_vehicle
    from trueflight.models.outside import unreadable

    if file.suffix.lower() not in ULOGS:
        raise InputError(f"{file}: only a PX4 ULog holds the parameters that a vehicle file is drafted from")
    if target.exists():
        raise InputError(f"{target}: there is a file already; a draft never replaces one, name another")
    log = load_ulog(file)
    with unreadable(file, "the log", "copy it from the vehicle's card again"):
        return draft_vehicle(log, mass)


def _print_draft(drafted: Draft, target: Path, file: Path) -> None:
    from rich.table import Table

    table = Table(title=f"{escape(str(target))}: drafted from {escape(file.name)}", title_justify="left")
    table.add_column("value", overflow="fold")
    table.add_column("where it is from", overflow="fold")
    for line in drafted.lines:
        if line.key == "rotor_directions" and not line.stated:
            continue
        mark = "" if line.complete else "[yellow]TO COMPLETE[/yellow] "
        value = f"{line.key} = {line.value}" if line.stated else f"{line.key} (left out)"
        table.add_row(escape(value), mark + escape(line.source))
    console.print(table)
    console.print(
        f"[yellow]the log cannot tell {escape(', '.join(drafted.to_complete))}[/yellow]: correct them in "
        f"{escape(str(target))}",
        highlight=False,
    )


def design_command(
    vehicle: Annotated[Path, typer.Argument(help="vehicle.toml")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Design file; default: design.json beside it.")
    ] = None,
    bandwidth: Annotated[float | None, typer.Option(help="Position loop, Hz.")] = None,
    attitude_bandwidth: Annotated[float | None, typer.Option(help="Attitude loop, Hz.")] = None,
    rate: Annotated[float, typer.Option(help="Control rate, Hz.")] = 100.0,
    keep: Annotated[
        Path | None, typer.Option("--keep", help="Keep the gains of this design, add only its integral loop.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Gains of the linear cascade by LQR, with and without integral, and what the closed loop will do."""
    from trueflight.groundstation.design.integral_design import integral_loops, with_integral
    from trueflight.groundstation.design.linear_design import (
        ATTITUDE_BANDWIDTH,
        POSITION_BANDWIDTH,
        actuation,
        loops,
        make_design,
    )
    from trueflight.models.design import load_design, save_design
    from trueflight.models.vehicle import load_vehicle

    believed = load_vehicle(vehicle)
    if keep is not None:
        if bandwidth is not None or attitude_bandwidth is not None:
            raise InputError("--keep: the gains are those of the file; leave out --bandwidth")
        design = load_design(keep, believed)
    else:
        design = make_design(
            believed, bandwidth or POSITION_BANDWIDTH, attitude_bandwidth or ATTITUDE_BANDWIDTH, rate
        )
    design = with_integral(design, believed)
    target = output or vehicle.with_name("design.json")
    save_design(design, target)
    found, integral = loops(design, believed), integral_loops(design, believed)
    if as_json:
        print_json(
            {
                "design": str(target),
                "K_zeta": design.K_zeta,
                "K_eta": design.K_eta,
                "integral": None if design.integral is None else asdict(design.integral),
                "loops": [_loop_row(loop) for loop in found],
                "integral_loops": [
                    {
                        **_loop_row(i.loop),
                        "disturbance_removed_after": i.removal,
                        "disturbance_allowed": i.allowed,
                        "disturbance_peak": i.peak,
                        "step_distance_to_lqr": i.step_distance,
                        "translation_distance_to_lqr": i.translation_distance,
                    }
                    for i in integral
                ],
            },
        )
        return
    from rich.table import Table

    delay, lag = actuation(believed, design.rate)
    table = Table(title=f"{believed.name}: closed loop, step of the reference")
    for heading in (
        "loop",
        "poles (1/s)",
        "rise",
        "settles",
        "overshoot",
        f"margin at {1e3 * delay:.0f} + {1e3 * lag:.0f} ms",
    ):
        table.add_column(heading, justify="left" if heading in ("loop", "poles (1/s)") else "right")
    shown = [(loop.name, loop) for loop in found] + [(f"{i.loop.name} + i", i.loop) for i in integral]
    for name, loop in shown:
        table.add_row(
            name,
            _poles(loop.poles),
            f"{loop.rise_time:.2f} s",
            f"{loop.settling_time:.2f} s",
            f"{100 * loop.overshoot:.0f} %",
            f"{loop.phase_margin:.0f} deg",
        )
    console.print(table)
    k_zeta, k_eta = design.K_zeta, design.K_eta
    console.print(f"K_zeta  roll, pitch {k_zeta[0][0]:.2f}, yaw {k_zeta[2][2]:.2f} 1/s")
    console.print(
        f"K_eta   tilt {k_eta[1][0]:.3f} rad/m, {k_eta[1][3]:.3f} rad s/m; thrust {k_eta[2][2]:.2f} N/m, "
        f"{k_eta[2][5]:.2f} N s/m",
        highlight=False,
    )
    table = Table(title="with integral (lqr_integral), a constant disturbance and the distance to lqr, 1 m")
    for heading in ("loop", "gone after", "peak", "step, rms", "translation, rms"):
        table.add_column(heading, justify="left" if heading == "loop" else "right")
    for i in integral:
        table.add_row(
            f"{i.loop.name} + i",
            f"{i.removal:.1f} s of {i.allowed:.1f} s",
            f"{100 * i.peak:.0f} % of lqr's",
            f"{100 * i.step_distance:.1f} cm",
            f"{100 * i.translation_distance:.1f} cm",
        )
    console.print(table)
    console.print(f"design: {escape(str(target))}")


def _loop_row(loop: Loop) -> dict[str, Any]:
    return {
        "name": loop.name,
        "poles": [[p.real, p.imag] for p in loop.poles],
        "crossover": loop.crossover,
        "phase_margin_deg": loop.phase_margin,
        "rise_time": loop.rise_time,
        "settling_time": loop.settling_time,
        "overshoot": loop.overshoot,
    }


def _poles(poles: tuple[complex, ...]) -> str:
    words = [
        f"{p.real:.1f}" if abs(p.imag) < 1e-6 else f"{p.real:.1f} ± {abs(p.imag):.1f}i"
        for p in poles
        if p.imag >= -1e-6
    ]
    return ", ".join(words)


def track_command(
    flights: Annotated[list[Path], typer.Argument(help="One flight or more, usually before and after.")],
    design: DesignOption = None,
    vehicle: VehicleOption = None,
    rrd: SaveOption = None,
    as_json: JsonOption = False,
) -> None:
    """Flights against the linear behaviour expected of them: mean squared error per axis, as in the paper."""
    from trueflight.groundstation.evaluate.tracking import told_apart, track_file
    from trueflight.groundstation.output.flown import print_tracking

    tracked = told_apart([track_file(path, design, vehicle) for path in flights])
    if rrd is not None:
        from trueflight.groundstation.views import write_tracking

        write_tracking(rrd, tracked)
    if as_json:
        print_json([_tracking_row(t, tracked[0]) for t in tracked])
        return
    for t in tracked:
        _print_notes(t.flight)
    print_tracking(console, tracked)
    if rrd is not None:
        console.print(f"Rerun recording: {escape(str(rrd))}")


def _tracking_row(tracking: Tracking, first: Tracking) -> dict[str, Any]:
    return {
        "flight": tracking.flight.origin,
        "label": tracking.label,
        "seconds": round(len(tracking.t) * tracking.flight.dt, 2),
        "mse": dict(zip("xyz", tracking.mse, strict=True)),
        "unit": "m^2",
        "mse_zeta": dict(zip(("roll", "pitch", "yaw"), tracking.mse_zeta, strict=True)),
        "rms": tracking.rms,
        "change": sum(tracking.mse) / sum(first.mse) - 1.0,
    }


def _print_notes(flight: Flight) -> None:
    for note in flight.notes:
        console.print(f"note: {escape(note)}", style="yellow")
