"""What a diagnosis says of the last seconds of a flight that goes on: one look after the other, each beginning where
the last one ended.

Every stage is the one that `identify.translation.diagnose` makes of a whole flight. A thorough look makes all of them
but two: what drifts by and by, and what structure is left, are not asked of so short a stretch. A brief one begins at
what the last look found, asks whether the window still supports it and whether anything changes in it, and leaves out
what a thorough look looks for besides: effects that are new, and other sets that explain the window as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from threadpoolctl import threadpool_limits

from trueflight.groundstation.identify.changes import in_time
from trueflight.groundstation.identify.fitting import MeasuredFlights
from trueflight.groundstation.identify.force import ForceProblem
from trueflight.groundstation.identify.rotation import judge_rotation
from trueflight.groundstation.identify.rotors import has_rotor_speeds
from trueflight.groundstation.identify.search import Choice, Search, State
from trueflight.groundstation.identify.spans import changes_of, split_at
from trueflight.groundstation.identify.steps import SHORTEST
from trueflight.groundstation.identify.translation import report, shown_by_rotors
from trueflight.groundstation.measured.measurement import measure
from trueflight.groundstation.results import Diagnosis
from trueflight.models.flight import Flight
from trueflight.models.model import Model


@dataclass(frozen=True)
class Look:
    """One look at the last seconds of a flight: what it says, and what the next one begins at; `thorough` tells which
    kind it was."""

    diagnosis: Diagnosis
    choices: tuple[Choice, ...]
    thorough: bool


def look(window: Flight, base: Model, before: Look | None = None, thorough: bool = True) -> Look:
    """What `base` lacks on the `window`, beginning at what the look `before` found; without one, always thorough.

    Raises `InputError` where the window lacks the columns for any comparison, or is too short.
    """
    with threadpool_limits(1, user_api="blas"):
        return _look(_since_the_last_change(window, before), base, before, thorough or before is None)


def _look(window: Flight, base: Model, before: Look | None, thorough: bool) -> Look:
    measured = MeasuredFlights((measure(window),), base.effects_directory, base.network_chain())
    rotation = judge_rotation(window, base.names(), base.effects_directory)
    problem = ForceProblem(measured, base, None, rotation.terms, turning_in_time=rotation.spanned)
    if has_rotor_speeds(window):
        problem = replace(problem, on_the_way=shown_by_rotors(problem))
    search = Search(problem, other_sets=thorough)
    found = None if before is None else in_time(search, _carried(search, before, window), False).state
    if thorough:
        anew = in_time(search, search.select(), False).state
        # what was found before stays where the window does not tell better
        found = anew if found is None or search.score(anew, found) < search.score(found, found) else found
        found = found if found is anew else in_time(search, search.grown(found), False).state
    assert found is not None
    return Look(report(search, found, search, rotation, structure=False), found.choices, thorough)


def _since_the_last_change(window: Flight, before: Look | None) -> Flight:
    """The window without what is left in it of the time before a change that is about to go out of it: too little to
    tell what was then, and enough to bend what is now."""
    edge = float(window.t[0]) + SHORTEST
    past = [t for t in moments(before.diagnosis) if t < edge] if before is not None else []
    return window.part(window.t > max(past)) if past else window


def moments(diagnosis: Diagnosis) -> list[float]:
    """When anything changes, s on the flight's clock."""
    return [c.time for e in diagnosis.effects if e.rank and e.over_time for c in e.over_time.changes]


def _carried(search: Search, before: Look, window: Flight) -> State:
    """What the last look found, as far as this window holds it: changes that have gone out of it are none any more."""
    known = {c.effect for c in search.problem.choices}
    start = float(window.t[0])
    held = []
    for choice in before.choices:
        inside = [t for t in changes_of(choice.spans) if t > start]
        if len(inside) < len(changes_of(choice.spans)):
            choice = replace(choice, spans=split_at(inside) if inside else ())
        held += [choice] if choice.effect in known else []
    settled = [c for c in search.problem.settled if c.effect not in {h.effect for h in held}]
    return search.settle((*settled, *held))
