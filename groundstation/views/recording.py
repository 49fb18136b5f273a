"""Recordings on disk: opened beside their final name, and there only when whole."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.models.whole_file import whole_file

TIME = "flight_time"
"""The timeline of everything that happened in a flight: s on the flight's clock."""
MOST_POINTS = 4000
"""Points of one curve; more cannot be seen and make the recording slow."""


@contextmanager
def recording(path: Path, kind: str, name: str) -> Iterator[rr.RecordingStream]:
    """A stream that writes the recording `path`; `kind` names the view, `name` this one of its kind.

    Raises `InputError` where it cannot be written.
    """
    with whole_file(path, "the recording", "choose another --save") as partial:
        stream = rr.RecordingStream(f"trueflight {kind}")
        # Into memory, and from there to the disk: Rerun's own writer tells of a full disk in a log alone, and then a
        # flush never returns.
        content = stream.binary_stream()
        stream.send_recording_name(name)
        yield stream
        partial.write_bytes(content.read() or b"")
        stream.disconnect()


def between(start: float, end: float) -> rr.TimeRange:
    """A stretch of flight time to look at first, s."""
    return rr.TimeRange(
        start=rr.TimeRangeBoundary.absolute(seconds=start), end=rr.TimeRangeBoundary.absolute(seconds=end)
    )


def thin(n: int, most: int = MOST_POINTS) -> slice:
    """Every how many of `n` samples to show."""
    return slice(None, None, max(1, -(-n // most)))


def curve(
    stream: rr.RecordingStream,
    path: str,
    t: np.ndarray,
    values: np.ndarray,
    name: str,
    color: tuple[int, int, int],
    width: float = 1.5,
    visible: bool = True,
) -> None:
    """A curve over flight time: `t` (N,) in s, `values` (N,); missing values interrupt it.

    One that is not `visible` stands in the legend, to be switched on there.
    """
    step = thin(len(t))
    lines = rr.SeriesLines(colors=[color], names=name, widths=[width], visible_series=[visible])
    stream.log(path, lines, static=True)
    stream.send_columns(
        path,
        indexes=[rr.TimeColumn(TIME, duration=np.asarray(t[step], dtype=float))],
        columns=rr.Scalars.columns(scalars=np.asarray(values[step], dtype=float)),
    )


def text(stream: rr.RecordingStream, path: str, markdown: str) -> None:
    """A page of text."""
    stream.log(path, rr.TextDocument(markdown, media_type="text/markdown"), static=True)


def page(content: rrb.Container) -> rrb.Blueprint:
    """A recording that opens on `content`, with the timeline folded in and no other panel in the way."""
    return rrb.Blueprint(content, rrb.TimePanel(state="collapsed", timeline=TIME), collapse_panels=True)
