"""Before and after: the residual of every model version, on the fitted and on the held-out flight."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from groundstation.compare import compare
from groundstation.results import Comparison, WaterfallStep
from groundstation.views import scene
from groundstation.views.bars import bar_groups, legend
from groundstation.views.colour import FLOOR, NEWEST, Colour, of_version
from groundstation.views.comparison import rolling_rms
from groundstation.views.recording import TIME, between, curve, recording, text
from models.flight import Flight
from models.model import Model

SMOOTHING = 0.5  # s
HELD_OUT: Colour = (0, 158, 115)


def write_before_after(
    path: Path, versions: Sequence[tuple[Model, Flight, Flight | None]], steps: Sequence[WaterfallStep]
) -> None:
    """Write the recording of model versions (model, fitted flight, held-out flight) and their waterfall
    `steps`.

    The paths show the first and the last version on the held-out flight, where there is one.
    """
    (first, fitted, held_out), (last, _, _) = versions[0], versions[-1]
    shown = fitted if held_out is None else held_out
    before, after = (compare(shown, model, horizons=False) for model in (first, last))
    with recording(path, "before and after", f"{shown.name}: {before.label} and {after.label}") as stream:
        stream.send_blueprint(_blueprint(stream, before, after, steps, held_out is not None))


def _blueprint(
    stream: rr.RecordingStream,
    before: Comparison,
    after: Comparison,
    steps: Sequence[WaterfallStep],
    held_out: bool,
) -> rrb.Blueprint:
    flight = before.flight
    width = round(SMOOTHING / flight.dt)
    errors = [rolling_rms(c.residual, c.used, width) for c in (before, after)]
    finite = errors[0][np.isfinite(errors[0])]
    highest = float(np.quantile(finite, 0.99)) if finite.size else 1.0
    views: list[rrb.View] = []
    if flight.position is not None:
        for name, c, error in (("before", before, errors[0]), ("after", after, errors[1])):
            views.append(_space(stream, name, c, error, highest))
    for index, (name, c, error) in enumerate((("before", before, errors[0]), ("after", after, errors[1]))):
        curve(stream, f"over_time/{name}", flight.t, error, c.label, of_version(index, 2), 2.0)
    floor = np.full(2, after.noise_floor)
    curve(stream, "over_time/floor", flight.t[[0, -1]], floor, "noise floor", FLOOR)
    bars = bar_groups(stream, "residual RMS (m/s²) over model version", _groups(steps))
    text(stream, "summary", _summary(before, after, steps, held_out))
    which = "held-out flight" if held_out else "fitted flight"
    over_time = rrb.TimeSeriesView(
        origin="over_time",
        name=f"residual on the {which}, RMS over {SMOOTHING:g} s, m/s²",
        axis_x=rrb.TimeAxis(view_range=between(float(flight.t[0]), float(flight.t[-1]))),
        axis_y=rrb.ScalarAxis(range=(0.0, 1.1 * float(finite.max(initial=0.1)))),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
    )
    right = rrb.Vertical(
        rrb.TextDocumentView(origin="summary", name=f"{before.label} → {after.label}"),
        bars,
        over_time,
        row_shares=[2.4, 3, 3],
    )
    if not views:
        return rrb.Blueprint(right, rrb.TimePanel(state="collapsed", timeline=TIME), collapse_panels=True)
    scale = legend(stream, "legend", highest, "m/s²", "residual on both paths")
    left = rrb.Vertical(*views, scale, row_shares=[4, 4, 1])
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[1, 1]),
        rrb.TimePanel(state="collapsed", timeline=TIME),
        collapse_panels=True,
    )


def _space(
    stream: rr.RecordingStream, name: str, comparison: Comparison, error: np.ndarray, highest: float
) -> rrb.Spatial3DView:
    flight = comparison.flight
    position = flight.position
    assert position is not None
    flown = np.isfinite(error)
    size = scene.extent(position[flown])
    root = f"space_{name}"
    stream.log(root, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    scene.log_error_line(stream, f"{root}/path", position, error, highest, 0.005 * size)
    return rrb.Spatial3DView(
        origin=root,
        name=f"{name}: {comparison.label}, {comparison.rms:.3f} m/s²",
        eye_controls=scene.eye(position[flown], 1.1),
        line_grid=scene.ground(),
    )


def _groups(steps: Sequence[WaterfallStep]) -> list[tuple[str, Colour, list[float]]]:
    groups = [("fitted flight", NEWEST, [step.fitted for step in steps])]
    if all(step.held_out is not None for step in steps):
        groups.append(("held-out flight", HELD_OUT, [step.held_out or 0.0 for step in steps]))
    return [*groups, ("noise floor", FLOOR, [step.noise_floor for step in steps])]


def _summary(before: Comparison, after: Comparison, steps: Sequence[WaterfallStep], held_out: bool) -> str:
    lines = [
        "| residual RMS, m/s² | fitted | held out |" if held_out else "| residual RMS, m/s² | fitted |",
        "|---|---|---|" if held_out else "|---|---|",
    ]
    for index, step in enumerate(steps):
        cells = [step.fitted] + ([step.held_out or np.nan] if held_out else [])
        was = [steps[0].fitted] + ([steps[0].held_out or np.nan] if held_out else [])
        told = [
            f"{c:.3f}" + (f" ({100 * (c / w - 1):+.0f} %)" if index else "")
            for c, w in zip(cells, was, strict=True)
        ]
        lines.append(f"| {step.label} | " + " | ".join(told) + " |")
    lines.append(
        f"| *noise floor* | {steps[-1].noise_floor:.3f} |"
        + (f" {after.noise_floor:.3f} |" if held_out else "")
    )
    return "\n".join(lines)
