"""Recordings on disk: opened beside their final name, and there only when whole."""

from __future__ import annotations

import hashlib
import re
import textwrap
import unicodedata
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
        # Named by the flight too: two recordings of one application would be shown with the blueprint of the first.
        stream = rr.RecordingStream(_application(f"trueflight {kind}: {name}"))
        # Into memory, and from there to the disk: Rerun's own writer tells of a full disk in a log alone, and then a
        # flush never returns.
        content = stream.binary_stream()
        stream.send_recording_name(name)
        yield stream
        partial.write_bytes(content.read() or b"")
        stream.disconnect()


def _application(name: str) -> str:
    """`name` as Rerun takes it for an application, or it warns: ASCII letters, digits and `_-:[]`, 150 at most.

    Names that differ only in what is left out stay different.
    """
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    plain = re.sub(r"[^\w \-:\[\]]", "-", plain, flags=re.ASCII)[:150]
    return plain if plain == name else f"{plain[:141]} {hashlib.sha256(name.encode()).hexdigest()[:8]}"


def between(start: float, end: float) -> rr.TimeRange:
    """A stretch of flight time to look at first, s."""
    return rr.TimeRange(
        start=rr.TimeRangeBoundary.absolute(seconds=start), end=rr.TimeRangeBoundary.absolute(seconds=end)
    )


LOG_LINE = 90
"""Letters of a line of a log in half a window; the viewer cuts what is longer."""
LABEL = 26.0
"""Points between two labels of an axis that Rerun shows both; its labels stand at whole powers of ten."""


def readable(low: float, high: float, height: float) -> tuple[float, float]:
    """The range of an axis `height` points high that holds `low` to `high` with a margin, and three labels at least.

    Labels stand at multiples of a power of ten that are `LABEL` apart: where these are only one or two, the range grows
    to three.
    """
    high = high if high > low else low + 1.0
    margin = 0.08 * (high - low)
    low, high = low - margin * (low != 0.0), high + margin * (high != 0.0)
    step = 10.0 ** np.ceil(np.log10((high - low) * LABEL / height))
    while np.floor(high / step + 1e-9) - np.ceil(low / step - 1e-9) < 2:
        up, down = np.ceil((high + 1e-9 * step) / step) * step, np.floor((low - 1e-9 * step) / step) * step
        if low == 0.0 or (high != 0.0 and up - high <= low - down):
            high = up + 0.06 * step
        else:
            low = down - 0.06 * step
    return float(low), float(high)


def log_words(stream: rr.RecordingStream, path: str, time: float, words: str) -> None:
    """An entry of a log at a time of the flight, s, on as many lines as it needs in half a window."""
    stream.set_time(TIME, duration=time)
    for line in textwrap.wrap(
        words, LOG_LINE, break_long_words=False, break_on_hyphens=False, subsequent_indent="   "
    ):
        stream.log(path, rr.TextLog(line, level=rr.TextLogLevel.WARN))
    stream.reset_time()


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
    exact: bool = False,
) -> None:
    """A curve over flight time: `t` (N,) in s, `values` (N,); missing values interrupt it.

    One that is not `visible` stands in the legend, to be switched on there. One that is `exact` is drawn point by
    point, where a viewer would draw the mean of what falls on one of its pixels.
    """
    step = thin(len(t))
    lines = rr.SeriesLines(
        colors=[color],
        names=name,
        widths=[width],
        visible_series=[visible],
        aggregation_policy="Off" if exact else None,
    )
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
