"""Flights, or models, side by side: the error over the same bins and the same clock, and the paths."""

from __future__ import annotations

from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.evaluate.error_over_time import error_over_time
from trueflight.groundstation.evaluate.side_by_side import SideBySide
from trueflight.groundstation.output.cited import written
from trueflight.groundstation.views.bars import bars_over
from trueflight.groundstation.views.colour import AXES, BETWEEN, LINEAR, NEWEST, REFERENCE, Colour
from trueflight.groundstation.views.error import error_curves, error_legend, error_path
from trueflight.groundstation.views.recording import page, recording, text

COLOURS: tuple[Colour, ...] = (LINEAR, NEWEST, REFERENCE, *BETWEEN, *AXES)
SMOOTHING = 0.5  # s
PATHS = 4
MAPS = 6


def write_side_by_side(path: Path, beside: SideBySide) -> None:
    """Write the recording of comparisons side by side."""
    with recording(path, "side by side", " and ".join(beside.names)) as stream:
        stream.send_blueprint(page(side_by_side_panel(stream, beside)))


def side_by_side_panel(stream: rr.RecordingStream, beside: SideBySide, root: str = "") -> rrb.Container:
    """The paths in one scale of colours, residuals over time from the start of each flight, and the maps."""
    highest = max(error_over_time(c, SMOOTHING).highest for c in beside.comparisons)
    errors = [error_over_time(c, SMOOTHING, highest) for c in beside.comparisons]
    first = errors[0]
    spaces = [
        error_path(stream, f"{root}space{k}", error, f"{beside.names[k]}: {error.comparison.rms:.3f} m/s²",
                   distance=1.0)
        for k, error in enumerate(errors[:PATHS])
    ]  # fmt: skip
    views: list[rrb.View | rrb.Container] = [v for v in spaces if v is not None]
    left: list[rrb.View | rrb.Container] = []
    shares: list[float] = []
    if views:
        rows = [rrb.Horizontal(*views[k : k + 2]) for k in range(0, len(views), 2)]
        left += [*rows, error_legend(stream, f"{root}scale", first, "residual on every path")]
        shares += [4.0] * len(rows) + [1.3]
    one_clock = len({id(c.flight) for c in beside.comparisons}) > 1
    named = [(beside.names[k], e, COLOURS[k % len(COLOURS)]) for k, e in enumerate(errors)]
    start = " from the start of each flight" if one_clock else ""
    left.append(
        error_curves(
            stream,
            f"{root}over_time",
            named,
            f"residual, RMS over {SMOOTHING:g} s, m/s²{start}",
            clock=0.0 if one_clock else None,
        )
    )
    shares.append(3.0)
    text(stream, f"{root}table", _table(beside))
    maps = [
        _map(stream, beside, variable, f"{root}maps")
        for variable in [m.variable for m in beside.where[0].maps if m.variable != "time"][:MAPS]
    ]
    pairs = [rrb.Horizontal(*maps[k : k + 2]) for k in range(0, len(maps), 2)]
    return rrb.Horizontal(
        rrb.Vertical(*left, row_shares=shares),
        rrb.Vertical(
            rrb.TextDocumentView(origin=f"{root}table", name="side by side"),
            *pairs,
            row_shares=[1.6, *[1.0] * len(pairs)],
        ),
        column_shares=[1, 1],
        name="side by side",
    )


def _map(stream: rr.RecordingStream, beside: SideBySide, variable: str, root: str) -> rrb.Spatial2DView:
    first = next(m for m in beside.where[0].maps if m.variable == variable)
    bars = []
    for k, where in enumerate(beside.where):
        m = next((m for m in where.maps if m.variable == variable), None)
        if m is not None:
            bars.append((str(k), COLOURS[k % len(COLOURS)], m.rms))
    unit = "" if first.unit == "1" else f" ({first.unit})"
    name = f"RMS (m/s²) over {variable}{unit}"
    return bars_over(stream, name, first.edges, bars, f"{root}/{variable.replace(' ', '_')}")


def _table(beside: SideBySide) -> str:
    axes = [a.axis for a in beside.comparisons[0].axes]
    lines = [
        "| residual RMS, m/s² | " + " | ".join(axes) + " | all | noise floor | change |",
        "|---|" + "---|" * (len(axes) + 3),
    ]
    for name, c, change in zip(beside.names, beside.comparisons, beside.change, strict=True):
        cells = [f"{a.rms:.3f}" for a in c.axes]
        told = "" if c is beside.comparisons[0] else written(change, "change")
        lines.append(
            f"| {name} | " + " | ".join(cells) + f" | **{c.rms:.3f}** | {c.noise_floor:.3f} | {told} |"
        )
    for name, where in zip(beside.names, beside.where, strict=True):
        if where.regions:
            lines += ["", f"**{name}**: {where.regions[0].text}"]
    return "\n".join(lines)
