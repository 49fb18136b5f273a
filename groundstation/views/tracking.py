"""Tracking: what was flown beside the linear behaviour that was expected, flight by flight."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.evaluate.tracking import Tracking, told_apart
from trueflight.groundstation.views import scene
from trueflight.groundstation.views.bars import bar_groups
from trueflight.groundstation.views.colour import EXPECTED, NEWEST, Colour, of_version
from trueflight.groundstation.views.recording import curve, page, readable, recording, text


def write_tracking(path: Path, tracked: Sequence[Tracking]) -> None:
    """Write the recording of flights (before first, after last) against their expected linear behaviour."""
    tracked = told_apart(tracked)
    with recording(path, "tracking", " and ".join(t.label for t in tracked)) as stream:
        stream.send_blueprint(page(tracking_panel(stream, tracked)))


def tracking_panel(stream: rr.RecordingStream, tracked: Sequence[Tracking], root: str = "") -> rrb.Container:
    """Flown and expected in space, the distance over time, errors per axis and the table of all."""
    count = len(tracked)
    positions = np.concatenate([t.position for t in tracked])
    misses = np.concatenate([t.position - t.expected for t in tracked])
    size = scene.extent(positions)
    stream.log(f"{root}space", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for index, t in enumerate(tracked):
        colour = of_version(index, count) if count > 1 else NEWEST
        scene.log_line(stream, f"{root}space/flight{index}", t.position, colour, 0.004 * size)
        scene.log_line(stream, f"{root}space/expected{index}", t.expected, EXPECTED, 0.003 * size)
        clock = t.t if count == 1 else t.t - t.t[0]
        miss = np.linalg.norm(t.position - t.expected, axis=1)
        gaps = np.concatenate([[False], np.diff(clock) > 0.2])
        miss = np.where(gaps, np.nan, miss)
        curve(stream, f"{root}distance/flight{index}", clock, 100 * miss, t.label, colour, 2.0)
        for axis, name in enumerate("xyz"):
            error = 100 * np.where(gaps, np.nan, t.position[:, axis] - t.expected[:, axis])
            curve(stream, f"{root}error/{name}/flight{index}", clock, error, t.label, colour, 1.5)
    space = rrb.Spatial3DView(
        origin=f"{root}space",
        name="flown, and expected of the linear design (green)",
        eye_controls=scene.eye(positions),
        line_grid=scene.ground(),
    )
    bars = bar_groups(
        stream, "mean squared error, cm²", ("x", "y", "z"), _groups(tracked), f"{root}bars/", wide=150.0
    )
    distance = rrb.TimeSeriesView(
        origin=f"{root}distance",
        name="distance to the expected position, cm",
        axis_y=rrb.ScalarAxis(range=readable(0.0, 100 * float(np.linalg.norm(misses, axis=1).max()), 270.0)),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
    )
    errors = [
        rrb.TimeSeriesView(
            origin=f"{root}error/{name}",
            name=f"error in {name}, cm",
            axis_y=rrb.ScalarAxis(
                range=readable(100 * float(misses[:, axis].min()), 100 * float(misses[:, axis].max()), 105.0)
            ),
            plot_legend=rrb.PlotLegend(visible=False),
        )
        for axis, name in enumerate("xyz")
    ]
    text(stream, f"{root}tracked", _summary(tracked))
    return rrb.Horizontal(
        rrb.Vertical(space, distance, row_shares=[3, 2]),
        rrb.Vertical(
            rrb.Horizontal(rrb.TextDocumentView(origin=f"{root}tracked", name="tracking"), bars),
            *errors,
            row_shares=[3, 1.4, 1.4, 1.4],
        ),
        column_shares=[1, 1],
        name="tracking",
    )


def _groups(tracked: Sequence[Tracking]) -> list[tuple[str, Colour, list[float | None]]]:
    count = len(tracked)
    colours = [of_version(index, count) if count > 1 else NEWEST for index in range(count)]
    return [
        (f"{index + 1} {t.label}", colour, [1e4 * axis for axis in t.mse])
        for index, (t, colour) in enumerate(zip(tracked, colours, strict=True))
    ]


def _summary(tracked: Sequence[Tracking]) -> str:
    lines = [
        "Mean squared error against the expected linear behaviour:",
        "",
        "| axis | " + " | ".join(t.label for t in tracked) + " |",
    ]
    lines.append("|---|" + "---|" * len(tracked))
    for axis, name in enumerate("xyz"):
        lines.append(f"| {name} (cm²) | " + " | ".join(f"{1e4 * t.mse[axis]:.3g}" for t in tracked) + " |")
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        lines.append(
            f"| {name} (deg²) | "
            + " | ".join(f"{np.degrees(np.degrees(t.mse_zeta[axis])):.3g}" for t in tracked)
            + " |"
        )
    lines.append("| **distance, rms (cm)** | " + " | ".join(f"**{100 * t.rms:.1f}**" for t in tracked) + " |")
    return "\n".join(lines)
