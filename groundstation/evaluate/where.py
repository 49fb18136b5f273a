"""Where in the flight a model fails: against height, speed, tilt, thrust, voltage, time and place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from trueflight.groundstation.results import Comparison, ErrorMap, Moment, PlaceMap, Region, WhereItFails
from trueflight.models.flight import Flight
from trueflight.models.frames import (
    euler_from_quaternion,
    rotate_inverse,
    rotation_matrix,
    world_from_heading,
)

BINS = 16
FINE = 40
"""Quantiles between which the edges of a region are sought."""
CELL = 0.5
"""m, side of a cell of the map over the ground."""
MOSTLY = 0.5
"""Part of the squared error from which a constant is told."""
ALIKE = 0.02
"""Difference of that part within which a constant is one in both axes: the flight does not tell them apart."""
MOMENT = 1.0
"""s, length of a worst moment."""


def where_it_fails(comparison: Comparison, bins: Mapping[str, np.ndarray] | None = None) -> WhereItFails:
    """Maps, regions and worst moments of the squared residual over the used samples of `comparison`.

    `bins` are edges by variable; without them each map spans what the flight covers.
    """
    flight, used = comparison.flight, comparison.used
    error = np.nanmean(comparison.residual**2, axis=1)  # over the axes that are measured
    variables = _variables(flight)
    edges = bins or {}
    maps = tuple(_map(name, unit, x[used], error[used], edges.get(name)) for name, unit, x, _ in variables)
    regions = [
        r for name, unit, x, words in variables if (r := _region(name, unit, x[used], error[used], words))
    ]
    regions.sort(key=lambda r: r.share_of_time - r.share_of_error)
    return WhereItFails(
        maps,
        (*_constant(comparison), *regions),
        _worst(comparison, error, variables),
        _place(flight, used, error),
    )


Variable = tuple[str, str, np.ndarray, tuple[str, str]]


def _variables(flight: Flight) -> list[Variable]:
    """Name, unit, values (N,), and the words for below and above."""
    out: list[Variable] = []
    if flight.position is not None:
        out.append(("height", "m", flight.position[:, 2], ("below", "above")))
    if flight.velocity is not None:
        speed = np.linalg.norm(flight.velocity[:, :2], axis=1)
        out.append(("horizontal speed", "m/s", speed, ("slower than", "faster than")))
        out.append(
            ("climb speed", "m/s", flight.velocity[:, 2], ("at climb speeds below", "at climb speeds above"))
        )
    if flight.quaternion is not None:
        up = np.clip(rotation_matrix(flight.quaternion)[:, 2, 2], -1.0, 1.0)
        out.append(("tilt", "deg", np.degrees(np.arccos(up)), ("at tilts below", "at tilts above")))
    thrust = flight.column("thrust_command") / flight.vehicle.hover_thrust
    out.append(("thrust", "hover", thrust, ("at thrust below", "at thrust above")))
    if flight.battery_voltage is not None:
        out.append(("battery voltage", "V", flight.battery_voltage, ("below", "above")))
    out.append(("time", "s", flight.t - flight.t[0], ("before", "after")))
    return out


def common_bins(places: Sequence[WhereItFails]) -> dict[str, np.ndarray]:
    """Edges by variable that span the maps of all of `places`, so that they can be read side by side."""
    edges: dict[str, list[np.ndarray]] = {}
    for where in places:
        for m in where.maps:
            edges.setdefault(m.variable, []).append(m.edges)
    return {
        name: np.linspace(min(e[0] for e in all_), max(e[-1] for e in all_), BINS + 1)
        for name, all_ in edges.items()
    }


def _map(name: str, unit: str, x: np.ndarray, error: np.ndarray, edges: np.ndarray | None) -> ErrorMap:
    if edges is None:
        low, high = np.quantile(x, [0.002, 0.998])
        edges = np.linspace(low, max(high, low + 1e-9), BINS + 1)
    number = np.clip(np.digitize(x, edges) - 1, 0, BINS - 1)
    count = np.bincount(number, minlength=BINS)
    total = np.bincount(number, weights=error, minlength=BINS)
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.sqrt(total / count)
    return ErrorMap(name, unit, edges, rms, total / error.sum(), count / len(x))


def _region(name: str, unit: str, x: np.ndarray, error: np.ndarray, words: tuple[str, str]) -> Region | None:
    """The interval of the variable that holds most error beyond its share of time; None if it holds no more than half
    again its share."""
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, FINE + 1)))
    if len(edges) < 4:
        return None
    number = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    e = np.r_[0.0, np.cumsum(np.bincount(number, weights=error, minlength=len(edges) - 1))] / error.sum()
    s = np.r_[0.0, np.cumsum(np.bincount(number, minlength=len(edges) - 1))] / len(x)
    excess = (e[None, :] - e[:, None]) - (s[None, :] - s[:, None])
    backwards = np.tri(len(s), dtype=bool)  # an interval ends after it begins; its complement scores the same
    excess[backwards | ((s[None, :] - s[:, None]) > 0.6)] = -1.0
    i, j = np.unravel_index(int(np.argmax(excess)), excess.shape)
    share_error, share_time = float(e[j] - e[i]), float(s[j] - s[i])
    if share_error < 0.3 or share_error < 1.5 * share_time:
        return None
    low, high = float(edges[i]), float(edges[j])
    if i == 0:
        place = f"{words[0]} {_number(high, unit)}"
    elif j == len(edges) - 1:
        place = f"{words[1]} {_number(low, unit)}"
    else:
        place = f"at a {name} of {_number(low, '')} to {_number(high, unit)}"
    text = f"{share_error:.0%} of the squared error sits {place}, in {share_time:.0%} of the flight"
    return Region(text.replace("%", " %"), name, low, high, share_error, share_time)


def _number(value: float, unit: str) -> str:
    """A value with its unit; thrust in multiples of the hover's."""
    return f"{value:.2f} times hover" if unit == "hover" else f"{value:.3g} {unit}".strip()


def _worst(
    comparison: Comparison, error: np.ndarray, variables: list[Variable], most: int = 5
) -> tuple[Moment, ...]:
    """The worst stretches of `MOMENT` s that do not overlap."""
    flight, used = comparison.flight, comparison.used
    width = max(2, round(MOMENT / flight.dt))
    weight = np.convolve(used, np.ones(width), mode="valid")
    total = np.convolve(np.where(used, error, 0.0), np.ones(width), mode="valid")
    score = np.where(weight > 0.5 * width, total / np.maximum(weight, 1.0), -1.0)
    moments = []
    for _ in range(most):
        k = int(np.argmax(score))
        if score[k] <= 0.0:
            break
        part = slice(k, k + width)
        told = ", ".join(
            f"{name} {_number(float(np.mean(x[part])), unit)}"
            for name, unit, x, _ in variables
            if name != "time"
        )
        start, end = float(flight.t[k]), float(flight.t[min(k + width, len(flight) - 1)])
        moments.append(Moment(start, end, float(np.sqrt(score[k])), told))
        score[max(0, k - width) : k + width] = -1.0
    return tuple(moments)


def _constant(comparison: Comparison) -> tuple[Region, ...]:
    """A constant that holds most of the squared error, in the axes in which it is one: wind and a slope in the world's,
    drag at a steady course in those of the heading, a bias or a thrust in the body's."""
    flight, used = comparison.flight, comparison.used
    heading = np.nan_to_num(comparison.residual[used])
    turned = {"the world": heading, "heading": heading, "body": heading}
    if flight.quaternion is not None:
        q = flight.quaternion[used]
        turned["the world"] = world_from_heading(heading, euler_from_quaternion(q)[:, 2])
        turned["body"] = rotate_inverse(q, turned["the world"])
    total = max(float(np.mean(np.sum(heading**2, axis=1))), 1e-30)
    means = {frame: column.mean(axis=0) for frame, column in turned.items()}
    shares = {frame: float(np.sum(mean**2)) / total for frame, mean in means.items()}
    best = max(shares, key=lambda frame: shares[frame])
    if shares[best] < MOSTLY:
        return ()
    alike = [frame for frame in shares if shares[frame] > shares[best] - ALIKE]
    axes = ("east", "north", "up") if best == "the world" else ("forward", "left", "up")
    size = float(np.linalg.norm(means[best]))
    told = ", ".join(
        f"{v:+.2f} m/s² {axis}" for v, axis in zip(means[best], axes, strict=True) if abs(v) > 0.2 * size
    )
    frames = " and ".join(alike if len(alike) < 3 else ["the world", "heading", "body"])
    text = f"{shares[best]:.0%} of the squared error is a constant in {frames} axes: {told}"
    text = text.replace("the world axes", "the world's axes").replace("%", " %")
    return (Region(text, f"constant, {best}", size, size, shares[best], 1.0),)


def _place(flight: Flight, used: np.ndarray, error: np.ndarray) -> PlaceMap | None:
    if flight.position is None:
        return None
    cells, number = np.unique(
        np.floor(flight.position[used, :2] / CELL).astype(int), axis=0, return_inverse=True
    )
    count = np.bincount(number.ravel())
    total = np.bincount(number.ravel(), weights=error[used])
    return PlaceMap(
        CELL, (cells + 0.5) * CELL, np.sqrt(total / count), total / total.sum(), count / count.sum()
    )
