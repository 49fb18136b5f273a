"""Comparison: measured and predicted acceleration together, the residual, open-loop errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.evaluate.error_over_time import error_over_time
from trueflight.groundstation.results import Comparison, WhereItFails
from trueflight.groundstation.views.colour import MEASURED, of_version
from trueflight.groundstation.views.error import error_curves
from trueflight.groundstation.views.recording import between, curve, page, readable, recording, text

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
        stream.send_blueprint(page(comparison_panel(stream, comparisons, where)))


def comparison_panel(
    stream: rr.RecordingStream,
    comparisons: Sequence[Comparison],
    where: WhereItFails | None,
    root: str = "",
    markdown: str | None = None,
) -> rrb.Container:
    """Measured and predicted acceleration per axis, the residual of each version, and the page of errors."""
    count = len(comparisons)
    panels = acceleration_views(stream, comparisons, where, root)
    errors = [
        (comparisons[k].label, error_over_time(comparisons[k], SMOOTHING), of_version(k, count))
        for k in _drawn(comparisons)
    ]
    name = f"residual over the whole flight, RMS over {SMOOTHING:g} s, m/s²"
    residual = error_curves(
        stream, f"{root}residual", errors, name, () if where is None else where.worst, height=370.0
    )
    text(stream, f"{root}errors", _summary(comparisons) if markdown is None else markdown)
    right = (rrb.TextDocumentView(origin=f"{root}errors", name="errors"), residual)
    return rrb.Horizontal(
        rrb.Vertical(*panels),
        rrb.Vertical(*right, row_shares=[1, 1]),
        column_shares=[3, 2],
        name="measured and predicted",
    )


def acceleration_views(
    stream: rr.RecordingStream, comparisons: Sequence[Comparison], where: WhereItFails | None, root: str = ""
) -> list[rrb.TimeSeriesView]:
    """Measured and predicted acceleration, a view for each axis that was measured."""
    flight, count = comparisons[0].flight, len(comparisons)
    start = _window(flight.t, where)
    drawn = _drawn(comparisons)
    shown = [axis for axis in range(3) if np.any(np.isfinite(comparisons[0].measured[:, axis]))]
    flying = np.ones(len(flight), bool) if flight.flying is None else flight.flying
    panels = []
    for axis in shown:
        name = "xyz"[axis]
        at = f"{root}acceleration/{name}"
        measured = np.where(flying, comparisons[0].measured[:, axis], np.nan)
        curve(stream, f"{at}/measured", flight.t, measured, "measured", MEASURED, 3.0)
        values = [measured]
        for index, c in enumerate(comparisons):
            predicted = np.where(flying, c.predicted[:, axis], np.nan)
            if index in drawn:
                values.append(predicted)
            colour = of_version(index, count)
            curve(stream, f"{at}/v{index}", flight.t, predicted, c.label, colour, visible=index in drawn)
        panels.append(
            rrb.TimeSeriesView(
                origin=at,
                name=f"{name} ({AXES[axis]}) acceleration, m/s², below {comparisons[0].bandwidth:g} Hz",
                axis_x=rrb.TimeAxis(view_range=between(start, min(start + WINDOW, float(flight.t[-1])))),
                axis_y=rrb.ScalarAxis(range=_range(values, flight.t, start, 700.0 / len(shown))),
                plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=axis == shown[0]),
            )
        )
    return panels


def _drawn(comparisons: Sequence[Comparison]) -> list[int]:
    """The first and the last two versions: more curves hide each other, and are switched on in the legend."""
    return sorted({0, max(0, len(comparisons) - 2), len(comparisons) - 1})


def _window(t: np.ndarray, where: WhereItFails | None) -> float:
    """Beginning of the first view: around the worst moment, otherwise from the middle."""
    middle = (
        0.5 * (where.worst[0].start + where.worst[0].end)
        if where and where.worst
        else 0.5 * float(t[0] + t[-1])
    )
    return float(np.clip(middle - 0.5 * WINDOW, t[0], max(t[0], t[-1] - WINDOW)))


def _range(curves: Sequence[np.ndarray], t: np.ndarray, start: float, height: float) -> tuple[float, float]:
    """Lowest and highest of all curves in the first window, on an axis `height` points high."""
    inside = (t >= start) & (t <= start + WINDOW)
    shown = np.concatenate([values[inside] for values in curves])
    shown = shown[np.isfinite(shown)] if np.any(np.isfinite(shown)) else np.zeros(1)
    low, high = np.quantile(shown, [0.001, 0.999])
    return readable(float(low), float(high), height)


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
