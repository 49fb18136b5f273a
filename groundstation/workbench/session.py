"""What the page shows, whoever looks: one state for every tab, changed by what is asked and by what the worker says."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from trueflight.groundstation.workbench.tasks import (
    START,
    Add,
    Beside,
    Diagnose,
    Ended,
    Message,
    Part,
    Plan,
    Read,
    Source,
    Step,
    Subject,
    Task,
)
from trueflight.groundstation.workbench.vehicle_form import Field, filled, form_of, write_vehicle
from trueflight.groundstation.workbench.worker import Worker
from trueflight.models.errors import InputError

PANELS = ("job", "flights", "vehicle", "compare", "where", "missing", "falls", "beside", "plan")


@dataclass(frozen=True)
class Entry:
    """A flight on the page. `facts` is what reading it told, None before; `form` its vehicle, None before; `problem`
    why it cannot be used, `versions` those of its vehicle that were there when it was read, as `--json` prints them."""

    number: int
    source: Source
    facts: Mapping[str, Any] | None = None
    form: tuple[Field, ...] | None = None
    problem: str = ""
    versions: tuple[Mapping[str, Any], ...] = ()

    @property
    def ready(self) -> bool:
        """Whether it has been read, with its vehicle."""
        return self.facts is not None


@dataclass(frozen=True)
class Job:
    """What the worker is doing: at `step` of the task's steps, for the sake of the flight `entry` where it reads."""

    task: Task
    number: int
    started: float
    step: int = 0
    text: str = ""
    entry: int = 0


@dataclass(frozen=True)
class State:
    """All that the page shows. `at` is the version at which it stands; `parts` what is known by version and name;
    `versions` those of the vehicle, as `--json` prints them; `last` the command of the last action."""

    entries: tuple[Entry, ...] = ()
    fitted: int = 0
    held_out: int = 0
    at: str = START
    versions: tuple[Mapping[str, Any], ...] = ()
    parts: Mapping[tuple[str, str], Part] = field(default_factory=dict)
    job: Job | None = None
    waiting: tuple[int, ...] = ()
    problem: str = ""
    last: str = ""

    def entry(self, number: int) -> Entry | None:
        """The flight of this number, None where there is none."""
        return next((e for e in self.entries if e.number == number), None)

    def version(self, label: str) -> Mapping[str, Any] | None:
        """A version by its label ("v1"), None where there is none."""
        return next((v for v in self.versions if f"v{v['version']}" == label), None)

    def part(self, name: str, at: str | None = None) -> Part | None:
        """A part of what is known, at the version of the page or another."""
        return self.parts.get((self.at if at is None else at, name))


class Session:
    """The state, the worker, and whoever listens: each change is told with the panels that it touches.

    Everything runs on the thread of the server.
    """

    def __init__(self, folder: Path, store: Path, changed: Callable[[Iterable[str]], None]) -> None:
        self.folder, self.store = folder, store
        self.state = State()
        self.revisions = dict.fromkeys(PANELS, 0)
        self._changed = changed
        self._worker: Worker | None = None
        self._numbers = 0
        self._to_hold_out = 0
        self._unasked = False  # whether the fitted flight is still to be compared and diagnosed

    def open(self, hand_over: Callable[[Callable[[], None]], None]) -> None:
        """Start the worker; `hand_over` runs a function on the thread of the server."""
        self._worker = Worker(lambda number, message: hand_over(lambda: self._heard(number, message)))

    def close(self) -> None:
        """End the worker."""
        if self._worker is not None:
            self._worker.close()

    def labels(self) -> list[str]:
        """The versions of the vehicle by their labels, the oldest first."""
        return [f"v{v['version']}" for v in self.state.versions]

    # --- what is asked ------------------------------------------------------------------------------------------

    def add_flight(self, source: Source, held_out: bool = False) -> int:
        """A flight comes, `held_out` of every fit or not; it is read as soon as the worker is free. Its number."""
        self._numbers += 1
        number = self._numbers
        entry = Entry(number, source)
        if held_out:
            self._to_hold_out = number
        self._set(("flights",), entries=(*self.state.entries, entry), waiting=(*self.state.waiting, number))
        self._next()
        return number

    def remove_flight(self, number: int) -> None:
        """Take a flight off the page; its file stays."""
        state = self.state
        if self._reading(number):
            self.cancel()
        rest = tuple(e for e in state.entries if e.number != number)
        waiting = tuple(n for n in state.waiting if n != number)
        if number in (state.fitted, state.held_out):
            self._forget()
        self._set(
            PANELS, entries=rest, waiting=waiting,
            fitted=0 if number == state.fitted else state.fitted,
            held_out=0 if number == state.held_out else state.held_out,
        )  # fmt: skip

    def choose(self, fitted: int, held_out: int) -> None:
        """Which flight the model is fitted to, and which is held out of every fit (0: none); then it is asked what is
        missing."""
        one = self.state.entry(fitted)
        if one is None or not one.ready:
            raise InputError("choose a flight that has been read, with its vehicle")
        other = self.state.entry(held_out)
        if held_out and (other is None or not other.ready or held_out == fitted):
            raise InputError("the held-out flight has to be another one that has been read")
        self._free()
        self._forget()
        self._fit_to(one, held_out)
        self.diagnose()

    def set_vehicle(self, number: int, texts: Mapping[str, str]) -> bool:
        """Take the vehicle of a flight as its owner filled it in; False where a value cannot be taken, which then
        stands beside it."""
        entry = self.state.entry(number)
        if entry is None or entry.form is None:
            raise InputError("there is no such flight on this page any more")
        form, vehicle = filled(entry.form, texts)
        if vehicle is None:
            self._replace(replace(entry, form=form), ("vehicle",))
            return False
        self._free()
        path = self.folder / "vehicles" / f"{number:03d}.vehicle.toml"
        write_vehicle(form, path, entry.source.name)
        source = replace(entry.source, vehicle=path)
        if number in (self.state.fitted, self.state.held_out):
            self._forget()
            self._set(PANELS, fitted=0 if number == self.state.fitted else self.state.fitted)
        self._replace(Entry(number, source, form=form), ("vehicle", "flights"))
        self._set((), waiting=(*self.state.waiting, number))
        self._next()
        return True

    def diagnose(self) -> None:
        """Compare, see where, and what is missing, from the version at which the page stands."""
        self._unasked = False
        self._begin(Diagnose(self._subject()))

    def add(self, effects: Sequence[str]) -> None:
        """Add effects to the model at which the page stands."""
        if not effects:
            raise InputError("name the effects to add")
        self._begin(Add(self._subject(), tuple(effects)))

    def stand_at(self, version: str) -> None:
        """Go to another version: undo, or back again. What is known of it is shown at once."""
        self._free()
        if version != START and self.state.version(version) is None:
            raise InputError(f"there is no version {version} on this page")
        self._set(PANELS, at=version, last=self._select(version))
        if self.state.part("diagnosed") is None:
            self.diagnose()

    def beside(self, flights: Sequence[int], models: Sequence[str]) -> None:
        """Two flights, or versions on the fitted one, side by side."""
        entries = [e for n in flights if (e := self.state.entry(n)) is not None and e.ready]
        if len(entries) * len(models) < 2:
            raise InputError("choose two flights, or two versions")
        sources = tuple(e.source for e in entries)
        self._begin(Beside(sources, tuple(models), self.store, self.folder / "results"))

    def plan(self, between: Sequence[str] = ()) -> None:
        """The flight that would tell what is open."""
        self._begin(Plan(self._subject(), tuple(between)))

    def cancel(self) -> None:
        """End what the worker does; what was known before stays."""
        job = self.state.job
        if job is None or self._worker is None:
            return
        self._worker.cancel()
        self._set(("job", "flights", "missing"), job=None, problem=f"cancelled: {job.task.title}")
        self._next()

    # --- what the worker says -------------------------------------------------------------------------------------

    def _heard(self, number: int, message: Message) -> None:
        job = self.state.job
        if job is None or job.number != number:
            return  # cancelled
        match message:
            case Step():
                self._set(("progress",), job=replace(job, step=message.number, text=message.text))
            case Part():
                self._take(job, message)
            case Ended():
                kept = self.state.problem if isinstance(job.task, Read) else ""
                self._set(PANELS, job=None, problem=message.problem or kept)
                if message.problem and isinstance(job.task, Read):
                    entry = self.state.entry(job.entry)
                    if entry is not None:
                        self._replace(replace(entry, problem=message.problem), ("flights", "vehicle"))
                        self._set(("job",), problem=kept)
                self._next()

    def _take(self, job: Job, part: Part) -> None:
        match part.name:
            case "draft" | "read":
                self._take_reading(job.entry, part)
            case "added":
                made = f"v{part.table['version']}"
                parts = {**self.state.parts, (made, "added"): part}
                self._set(PANELS, at=made, versions=(*self.state.versions, part.table), parts=parts)
            case "beside" | "plan":
                self._set((part.name,), parts={**self.state.parts, ("", part.name): part})
            case _:
                self._set(PANELS, parts={**self.state.parts, (self.state.at, part.name): part})

    def _take_reading(self, number: int, part: Part) -> None:
        entry = self.state.entry(number)
        if entry is None:
            return
        if part.name == "draft":
            entry = replace(entry, form=part.more["form"], problem="")
        else:
            entry = replace(entry, facts=part.table, problem="", versions=tuple(part.more["versions"]))
            if entry.form is None:
                entry = replace(entry, form=form_of(part.more["vehicle"]))
        self._replace(entry, ("flights", "vehicle"))
        if entry.ready and number == self._to_hold_out:
            self._set(PANELS, held_out=number)
        elif entry.ready and not self.state.fitted:
            self._fit_to(entry, self.state.held_out)

    # --- one after the other --------------------------------------------------------------------------------------

    def _next(self) -> None:
        """Ask what is missing from the flight that was chosen; then read the next that waits."""
        state = self.state
        if state.job is not None:
            return
        first = self._to_hold_out if self._to_hold_out in state.waiting and state.fitted else 0
        if self._unasked and not first:
            self.diagnose()
            return
        for number in (first, *state.waiting) if first else state.waiting:
            entry = state.entry(number)
            self._set((), waiting=tuple(n for n in self.state.waiting if n != number))
            if entry is not None:
                self._begin(Read(entry.source, self.store), number)
                return

    def _begin(self, task: Task, entry: int = 0) -> None:
        self._free()
        assert self._worker is not None
        self._unasked = self._unasked and isinstance(task, Read)
        job = Job(task, self._worker.ask(task), time.monotonic(), entry=entry)
        told = self.state.last if isinstance(task, Read) else task.command()
        problem = self.state.problem if isinstance(task, Read) else ""
        self._set(PANELS, job=job, problem=problem, last=told)

    def _free(self) -> None:
        """The worker is to be free: a flight that is being read waits again, anything else is in the way."""
        job = self.state.job
        if job is None:
            return
        if not isinstance(job.task, Read) or self._worker is None:
            raise InputError(f"busy {job.task.title}; cancel it first, or wait")
        self._worker.cancel()
        self._set((), job=None, waiting=(job.entry, *self.state.waiting))

    def _reading(self, number: int) -> bool:
        return self.state.job is not None and self.state.job.entry == number

    def _subject(self) -> Subject:
        state = self.state
        fitted = state.entry(state.fitted)
        if fitted is None or not fitted.ready:
            raise InputError("drop a flight first, and say what its vehicle is")
        held_out = state.entry(state.held_out)
        return Subject(
            fitted.source,
            None if held_out is None else held_out.source,
            self.store,
            state.at,
            self.folder / "results",
        )

    def _select(self, version: str) -> str:
        return replace(Diagnose(self._subject()), about=replace(self._subject(), model=version)).command()

    def _forget(self) -> None:
        """What was known of a flight is not known of another."""
        self._set((), at=START, versions=(), parts={})

    def _fit_to(self, entry: Entry, held_out: int = 0) -> None:
        """The model is fitted to this flight, from the newest version of its vehicle, as the commands do."""
        self._unasked = True
        newest = f"v{entry.versions[-1]['version']}" if entry.versions else START
        self._set(PANELS, fitted=entry.number, held_out=held_out, at=newest, versions=entry.versions)

    def _replace(self, entry: Entry, panels: Sequence[str]) -> None:
        entries = tuple(entry if e.number == entry.number else e for e in self.state.entries)
        self._set(panels, entries=entries)

    def _set(self, panels: Sequence[str], **changes: Any) -> None:
        self.state = replace(self.state, **changes)
        for name in panels:
            if name in self.revisions:
                self.revisions[name] += 1
        if panels:
            self._changed(panels)
