"""The flights of one vehicle as its history: fitted together, and what has changed since.

A survey diagnoses every flight alone; here the flights of each vehicle, the newest at most `NEWEST`, are fitted
together: what is the vehicle's is one number for all of them, unless they differ. What differs in the newest flight is
told with the last good flight in which it was otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from trueflight.groundstation.results import Diagnosis, ParameterEstimate, SharedNumber
from trueflight.models.effect import Parameter
from trueflight.models.effects import effect_named
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight

NEWEST = 12
"""Flights of a vehicle that are fitted together."""
SECONDS = 100.0
"""s of each flight that are looked at, in parts of it: memory does not grow with their length."""


@dataclass(frozen=True)
class Change:
    """A number of a vehicle that is not what it was: `before` in the flight `last`, `after` from the flight `since` on
    (files); `text` says it in words."""

    effect: str
    parameter: str
    last: str
    since: str
    before: ParameterEstimate
    after: ParameterEstimate
    text: str


@dataclass(frozen=True)
class History:
    """Flights of one vehicle, fitted together.

    `flights` are their files, oldest first; `left_out` says of others why they could not be fitted with the newest.
    `numbers` are those of the vehicle, each with its value in every flight, `changes` those that the newest flight has
    otherwise. `error` says why nothing could be fitted, and is empty otherwise.
    """

    vehicle: str
    flights: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    numbers: tuple[SharedNumber, ...] = ()
    changes: tuple[Change, ...] = ()
    error: str = ""


@dataclass(frozen=True)
class Flown:
    """A flight of a survey as its history needs it: file, day (ISO, or empty), whether nothing in it is unexplained."""

    file: str
    day: str
    good: bool


def history_of(
    name: str,
    flown: Sequence[Flown],
    vehicle: str | None,
    mapping: Sequence[str],
    effects: str | None,
    per_flight: Sequence[str] = (),
    shared: Sequence[str] = (),
) -> History:
    """The history of the vehicle `name` from its flights; whatever goes wrong is told in it."""
    from trueflight.groundstation.identify.flights import diagnose_flights
    from trueflight.models.model import rigid_body_model

    order = sorted(flown, key=lambda f: (f.day, f.file))[-NEWEST:]
    try:
        kept, flights, left_out = _read(order, vehicle, mapping)
        if len(flights) < 2:
            return History(name, tuple(f.file for f in kept), left_out)
        base = rigid_body_model(flights[0].vehicle, effects)
        d = diagnose_flights(flights, base, per_flight=per_flight, shared=shared)
    except InputError as error:
        return History(name, tuple(f.file for f in order), error=" ".join(str(error).split()))
    except Exception as error:  # noqa: BLE001 - one vehicle must not end an analysis of a fleet
        return History(name, tuple(f.file for f in order), error=f"{type(error).__name__}: {error}")
    return History(
        name,
        tuple(f.file for f in kept),
        left_out,
        d.named("missing"),
        d.shared,
        tuple(changes_of(d, kept)),
    )


def _read(
    order: Sequence[Flown], vehicle: str | None, mapping: Sequence[str]
) -> tuple[list[Flown], list[Flight], tuple[str, ...]]:
    """The flights that can be fitted with the newest, oldest first, and why others cannot."""
    from trueflight.groundstation.identify.together import check_together, thinned
    from trueflight.groundstation.reading import read_flight

    kept: list[Flown] = []
    flights: list[Flight] = []
    left_out: list[str] = []
    for one in reversed(order):
        try:
            flight = thinned(read_flight(Path(one.file), vehicle, list(mapping) or None), SECONDS)
            check_together([flight, *flights])
        except InputError as error:
            left_out.append(" ".join(str(error).split()))
            continue
        kept.insert(0, one)
        flights.insert(0, flight)
    return kept, flights, tuple(left_out)


def changes_of(d: Diagnosis, flown: Sequence[Flown]) -> list[Change]:
    """What the newest of the flights has otherwise than an earlier one: the last good one, or else the last."""
    found = []
    for number in d.differing:
        if len(number.values) != len(flown):
            continue
        newest = number.values[-1]
        other = [k for k, v in enumerate(number.values) if not _alike(v, newest)]
        if not other:
            continue  # it was otherwise in between, and is again what it was
        # the change lies behind the last flight that has another value
        since, good = other[-1] + 1, [k for k in other if flown[k].good]
        last = good[-1] if good else other[-1]
        effect = effect_named(number.effect, d.base.effects_directory)
        parameter = next(p for p in effect.parameters if p.name == number.parameter)
        before = number.values[last]
        text = f"compared with {_when(flown[last])}, {_words(number.effect, parameter, before, newest)}"
        found.append(
            Change(number.effect, number.parameter, flown[last].file, flown[since].file, before, newest, text)
        )
    return found


def _alike(one: ParameterEstimate, other: ParameterEstimate) -> bool:
    """Whether two estimates agree within their 95 % intervals."""
    half = (0.5 * (one.high - one.low)) ** 2 + (0.5 * (other.high - other.low)) ** 2
    return bool(abs(one.value - other.value) <= half**0.5)


def _when(one: Flown) -> str:
    """The day in words, with the file."""
    name = Path(one.file).name
    try:
        day = date.fromisoformat(one.day)
    except ValueError:
        return name
    return f"{day.day} {day.strftime('%B %Y')} ({name})"


def _words(effect: str, p: Parameter, before: ParameterEstimate, after: ParameterEstimate) -> str:
    by = after.value - before.value
    words = p.grows if by > 0.0 else p.shrinks
    if words:
        return words.format(abs(by)).replace("%", " %")
    unit = "" if p.unit == "1" else f" {p.unit}"
    return f"{effect} {p.name} ({p.meaning}) went from {before.value:.3g} to {after.value:.3g}{unit}"
