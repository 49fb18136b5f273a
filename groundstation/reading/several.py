"""Several flights at once: one held out of a fit, some to compare with the first, those of whole folders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from trueflight.groundstation.reading.flight_file import ENDINGS, is_flight_file, read_flight
from trueflight.groundstation.reading.mapping import Given
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.whole_file import is_hidden


def read_held_out(
    path: Path, fitted: Sequence[Flight], vehicle: Path | None = None, mapping: Given = None
) -> Flight:
    """A flight that those `fitted` are checked on, of the same vehicle, whose vehicle file serves it, too.

    Raises `InputError` as `check_held_out`.
    """
    flight = read_flight(path, vehicle or _vehicle_file(fitted[-1]), mapping)
    check_held_out(flight, fitted)
    return flight


def check_held_out(flight: Flight, fitted: Sequence[Flight]) -> None:
    """Raise `InputError` where `flight` is one of the `fitted`, which proves nothing, or of another vehicle."""
    name = flight.origin or flight.name
    for one in fitted:
        if flight.data_hash and flight.data_hash == one.data_hash:
            raise InputError(f"{name}: the flight that is fitted; hold out another one, or none")
        if flight.vehicle.name != one.vehicle.name:
            raise InputError(
                f"{name} is of vehicle '{flight.vehicle.name}', {one.origin or one.name} of '{one.vehicle.name}'; hold "
                "out a flight of the same vehicle"
            )


def read_beside(path: Path, first: Flight, vehicle: Path | None = None, mapping: Given = None) -> Flight:
    """A flight to compare `first` with, by the vehicle file beside it or else by that of the first."""
    try:
        return read_flight(path, vehicle, mapping)
    except InputError:
        if vehicle is not None or (same := _vehicle_file(first)) is None:
            raise
        return read_flight(path, same, mapping)


def read_together(paths: Sequence[Path], vehicle: Path | None = None, mapping: Given = None) -> list[Flight]:
    """Flights to compare with the first of them, as `read_beside`, their names told apart."""
    first = read_flight(paths[0], vehicle, mapping)
    return told_apart([first, *(read_beside(path, first, vehicle, mapping) for path in paths[1:])])


def told_apart(flights: Sequence[Flight]) -> list[Flight]:
    """The flights, named by their folder too where two files have the same name, and numbered where that is not
    enough."""
    names = [f.name for f in flights]
    longer = [
        f"{Path(f.origin).parent.name}/{f.name}" if names.count(f.name) > 1 and f.origin else f.name
        for f in flights
    ]
    told = [f"{n} ({longer[: k + 1].count(n)})" if longer.count(n) > 1 else n for k, n in enumerate(longer)]
    return [f if f.name == name else replace(f, name=name) for f, name in zip(flights, told, strict=True)]


def read_flights(
    paths: Sequence[Path],
    vehicle: Path | None = None,
    mapping: Given = None,
    progress: Callable[[int, Path], None] = lambda done, file: None,
) -> list[Flight]:
    """The flights of files and folders, as `flights_in` lists them; `progress` is told how many were read, and the
    last of them. Raises `InputError` for a folder without flights, and for whatever makes a file unfit."""
    flights = []
    for number, file in enumerate(flights_in(paths), 1):
        flights.append(read_flight(file, vehicle, mapping))
        progress(number, file)
    return flights


def flights_in(paths: Sequence[Path]) -> list[Path]:
    """The files of `paths`, folders replaced by the flights in them, by name; of a record and its table, the record.
    Raises `InputError` for a folder without flights."""
    return [file for path in paths for file in (_one_each(path) if path.is_dir() else [path])]


def flight_files(folder: Path) -> list[Path]:
    """Every flight file below `folder`, sorted; none where it has none. Raises `InputError` where it is no folder."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; pass the one that holds your flights")
    return sorted(
        f for f in folder.rglob("*") if f.is_file() and is_flight_file(f) and not is_hidden(f, folder)
    )


def other_files(folder: Path) -> list[Path]:
    """Every file below `folder` that is not taken for a flight, sorted; hidden ones are none."""
    return sorted(
        f for f in folder.rglob("*") if f.is_file() and not is_flight_file(f) and not is_hidden(f, folder)
    )


def _one_each(folder: Path) -> list[Path]:
    """The flights of a folder, one file each."""
    found: dict[Path, Path] = {}
    for file in flight_files(folder):
        known = found.get(file.with_suffix(""))
        if known is None or _rank(file) < _rank(known):
            found[file.with_suffix("")] = file
    if not found:
        raise InputError(f"{folder}: no flights in this folder (known endings: {', '.join(ENDINGS)})")
    return list(found.values())


def _rank(file: Path) -> int:
    suffix = file.suffix.lower()
    return ENDINGS.index(suffix) if suffix in ENDINGS else len(ENDINGS)


def _vehicle_file(flight: Flight) -> Path | None:
    source = Path(flight.vehicle.source)
    return source if source.is_file() else None
