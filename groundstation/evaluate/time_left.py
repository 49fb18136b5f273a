"""How long a survey will still take, from what was seen of it.

Files of a folder cost very different times: one that is no flight is refused at once, a long one is searched for
minutes, and those of one vehicle, day and kind lie beside each other. So they are done in an order in which every
beginning is like the whole, and the time is told by kinds and sizes, once enough of them were done.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from pathlib import Path

import numpy as np

ENOUGH = 25
"""Files that must be done before anything is said: of few, none may have been a long one."""
DOUBTFUL, NEGLIGIBLE = 0.3, 0.05
"""Share of the time left that its standard error may be before it is told, or of all the time, where little is left."""
FEW = 4
"""Files of one kind and size from which on their own mean is believed; fewer are taken with the others."""

Kind = tuple[str, int]


def kind_of(file: Path) -> Kind:
    """What files that cost about the same have in common: their ending, and their size in steps of a factor of four."""
    try:
        size = file.stat().st_size
    except OSError:
        size = 0
    return file.suffix.lower(), (size >> 12).bit_length() // 2


def mixed(files: Sequence[Path]) -> list[Path]:
    """The files in an order, the same each time, in which every beginning has its share of all kinds."""
    draw = random.Random(0)
    kinds: dict[Kind, list[Path]] = {}
    for file in sorted(files):
        kinds.setdefault(kind_of(file), []).append(file)
    placed: list[tuple[float, Path]] = []
    for _, some in sorted(kinds.items()):
        draw.shuffle(some)
        begin = draw.random()
        placed += [((number + begin) / len(some), file) for number, file in enumerate(some)]
    return [file for _, file in sorted(placed)]


class TimeLeft:
    """The time that files still take. `kinds` are those of all files that are to be done."""

    def __init__(self, kinds: Sequence[Kind]) -> None:
        self._left: dict[Kind, int] = {}
        for kind in kinds:
            self._left[kind] = self._left.get(kind, 0) + 1
        self._seconds: dict[Kind, list[float]] = {}

    def done(self, kind: Kind, seconds: float) -> None:
        """A file of this kind took so many seconds of one worker."""
        self._left[kind] = max(self._left.get(kind, 0) - 1, 0)
        self._seconds.setdefault(kind, []).append(seconds)

    def left(self, elapsed: float) -> float | None:
        """Seconds until all are done, after `elapsed` seconds; None where too little was seen to say it."""
        every = np.array([s for some in self._seconds.values() for s in some])
        if not any(self._left.values()):
            return 0.0
        if len(every) < ENOUGH or elapsed <= 0.0 or not every.sum() > 0.0:
            return None
        work = variance = 0.0
        for kind, count in self._left.items():
            seen = np.array(self._seconds.get(kind, ()))
            like = seen if len(seen) >= FEW else every
            work += count * float(like.mean())
            variance += float(like.var(ddof=1)) * (count**2 / len(like) + count)
        if variance > max(DOUBTFUL * work, NEGLIGIBLE * (work + float(every.sum()))) ** 2:
            return None
        at_a_time = float(every.sum()) / elapsed
        return work / at_a_time


def in_words(seconds: float | None) -> str:
    """A time left as it can be known: "about 4 min left"."""
    if seconds is None:
        return "time left not known yet"
    if seconds < 15.0:
        return "a few seconds left"
    if seconds < 100.0:
        return f"about {10 * round(seconds / 10)} s left"
    minutes = round(seconds / 60.0)
    return f"about {minutes} min left" if minutes < 100 else f"about {seconds / 3600.0:.1f} h left"
