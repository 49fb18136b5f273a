"""Where a model fails: the path coloured by the error, the error against each variable, the worst moments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from groundstation.results import Comparison, ErrorMap, WhereItFails
from groundstation.views import scene
from groundstation.views.bars import legend
from groundstation.views.colour import FLOOR, NEWEST, WARNING
from groundstation.views.comparison import rolling_rms
from groundstation.views.recording import TIME, between, curve, recording, text

MARKED = 3
"""Worst moments that are marked in space."""
MAPS = 6
SMOOTHING = 0.3  # s


def write_where(path: Path, comparison: Comparison, where: WhereItFails) -> None:
    """Write the recording of where `comparison` fails."""
    with recording(path, "where", f"{comparison.flight.name}: where {comparison.label} fails") as stream:
        stream.send_blueprint(_blueprint(stream, comparison, where))


def _blueprint(stream: rr.RecordingStream, comparison: Comparison, where: WhereItFails) -> rrb.Blueprint:
    flight = comparison.flight
    error = rolling_rms(comparison.residual, comparison.used, round(SMOOTHING / flight.dt))
    finite = error[np.isfinite(error)]
    highest = float(np.quantile(finite, 0.99)) if finite.size else 1.0
    left: list[rrb.View] = []
    shares: list[float] = []
    if flight.position is not None:
        left += [_space(stream, comparison, where, error, highest)]
        left += [
            legend(
                stream, "legend", highest, "m/s²", f"residual of {comparison.label}, RMS over {SMOOTHING:g} s"
            )
        ]
        shares += [8.0, 1.3]
    curve(stream, "over_time/residual", flight.t, error, comparison.label, NEWEST, 1.5)
    floor = np.full(2, comparison.noise_floor)
    curve(stream, "over_time/floor", flight.t[[0, -1]], floor, "noise floor", FLOOR)
    _mark_worst(stream, where, highest)
    left.append(
        rrb.TimeSeriesView(
            origin="over_time",
            name="residual over time, m/s² (worst moments marked)",
            axis_x=rrb.TimeAxis(view_range=between(float(flight.t[0]), float(flight.t[-1]))),
            axis_y=rrb.ScalarAxis(range=(0.0, 1.1 * float(finite.max(initial=0.1)))),
            plot_legend=rrb.PlotLegend(visible=False),
        )
    )
    shares.append(3.0)
    text(stream, "regions", _regions(comparison, where))
    maps = [_map(stream, m) for m in where.maps if m.variable != "time"][:MAPS]
    rows = [rrb.Horizontal(*maps[k : k + 2]) for k in range(0, len(maps), 2)]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*left, row_shares=shares),
            rrb.Vertical(
                rrb.TextDocumentView(origin="regions", name="where the error sits"),
                *rows,
                row_shares=[1.8, *[1.0] * len(rows)],
            ),
            column_shares=[1, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIME),
        collapse_panels=True,
    )


def _space(
    stream: rr.RecordingStream, comparison: Comparison, where: WhereItFails, error: np.ndarray, highest: float
) -> rrb.Spatial3DView:
    flight = comparison.flight
    position = flight.position
    assert position is not None
    flown = np.isfinite(error)
    size = scene.extent(position[flown])
    stream.log("space", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    scene.log_error_line(stream, "space/path", position, error, highest, 0.004 * size)
    scene.log_vehicle(stream, "space/vehicle", flight.vehicle, size)
    if flight.quaternion is not None:
        scene.log_motion(stream, "space/vehicle", flight.t, position, flight.quaternion)
    if where.worst:
        middles = [0.5 * (m.start + m.end) for m in where.worst[:MARKED]]
        places = np.stack([np.interp(middles, flight.t, axis) for axis in position.T], -1)
        labels = [f"{m.rms:.2f} m/s² at {m.start:.1f} s" for m in where.worst[:MARKED]]
        stream.log(
            "space/worst",
            rr.Points3D(
                places, labels=labels, radii=0.012 * size, colors=[(255, 255, 255)], show_labels=True
            ),
            static=True,
        )
    return rrb.Spatial3DView(
        origin="space",
        name="path, coloured by the residual",
        eye_controls=scene.eye(position[flown]),
        line_grid=scene.ground(),
    )


def _mark_worst(stream: rr.RecordingStream, where: WhereItFails, highest: float) -> None:
    """Each worst stretch as a bar of its RMS over the time axis."""
    for number, moment in enumerate(where.worst):
        t = np.array([moment.start, moment.end])
        name = "worst moments" if number == 0 else f"worst {number + 1}"
        curve(stream, f"over_time/worst/{number}", t, np.full(2, moment.rms), name, WARNING, 5.0)


def _map(stream: rr.RecordingStream, error_map: ErrorMap) -> rrb.BarChartView:
    path = f"maps/{error_map.variable.replace(' ', '_')}"
    edges = error_map.edges
    middle, width = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    values = np.nan_to_num(error_map.rms)
    stream.log(path, rr.BarChart(values, abscissa=middle, widths=0.92 * width, color=NEWEST), static=True)
    unit = "" if error_map.unit == "1" else f" ({error_map.unit})"
    return rrb.BarChartView(
        origin=path,
        name=f"RMS (m/s²) over {error_map.variable}{unit}",
        plot_legend=rrb.PlotLegend(visible=False),
    )


def _regions(comparison: Comparison, where: WhereItFails) -> str:
    head = f"**{comparison.label}: {comparison.rms:.3f} m/s²**, noise floor {comparison.noise_floor:.3f} m/s²"
    lines = [head, ""]
    if where.regions:
        lines += [
            f"- **{region.text}**" if n == 0 else f"- {region.text}" for n, region in enumerate(where.regions)
        ]
    else:
        lines.append("The error is spread over the flight: no part of it holds much more than its share.")
    lines += ["", "Worst moments:", ""]
    lines += [
        f"- {m.start:.1f} to {m.end:.1f} s, **{m.rms:.2f} m/s²**: {m.text}" for m in where.worst[:MARKED]
    ]
    return "\n".join(lines)
