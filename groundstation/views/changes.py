"""What changes in flight: parameters over time, and the moments as lines of a log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.results import EffectVerdict
from trueflight.groundstation.views.colour import NEWEST, of_version
from trueflight.groundstation.views.recording import TIME, between, curve, log_words, readable


def changes_panel(
    stream: rr.RecordingStream, effects: Sequence[EffectVerdict], root: str
) -> rrb.Container | None:
    """The parameters of effects that change in flight over time, and their moments; None where none does."""
    told = [e for e in effects if e.over_time is not None and e.rank]
    if not told:
        return None
    courses = [
        (f"{e.name} {c.name}", c) for e in told if e.over_time is not None for c in e.over_time.courses
    ]
    for number, (name, course) in enumerate(courses):
        label = f"{name}, {course.unit}" if course.unit != "1" else name
        # a step is one: of two values at one time a viewer draws the mean
        later = np.arange(len(course.times)) * 1e-6
        colour = of_version(number, len(courses)) if len(courses) > 1 else NEWEST
        curve(
            stream,
            f"{root}curves/{number}",
            course.times + later,
            course.value,
            label,
            colour,
            2.5,
            exact=True,
        )
    for e in told:
        for change in () if e.over_time is None else e.over_time.changes:
            words = f"{e.name} changes [{change.low:.2f}, {change.high:.2f}]: {'; '.join(e.over_time.lines)}"  # type: ignore[union-attr]
            log_words(stream, f"{root}moments", change.time, words)
    names = ", ".join(e.name for e in told)
    values = np.concatenate([[0.0], *(course.value for _, course in courses)])
    times = np.concatenate([course.times for _, course in courses])
    return rrb.Vertical(
        rrb.TimeSeriesView(
            origin=f"{root}curves",
            name=f"parameters over time: {names}",
            axis_x=rrb.TimeAxis(view_range=between(float(times.min()), float(times.max()))),
            axis_y=rrb.ScalarAxis(range=readable(float(values.min()), float(values.max()), 110.0)),
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        ),
        rrb.TextLogView(
            origin=f"{root}moments",
            name="moments of change (click on a time to go there)",
            columns=rrb.TextLogColumns(timeline_columns=[TIME], text_log_columns=["Body"]),
        ),
        row_shares=[2.6, 1.7],
    )
