"""The training database: which flights teach a model what a vehicle does, and the folder that collects them.

Translations in several planes, steps in all directions, rotations, spirals, circles, lemniscates, low passes and the
excitation survey, each with sizes, speeds, heights and headings of its own, on batteries from full to nearly empty,
as in section V of Carvalho et al., ICUAS 2022. The step-and-translation `scenario` and the lemniscate 15 cm above
ground are never in it: models are judged by them.
"""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from trueflight.models.errors import InputError
from trueflight.models.outside import read_text
from trueflight.models.reference import trajectory
from trueflight.models.trajectory import Trajectory
from trueflight.models.whole_file import write_whole

MINUTES = 30.0
"""Flight time of a database unless told otherwise, as in the paper."""
FULLEST, EMPTIEST, EMPTIEST_LOW = 0.97, 0.35, 0.5
"""Charges that flights begin with. A cascade without integral sinks on a weak battery, so that what flies low begins
with half of it."""

Parameters = dict[str, float | str]


@dataclass(frozen=True)
class Sortie:
    """One flight of a database: a named trajectory with its parameters, and the battery's state of charge (0 to 1)
    at its start, where whoever flies it can choose that.
    """

    trajectory: str
    parameters: Parameters
    charge: float

    @cached_property
    def path(self) -> Trajectory:
        """The reference to fly."""
        return trajectory(self.trajectory, **self.parameters)


def _translation(draw: random.Random, plane: str) -> Parameters:
    upright = "z" in plane
    return {
        "plane": plane,
        "size": draw.uniform(0.6, 1.8) if upright else draw.uniform(0.8, 3.0),
        "speed": draw.uniform(0.8, 2.5) if upright else draw.uniform(0.8, 3.5),
        "height": draw.uniform(0.5, 1.0) if upright else draw.uniform(0.5, 2.0),
        "yaw": draw.uniform(-math.pi, math.pi),
    }


def _steps(draw: random.Random) -> Parameters:
    return {
        "size": draw.uniform(0.4, 1.2),
        "height": draw.uniform(1.2, 2.0),
        "time": draw.uniform(1.5, 3.0),
        "count": 6.0,
        "yaw": draw.uniform(-math.pi, math.pi),
        "seed": float(draw.randrange(10**6)),
    }


def _rotation(draw: random.Random) -> Parameters:
    return {
        "angle": draw.choice((-1.0, 1.0)) * draw.uniform(0.5 * math.pi, 2.0 * math.pi),
        "rate": draw.uniform(0.8, 2.0),
        "height": draw.uniform(0.4, 1.6),
    }


def _spiral(draw: random.Random) -> Parameters:
    return {
        "radius": draw.uniform(0.8, 1.8),
        "speed": draw.uniform(0.8, 2.8),
        "height": draw.uniform(0.4, 1.0),
        "climb": draw.uniform(0.3, 1.2),
        "laps": 2.0,
        "yaw": draw.uniform(-math.pi, math.pi),
    }


def _circle(draw: random.Random) -> Parameters:
    return {
        "radius": draw.uniform(0.8, 2.0),
        "speed": draw.uniform(1.0, 3.5),
        "height": draw.uniform(0.25, 1.5),
        "laps": 2.0,
        "yaw": draw.uniform(-math.pi, math.pi),
    }


def _lemniscate(draw: random.Random) -> Parameters:
    return {
        "width": draw.uniform(2.5, 4.5),
        "depth": draw.uniform(1.0, 2.5),
        "speed": draw.uniform(1.0, 3.5),
        "height": draw.uniform(0.25, 1.6),
        "laps": 2.0,
        "yaw": draw.uniform(-math.pi, math.pi),
    }


def _low_pass(draw: random.Random) -> Parameters:
    return {
        "low": draw.uniform(0.1, 0.35),
        "length": draw.uniform(2.0, 4.0),
        "speed": draw.uniform(0.8, 3.0),
        "height": draw.uniform(0.6, 1.2),
        "passes": 4.0,
        "yaw": draw.uniform(-math.pi, math.pi),
    }


def _excitation(draw: random.Random) -> Parameters:
    return {"low": draw.uniform(0.15, 0.4), "speed": draw.uniform(2.5, 4.5), "height": draw.uniform(1.2, 1.7)}


_ROUND: tuple[tuple[str, Callable[[random.Random], Parameters]], ...] = (
    ("translation", lambda draw: _translation(draw, "xy")),
    ("translation", lambda draw: _translation(draw, "xz")),
    ("translation", lambda draw: _translation(draw, "yz")),
    ("steps", _steps),
    ("rotation", _rotation),
    ("spiral", _spiral),
    ("circle", _circle),
    ("lemniscate", _lemniscate),
    ("low_pass", _low_pass),
    ("excitation", _excitation),
)
"""One of each, in less than four minutes; a database is as many rounds, each with sizes and an order of its own."""
_LOW = ("low_pass", "excitation", "circle", "lemniscate")


def database(seed: int, minutes: float = MINUTES) -> tuple[Sortie, ...]:
    """The flights of a database with at least `minutes` of flight, at most one flight more; the same for the same
    seed. Within each round the battery is anything between full and nearly empty, evenly.

    Raises `InputError` for a time without sense.
    """
    if not 0.1 <= minutes <= 1000.0:
        raise InputError(f"--minutes {minutes:g}: must be 0.1 to 1000")
    draw = random.Random(f"database {seed}")
    out: list[Sortie] = []
    flown = 0.0
    while True:
        families = draw.sample(_ROUND, len(_ROUND))
        shares = [(i + draw.random()) / len(_ROUND) for i in draw.sample(range(len(_ROUND)), len(_ROUND))]
        for (name, parameters), share in zip(families, shares, strict=True):
            least = EMPTIEST_LOW if name in _LOW else EMPTIEST
            rounded = {
                key: value if isinstance(value, str) else round(value, 4)
                for key, value in parameters(draw).items()
            }
            sortie = Sortie(name, rounded, round(least + (FULLEST - least) * share, 3))
            out.append(sortie)
            flown += sortie.path.duration
            if flown >= 60.0 * minutes:
                return tuple(out)


INDEX = "collection.json"


class Collection:
    """A folder of flight records with an index that tells what was asked and what has been flown.

    `settings` is everything that the flights depend on. A folder that was begun with the same settings is continued;
    `flown` maps the names of its whole records to what is known of them. Raises `InputError` for a folder that holds
    anything else, or was begun with other settings.
    """

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        self.folder = folder
        self.settings: dict[str, Any] = json.loads(json.dumps(settings))
        self.flown: dict[str, dict[str, Any]] = {}
        index = folder / INDEX
        try:
            if index.exists():
                self._continue(index)
            elif folder.exists() and any(not p.name.startswith(".") for p in folder.iterdir()):
                raise InputError(f"{folder}: not empty, and no collection; choose another folder with -o")
            folder.mkdir(parents=True, exist_ok=True)
            self._write()
        except OSError as error:
            raise InputError(f"{folder}: cannot collect flights there ({error.strerror})") from None

    def _continue(self, index: Path) -> None:
        try:
            text = read_text(index, "the index of a collection", "choose another folder with -o")
            if not text:  # of an earlier version that was killed at its start
                return
            found = json.loads(text)
            before, flights = dict(found["settings"]), dict(found["flights"])
        except (ValueError, KeyError, TypeError, RecursionError):
            raise InputError(
                f"{index}: not the index of a collection; choose another folder with -o"
            ) from None
        for key in [*self.settings, *before]:
            if before.get(key) != self.settings.get(key):
                raise InputError(
                    f"{self.folder}: begun with {key} {before.get(key)}, now {self.settings.get(key)}; "
                    "continue with the same settings, or choose another folder with -o"
                )
        self.flown = {name: entry for name, entry in flights.items() if (self.folder / name).is_file()}

    def add(self, record: str, entry: dict[str, Any]) -> None:
        """Enter a record of the folder."""
        self.flown[record] = entry
        self._write()

    def _write(self) -> None:
        index = {"settings": self.settings, "flights": dict(sorted(self.flown.items()))}
        write_whole(self.folder / INDEX, json.dumps(index, indent=1) + "\n", "the index of the collection")


def record_name(number: int, sortie: Sortie) -> str:
    """File name of a database's flight, the `sortie` with this `number`; names sort in the order of flying."""
    return f"{number:03d}-{sortie.trajectory}.mcap"
