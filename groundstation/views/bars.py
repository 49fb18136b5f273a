"""Bars with their names and values, drawn in a plane, and the legend of the error's colours."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.views.colour import Colour, of_error

WIDTH = 100.0
"""Length of the legend, in units of its plane."""
WIDE, HIGH = 330.0, 56.0
"""The plane of a bar chart in half of a window, without what is written around it."""
LETTER, LINE = 4.3, 12.0
"""A letter's width and a line's height there."""
WHITE: Colour = (230, 230, 230)
FAINT: Colour = (110, 110, 110)
STROKES, FINE = 60, 8
"""Lines that fill a bar: a single one would have round ends."""


def bar_groups(
    stream: rr.RecordingStream,
    name: str,
    places: Sequence[str],
    groups: Sequence[tuple[str, Colour, Sequence[float | None]]],
    root: str,
    line: tuple[str, float] | None = None,
    wide: float = WIDE,
) -> rrb.Spatial2DView:
    """A chart with one bar of each group (name, colour, values) over each of `places`, by its name; returns its view.

    Every bar has its value above it; a value that is None has no bar. `line` is a name and a value for all.
    """
    shown = [v for _, _, values in groups for v in values if v is not None]
    most = max([*shown, 0.0 if line is None else line[1]]) or 1.0
    room = wide / len(places)
    width = 0.8 * room / len(groups)
    for number, (group, colour, values) in enumerate(groups):
        middles = [room * (k + 0.1) + width * (number + 0.5) for k in range(len(places))]
        bars = [
            (x, HIGH * v / most, _short(v)) for x, v in zip(middles, values, strict=True) if v is not None
        ]
        _bars(stream, root + group.replace(" ", "_"), bars, 0.92 * width, colour)
    drawn = [root + group.replace(" ", "_") for group, _, _ in groups]
    if line is not None:
        told, value = line
        at = -HIGH * value / most
        stream.log(
            f"{root}frame/floor",
            rr.LineStrips2D([[[0, at], [wide, at]]], colors=[WHITE], radii=0.3),
            static=True,
        )
        words(stream, f"{root}frame/floor_name", [(wide + 6 * LETTER, at)], [f"{told}\n{_short(value)}"])
    _frame(stream, root, places, wide)
    lines = _names(stream, root, [(g, colour) for g, colour, _ in groups], wide) if len(groups) > 1 else 0
    return rrb.Spatial2DView(
        origin="/",
        contents=[f"/{path}/**" for path in (f"{root}frame", *drawn)],
        name=name,
        visual_bounds=rrb.VisualBounds2D(
            x_range=[-6.0, wide + (6.0 if line is None else 12 * LETTER)],
            y_range=[-HIGH - (1.4 + lines) * LINE, 2.2 * LINE],
        ),
    )


def _bars(
    stream: rr.RecordingStream,
    path: str,
    bars: Sequence[tuple[float, float, str]],
    width: float,
    colour: Colour,
) -> None:
    """Bars (middle, height, value in words) of one colour, and the values above them."""
    across = (np.arange(STROKES) + 0.5) / STROKES - 0.5
    strips = [[[x + width * a, 0.0], [x + width * a, -max(top, 0.3)]] for x, top, _ in bars for a in across]
    stream.log(
        f"{path}/bars", rr.LineStrips2D(strips, colors=[colour], radii=0.9 * width / STROKES), static=True
    )
    words(
        stream,
        f"{path}/values",
        [(x, -top - 0.75 * LINE) for x, top, _ in bars],
        [told for _, _, told in bars],
    )


def _frame(stream: rr.RecordingStream, root: str, places: Sequence[str], wide: float) -> None:
    """The line that bars stand on, and the name of each place below it, folded to its room."""
    ground = rr.LineStrips2D([[[0, 0], [wide, 0]]], colors=[FAINT], radii=0.3)
    stream.log(f"{root}frame/line", ground, static=True)
    room = wide / len(places)
    letters = max(8, int(room / LETTER))
    named = [
        "\n".join(textwrap.wrap(place, letters, break_long_words=False, break_on_hyphens=False))
        for place in places
    ]
    rows = [0.8 * LINE + 0.4 * LINE * text.count("\n") for text in named]
    words(stream, f"{root}frame/places", [(room * (k + 0.5), y) for k, y in enumerate(rows)], named)


def _names(stream: rr.RecordingStream, root: str, groups: Sequence[tuple[str, Colour]], wide: float) -> int:
    """What the colours are, above the bars to the right, side by side or below each other; returns the lines."""
    long = [(len(group) + 5) * LETTER for group, _ in groups]
    below = sum(long) > wide
    right = wide
    for k, ((group, colour), length) in enumerate(zip(groups, long, strict=True)):
        x = wide - 0.5 * length if below else right - sum(long[k:]) + 0.5 * length
        y = -HIGH - (1.9 + (len(groups) - 1 - k if below else 0)) * LINE
        words(stream, f"{root}{group.replace(' ', '_')}/name", [(x, y)], [f"■ {group}"], colour)
    return len(groups) if below else 1


def _short(value: float) -> str:
    """Two digits of a number, and the whole of what is larger."""
    return f"{value:.0f}" if value >= 100.0 else f"{value:#.2g}".rstrip(".")


def bars_over(
    stream: rr.RecordingStream,
    name: str,
    edges: np.ndarray,
    groups: Sequence[tuple[str, Colour, np.ndarray]],
    root: str,
    wide: float = 175.0,
) -> rrb.Spatial2DView:
    """A chart of values over the bins between `edges` (M + 1,), one bar of each group (name, colour, values (M,)) in
    each; both axes have labels at round numbers. Returns its view."""
    shown = np.concatenate([np.asarray(values, dtype=float) for _, _, values in groups])
    up, along = _ticks(0.0, float(np.nanmax(shown, initial=1e-9))), _ticks(float(edges[0]), float(edges[-1]))
    x_of = wide / (edges[-1] - edges[0])
    width = np.diff(edges) * x_of * 0.92 / len(groups)
    drawn = []
    for number, (group, colour, values) in enumerate(groups):
        starts = (edges[:-1] - edges[0]) * x_of + 0.04 * np.diff(edges) * x_of + number * width
        tops = HIGH * np.nan_to_num(np.asarray(values, dtype=float)) / up[-1]
        drawn.append(f"{root}/{group.replace(' ', '_')}")
        across = (np.arange(FINE) + 0.5) / FINE
        strips = [
            [[start + w * a, 0.0], [start + w * a, -top]]
            for start, w, top in zip(starts, width, tops, strict=True)
            for a in across
            if top > 0.0
        ]
        radius = 0.6 * float(width.max()) / FINE
        stream.log(f"{drawn[-1]}/bars", rr.LineStrips2D(strips, colors=[colour], radii=radius), static=True)
    lines = [[[0.0, -HIGH * v / up[-1]], [wide, -HIGH * v / up[-1]]] for v in up]
    stream.log(
        f"{root}/frame/lines",
        rr.LineStrips2D(lines, colors=[FAINT], radii=0.15, draw_order=-1.0),
        static=True,
    )
    words(stream, f"{root}/frame/up", [(-9.0, -HIGH * v / up[-1]) for v in up], [f"{v:g}" for v in up])
    inside = [v for v in along if edges[0] <= v <= edges[-1]]
    places = [(float((v - edges[0]) * x_of), 0.8 * LINE) for v in inside]
    words(stream, f"{root}/frame/along", places, [f"{v:g}" for v in inside])
    return rrb.Spatial2DView(
        origin="/",
        contents=[f"/{path}/**" for path in (f"{root}/frame", *drawn)],
        name=name,
        visual_bounds=rrb.VisualBounds2D(
            x_range=[-22.0, wide + 8.0], y_range=[-HIGH - 0.6 * LINE, 2.1 * LINE]
        ),
    )


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers over a range, three at least inside it where it does not begin at nothing, with the one above."""
    from matplotlib.ticker import MaxNLocator

    for most in (4, 5, 6, 8, 12):
        found = [
            float(f"{v:.6g}") for v in MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
        ]
        if sum(low <= v <= high for v in found) >= 3 or low == 0.0:
            return found
    return found


def words(
    stream: rr.RecordingStream,
    path: str,
    places: Sequence[tuple[float, float]],
    texts: Sequence[str],
    colour: Colour = WHITE,
) -> None:
    """Words in the plane, centred on their places."""
    stream.log(
        path,
        rr.Points2D(places, labels=list(texts), radii=0.0, colors=[colour], show_labels=True, draw_order=2.0),
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
