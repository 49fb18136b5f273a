"""Bar charts with several bars a place, and the legend of the error's colours."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.views.colour import Colour, of_error

WIDTH = 100.0
"""Length of the legend, in units of its plane."""


def bar_groups(
    stream: rr.RecordingStream,
    name: str,
    groups: Sequence[tuple[str, Colour, Sequence[float]]],
    root: str = "",
) -> rrb.BarChartView:
    """A chart with one bar of each group (name, colour, values) at 0, 1, 2...; returns its view.

    The legend of a chart shows entity paths, so each group stands under its own name, behind `root`.
    """
    width = 0.8 / len(groups)
    paths = [root + group.replace(" ", "_") for group, _, _ in groups]
    for number, (path, (_, colour, values)) in enumerate(zip(paths, groups, strict=True)):
        places = np.arange(len(values)) + width * (number - 0.5 * (len(groups) - 1))
        widths = np.full(len(values), 0.92 * width)
        bars = rr.BarChart(np.asarray(values, dtype=float), abscissa=places, widths=widths, color=colour)
        stream.log(path, bars, static=True)
    return rrb.BarChartView(
        origin="/",
        contents=[f"/{path}" for path in paths],
        name=name,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
    )


def words(
    stream: rr.RecordingStream, path: str, places: Sequence[tuple[float, float]], texts: Sequence[str]
) -> None:
    """Words in the plane, centred on their places."""
    stream.log(
        path,
        rr.Points2D(
            places, labels=list(texts), radii=0.0, colors=[(230, 230, 230)], show_labels=True, draw_order=2.0
        ),
        static=True,
    )


def legend(stream: rr.RecordingStream, path: str, highest: float, unit: str, name: str) -> rrb.Spatial2DView:
    """The colour scale of errors from 0 to `highest`."""
    steps = 60
    x = np.linspace(0.0, WIDTH, steps + 1)
    strips = [[[a, 0.0], [b, 0.0]] for a, b in pairwise(x)]
    colours = of_error(np.linspace(0.0, highest, steps), highest)
    stream.log(f"{path}/scale", rr.LineStrips2D(strips, colors=colours, radii=2.2), static=True)
    marks = np.linspace(0.0, 1.0, 5)
    words(
        stream,
        f"{path}/numbers",
        [(WIDTH * m, 6.0) for m in marks],
        [f"{m * highest:.2g}{' ' + unit if m == 1.0 else ''}" for m in marks],
    )
    return rrb.Spatial2DView(
        origin=path,
        contents=f"{path}/**",
        name=name,
        visual_bounds=rrb.VisualBounds2D(x_range=[-8.0, WIDTH + 12.0], y_range=[-5.0, 11.0]),
    )
