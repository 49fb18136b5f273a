"""Comparison: measured and predicted acceleration together, the residual, open-loop errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from groundstation.results import Comparison, WhereItFails
from groundstation.views.colour import FLOOR, MEASURED, of_version
from groundstation.views.recording import TIME, between, curve, recording, text

AXES = ("forward", "left", "up")
WINDOW = 15.0
"""s of flight that measured and predicted are first shown for; the whole flight is one scroll away."""
SMOOTHING = 1.0
"""s over which the residual's RMS is taken."""


def write_comparison(
    path: Path, comparisons: Sequence[Comparison], where: WhereItFails | None = None
) -> None:
    """Write the recording of model versions (the linear one first, the newest last) against one flight."""
    flight = comparisons[0].flight
    with recording(path, "comparison", f"{flight.name}: measured and predicted") as stream:
        stream.send_blueprint(_blueprint(stream, comparisons, where))


def _blueprint(
    stream: rr.RecordingStream, comparisons: Sequence[Comparison], where: WhereItFails | None
) -> rrb.Blueprint:
    flight, count = comparisons[0].flight, len(comparisons)
    start = _window(flight.t, where)
    shown = [axis for axis in range(3) if np.any(np.isfinite(comparisons[0].measured[:, axis]))]
    panels = []
    for axis in shown:
        name = "xyz"[axis]
        flying = np.ones(len(flight), bool) if flight.flying is None else flight.flying
        measured = np.where(flying, comparisons[0].measured[:, axis], np.nan)
        curve(stream, f"acceleration/{name}/measured", flight.t, measured, "measured", MEASURED, 3.0)
        values = [measured]
        for index, c in _drawn(comparisons):
            predicted = np.where(flying, c.predicted[:, axis], np.nan)
            values.append(predicted)
            curve(
                stream,
                f"acceleration/{name}/v{index}",
                flight.t,
                predicted,
                c.label,
                of_version(index, count),
            )
        panels.append(
            rrb.TimeSeriesView(
                origin=f"acceleration/{name}",
                name=f"{name} ({AXES[axis]}) acceleration, m/s², below {comparisons[0].bandwidth:g} Hz",
                axis_x=rrb.TimeAxis(view_range=between(start, min(start + WINDOW, float(flight.t[-1])))),
                axis_y=rrb.ScalarAxis(range=_range(values, flight.t, start)),
                plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=axis == shown[0]),
            )
        )
    highest = 0.0
    for index, c in _drawn(comparisons):
        rolling = rolling_rms(c.residual, c.used, round(SMOOTHING / flight.dt))
        highest = max(highest, float(np.nanmax(rolling, initial=0.0)))
        curve(stream, f"residual/v{index}", flight.t, rolling, c.label, of_version(index, count), 2.0)
    floor = np.full(2, comparisons[-1].noise_floor)
    curve(stream, "residual/floor", flight.t[[0, -1]], floor, "noise floor", FLOOR)
    residual = rrb.TimeSeriesView(
        origin="residual",
        name="residual over the whole flight, RMS over 1 s, m/s²",
        axis_x=rrb.TimeAxis(view_range=between(float(flight.t[0]), float(flight.t[-1]))),
        axis_y=rrb.ScalarAxis(range=(0.0, 1.1 * highest)),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
    )
    text(stream, "summary", _summary(comparisons))
    right = (rrb.TextDocumentView(origin="summary", name="errors"), residual)
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*panels), rrb.Vertical(*right, row_shares=[1, 1]), column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline=TIME),
        collapse_panels=True,
    )


def rolling_rms(residual: np.ndarray, used: np.ndarray, width: int) -> np.ndarray:
    """RMS (N,) per axis of a residual (N, 3) over `width` samples; nan where little of them counts."""
    square = np.where(used, np.nanmean(np.where(used[:, None], residual, 0.0) ** 2, axis=1), 0.0)
    window = np.ones(max(width, 1))
    total, count = np.convolve(square, window, "same"), np.convolve(used.astype(float), window, "same")
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count > 0.3 * len(window), np.sqrt(total / count), np.nan)


def _drawn(comparisons: Sequence[Comparison]) -> list[tuple[int, Comparison]]:
    """The first and the last two versions: more curves hide each other."""
    chosen = sorted({0, max(0, len(comparisons) - 2), len(comparisons) - 1})
    return [(index, comparisons[index]) for index in chosen]


def _window(t: np.ndarray, where: WhereItFails | None) -> float:
    """Beginning of the first view: around the worst moment, otherwise from the middle."""
    middle = (
        0.5 * (where.worst[0].start + where.worst[0].end)
        if where and where.worst
        else 0.5 * float(t[0] + t[-1])
    )
    return float(np.clip(middle - 0.5 * WINDOW, t[0], max(t[0], t[-1] - WINDOW)))


def _range(curves: Sequence[np.ndarray], t: np.ndarray, start: float) -> tuple[float, float]:
    """Lowest and highest of all curves in the first window, with a margin."""
    inside = (t >= start) & (t <= start + WINDOW)
    shown = np.concatenate([values[inside] for values in curves])
    shown = shown[np.isfinite(shown)] if np.any(np.isfinite(shown)) else np.zeros(1)
    low, high = np.quantile(shown, [0.001, 0.999])
    margin = 0.1 * max(high - low, 0.5)
    return float(low - margin), float(high + margin)


def _summary(comparisons: Sequence[Comparison]) -> str:
    first = comparisons[0]
    axes = [axis.axis for axis in first.axes]
    lines = [
        f"Residual RMS of flight **{first.flight.name}**, vehicle {first.flight.vehicle.name}, m/s²:",
        "",
        "| model | " + " | ".join(axes) + " | all | explained |",
        "|---|" + "---|" * (len(axes) + 2),
    ]
    for c in comparisons:
        shares = ", ".join(f"{100 * axis.share_explained:.0f}" for axis in c.axes)
        lines.append(
            f"| {c.label} | " + " | ".join(f"{axis.rms:.3f}" for axis in c.axes) + f" | **{c.rms:.3f}** | "
            f"{shares} % |"
        )
    floors = " | ".join(f"{axis.noise_floor:.3f}" for axis in comparisons[-1].axes)
    lines.append(f"| *noise floor* | {floors} | {comparisons[-1].noise_floor:.3f} | |")
    if comparisons[-1].horizons:
        lines += ["", "Open-loop position error, RMS over all starts:", ""]
        lines.append("| model | " + " | ".join(f"{h.horizon:g} s" for h in comparisons[-1].horizons) + " |")
        lines.append("|---|" + "---|" * len(comparisons[-1].horizons))
        for c in comparisons:
            errors = [float(np.linalg.norm(h.position)) for h in c.horizons]
            lines.append(f"| {c.label} | " + " | ".join(_length(e) for e in errors) + " |")
    return "\n".join(lines)


def _length(metres: float) -> str:
    return f"{1000 * metres:.1f} mm" if metres < 0.01 else f"{100 * metres:.1f} cm"
