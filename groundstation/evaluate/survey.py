"""A folder of flights as one analysis: every flight diagnosed, then what holds of the fleet.

The flights are spread over processes by Dask, on this machine or on a cluster. A worker reads one file, diagnoses it
and returns one row of a few kilobytes, so that memory does not grow with the folder.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import stats

from trueflight.groundstation.evaluate.history import Flown, History, history_of
from trueflight.groundstation.evaluate.time_left import mixed
from trueflight.groundstation.reading.flight_file import ENDINGS
from trueflight.groundstation.reading.mapping import Given, absolute
from trueflight.groundstation.reading.several import flight_files, other_files
from trueflight.models.errors import InputError
from trueflight.models.outside import is_number
from trueflight.models.whole_file import whole_file

if TYPE_CHECKING:
    from distributed import Client

VERDICTS = ("missing", "possible", "minor", "not_supported", "not_excited", "included")


@dataclass(frozen=True)
class Estimate:
    """A parameter found in one flight, with its 95 % interval."""

    effect: str
    parameter: str
    value: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class Row:
    """One flight of a survey; RMS in m/s². `error` says in one line why it could not be used, and is empty otherwise.

    `day` is the date in the file's name, or else that of the file; `stamp` tells whether the file is still the same.
    """

    file: str
    stamp: str
    day: str
    vehicle: str = ""
    duration: float = 0.0
    rms_before: float | None = None
    rms_after: float | None = None
    noise_floor: float | None = None
    verdicts: dict[str, str] = field(default_factory=dict)
    estimates: tuple[Estimate, ...] = ()
    unexplained: tuple[str, ...] = ()
    seconds: float = 0.0
    error: str = ""

    def named(self, verdict: str) -> list[str]:
        """The effects with this verdict."""
        return [name for name, said in self.verdicts.items() if said == verdict]


@dataclass(frozen=True)
class HowOften:
    """One effect over all flights: counts of verdicts, and the share of the flights that could have shown it in which
    it is missing, with Wilson's 95 % interval (None where no flight could)."""

    effect: str
    counts: dict[str, int]
    share: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Spread:
    """One parameter over the flights that showed it: mean, standard deviation from vehicle to vehicle and from flight
    to flight of one vehicle (the fits' own uncertainty taken out; None where there are too few), and the trend a day
    with its p-value, each vehicle with a level of its own."""

    effect: str
    parameter: str
    unit: str
    flights: int
    vehicles: int
    mean: float
    between_vehicles: float | None
    between_flights: float | None
    uncertainty: float
    trend_per_day: float | None
    trend_p: float | None


@dataclass(frozen=True)
class Fleet:
    """What holds of all flights together; `passed_over` counts the files beside them that are no logs."""

    flights: int
    failed: int
    vehicles: tuple[str, ...]
    clean: int
    unexplained: int
    effects: tuple[HowOften, ...]
    parameters: tuple[Spread, ...]
    histories: tuple[History, ...] = ()
    passed_over: int = 0


def survey_files(folder: Path) -> list[Path]:
    """Every flight file below `folder`, but not what a survey left there; raises `InputError` where there is none."""
    files = [file for file in flight_files(folder) if file.name != SAVED_TABLE]
    if not files:
        raise InputError(f"{folder}: no flights in it; known endings are {', '.join(ENDINGS)}")
    return files


def passed_over(folder: Path, save: Path | None = None) -> list[Path]:
    """The files below `folder` that are taken for no logs: neither by their ending nor, without one, by how they begin.
    Vehicle files, mappings and what a survey left in `save` are not among them."""
    return [
        file
        for file in other_files(folder)
        if not file.name.endswith(BESIDE)
        and not (file.name in SAVED and save is not None and file.parent.samefile(save))
    ]


SAVED_TABLE = "survey.parquet"
SAVED = ("survey.jsonl", SAVED_TABLE, "fleet.json")
BESIDE = ("vehicle.toml", "mapping.toml")


_Task = tuple[str | None, list[str], str | None]


def survey_flight(file: str, vehicle: str | None, mapping: list[str], effects: str | None) -> Row:
    """Diagnose one file from the linear model with exact rotation; whatever goes wrong is told in the row."""
    from trueflight.groundstation.identify.translation import diagnose
    from trueflight.groundstation.reading import read_flight
    from trueflight.models.model import rigid_body_model

    path, begin = Path(file), time.perf_counter()
    row = Row(file, stamp_of(path), _day(path))
    try:
        flight = read_flight(path, vehicle, mapping)
        d = diagnose(flight, rigid_body_model(flight.vehicle, effects))
    except InputError as error:
        return _failed(row, str(error), begin)
    except Exception as error:  # noqa: BLE001 - one bad file must not end an analysis of a thousand
        return _failed(row, f"{path}: {type(error).__name__}: {error}", begin)
    return Row(
        file,
        row.stamp,
        row.day,
        vehicle=flight.vehicle.name,
        duration=flight.duration,
        rms_before=d.rms_before,
        rms_after=d.rms_after,
        noise_floor=d.noise_floor,
        verdicts={e.name: e.verdict for e in d.effects},
        estimates=tuple(
            Estimate(e.name, p.name, p.value, p.low, p.high, p.unit)
            for e in d.effects
            if e.verdict in ("missing", "possible")
            for p in e.parameters
        ),
        unexplained=d.unexplained.where if d.unexplained.verdict else (),
        seconds=time.perf_counter() - begin,
    )


def _failed(row: Row, why: str, begin: float | None = None) -> Row:
    seconds = 0.0 if begin is None else time.perf_counter() - begin
    why = " ".join(why.split()) or "unknown error"
    return Row(row.file, row.stamp, row.day, error=why, seconds=seconds)


def stamp_of(path: Path) -> str:
    """Size and time of a file: another file has another stamp."""
    try:
        status = path.stat()
    except OSError:
        return ""
    return f"{status.st_size}-{status.st_mtime_ns}"


def _day(path: Path) -> str:
    for year, month, day in re.findall(r"(20\d\d)[-_]?(\d\d)[-_]?(\d\d)", path.name):
        try:
            return date(int(year), int(month), int(day)).isoformat()
        except ValueError:
            continue
    try:
        return datetime.fromtimestamp(path.stat().st_mtime, UTC).date().isoformat()
    except OSError:
        return ""


# --- over many processes --------------------------------------------------------------------------------------


def survey(
    files: Sequence[Path],
    vehicle: Path | None = None,
    mapping: Given = None,
    effects: Path | None = None,
    jobs: int = 0,
    memory: str = "auto",
    scheduler: str | None = None,
    ready: Callable[[str], None] = lambda _: None,
) -> Iterator[Row]:
    """Diagnose the files, in the order in which they are done: a mixed one, of which every beginning is like the whole.

    With `jobs` 1 here; otherwise in so many processes of Dask (0: one a core), each held to `memory`, or by the workers
    of the cluster at `scheduler`, which must see the files under the same paths. `ready` is told where one can watch.
    """
    believed, own = (None if p is None else str(p.resolve()) for p in (vehicle, effects))
    task: _Task = (believed, absolute(mapping), own)
    names = [str(f.resolve()) for f in mixed(files)]
    if scheduler is None and (jobs == 1 or len(files) == 1):
        for name in names:
            yield survey_flight(name, *task)
        return
    yield from _by_dask(names, task, jobs, memory, scheduler, ready)


def histories(
    rows: Sequence[Row],
    vehicle: Path | None = None,
    mapping: Given = None,
    effects: Path | None = None,
    jobs: int = 0,
    memory: str = "auto",
    scheduler: str | None = None,
    own: tuple[Sequence[str], Sequence[str]] = ((), ()),
) -> list[History]:
    """The flights of each vehicle that has flown more than once, fitted together, and what has changed; `own` names
    what is each flight's and what is shared against its effect's file. Where and how it is computed as in `survey`."""
    flown: dict[str, list[Flown]] = {}
    for row in rows:
        if not row.error:
            flown.setdefault(row.vehicle, []).append(Flown(row.file, row.day, not row.unexplained))
    several = {name: flights for name, flights in sorted(flown.items()) if len(flights) > 1}
    believed, folder = (None if p is None else str(p.resolve()) for p in (vehicle, effects))
    task = (believed, absolute(mapping), folder, *own)
    if scheduler is None and (jobs == 1 or len(several) < 2):
        return [history_of(name, flights, *task) for name, flights in several.items()]
    with _workers(min(jobs, len(several)), memory, scheduler) as client:
        futures = [client.submit(history_of, n, flights, *task, pure=False) for n, flights in several.items()]
        return [
            f.result()
            if f.exception() is None
            else History(n, error=f"{type(f.exception()).__name__}: its worker did not survive it")
            for n, f in zip(several, futures, strict=True)
        ]


def _by_dask(
    names: list[str],
    task: _Task,
    jobs: int,
    memory: str,
    scheduler: str | None,
    ready: Callable[[str], None],
) -> Iterator[Row]:
    with _workers(jobs, memory, scheduler) as client:
        ready(f"{len(client.scheduler_info()['workers'])} workers")
        yield from _surveyed(client, names, task)


@contextmanager
def _workers(jobs: int, memory: str, scheduler: str | None) -> Iterator[Client]:
    """A client of the scheduler, or of workers on this machine that end with it."""
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError(
            "Dask is not installed; pip install 'trueflight[cluster]', or pass --jobs 1 to do without"
        ) from None
    # the profiler of a worker keeps every stack it has seen
    dask.config.set(
        {"distributed.scheduler.allowed-failures": 1, "distributed.worker.profile.enabled": False}
    )
    cluster = None
    try:
        if scheduler is None:
            cluster = LocalCluster(
                n_workers=jobs or None,
                threads_per_worker=1,
                memory_limit=memory,
                dashboard_address=None,
                silence_logs=50,
            )
            client = Client(cluster)
        else:
            client = Client(scheduler, timeout="15s")
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"--scheduler {scheduler}: no Dask scheduler answers there ({error}); start one with 'dask scheduler' and "
            "workers with 'dask worker'"
        ) from None
    try:
        yield client
    finally:
        client.close()
        if cluster is not None:
            cluster.close()


def _surveyed(client: Client, names: list[str], task: _Task) -> Iterator[Row]:
    """Each flight as it is done; a worker that dies takes along what waited for it: who kills one alone is told, the
    others are not."""
    from distributed import as_completed, wait

    futures = {client.submit(survey_flight, name, *task, pure=False): name for name in names}
    suspects = []
    for done in as_completed(list(futures)):
        name = futures.pop(done)
        if done.status == "finished":
            yield done.result()
        else:
            suspects.append(name)
        done.release()
    for name in suspects:
        alone = client.submit(survey_flight, name, *task, pure=False)
        wait(alone)
        if alone.status == "finished":
            yield alone.result()
        else:
            path, why = Path(name), type(alone.exception()).__name__
            row = Row(name, stamp_of(path), _day(path))
            yield _failed(row, f"{path}: {why}: its worker did not survive it (more --memory may help)")
        alone.release()


# --- the fleet ------------------------------------------------------------------------------------------------


def fleet_of(rows: Sequence[Row], told: Sequence[History] = (), others: int = 0) -> Fleet:
    """What holds of all flights together; `told` are the histories of the vehicles, `others` the files passed over."""
    good = [r for r in rows if not r.error]
    names = list(dict.fromkeys(name for r in good for name in r.verdicts))
    often = [_how_often(name, good) for name in names]
    often.sort(key=lambda h: (-h.counts["missing"], -h.counts["possible"], h.effect))
    keys = list(dict.fromkeys((e.effect, e.parameter) for r in good for e in r.estimates))
    return Fleet(
        flights=len(rows),
        failed=len(rows) - len(good),
        vehicles=tuple(sorted({r.vehicle for r in good})),
        clean=sum(not r.named("missing") and not r.named("possible") and not r.unexplained for r in good),
        unexplained=sum(bool(r.unexplained) for r in good),
        effects=tuple(often),
        parameters=tuple(_spread(effect, parameter, good) for effect, parameter in keys),
        histories=tuple(told),
        passed_over=others,
    )


def _how_often(effect: str, rows: Sequence[Row]) -> HowOften:
    counts = {verdict: sum(r.verdicts.get(effect) == verdict for r in rows) for verdict in VERDICTS}
    could = counts["missing"] + counts["minor"] + counts["not_supported"]
    if could == 0:
        return HowOften(effect, counts, None, None, None)
    interval = stats.binomtest(counts["missing"], could).proportion_ci(method="wilson")
    return HowOften(effect, counts, counts["missing"] / could, float(interval.low), float(interval.high))


def _spread(effect: str, parameter: str, rows: Sequence[Row]) -> Spread:
    """One-way analysis of variance with unequal groups (Searle, Casella & McCulloch 1992, section 3.6)."""
    found = [
        (r.vehicle, r.day, e)
        for r in rows
        for e in r.estimates
        if (e.effect, e.parameter) == (effect, parameter)
    ]
    value = np.array([e.value for *_, e in found])
    error = np.array([(e.high - e.low) / (2 * 1.96) for *_, e in found])
    names, group = np.unique([v for v, *_ in found], return_inverse=True)
    n, g = len(value), len(names)
    size = np.bincount(group)
    mean = np.bincount(group, weights=value) / size
    noise = float(np.mean(error**2))
    within = between = None
    if n > g:
        square = float(np.sum((value - mean[group]) ** 2)) / (n - g)
        within = float(np.sqrt(max(0.0, square - noise)))
        if g > 1:
            among = float(np.sum(size * (mean - value.mean()) ** 2)) / (g - 1)
            typical = (n - float(np.sum(size**2)) / n) / (g - 1)
            between = float(np.sqrt(max(0.0, (among - square) / typical)))
    slope, p = _trend(value, group, [day for _, day, _ in found])
    return Spread(
        effect, parameter, found[0][2].unit, n, g, float(value.mean()), between, within, float(np.sqrt(noise)), slope, p
    )  # fmt: skip


def _trend(value: np.ndarray, group: np.ndarray, days: list[str]) -> tuple[float | None, float | None]:
    """Slope a day and its p-value, each vehicle with a level of its own; None where days or flights are too few."""
    if len(set(days)) < 3 or not all(days):
        return None, None
    t = np.array([date.fromisoformat(d).toordinal() for d in days], dtype=float)
    size = np.bincount(group)
    t = t - (np.bincount(group, weights=t) / size)[group]
    y = value - (np.bincount(group, weights=value) / size)[group]
    freedom = len(value) - len(size) - 1
    if freedom < 3 or np.sum(t**2) == 0.0:
        return None, None
    slope = float(t @ y / (t @ t))
    error = float(np.sqrt(np.sum((y - slope * t) ** 2) / freedom / (t @ t)))
    if error == 0.0:
        return slope, 0.0
    return slope, float(2.0 * stats.t.sf(abs(slope) / error, freedom))


# --- on disk --------------------------------------------------------------------------------------------------


def row_from_table(table: dict[str, Any]) -> Row:
    """A row as `asdict` and JSON wrote it. Raises `KeyError`, `TypeError` or `AttributeError` for any other table."""
    estimates = tuple(Estimate(**e) for e in table["estimates"])
    row = Row(**{**table, "estimates": estimates, "unexplained": tuple(table["unexplained"])})
    texts = (
        row.file,
        row.stamp,
        row.day,
        row.vehicle,
        row.error,
        *row.unexplained,
        *row.verdicts,
        *row.verdicts.values(),
    )
    numbers = [row.duration, row.seconds, *(n for e in estimates for n in (e.value, e.low, e.high))]
    numbers += [n for n in (row.rms_before, row.rms_after, row.noise_floor) if n is not None]
    if not all(
        isinstance(t, str) for t in (*texts, *(t for e in estimates for t in (e.effect, e.parameter, e.unit)))
    ):
        raise TypeError("a text is none")
    if not all(is_number(n) for n in numbers):
        raise TypeError("a number is none")
    return row


def write_table(rows: Sequence[Row], path: Path) -> None:
    """One row a flight as Parquet: verdict_EFFECT, and EFFECT_PARAMETER with _low and _high."""
    import pyarrow as pa
    from pyarrow import parquet

    plain = ("file", "day", "vehicle", "duration", "rms_before", "rms_after", "noise_floor", "error")
    columns: dict[str, list[Any]] = {name: [getattr(r, name) for r in rows] for name in plain}
    columns["unexplained"] = ["; ".join(r.unexplained) for r in rows]
    for effect in dict.fromkeys(name for r in rows for name in r.verdicts):
        columns[f"verdict_{effect}"] = [r.verdicts.get(effect) for r in rows]
    for effect, parameter in dict.fromkeys((e.effect, e.parameter) for r in rows for e in r.estimates):
        found = [{(e.effect, e.parameter): e for e in r.estimates}.get((effect, parameter)) for r in rows]
        for ending, name in (("", "value"), ("_low", "low"), ("_high", "high")):
            columns[f"{effect}_{parameter}{ending}"] = [
                None if e is None else getattr(e, name) for e in found
            ]
    with whole_file(path, "the survey", "pass another --save") as partial:
        parquet.write_table(pa.table(columns), partial)


def row_table(row: Row) -> dict[str, Any]:
    """The JSON of a row."""
    return asdict(row)
