"""One line of a report about vehicle or machine, and how reports of them look and travel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich.markup import escape

from trueflight.models.terminal import Table

OK, NOTE, WARN, DANGER, FAIL = STATES = ("ok", "note", "warn", "danger", "fail")
"""How bad it is, mildest first; `note` is no judgement, `danger` is what was asked for and bars no flight."""

_STYLE = {OK: "green", NOTE: "dim", WARN: "yellow", DANGER: "bold red", FAIL: "bold red"}


@dataclass(frozen=True)
class Finding:
    """What was looked at, what it is, what it should be, why or what to do, and how bad it is."""

    name: str
    value: str
    wanted: str
    why: str
    state: str


def table_of(title: str, findings: Sequence[Finding], last: str = "why") -> Table:
    """Findings for a terminal; without a column that would stay empty."""
    wanted = any(finding.wanted for finding in findings)
    table = Table(title=title, title_style="bold")
    table.add_column("", no_wrap=True)
    table.add_column("what", max_width=22)
    table.add_column("found", max_width=30)
    if wanted:
        table.add_column("wanted", max_width=22)
    table.add_column(last)
    for finding in findings:
        cells = [finding.name, finding.value, *([finding.wanted] if wanted else []), finding.why]
        state = f"[{_STYLE[finding.state]}]{finding.state}[/]"
        table.add_row(state, *(escape(cell) for cell in cells))
    return table


def rows_of(findings: Sequence[Finding]) -> list[dict[str, Any]]:
    """Findings for programs."""
    return [
        {
            "name": finding.name,
            "value": finding.value,
            "wanted": finding.wanted,
            "why": finding.why,
            "state": finding.state,
        }
        for finding in findings
    ]
