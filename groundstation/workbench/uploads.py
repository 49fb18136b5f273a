"""Files that are dropped on the page: stored under numbers of ours, whatever they are called."""

from __future__ import annotations

import unicodedata
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from trueflight.groundstation.reading.flight_file import ENDINGS
from trueflight.models.errors import InputError

MOST_BYTES = 2_048_000_000
"""Of one file."""
MOST_NAME = 120
SIDECARS = ("vehicle.toml", "mapping.toml")
"""Files that go with a flight, by how their names end."""


@dataclass(frozen=True)
class Dropped:
    """A file as it came: `name` is what its owner calls it, with the folders in which it was dropped."""

    name: str
    path: Path


def shown_name(name: str) -> str:
    """A name as it may be shown: printable, its folders before it, no longer than can be read."""
    clean = "".join(c for c in unicodedata.normalize("NFC", name) if c.isprintable()).replace("\\", "/")
    parts = [part for part in clean.split("/") if part not in ("", ".", "..")]
    return "/".join(parts)[-MOST_NAME:] or "flight"


def ending(name: str) -> str:
    """The ending under which a file of this name is stored. Raises `InputError` for one that is no flight's, nor goes
    with one."""
    low = name.lower()
    for sidecar in SIDECARS:
        if low.endswith(sidecar):
            return f".{sidecar}"
    suffix = PurePosixPath(low).suffix
    if suffix in ENDINGS:
        return suffix
    if not suffix:
        return ""  # a Crazyflie's card: told by how it begins
    raise InputError(
        f"{shown_name(name)}: '{suffix[:12]}' is no kind of flight file; known are {', '.join(ENDINGS)} and the logs "
        "of a Crazyflie's card"
    )


async def store(name: str, body: AsyncIterator[bytes], folder: Path, most: int = MOST_BYTES) -> Dropped:
    """Write a file as it comes in, under the next number in `folder`. Raises `InputError` for one that is too large,
    or no flight's; nothing of it is left then."""
    suffix = ending(name)
    folder.mkdir(parents=True, exist_ok=True)
    number = 1 + max((int(p.name[:4]) for p in folder.iterdir() if p.name[:4].isdecimal()), default=0)
    path = folder / f"{number:04d}{suffix}"
    size = 0
    try:
        with path.open("xb") as file:
            async for piece in body:
                size += len(piece)
                if size > most:
                    raise too_large(name, most)
                file.write(piece)
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return Dropped(shown_name(name), path)


def beside(flight: Dropped, all_of_them: list[Dropped], kind: str) -> Path | None:
    """The file of `kind` ("vehicle.toml") that goes with a flight among those dropped together: of `NAME.kind` in the
    flight's folder the one with the longest NAME that the flight's name starts with, otherwise `kind` alone."""
    folder, _, own = flight.name.rpartition("/")
    named: Mapping[str, Path] = {
        d.name.rpartition("/")[2]: d.path for d in all_of_them if d.name.rpartition("/")[0] == folder
    }
    fitting = [n for n in named if n.endswith(f".{kind}") and own.startswith(n.removesuffix(f".{kind}"))]
    if fitting:
        return named[max(fitting, key=len)]
    return named.get(kind)


def too_large(name: str, most: int) -> InputError:
    """The error of a file that is larger than `most` bytes."""
    return InputError(
        f"{shown_name(name)}: larger than {most / 1e6:.0f} MB, the most that is taken; open it in the terminal, which "
        "does not copy it: groundstation open FILE"
    )
