"""How much of a disturbance each controller stands: the size up to which its flights do not end early, by bisection.

After the delay margin and the failure intensity of AdaptiveQuadBench (Zhang et al., arXiv:2510.03471), which go up in
steps; a flight has failed here where the companion would have given it up: 4 m from its reference, or on the ground.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from trueflight.groundstation.study.controllers import FINISHED, fly_table, prepared_for, row_of
from trueflight.groundstation.study.disturbances import Limit
from trueflight.groundstation.study.reproduce import Asked
from trueflight.models.errors import InputError
from trueflight.models.outside import json_object, read_text
from trueflight.models.whole_file import write_whole

HALVINGS = 6
"""After which a margin is known to a 64th of its range."""
ROUNDS = HALVINGS + 1
"""In the first both ends are flown."""


@dataclass(frozen=True)
class Margin:
    """The greatest size found at which a flight `finished`; None where it is lost at the least one already. `beyond`
    says that the greatest one asked for was flown, too."""

    seed: int
    limit: str
    controller: str
    size: float | None
    beyond: bool


@dataclass
class _Search:
    limit: Limit
    controller: str
    low: float
    high: float
    done: Margin | None = None


def find_margins(
    asked: Asked,
    seeds: Sequence[int],
    limits: Sequence[Limit],
    names: Sequence[str],
    jobs: int,
    tell: Callable[[str, int], None],
) -> list[Margin]:
    """The margins of every controller and vehicle; what the folder holds is kept. `tell` is called with what is done
    now, and how many rounds are done with it."""
    found: list[Margin] = []
    for seed in seeds:
        kept = asked.folder / f"vehicle-{seed}" / "margins.json"
        known = {(one.limit, one.controller): one for one in _known(kept)}
        wanted = [(limit, name) for limit in limits for name in names]
        missing = [(limit, name) for limit, name in wanted if (limit.name, name) not in known]
        if missing:
            searches = [_Search(limit, name, limit.least, limit.most) for limit, name in missing]
            _search(asked, seed, searches, jobs, tell)
            known |= {(s.limit.name, s.controller): _margin(seed, s) for s in searches}
            text = json.dumps({"margins": [asdict(one) for one in known.values()]})
            write_whole(kept, text, "the margins")
        else:
            tell(f"vehicle {seed}: margins", ROUNDS)
        found += [known[limit.name, name] for limit, name in wanted]
    return found


def _known(kept: Path) -> list[Margin]:
    if not kept.is_file():
        return []
    try:
        table = json_object(read_text(kept, "the margins", "they are flown again"), str(kept), "flown again")
        return [Margin(**one) for one in table["margins"]]
    except (InputError, TypeError, KeyError):  # damaged, or of another version
        return []


def _search(
    asked: Asked, seed: int, searches: Sequence[_Search], jobs: int, tell: Callable[[str, int], None]
) -> None:
    """Close in on all of them together: the flights of one round are flown as one batch."""
    prepared = prepared_for(asked, seed, (one.controller for one in searches), tell)
    folder = asked.folder / f"vehicle-{seed}" / "margins"
    try:
        for number in range(ROUNDS):
            open_ = [one for one in searches if one.done is None]
            sizes = [(one, size) for one in open_ for size in _asked(one, number)]
            folder.mkdir(exist_ok=True)
            rows = [
                row_of(asked, seed, prepared, one.limit.at(size), one.controller, f"{i:04d}")
                for i, (one, size) in enumerate(sizes)
            ]
            reports = fly_table(asked, rows, folder, jobs)
            flew = [reports[str(row["name"])]["outcome"] == FINISHED for row in rows]
            for one in open_:
                here = [ok for (other, _), ok in zip(sizes, flew, strict=True) if other is one]
                _narrow(seed, one, here)
            shutil.rmtree(folder)
            tell(f"vehicle {seed}: margins", 1)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _asked(one: _Search, number: int) -> list[float]:
    return [one.low, one.high] if number == 0 else [0.5 * (one.low + one.high)]


def _narrow(seed: int, one: _Search, flew: Sequence[bool]) -> None:
    """Take over what the flights of one round said."""
    if len(flew) == 2:  # both ends
        if not flew[0] or flew[1]:
            size = None if not flew[0] else one.high
            one.done = Margin(seed, one.limit.name, one.controller, size, flew[0])
        return
    middle = 0.5 * (one.low + one.high)
    one.low, one.high = (middle, one.high) if flew[0] else (one.low, middle)


def _margin(seed: int, one: _Search) -> Margin:
    return one.done or Margin(seed, one.limit.name, one.controller, one.low, False)
