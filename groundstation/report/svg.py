"""Figures of matplotlib as inline SVG in the colours of the page, so that they follow its light and dark."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass

import matplotlib
import numpy as np
from markupsafe import Markup, escape
from matplotlib.figure import Figure

LEVELS = 8
"""Steps of the error's scale."""
BESIDE = 6
"""Colours of what is compared side by side."""

Colours = Mapping[str, str]
"""What the parts of a chart are drawn in: a colour for ink, muted, grid, measured, before, after, ...; for e0 to e7,
the error's scale; and for s0 to s5, what is side by side."""

COLOURS: Colours = {
    # stand-ins that the page's stylesheet gives a value, in light and in dark
    **{
        name: f"#00{number:02x}01"
        for number, name in enumerate(
            ("ink", "muted", "grid", "measured", "linear", "before", "after", "held", "floor", "worst"), 1
        )
    },
    **{f"e{number}": f"#00{number:02x}02" for number in range(LEVELS)},
    **{f"s{number}": f"#00{number:02x}03" for number in range(BESIDE)},
}

LIGHT: Colours = {
    "ink": "#1b1f24",
    "muted": "#5b636e",
    "grid": "#dde1e6",
    "measured": "#a3abb5",
    "linear": "#b5540a",
    "before": "#d55e00",
    "after": "#0b6bb5",
    "held": "#00835f",
    "floor": "#777777",
    "worst": "#e69f00",
    "e0": "#f3e5a1",
    "e1": "#f5cf78",
    "e2": "#f3b054",
    "e3": "#ea8a42",
    "e4": "#d9633f",
    "e5": "#bb3f4e",
    "e6": "#8f2761",
    "e7": "#571a63",
    "s0": "#d55e00",
    "s1": "#0b6bb5",
    "s2": "#00835f",
    "s3": "#b8860b",
    "s4": "#b3568c",
    "s5": "#555555",
}
"""What the page's stylesheet gives them in light, for a picture that stands alone."""


@dataclass(frozen=True)
class Drawing:
    """A drawn chart: `name` tells it from the others of a page, `alt` says in words what it shows."""

    figure: Figure
    name: str
    alt: str


STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "trueflight",
    "font.family": "sans-serif",
    "font.size": 8.5,
    "text.color": COLOURS["ink"],
    "axes.edgecolor": COLOURS["muted"],
    "axes.labelcolor": COLOURS["ink"],
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": COLOURS["grid"],
    "grid.linewidth": 0.6,
    "xtick.color": COLOURS["muted"],
    "ytick.color": COLOURS["muted"],
    "xtick.labelcolor": COLOURS["ink"],
    "ytick.labelcolor": COLOURS["ink"],
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "path.simplify": True,
    "path.simplify_threshold": 0.5,
}


class Picture(Figure):
    """A figure that a notebook shows by itself, without pyplot."""

    def _repr_png_(self) -> bytes:
        out = io.BytesIO()
        self.savefig(out, format="png", dpi=110)
        return out.getvalue()


def figure(
    rows: int, columns: int, width: float, height: float, sharex: bool = False
) -> tuple[Figure, np.ndarray]:
    """A figure of `width` by `height` inches with its axes (rows, columns)."""
    made = Picture(figsize=(width, height), layout="constrained", facecolor="none")
    axes = made.subplots(rows, columns, squeeze=False, sharex=sharex)
    for one in axes.flat:
        one.set_facecolor("none")
    return made, axes


def style() -> AbstractContextManager[None]:
    """While it holds, figures are drawn in the style of the page."""
    return matplotlib.rc_context(STYLE)


def light_style() -> AbstractContextManager[None]:
    """While it holds, figures are drawn in the colours of `LIGHT`."""
    given = {stand_in: LIGHT[name] for name, stand_in in COLOURS.items()}
    return matplotlib.rc_context({k: given.get(v, v) if isinstance(v, str) else v for k, v in STYLE.items()})


def to_svg(chart: Drawing) -> Markup:
    """The chart, drawn in `COLOURS`, as one inline element."""
    name, alt = chart.name, chart.alt
    out = io.StringIO()
    chart.figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    # one page holds many figures: their names must not meet
    text = re.sub(r'\bid="([^"]+)"', rf'id="{name}-\1"', text)
    text = re.sub(r'xlink:href="#([^"]+)"', rf'href="#{name}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", text)
    for key, colour in COLOURS.items():
        text = text.replace(colour, f"var(--{key})")
    box = re.search(r'viewBox="([^"]+)"', text)
    assert box is not None
    head = (
        f'<svg class="chart" viewBox="{box[1]}" role="img" aria-label="{escape(alt)}" '
        f'xmlns="http://www.w3.org/2000/svg">'
    )
    return Markup(head + f"<title>{escape(alt)}</title>" + text[text.index(">") + 1 :])


def level(values: np.ndarray, highest: float) -> np.ndarray:
    """Step (N,) of the error's scale, 0 to 7; -1 where there is no value."""
    place = np.clip(np.nan_to_num(values) / max(highest, 1e-12) * LEVELS, 0, LEVELS - 1).astype(int)
    return np.where(np.isfinite(values), place, -1)
