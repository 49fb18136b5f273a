"""A training database flown in-process: every flight of `models.database`, each into its own record."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from trueflight.models.database import Collection, Sortie, database, record_name
from trueflight.models.design import design_to_json
from trueflight.models.errors import InputError
from trueflight.models.record import vehicle_to_toml
from trueflight.models.vehicle import Vehicle
from trueflight.models.workers import interrupts_held, worker_pool
from trueflight.sim_bridge.in_process import Flown, record
from trueflight.sim_bridge.plan import Plan, design_of
from trueflight.sim_bridge.settings import Settings
from trueflight.sim_bridge.truth.battery import BatteryState
from trueflight.sim_bridge.truth.hidden import Hidden, choose


@dataclass(frozen=True)
class Flight:
    """One flight of a collection: `number` from 1, the `sortie`, and the `plan` that flies it."""

    number: int
    sortie: Sortie
    plan: Plan

    @property
    def name(self) -> str:
        """File name of its record."""
        return record_name(self.number, self.sortie)


@dataclass(frozen=True)
class Database:
    """A training database under way: its flights, what is hidden in all of them, and the folder that they fly into."""

    flights: list[Flight]
    hidden: tuple[Hidden, ...]
    collection: Collection

    @property
    def seconds(self) -> float:
        """Flight time of the whole, s."""
        return sum(flight.sortie.path.duration for flight in self.flights)

    @property
    def flown_seconds(self) -> float:
        """Flight time that the folder has already, s."""
        return float(sum(entry["seconds"] for entry in self.collection.flown.values()))

    def entries(self) -> list[dict[str, Any]]:
        """What is known of each flight, once all have flown."""
        return [self.collection.flown[flight.name] for flight in self.flights]

    def fly(self, jobs: int) -> Iterator[tuple[Flight, dict[str, Any]]]:
        """Fly what is missing, as `collect` does."""
        return collect(self.flights, self.collection, jobs)


def begin(
    folder: Path, settings: Settings, vehicle: Vehicle, minutes: float, rate: float, model: bytes | None
) -> Database:
    """Begin a database of at least so many minutes in a folder, or continue it. Raises `InputError`, and writes nothing
    then, for what cannot be flown and for a folder that holds something else.
    """
    sorties = database(settings.seed, minutes)
    plan = Plan(
        vehicle,
        design_of(settings, vehicle),
        sorties[0].path,
        choose(list(settings.hidden), vehicle, settings.seed, settings.hidden_count),
        settings.seed,
        rate=rate,
        model=model,
        noise=settings.sensor_noise,
        battery=settings.battery,
    )
    _ = plan.steps_per_tick  # a rate that cannot be flown is told before anything is written
    asked = {"hidden": settings.hidden, "seed": settings.seed, "minutes": minutes, "rate": rate}
    asked |= {"noise": settings.noise, "battery_age": settings.battery_age, "fingerprint": fingerprint(plan)}
    collection = Collection(folder, {"flown_by": "sim-bridge collect", "vehicle": vehicle.name, **asked})
    return Database(flights(sorties, plan), plan.hidden, collection)


def flights(sorties: Sequence[Sortie], plan: Plan) -> list[Flight]:
    """The sorties as `plan` flies them: same vehicle, design, truth and model; own battery charge and own noise."""
    return [
        Flight(
            number,
            sortie,
            replace(
                plan,
                trajectory=sortie.path,
                # Far apart, so that two collections of neighbouring seeds share no noise.
                seed=1_000_003 * (plan.seed + 1) + number,
                battery=BatteryState(sortie.charge, plan.battery.age),
            ),
        )
        for number, sortie in enumerate(sorties, 1)
    ]


def fingerprint(plan: Plan) -> str:
    """A hash of all that the records of a collection depend on beside seed and missions."""
    told = (
        vehicle_to_toml(plan.vehicle),
        design_to_json(plan.design),
        repr((plan.hidden, plan.noise, plan.rate, plan.battery.age)),
    )
    return hashlib.sha256("\n".join(told).encode() + (plan.model or b"")).hexdigest()[:16]


def collect(
    wanted: Sequence[Flight], collection: Collection, jobs: int
) -> Iterator[tuple[Flight, dict[str, Any]]]:
    """Fly what the collection lacks, in `jobs` processes; yields each flight with its entry once its record is whole.

    A record depends on its flight alone: not on `jobs`, the order of ending, or earlier interruptions. When the
    generator is closed or interrupted, flights under way are finished and kept, and the rest is not begun.
    """
    missing = [flight for flight in wanted if flight.name not in collection.flown]
    if not missing:
        return
    under_way: dict[Future[Flown], Flight] = {}
    try:
        with worker_pool(max(1, min(jobs, len(missing)))) as pool:
            with interrupts_held():
                under_way.update({pool.submit(_fly, flight, collection.folder): flight for flight in missing})
            for done in as_completed(list(under_way)):
                flight = under_way.pop(done)
                yield flight, _kept(collection, flight, done.result())
    except BrokenProcessPool:
        raise InputError(
            f"{collection.folder}: a process was ended from outside (out of memory?); the same command continues, with "
            "fewer --jobs if need be"
        ) from None
    finally:
        for late, flight in under_way.items():
            if late.done() and not late.cancelled() and late.exception() is None:
                _kept(collection, flight, late.result())


def _fly(flight: Flight, folder: Path) -> Flown:
    """Fly one into its record, which has its name only when it is whole."""
    target = folder / flight.name
    target.unlink(missing_ok=True)  # of a run that was killed before it could enter the record
    return record(flight.plan, target)


def _kept(collection: Collection, flight: Flight, flown: Flown) -> dict[str, Any]:
    entry = {
        "trajectory": flight.sortie.trajectory,
        "parameters": flight.sortie.parameters,
        "charge": flight.sortie.charge,
        "outcome": flown.outcome,
        "seconds": flown.simulated,
        "ticks": flown.ticks,
        "ticks_on_ground": flown.touching,
        "rms_error": list(flown.rms_error),
    }
    collection.add(flight.name, entry)
    return entry
