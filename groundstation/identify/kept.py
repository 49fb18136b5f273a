"""Steps of a prediction that have been taken before, on the same columns with the same numbers.

A fit moves one number after the other, and most of a chain stays as it was: what a step reads is noted while it is
taken, and where nothing of that has changed, what it changed is taken from there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from trueflight.models.effect import Motion
from trueflight.models.prediction import Step

STEPS, ROWS = 6, 400_000
"""Most that is kept of each step, and how many samples in all, so that a long flight does not fill the memory."""
_FIELDS = frozenset(f.name for f in fields(Motion))


class _Watched(Motion):
    """A motion that notes which of its fields are read, and so do those that are made from it."""

    def __getattribute__(self, name: str) -> Any:
        if name in _FIELDS:
            object.__getattribute__(self, "__dict__").get(".read", set()).add(name)
        return object.__getattribute__(self, name)


@dataclass(frozen=True)
class _Taken:
    """A step: its numbers, what it `read` and what it `changed`, by field."""

    numbers: tuple[Any, ...]
    read: dict[str, Any]
    changed: dict[str, Any]

    def is_of(self, motion: Motion, numbers: tuple[Any, ...]) -> bool:
        """Whether it is the one with these numbers from this motion."""
        if self.numbers != numbers:
            return False
        here = motion.__dict__
        return all(_same(here[name], value) for name, value in self.read.items())


class Kept:
    """The last steps taken with a flight of so many samples; `see` turns a column (N, 3) into what is compared."""

    def __init__(self, count: int, see: Callable[[np.ndarray], np.ndarray]) -> None:
        self._see = see
        self._most = int(np.clip(ROWS // max(count, 1), 2, STEPS))
        self._steps: dict[str, list[_Taken]] = {}
        self._seen: list[tuple[np.ndarray, np.ndarray]] = []

    def take(self, motion: Motion, name: str, numbers: tuple[Any, ...], step: Step) -> Motion:
        """The step `name` from a motion, with these numbers."""
        taken = self._steps.setdefault(name, [])
        found = next((i for i, one in enumerate(taken) if one.is_of(motion, numbers)), None)
        one = _watched(motion, numbers, step) if found is None else taken.pop(found)
        taken.insert(0, one)
        del taken[self._most :]
        return motion.with_(**one.changed)

    def seen(self, column: np.ndarray) -> np.ndarray:
        """What is compared of a column that a step has made."""
        found = next((i for i, (made, _) in enumerate(self._seen) if made is column), None)
        one = (column, self._see(column)) if found is None else self._seen.pop(found)
        self._seen.insert(0, one)
        del self._seen[4 * self._most :]
        return one[1]


def _watched(motion: Motion, numbers: tuple[Any, ...], step: Step) -> _Taken:
    watched: Motion = object.__new__(_Watched)
    read: set[str] = set()
    watched.__dict__.update(motion.__dict__, **{".read": read})
    after = step(watched).__dict__
    before = motion.__dict__
    read = {name for name in read if name in before}
    changed = {name: after[name] for name in before if after[name] is not before[name]}
    return _Taken(numbers, {name: before[name] for name in read}, changed)


def _same(one: Any, other: Any) -> bool:
    return one is other or (isinstance(one, float) and isinstance(other, float) and one == other)
