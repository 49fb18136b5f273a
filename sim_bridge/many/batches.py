"""Many flights into a folder of records, in batches over processes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from itertools import groupby
from math import ceil
from pathlib import Path

from trueflight.models.errors import InputError
from trueflight.models.workers import interrupts_held, worker_pool
from trueflight.sim_bridge.in_process import Flown, record
from trueflight.sim_bridge.many.records import record_many
from trueflight.sim_bridge.many.variations import Variation
from trueflight.sim_bridge.plan import Plan, legs_of

AT_ONCE = 256
"""Flights of one batch at most: they have half a megabyte each, and more of them at once are hardly faster."""
WORTH_IT = 24
"""Flights from which on arrays are faster than one flight after the other."""


def seconds_of(plan: Plan) -> float:
    """Length of a flight, s."""
    return plan.settle + sum(leg.duration for leg in legs_of(plan))


def batched(flights: Sequence[Variation], jobs: int) -> list[list[Variation]]:
    """The flights in batches of one rate and of similar length, for so many processes; the longest first.

    A batch goes on until its longest flight has ended, and fewer under way take as long as many.
    """
    order = sorted(flights, key=lambda one: (one.plan.rate, -seconds_of(one.plan)))
    batches = []
    for _, same in groupby(order, key=lambda one: one.plan.rate):
        these = list(same)
        parts = max(ceil(len(these) / AT_ONCE), min(jobs, ceil(len(these) / WORTH_IT)))
        size = ceil(len(these) / parts)
        batches += [these[i : i + size] for i in range(0, len(these), size)]
    return batches


def record_all(flights: Sequence[Variation], folder: Path, jobs: int) -> Iterator[tuple[Variation, Flown]]:
    """Fly all into `folder`/NAME.mcap, batch by batch in `jobs` processes; yields each with how it went, once its batch
    is over. Raises `InputError` where a record is there already, before any is flown, or cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for flight in flights:
        if path_of(folder, flight).exists():
            raise InputError(
                f"{path_of(folder, flight)}: is there already and is never overwritten; choose another -o"
            )
    batches = batched(flights, jobs)
    if min(jobs, len(batches)) == 1:
        for batch in batches:
            yield from zip(batch, _fly(batch, folder), strict=True)
        return
    try:
        with worker_pool(min(jobs, len(batches))) as pool:
            with interrupts_held():
                begun = {pool.submit(_fly, batch, folder): batch for batch in batches}
            for done in as_completed(begun):
                yield from zip(begun[done], done.result(), strict=True)
    except BrokenProcessPool:
        raise InputError(
            f"{folder}: a process was ended from outside (out of memory?); fly with fewer --jobs"
        ) from None


def path_of(folder: Path, flight: Variation) -> Path:
    """Where its record goes."""
    return folder / f"{flight.name}.mcap"


def _fly(batch: Sequence[Variation], folder: Path) -> list[Flown]:
    plans, paths = [one.plan for one in batch], [path_of(folder, one) for one in batch]
    if len(batch) < WORTH_IT:
        return [record(plan, path) for plan, path in zip(plans, paths, strict=True)]
    return record_many(plans, paths)
