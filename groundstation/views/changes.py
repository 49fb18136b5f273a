"""What changes in flight: parameters over time, and the moments as lines of a log."""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.results import EffectVerdict
from trueflight.groundstation.views.colour import of_version
from trueflight.groundstation.views.recording import TIME, curve


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
        curve(
            stream,
            f"{root}{name.replace(' ', '/')}",
            course.times,
            course.value,
            label,
            of_version(number, len(courses)),
        )
    for e in told:
        for change in () if e.over_time is None else e.over_time.changes:
            stream.set_time(TIME, duration=change.time)
            words = f"{e.name} changes [{change.low:.2f}, {change.high:.2f}]: {'; '.join(e.over_time.lines)}"  # type: ignore[union-attr]
            stream.log(f"{root}moments", rr.TextLog(words, level=rr.TextLogLevel.WARN))
    stream.reset_time()
    names = ", ".join(e.name for e in told)
    return rrb.Vertical(
        rrb.TimeSeriesView(origin=root.rstrip("/"), name=f"parameters over time: {names}"),
        rrb.TextLogView(
            origin=f"{root}moments",
            name="moments of change (click on a time to go there)",
            columns=rrb.TextLogColumns(timeline_columns=[TIME], text_log_columns=["Body"]),
        ),
        row_shares=[3, 1.2],
    )
