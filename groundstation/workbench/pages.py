"""The page, panel by panel: templates over the state, every number of a result looked up in what `--json` prints."""

from __future__ import annotations

import time
from pathlib import PurePath
from typing import Any

from markupsafe import Markup

from trueflight.groundstation.output.cited import CitedValue, environment
from trueflight.groundstation.output.tables import SAID
from trueflight.groundstation.workbench.session import PANELS, Session
from trueflight.groundstation.workbench.tasks import START, Part, Read

TITLES = {
    "job": "",
    "flights": "Flights",
    "vehicle": "Vehicle",
    "compare": "Compare",
    "where": "Where",
    "missing": "Missing",
    "falls": "Error falls",
    "beside": "Side by side",
    "plan": "Plan",
}


class Pages:
    """The page and its panels as HTML."""

    def __init__(self) -> None:
        self._html = environment(True, __package__, "trueflight.groundstation.report")

    def whole(self, session: Session) -> str:
        """The whole page."""
        panels = {name: self.panel(session, name) for name in PANELS}
        return self._html.get_template("bench/page.html").render(
            panels=panels, titles=TITLES, revisions=session.revisions, progress=progress(session)
        )

    def viewer(self, recording: str) -> str:
        """The page of the embedded viewer."""
        return self._html.get_template("bench/viewer.html").render(recording=recording)

    def panel(self, session: Session, name: str) -> Markup:
        """One panel, without its frame."""
        state = session.state
        values: dict[str, Any] = {
            "state": state,
            "busy": state.job is not None and not isinstance(state.job.task, Read),
            "session": session,
            "START": START,
            "said": SAID,
            "url": _url,
            "entry": state.entry(state.fitted),
            "held": state.entry(state.held_out),
        }
        for part in ("compared", "diagnosed", "added"):
            values |= _told(part, state.part(part))
        for part in ("beside", "plan"):
            values |= _told(part, state.part(part, ""))
        return Markup(self._html.get_template(f"bench/{name}.html").render(values))


def progress(session: Session) -> dict[str, Any] | None:
    """How far the worker is, None where it does nothing."""
    job = session.state.job
    if job is None:
        return None
    return {
        "title": job.task.title,
        "step": job.step,
        "steps": job.task.steps,
        "text": job.text,
        "seconds": round(time.monotonic() - job.started, 1),
    }


def _told(name: str, part: Part | None) -> dict[str, Any]:
    """What a template may use of a part: its numbers, its charts, its files, and what stands beside."""
    if part is None:
        return {name: None}
    charts = {k: None if svg is None else Markup(svg) for k, svg in part.charts.items()}
    return {name: {"t": CitedValue(part.table), "chart": charts, "files": part.files, "more": part.more}}


def _url(path: PurePath) -> str:
    """Where a file of the results is served."""
    return f"/results/{path.name}"
