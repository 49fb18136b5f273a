"""Several flights with one model, or several models on one flight, in the same bins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from trueflight.groundstation.evaluate.compare import compare
from trueflight.groundstation.evaluate.where import common_bins, where_it_fails
from trueflight.groundstation.results import Comparison, WhereItFails
from trueflight.models.flight import Flight
from trueflight.models.model import Model


@dataclass(frozen=True)
class SideBySide:
    """Comparisons that are read beside each other; `where` has their error over the same bins, in the same order.

    `names` (one each) tell them apart: by flight, by model, or by both. `change` is the RMS against that of the first,
    less 1.
    """

    names: tuple[str, ...]
    comparisons: tuple[Comparison, ...]
    where: tuple[WhereItFails, ...]
    change: tuple[float, ...]


def side_by_side(
    flights: Sequence[Flight], models: Sequence[Sequence[Model]], bandwidth: float | None = None
) -> SideBySide:
    """Compare every flight with each of its `models` (one sequence a flight), flight by flight.

    Raises `InputError` where a flight lacks what a comparison needs.
    """
    comparisons = [
        compare(flight, model, bandwidth)
        for flight, its in zip(flights, models, strict=True)
        for model in its
    ]
    bins = common_bins([where_it_fails(c) for c in comparisons])
    where = [where_it_fails(c, bins) for c in comparisons]
    return SideBySide(
        _names(comparisons, len(flights) > 1, any(len(its) > 1 for its in models)),
        tuple(comparisons),
        tuple(where),
        tuple(c.rms / comparisons[0].rms - 1.0 for c in comparisons),
    )


def _names(comparisons: Sequence[Comparison], flights: bool, models: bool) -> tuple[str, ...]:
    """What tells the comparisons apart; numbered where nothing does."""
    names = []
    for c in comparisons:
        parts = [c.flight.name] if flights or not models else []
        names.append(", ".join([*parts, c.label] if models else parts))
    return tuple(
        f"{name} ({names[: k + 1].count(name)})" if names.count(name) > 1 else name
        for k, name in enumerate(names)
    )
