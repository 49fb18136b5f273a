"""The page, section by section; each stands alone and can be left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from trueflight.groundstation.evaluate.analysis import Analysis
from trueflight.groundstation.evaluate.side_by_side import SideBySide
from trueflight.groundstation.output.cited import CitedValue, environment, sentences
from trueflight.groundstation.report import charts
from trueflight.groundstation.report.svg import Drawing, style, to_svg
from trueflight.models.errors import InputError
from trueflight.models.whole_file import write_whole

Table = dict[str, Any]
Charts = dict[str, Drawing | None]


@dataclass(frozen=True)
class Section:
    """One part of the page: `template` is its file under templates/sections, `charts` draws what it shows; it is left
    out where the table has nothing under one of `needs`."""

    name: str
    title: str
    charts: Callable[[Analysis, Table], Charts]
    needs: tuple[str, ...] = ()

    @property
    def template(self) -> str:
        """Its file."""
        return f"sections/{self.name}.html"


def _none(a: Analysis, table: Table) -> Charts:
    return {}


SECTIONS: tuple[Section, ...] = (
    Section(
        "ranking", "Which effect is missing", lambda a, t: {"over_time": charts.courses(a.diagnosis.effects)}
    ),
    Section("flights", "Numbers of the vehicle, and of each flight", _none, ("flights",)),
    Section(
        "waterfall", "The error as effects are added", lambda a, t: {"bars": charts.waterfall(t["waterfall"])}
    ),
    Section(
        "prediction",
        "Measured and predicted",
        lambda a, t: {
            "window": charts.prediction(a.before, a.after, a.where.worst),
            "over_time": charts.over_time(a.before, a.after, a.where.worst),
        },
    ),
    Section(
        "where",
        "Where it fails",
        lambda a, t: {
            "path": charts.path(a.before, a.where.worst),
            "maps": charts.maps(t["where"], t["where_left"], (a.before.label, a.after.label)),
            "place": charts.place(a.before, t["where"]),
        },
    ),
    Section("worst", "Worst moments", _none),
    Section(
        "tracking",
        "Tracking",
        lambda a, t: {"errors": None if a.tracking is None else charts.tracking(a.tracking)},
        ("reference",),
    ),
    Section(
        "side_by_side",
        "Side by side",
        lambda a, t: _beside(a.side_by_side, t),
        ("side_by_side",),
    ),
    Section("blind", "What these data cannot tell", _none),
    Section("provenance", "How this was made", _none, ("provenance",)),
)


def _beside(beside: SideBySide | None, table: Table) -> Charts:
    if beside is None:
        return {}
    return {"maps": charts.beside_maps(table["side_by_side"]), "over_time": charts.beside_over_time(beside)}


def chosen(without: Sequence[str]) -> tuple[Section, ...]:
    """The sections but those named; raises `InputError` for a name that is none."""
    names = [s.name for s in SECTIONS]
    for name in without:
        if name not in names:
            raise InputError(f"--without {name}: no such section; there are: {', '.join(names)}")
    return tuple(s for s in SECTIONS if s.name not in without)


def render(analysis: Analysis, table: Table, sections: Sequence[Section] = SECTIONS) -> str:
    """The page as HTML. `table` is the JSON of `analysis`: every number in the page is read from it."""
    html, told = environment(True, __package__), CitedValue(table)
    with style():
        bodies = [
            (section, _body(html, section, section.charts(analysis, table), told))
            for section in sections
            if all(table.get(need) for need in section.needs)
        ]
    return html.get_template("report.html").render(
        t=told,
        verdict=sentences(table, html=True),
        title=f"{table['flight']}: what is missing",
        sections=bodies,
    )


def render_side_by_side(beside: SideBySide, table: Table) -> str:
    """A page of comparisons side by side alone; `table` holds their JSON under "side_by_side", and
    "provenance"."""
    html, told = environment(True, __package__), CitedValue(table)
    wanted = {s.name: s for s in SECTIONS}
    with style():
        drawn = _beside(beside, table)
    bodies = [
        (wanted["side_by_side"], _body(html, wanted["side_by_side"], drawn, told)),
        (wanted["provenance"], _body(html, wanted["provenance"], {}, told)),
    ]
    lines = html.get_template("beside.txt").render(t=told).splitlines()
    verdict = [Markup(" ".join(line.split())) for line in lines if line.strip()]
    title = " and ".join(beside.names)
    return html.get_template("report.html").render(t=told, verdict=verdict, title=title, sections=bodies)


def _body(html: Any, section: Section, drawn: Charts, told: CitedValue) -> Markup:
    inline = {name: None if drawing is None else to_svg(drawing) for name, drawing in drawn.items()}
    return Markup(html.get_template(section.template).render(t=told, chart=inline))


def write_report(path: Path, text: str) -> None:
    """Write a page whole or not at all. Raises `InputError` where it cannot be written."""
    write_whole(path, text, "the report", "choose another --output")
