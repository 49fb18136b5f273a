"""What the page asks of the worker process, and what comes back: plain data that travels between the two."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

START = "linear"
"""The model that a line of versions begins with, as `--model` names it."""


@dataclass(frozen=True)
class Source:
    """A flight's file with what goes with it; `name` is what people call it."""

    path: Path
    name: str
    vehicle: Path | None = None
    mapping: Path | None = None


@dataclass(frozen=True)
class Read:
    """Read a flight, and tell what it is and which versions `store` has of its vehicle; where it has no vehicle file,
    draft one."""

    flight: Source
    store: Path
    title: str = "reading the flight"
    steps: int = 1

    def command(self) -> str:
        """The command line that does the same."""
        words = ["groundstation", "import", str(self.flight.path)]
        return _joined([*words, "--check", *_reading(self.flight)])


@dataclass(frozen=True)
class Subject:
    """What is asked about: a flight, another held out of every fit, the folder of versions, and the version at which
    the page stands (`START`, "v1", ...)."""

    flight: Source
    held_out: Source | None
    store: Path
    model: str
    results: Path

    def options(self) -> list[str]:
        """The options of a command that asks about it."""
        words = _reading(self.flight)
        if self.held_out is not None:
            words += ["--validate", str(self.held_out.path)]
        return [*words, "--store", str(self.store), "--model", self.model]


@dataclass(frozen=True)
class Diagnose:
    """Compare, see where the model fails, and what is missing from it."""

    about: Subject
    title: str = "comparing and looking for what is missing"
    steps: int = 4

    def command(self) -> str:
        """The command line that does the same."""
        return _joined(["groundstation", "diagnose", str(self.about.flight.path), *self.about.options()])


@dataclass(frozen=True)
class Add:
    """Add effects to the model, refitted, as a new version; then ask again what is missing."""

    about: Subject
    effects: tuple[str, ...]
    steps: int = 6

    @property
    def title(self) -> str:
        """What is being done."""
        return f"adding {' and '.join(self.effects)}"

    def command(self) -> str:
        """The command line that does the same."""
        about = self.about
        words = ["groundstation", "model", "add", *self.effects, "--flight", str(about.flight.path)]
        return _joined([*words, *about.options()])


@dataclass(frozen=True)
class Beside:
    """Flights, or versions on one flight, side by side."""

    flights: tuple[Source, ...]
    models: tuple[str, ...]
    store: Path
    results: Path
    title: str = "comparing side by side"
    steps: int = 2

    def command(self) -> str:
        """The command line that does the same."""
        words = ["groundstation", "compare", *(str(f.path) for f in self.flights)]
        models = [word for model in self.models for word in ("--model", model)]
        return _joined([*words, *_reading(self.flights[0]), "--store", str(self.store), *models])


@dataclass(frozen=True)
class Plan:
    """The short flight that would tell apart what is still open, or the effects named in `between`."""

    about: Subject
    between: tuple[str, ...] = ()
    title: str = "planning the flight that would tell"
    steps: int = 2

    def command(self) -> str:
        """The command line that does the same."""
        about = self.about
        words = ["groundstation", "plan-flight", str(about.flight.path)]
        words += [word for name in self.between for word in ("--between", name)]
        words += [*_reading(about.flight), "--store", str(about.store), "--model", about.model]
        return _joined([*words, "-o", str(about.results / "plan.csv")])


Task = Read | Diagnose | Add | Beside | Plan


@dataclass(frozen=True)
class Part:
    """A part of an answer: `table` is what `--json` prints of it, `charts` its drawings as SVG, `files` what was
    written for it, `more` what the page needs beside."""

    name: str
    table: Mapping[str, Any]
    charts: Mapping[str, str | None] = field(default_factory=dict)
    files: Mapping[str, Path] = field(default_factory=dict)
    more: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Step:
    """The worker has come to step `number` and does `text`."""

    number: int
    text: str


@dataclass(frozen=True)
class Ended:
    """The task has ended: well, or for the reason in `problem`."""

    problem: str = ""


Message = Step | Part | Ended


def _reading(source: Source) -> list[str]:
    words = [] if source.vehicle is None else ["--vehicle", str(source.vehicle)]
    return words if source.mapping is None else [*words, "--mapping", str(source.mapping)]


def _joined(words: list[str]) -> str:
    return shlex.join(words)
