"""`groundstation flights` and `import`: flights listed, and brought into the project's own format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from trueflight.groundstation.commands.options import (
    FlightArgument,
    JsonOption,
    MappingOption,
    VehicleOption,
)
from trueflight.groundstation.output.terminal import print_notes, working
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.groundstation.versions.vehicle_draft import Draft
    from trueflight.models.flight import Flight

console = Terminal()


def register(app: typer.Typer) -> None:
    """Add these commands to the ground station's application."""
    app.command("flights", epilog="Example: groundstation flights samples")(flights_command)
    app.command(
        "import",
        epilog="Example: groundstation import log.csv --mapping mine.mapping.toml --vehicle vehicle.toml "
        "-o flight.csv; groundstation import log.ulg --draft-vehicle vehicle.toml",
    )(import_command)


def flights_command(
    directory: Annotated[Path, typer.Argument(help="Folder to look through.")] = Path("flights"),
    as_json: JsonOption = False,
) -> None:
    """The flights in a folder: what was flown, how long, and what was measured."""
    from rich.progress import track as progress

    from trueflight.groundstation.reading.flight_file import ENDINGS
    from trueflight.groundstation.reading.listing import flight_row
    from trueflight.groundstation.reading.several import flight_files

    files = flight_files(directory)
    shown = (
        files if as_json or len(files) < 4 else progress(files, "reading", console=console, transient=True)
    )
    rows = [flight_row(file, directory) for file in shown]
    if as_json:
        print_json(rows)
        return
    _print_flights(rows, directory)
    if not files:
        console.print(f"no flights in {directory} (known endings: {', '.join(ENDINGS)})")


def _print_flights(rows: list[dict[str, Any]], directory: Path) -> None:
    from trueflight.models.terminal import Table

    table = Table(caption=f"{len(rows)} files in {directory}")
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


def import_command(
    file: FlightArgument,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Where to: .csv or .parquet.")] = None,
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    draft: Annotated[
        Path | None,
        typer.Option(
            "--draft-vehicle", help="Draft a vehicle file from an autopilot's log; never replaces one."
        ),
    ] = None,
    mass: Annotated[float | None, typer.Option(help="kg, for the draft: no autopilot knows it.")] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only tell which columns agree with each other; writes nothing.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Read any flight, check it, and write it in the project's own format with its vehicle file beside it.

    Alone it tells what the flight holds and writes nothing. From an autopilot's log (ULog, ArduPilot) a vehicle file
    can be drafted first: `--draft-vehicle vehicle.toml`.
    """
    from trueflight.groundstation.output.as_json import draft_table, imported_table
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.reading.writing import write_flight
    from trueflight.groundstation.versions.vehicle_draft import draft_of, write_draft

    if check and (output is not None or draft is not None):
        raise InputError("--check writes nothing; leave out -o and --draft-vehicle, or --check")
    if output is None and draft is None:
        if mass is not None:
            raise InputError(
                "--mass goes with --draft-vehicle; a vehicle file of your own tells its mass itself"
            )
        _summarise(file, vehicle, mapping, check, as_json)
        return
    _check_import(file, output, vehicle, draft, mass)
    told: dict[str, Any] = {}
    flight = None
    with working(console, f"reading {escape(file.name)}", as_json):
        drafted = None if draft is None else draft_of(file, draft, mass)
        if output is not None:
            flight = read_flight(file, vehicle if drafted is None else drafted.vehicle, mapping)
            vehicle_path = write_flight(flight, output)
            told = imported_table(flight, output, vehicle_path)
    if drafted is not None and draft is not None:
        write_draft(drafted, draft)
        told |= draft_table(drafted, draft)
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
        print_notes(console, flight)


def _summarise(
    file: Path, vehicle: Path | None, mapping: list[str] | None, check: bool, as_json: bool
) -> None:
    """Tell what a flight holds and whether its columns agree; a log without a vehicle file is read with the
    vehicle that the log itself tells of."""
    from trueflight.groundstation.reading import read_flight
    from trueflight.groundstation.reading.flight_file import NoVehicle
    from trueflight.groundstation.reading.listing import SENSORS
    from trueflight.groundstation.versions.vehicle_draft import LOADERS, draft_vehicle

    drafted = False
    with working(console, f"reading {escape(file.name)}", as_json):
        try:
            flight = read_flight(file, vehicle, mapping)
        except NoVehicle:
            load = LOADERS.get(file.suffix.lower())
            if check or load is None:
                raise
            flight, drafted = read_flight(file, draft_vehicle(load(file), None).vehicle, mapping), True
    if not as_json and not check:
        flying = 1.0 if flight.flying is None else float(flight.flying.mean())
        console.print(
            f"[bold]{escape(file.name)}[/bold]: {flight.duration:.1f} s at {1 / flight.dt:.0f} Hz, "
            f"{flying * len(flight) * flight.dt:.1f} s in the air; measured: "
            + ", ".join(name for column, name in SENSORS.items() if flight.has(column)),
            highlight=False,
        )
    _tell_consistency(flight, as_json)
    if as_json or check:
        return
    follow = f"groundstation diagnose {file}"
    if drafted:
        console.print(
            "no vehicle file beside it: mass and hover thrust are guesses until you draft one and correct it",
            style="yellow",
        )
        follow = f"groundstation import {file} --draft-vehicle {file.with_suffix('.vehicle.toml')}"
    console.print(f"[bold]next:[/bold] {escape(follow)}", highlight=False, soft_wrap=True)


def _tell_consistency(flight: Flight, as_json: bool) -> None:
    from trueflight.groundstation.output.as_json import consistency_table
    from trueflight.groundstation.output.tables import print_consistency

    if as_json:
        print_json({"notes": list(flight.notes), "consistency": consistency_table(flight)})
        return
    print_consistency(console, flight)
    print_notes(console, flight)


def _check_import(
    file: Path, output: Path | None, vehicle: Path | None, draft: Path | None, mass: float | None
) -> None:
    """Raise `InputError` for options that contradict each other."""
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


def _print_draft(drafted: Draft, target: Path, file: Path) -> None:
    from trueflight.models.terminal import Table

    table = Table(title=f"{escape(str(target))}: drafted from {escape(file.name)}")
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
