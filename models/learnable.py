"""A number of a deployed model that may be learnt anew in flight, as the file says it."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

MOST = 8
"""Parameters that one model may let be learnt: the filter on board keeps a matrix of so many rows and columns."""


@dataclass(frozen=True)
class Learnable:
    """One parameter of one effect, in `unit`: its `value` as deployed, and how far from it the truth may be.

    It stays within `low` and `high`. `spread` is the standard deviation that the value has where nothing was learnt
    yet, and the most that it ever has; `drift` by how much the truth may change, per root second.

    Raises `ValueError` for numbers that contradict each other.
    """

    effect: str
    parameter: str
    unit: str
    value: float
    low: float
    high: float
    spread: float
    drift: float

    def __post_init__(self) -> None:
        numbers = (self.value, self.low, self.high, self.spread, self.drift)
        if not all(isinstance(n, float) and math.isfinite(n) for n in numbers):
            raise ValueError(f"{self.name}: a number of it is not finite")
        if not (self.low <= self.value <= self.high and self.low < self.high):
            raise ValueError(f"{self.name}: {self.value:g} is not between {self.low:g} and {self.high:g}")
        if not (self.spread > 0.0 and self.drift > 0.0):
            raise ValueError(f"{self.name}: spread and drift must be above 0")

    @property
    def name(self) -> str:
        """`effect.parameter`, as in ticks."""
        return f"{self.effect}.{self.parameter}"

    def table(self) -> dict[str, Any]:
        """As JSON holds it."""
        return asdict(self)
