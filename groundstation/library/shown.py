"""How results are shown: as the commands print them, as HTML in a notebook, as the report's charts."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, TypeVar

from trueflight.models.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd
    from matplotlib.figure import Figure
    from rich.console import Console

    from trueflight.groundstation.report.svg import Colours, Drawing

WIDTH = 100
"""Columns of a summary: what the tables of the commands are made for."""

T = TypeVar("T")


@dataclass(frozen=True)
class Summary:
    """What a result has to say: `text` as a terminal prints it, `html` as a notebook shows it."""

    text: str
    html: str

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return self.text

    def _repr_html_(self) -> str:
        return self.html


def summary_of(show: Callable[[Console], None]) -> Summary:
    """The summary that `show` prints on a console of `WIDTH` columns."""
    from trueflight.models.terminal import Terminal

    console = Terminal(
        width=WIDTH,
        record=True,
        file=io.StringIO(),
        force_terminal=False,
        force_jupyter=False,
        legacy_windows=False,
    )
    show(console)
    html = console.export_html(
        inline_styles=True,
        clear=False,
        code_format="<pre style='line-height: 1.15; font-size: 0.85em'>{code}</pre>",
    )
    lines = console.export_text().splitlines()
    return Summary("\n".join(line.rstrip() for line in lines), html)


def answering(kind: type[T], value: Any, **more: Any) -> T:
    """`value`, a dataclass, as its subclass `kind`, with the fields in `more` set."""
    given = {f.name: getattr(value, f.name) for f in fields(value)}
    return kind(**{**given, **more})


def picture(drawings: Mapping[str, Callable[[Colours], Drawing | None]], chart: str) -> Figure:
    """One of `drawings` (by name) as a matplotlib figure on white.

    Raises `InputError` for a `chart` that is none of them, and for one that the flight has no columns for.
    """
    from trueflight.groundstation.report.svg import LIGHT, light_style

    if chart not in drawings:
        raise InputError(f"plot: no chart '{chart}'; there are: {', '.join(drawings)}")
    with light_style():
        drawing = drawings[chart](LIGHT)
    if drawing is None:
        raise InputError(f"plot: the flight has no position, which the chart '{chart}' is drawn over")
    drawing.figure.set_facecolor("white")
    return drawing.figure


def data_frame(columns: Mapping[str, Any], index: str | Sequence[str] | None = None) -> pd.DataFrame:
    """A pandas table of `columns` (each with N rows), indexed by some of them.

    Raises `InputError` where pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError:
        raise InputError(
            "to_pandas: pandas is not installed; pip install 'trueflight[notebook]', or pandas alone"
        ) from None
    frame = pd.DataFrame(dict(columns))
    return frame if index is None else frame.set_index(index if isinstance(index, str) else list(index))
