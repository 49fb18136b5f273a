"""A whole analysis in one recording: verdict, prediction, where it fails, what adding the effects does, tracking."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.evaluate.analysis import Analysis
from trueflight.groundstation.evaluate.error_over_time import error_over_time
from trueflight.groundstation.output.as_json import analysis_table
from trueflight.groundstation.output.cited import CitedValue, environment, sentences
from trueflight.groundstation.views.bars import bar_groups
from trueflight.groundstation.views.changes import changes_panel
from trueflight.groundstation.views.colour import NEWEST, of_version
from trueflight.groundstation.views.comparison import comparison_panel
from trueflight.groundstation.views.error import error_curves, moments_log
from trueflight.groundstation.views.recording import page, recording, text
from trueflight.groundstation.views.side_by_side import side_by_side_panel
from trueflight.groundstation.views.tracking import tracking_panel
from trueflight.groundstation.views.waterfall import waterfall_bars, waterfall_panel
from trueflight.groundstation.views.where import where_panel

SMOOTHING = 1.0  # s


def write_analysis(path: Path, analysis: Analysis) -> None:
    """Write the recording of `analysis`; its texts are those of the table that `--json` prints."""
    found = ", ".join(analysis.diagnosis.named("missing") or analysis.diagnosis.named("possible"))
    name = f"{analysis.flight.name}: {found or 'nothing'} missing"
    with recording(path, "analysis", name) as stream:
        stream.send_blueprint(page(_tabs(stream, analysis)))


def _tabs(stream: rr.RecordingStream, a: Analysis) -> rrb.Container:
    table = analysis_table(a)
    tabs: list[rrb.Container] = [
        _verdict(stream, a, table),
        comparison_panel(stream, a.comparisons, a.where, "predicted/"),
        where_panel(stream, a.before, a.where, (a.after.label, a.where_left), "where/"),
    ]
    if len(a.comparisons) > 1:
        shown = a.held_out or a.comparisons
        tabs.append(waterfall_panel(stream, shown[a.first], shown[-1], a.waterfall, "steps/"))
    if a.tracking is not None:
        tabs.append(tracking_panel(stream, [a.tracking], "tracking/"))
    if a.side_by_side is not None:
        tabs.append(side_by_side_panel(stream, a.side_by_side, "beside/"))
    return rrb.Tabs(*tabs, active_tab=0)


def _verdict(stream: rr.RecordingStream, a: Analysis, table: dict[str, Any]) -> rrb.Container:
    """Plain words and the ranking, the share of each effect, the waterfall, the error over time."""
    markdown = environment(False, "trueflight.groundstation.views")
    words = sentences(table, html=False)
    told = CitedValue(table)
    text(stream, "verdict/words", "\n\n".join([f"## {words[0]}", *words[1:]]))
    text(stream, "verdict/ranking", markdown.get_template("ranking.md").render(t=told))
    text(stream, "verdict/about", markdown.get_template("about.md").render(t=told))
    ranked = [e for e in a.diagnosis.effects if e.rank]
    shares: list[rrb.View] = []
    if len(ranked) > 1:
        share: list[float | None] = [100 * e.variance_share for e in ranked]
        name = "share of the squared error, %"
        groups = [("share", NEWEST, share)]
        shares.append(bar_groups(stream, name, [e.name for e in ranked], groups, "verdict/shares/"))
    versions = [
        (c.label, error_over_time(c, SMOOTHING), of_version(k, 2))
        for k, c in enumerate((a.before, a.after) if a.after is not a.before else (a.before,))
    ]
    name = f"residual over the flight, RMS over {SMOOTHING:g} s, m/s² (worst moments marked)"
    curves = error_curves(stream, "verdict/residual", versions, name, a.where.worst)
    changes = changes_panel(stream, a.diagnosis.effects, "verdict/changes/")
    marks = moments_log(
        stream, "verdict/moments", a.where.worst, "worst moments (click on a time to go there)"
    )
    return rrb.Horizontal(
        rrb.Vertical(
            rrb.TextDocumentView(origin="verdict/words", name="verdict"),
            rrb.TextDocumentView(origin="verdict/ranking", name="ranking of effects"),
            rrb.TextDocumentView(origin="verdict/about", name="what was analysed"),
            row_shares=[2.2, 4, 2],
        ),
        rrb.Vertical(
            rrb.Horizontal(*shares, waterfall_bars(stream, a.waterfall, "verdict/waterfall/")),
            curves,
            marks,
            *(() if changes is None else (changes,)),
            row_shares=[3, 3, 1.5] if changes is None else [2.6, 2.4, 1.8, 4.3],
        ),
        column_shares=[1, 1],
        name="verdict",
    )
