"""The residual in space and over time, with the worst moments as marks: what several views share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.evaluate.error_over_time import ErrorOverTime
from trueflight.groundstation.results import Moment
from trueflight.groundstation.views import scene
from trueflight.groundstation.views.bars import legend
from trueflight.groundstation.views.colour import FLOOR, WARNING, Colour
from trueflight.groundstation.views.recording import TIME, between, curve, log_words, readable

MARKED = 3
"""Worst moments that are marked in space."""


def error_path(
    stream: rr.RecordingStream,
    root: str,
    error: ErrorOverTime,
    name: str,
    worst: Sequence[Moment] = (),
    vehicle: bool = False,
    distance: float = 0.8,
) -> rrb.Spatial3DView | None:
    """The path in space coloured by the error, with worst moments and the moving vehicle; None without position."""
    flight = error.comparison.flight
    position = flight.position
    if position is None:
        return None
    flown = np.isfinite(error.values) & np.all(np.isfinite(position), axis=1)
    if not np.any(flown):
        return None
    size = scene.extent(position[flown])
    stream.log(root, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    scene.log_error_line(stream, f"{root}/path", position, error.values, error.highest, 0.0045 * size)
    if vehicle:
        scene.log_vehicle(stream, f"{root}/vehicle", flight.vehicle, size)
        if flight.quaternion is not None:
            scene.log_motion(stream, f"{root}/vehicle", flight.t, position, flight.quaternion)
    if worst:
        middles = [0.5 * (m.start + m.end) for m in worst[:MARKED]]
        places = np.stack([np.interp(middles, flight.t, axis) for axis in position.T], -1)
        labels = [f"worst {number}" for number in range(1, len(places) + 1)]
        marks = rr.Points3D(
            places, labels=labels, radii=0.012 * size, colors=[(255, 255, 255)], show_labels=True
        )
        stream.log(f"{root}/worst", marks, static=True)
    return rrb.Spatial3DView(
        origin=root, name=name, eye_controls=scene.eye(position[flown], distance), line_grid=scene.ground()
    )


def error_legend(stream: rr.RecordingStream, path: str, error: ErrorOverTime, name: str) -> rrb.View:
    """The scale of the error's colours."""
    return legend(stream, path, error.highest, "m/s²", f"{name}, RMS over {error.smoothing:g} s")


def error_curves(
    stream: rr.RecordingStream,
    root: str,
    errors: Sequence[tuple[str, ErrorOverTime, Colour]],
    name: str,
    worst: Sequence[Moment] = (),
    clock: float | None = None,
    height: float = 150.0,
) -> rrb.TimeSeriesView:
    """Residuals (name, error, colour) over the whole flight beside the noise floor, the worst moments marked.

    `clock` is the time at which every flight begins, where flights are laid over each other. `height` is that of
    the view, in points of a window of 900.
    """
    highest, start, end = 0.1, np.inf, -np.inf
    for number, (label, error, colour) in enumerate(errors):
        t = error.comparison.flight.t
        t = t if clock is None else t - t[0] + clock
        start, end = min(start, float(t[0])), max(end, float(t[-1]))
        highest = max(highest, float(np.nanmax(error.values, initial=0.1)))
        curve(stream, f"{root}/{number}", t, error.values, label, colour, 2.0)
    floor = np.full(2, errors[-1][1].comparison.noise_floor)
    curve(stream, f"{root}/floor", np.array([start, end]), floor, "noise floor", FLOOR)
    if worst:
        _mark(stream, f"{root}/worst", worst)
    return rrb.TimeSeriesView(
        origin=root,
        name=name,
        axis_x=rrb.TimeAxis(view_range=between(start, end)),
        axis_y=rrb.ScalarAxis(range=readable(0.0, highest, height)),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=len(errors) > 1),
    )


def _mark(stream: rr.RecordingStream, path: str, worst: Sequence[Moment]) -> None:
    """Each worst stretch as a bar at its RMS, all in one curve."""
    ordered = sorted(worst, key=lambda m: m.start)
    t = np.array([x for m in ordered for x in (m.start, m.end, m.end + 1e-6)])
    values = np.array([x for m in ordered for x in (m.rms, m.rms, np.nan)])
    # drawn point by point: averaged over pixels, a gap would swallow its neighbours
    lines = rr.SeriesLines(colors=[WARNING], names="worst moments", widths=[5.0], aggregation_policy="Off")
    stream.log(path, lines, static=True)
    times = rr.TimeColumn(TIME, duration=t)
    stream.send_columns(path, indexes=[times], columns=rr.Scalars.columns(scalars=values))


def moments_log(stream: rr.RecordingStream, path: str, worst: Sequence[Moment], name: str) -> rrb.TextLogView:
    """The worst moments as lines of a log at their times: a click on a time moves the whole recording there."""
    for number, moment in enumerate(worst, 1):
        told = f"worst {number}: {moment.rms:.2f} m/s², until {moment.end:.1f} s: {moment.text}"
        log_words(stream, path, moment.start, told)
    return rrb.TextLogView(
        origin=path,
        name=name,
        columns=rrb.TextLogColumns(timeline_columns=[TIME], text_log_columns=["Body"]),
    )
