"""The tube: the flown error inside what the bound allows, over time and in space."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.evaluate.bound import Tube
from trueflight.groundstation.views import scene
from trueflight.groundstation.views.colour import FLOOR, LINEAR, NEWEST, REFERENCE
from trueflight.groundstation.views.recording import TIME, curve, readable, recording, text, thin

BALLS = 60
"""Balls drawn along the middle of the tube at most; more hide the path."""
WIDEST = 0.25
"""Half width of a tube, in sizes of the scene, beyond which it would hide the path: then only the ball of the moment
is drawn."""


def write_tube(path: Path, tube: Tube) -> None:
    """Write the recording of a flight in its tube."""
    with recording(path, "tube", tube.label) as stream:
        stream.send_blueprint(_blueprint(stream, tube))


def _blueprint(stream: rr.RecordingStream, tube: Tube) -> rrb.Blueprint:
    clock = tube.t - tube.t[0]
    breaks = np.concatenate([[False], np.diff(clock) > 0.2])
    rows = []
    for k, axis in enumerate("xyz"):
        for kind, column, scale, unit in (("position", 0, 100.0, "cm"), ("velocity", 1, 100.0, "cm/s")):
            allowed = _broken(scale * tube.extent[:, k, column], breaks)
            middle = scale * tube.centre[:, k, column]
            error = _broken(scale * tube.eta[:, k, column], breaks)
            curve(stream, f"{kind}/{axis}/above", clock, middle + allowed, "tube", REFERENCE, 2.0)
            curve(stream, f"{kind}/{axis}/below", clock, middle - allowed, "tube", REFERENCE, 2.0)
            curve(stream, f"{kind}/{axis}/flown", clock, error, f"error, {unit}", NEWEST, 1.5)
            _mark(stream, f"{kind}/{axis}/left", tube, axis, clock, error)
        curve(
            stream,
            f"level/{axis}/allowed",
            clock,
            _broken(tube.predicted[:, k], breaks),
            "allowed",
            REFERENCE,
            2.0,
        )
        curve(stream, f"level/{axis}/flown", clock, _broken(tube.level[:, k], breaks), "flown", NEWEST, 1.5)
        _mark(stream, f"level/{axis}/left", tube, axis, clock, tube.level[:, k])
        d = _broken(np.abs(tube.disturbance.total[:, k]), breaks)
        curve(stream, f"level/{axis}/d", clock, d, "|d|", FLOOR, 1.0)
        rows.append(_row(tube, k, first=k == 0))
    _log_space(stream, tube, clock)
    text(stream, "summary", _summary(tube))
    space = rrb.Spatial3DView(
        origin="space",
        name=f"flown (blue) and the ball around the {tube.disturbance.around} (green)",
        eye_controls=scene.eye(np.concatenate([tube.position, tube.reference + tube.centre[:, :, 0]]), 1.1),
        line_grid=scene.ground(),
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(rrb.TextDocumentView(origin="summary", name="bound"), space, row_shares=[2, 3]),
            rrb.Vertical(*rows),
            column_shares=[2, 3],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIME),
        collapse_panels=True,
    )


def _row(tube: Tube, k: int, first: bool) -> rrb.Horizontal:
    axis, legend = "xyz"[k], rrb.PlotLegend(rrb.Corner2D.RightTop, visible=first)
    ends = []
    for c in (0, 1):
        centre, extent = tube.centre[:, k, c], tube.extent[:, k, c]
        ends.append(100.0 * np.concatenate([centre - extent, centre + extent, tube.eta[:, k, c]]))
    level = np.concatenate(
        [[0.0], tube.predicted[:, k], tube.level[:, k], np.abs(tube.disturbance.total[:, k])]
    )
    return rrb.Horizontal(
        *(
            rrb.TimeSeriesView(
                origin=f"{origin}/{axis}",
                name=name,
                axis_y=rrb.ScalarAxis(
                    range=readable(float(np.nanmin(drawn)), float(np.nanmax(drawn)), 215.0)
                ),
                plot_legend=legend,
            )
            for origin, name, drawn in (
                ("position", f"position error in {axis}, cm", ends[0]),
                ("velocity", f"velocity error in {axis}, cm/s", ends[1]),
                ("level", f"V^½ of {axis}, and |d|, m/s²", level),
            )
        )
    )


def _broken(values: np.ndarray, breaks: np.ndarray) -> np.ndarray:
    """Values (M,) with a gap where one mission ends and the next begins."""
    return np.where(breaks, np.nan, values)


def _mark(
    stream: rr.RecordingStream, path: str, tube: Tube, axis: str, clock: np.ndarray, values: np.ndarray
) -> None:
    """Points where the flight leaves the tube."""
    times = [leaving.start for leaving in tube.leavings if leaving.axis == axis]
    if not times:
        return
    rows = np.searchsorted(tube.t, times)
    stream.log(
        path,
        rr.SeriesPoints(colors=[LINEAR], markers="circle", marker_sizes=[6.0], names="leaves the tube"),
        static=True,
    )
    stream.send_columns(
        path,
        indexes=[rr.TimeColumn(TIME, duration=clock[rows])],
        columns=rr.Scalars.columns(scalars=values[rows]),
    )


def _log_space(stream: rr.RecordingStream, tube: Tube, clock: np.ndarray) -> None:
    size = scene.extent(tube.position)
    middle = tube.reference + tube.centre[:, :, 0]
    stream.log("space", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    scene.log_line(stream, "space/flown", tube.position, NEWEST, 0.006 * size)
    scene.log_line(stream, "space/middle", middle, REFERENCE, 0.003 * size)
    some = thin(len(clock), BALLS)
    half = tube.extent[:, :, 0]
    if half.max() < WIDEST * size:
        stream.log(
            "space/tube",
            rr.Ellipsoids3D(
                centers=middle[some], half_sizes=half[some], colors=[(*REFERENCE, 10)], fill_mode="solid"
            ),
            static=True,
        )
    outside = np.any(tube.level > tube.predicted + tube.resolution, axis=1)
    if outside.any():
        points = tube.position[outside][thin(int(outside.sum()), 500)]
        stream.log("space/outside", rr.Points3D(points, colors=[LINEAR], radii=0.012 * size), static=True)
    step = thin(len(clock))
    stream.send_columns(
        "space/now",
        indexes=[rr.TimeColumn(TIME, duration=clock[step])],
        columns=rr.Ellipsoids3D.columns(
            centers=middle[step],
            half_sizes=half[step],
            colors=np.tile(REFERENCE, (len(clock[step]), 1)),
        ),
    )


def _summary(tube: Tube) -> str:
    ball, most, inside = tube.ball, np.abs(tube.distance).max(axis=0), tube.inside
    lines = [
        "| axis | radius (m/s²) | decay (1/s) | ball (cm) | flown | ball (cm/s) | flown | inside |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for k, axis in enumerate("xyz"):
        lines.append(
            f"| {axis} | {tube.radius[k]:.2f} | {tube.balls[k].decay:.2f} | ± {100 * ball[k, 0]:.1f} "
            f"| {100 * most[k, 0]:.1f} | ± {100 * ball[k, 1]:.0f} | {100 * most[k, 1]:.0f} | {100 * inside[k]:.2f} % |"
        )
    lines += ["", f"Around the {tube.disturbance.around}; bound from {Path(tube.bound_from).name}."]
    if len(tube.jumps):
        lines.append(f"The reference jumps {len(tube.jumps)} times; the tube widens there by as much.")
    lines += ["", f"The sensors resolve {tube.resolution.max():.2f} m/s².", ""]
    lines += [
        f"- **leaves the tube** in {leaving.axis} at t = {leaving.start - tube.t[0]:.2f} s for "
        f"{leaving.end - leaving.start:.2f} s"
        for leaving in tube.leavings[:6]
    ] or ["The flight never leaves the tube."]
    return "\n".join(lines)
