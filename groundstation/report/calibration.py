"""The page of a calibration study: every number is read from the table that `--json` prints."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from trueflight.groundstation.evaluate.calibration import NOTHING, OUTCOMES
from trueflight.groundstation.output.cited import CitedValue, environment
from trueflight.groundstation.report.page import write_report
from trueflight.groundstation.report.svg import COLOURS, LIGHT, Drawing, figure, light_style, style, to_svg
from trueflight.models.whole_file import whole_file

Table = dict[str, Any]
Colours = Mapping[str, str]
WIDTH = 7.4
OUTCOME_WORDS = {
    "missing": "missing",
    "possible": "in a group",
    "not_excited": "not excited",
    "not_supported": "denied",
}
INSIDE, OUTSIDE = "after", "before"
"""Colours of what is as it should be, and of what is not."""


def reliability(table: Table, colours: Colours) -> Figure:
    """How sure verdicts are against how often they are right."""
    made, axes = figure(1, 2, WIDTH, 3.0)
    for ax, key, title in (
        (axes[0, 0], "present", "“it is there”"),
        (axes[0, 1], "absent", "“it is not there”"),
    ):
        bins = table[key]["bins"]
        x = np.arange(len(bins))
        share = [b["right"]["share"] for b in bins]
        spread = [
            [b["right"]["share"] - b["right"]["low"] for b in bins],
            [b["right"]["high"] - b["right"]["share"] for b in bins],
        ]
        ax.plot(
            x, [b["sure"] for b in bins], color=colours["ink"], dashes=(4, 2), linewidth=1.1, label="sure"
        )
        ax.errorbar(
            x, share, np.maximum(spread, 0.0), fmt="o", color=colours[INSIDE], capsize=3, label="right"
        )
        for k, b in enumerate(bins):
            ax.annotate(
                str(b["right"]["of"]),
                (k, 0.02),
                xycoords=("data", "axes fraction"),
                ha="center",
                fontsize=7.0,
                color=colours["muted"],
            )
        ax.set_xticks(x, [_edges(b) for b in bins], rotation=30, ha="right")
        ax.set_ylim(-0.02, 1.05)
        ax.set_xlim(-0.6, max(len(bins) - 0.4, 0.6))
        ax.set_title(title)
        ax.set_xlabel("says it is sure")
    axes[0, 0].set_ylabel("share that is right")
    axes[0, 1].legend(loc="center right")
    return made


def _edges(b: Table) -> str:
    return f"{100 * b['low']:g}–{100 * b['high']:g} %"


def confusion(table: Table, colours: Colours) -> Figure:
    """Hidden effects against what was said of them, and what was called missing in their place."""
    rows = table["confusion"]
    others = sorted({name for row in rows for name in row["instead"]})
    columns = [*OUTCOMES, *others]
    made, axes = figure(1, 1, WIDTH, 1.5 + 0.21 * len(rows))
    ax = axes[0, 0]
    counts = np.array(
        [
            [row["outcomes"].get(o, 0) for o in OUTCOMES] + [row["instead"].get(n, 0) for n in others]
            for row in rows
        ],
        dtype=float,
    )
    hidden = np.array([max(row["hidden"], 1) for row in rows], dtype=float)
    good = {"missing", "possible"}
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            if not counts[i, j]:
                continue
            right = column in good or (row["effect"] == NOTHING and column == "not_supported")
            neutral = column == "not_excited"
            colour = colours["measured"] if neutral else colours[INSIDE if right else OUTSIDE]
            share = float(np.clip(counts[i, j] / hidden[i], 0.0, 1.0))
            ax.barh(i, 0.94, 0.9, left=j - 0.47, color=colour, alpha=0.18 + 0.67 * share, linewidth=0)
            ax.text(j, i, f"{counts[i, j]:.0f}", ha="center", va="center", fontsize=7.5)
    ax.set_yticks(
        range(len(rows)),
        [
            f"{'nothing else' if row['effect'] == NOTHING else row['effect']}  ({row['hidden']})"
            for row in rows
        ],
    )
    words = [OUTCOME_WORDS.get(c, c) for c in columns]
    ax.set_xticks(range(len(columns)), words, rotation=40, ha="left", rotation_mode="anchor")
    ax.xaxis.tick_top()
    ax.tick_params(length=0)
    ax.axvline(len(OUTCOMES) - 0.5, color=colours["muted"], linewidth=0.8)
    ax.set_xlim(-0.55, len(columns) - 0.45)
    ax.set_ylim(len(rows) - 0.45, -0.55)
    ax.grid(visible=False)
    for side in ax.spines.values():
        side.set_visible(False)
    ax.set_ylabel("hidden (times)")
    return made


def coverage(table: Table, colours: Colours) -> Figure:
    """Share of the 95 % intervals that hold the truth, by effect."""
    rows = [row for row in table["coverage"] if not row["parameter"]]
    made, axes = figure(1, 1, WIDTH, 0.9 + 0.24 * max(len(rows), 1))
    ax = axes[0, 0]
    y = np.arange(len(rows))
    for k, row in enumerate(rows):
        inside = row["inside"]
        holds = inside["low"] <= 0.95 <= inside["high"]
        colour = colours[INSIDE if holds else OUTSIDE]
        ax.plot([inside["low"], inside["high"]], [k, k], color=colour, linewidth=2.0, alpha=0.6)
        ax.plot([inside["share"]], [k], marker="o", color=colour, markersize=5)
        ax.annotate(
            f"{inside['count']}/{inside['of']}",
            (1.01, k),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=7.5,
            color=colours["muted"],
        )
    ax.axvline(0.95, color=colours["ink"], dashes=(4, 2), linewidth=1.1)
    ax.set_yticks(y, [row["effect"] or "all" for row in rows])
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlim(0.0, 1.02)
    ax.set_xlabel("share of the 95 % intervals that hold the truth, with its own 95 % interval")
    return made


def error(table: Table, colours: Colours) -> Figure:
    """Relative error of each estimate against how far the effect stands out of the noise."""
    made, axes = figure(1, 1, WIDTH, 3.0)
    ax = axes[0, 0]
    for inside, marker, label in (
        (True, "o", "intervals hold the truth"),
        (False, "x", "an interval does not"),
    ):
        rows = [r for r in table["estimates"] if r["inside"] is inside and r["excitation"] and r["error"]]
        ax.plot(
            [r["excitation"] for r in rows],
            [r["error"] for r in rows],
            linestyle="none",
            marker=marker,
            markersize=4.5,
            color=colours[INSIDE if inside else OUTSIDE],
            label=label,
        )
    ax.axhline(0.1, color=colours["ink"], dashes=(4, 2), linewidth=1.0)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("what the effect changes, RMS, over the noise floor")
    ax.set_ylabel("error over true size")
    ax.legend(loc="lower left")
    return made


def shares(table: Table, colours: Colours) -> Figure:
    """How often flights were diagnosed rightly, by what kind of flight they were, and the false alarms."""
    rows: list[tuple[str, Table]] = [
        ("all flights", table["right"]),
        ("no false alarm, nothing hidden", _turned(table["false_alarm"])),
    ]
    for by, groups in table["by"].items():
        rows += [(f"{by}: {name}", share) for name, share in groups.items()]
    made, axes = figure(1, 1, WIDTH, 0.7 + 0.22 * len(rows))
    ax = axes[0, 0]
    for k, (_, share) in enumerate(rows):
        if not share["of"]:
            continue
        ax.plot([share["low"], share["high"]], [k, k], color=colours[INSIDE], linewidth=2.0, alpha=0.6)
        ax.plot([share["share"]], [k], marker="o", color=colours[INSIDE], markersize=5)
        ax.annotate(
            f"{share['count']}/{share['of']}",
            (1.01, k),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=7.5,
            color=colours["muted"],
        )
    ax.set_yticks(range(len(rows)), [name for name, _ in rows])
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlim(0.0, 1.02)
    ax.set_xlabel("share of the flights that is right, with its 95 % interval")
    return made


def _turned(share: Table) -> Table:
    """The share of the others."""
    if not share["of"]:
        return share
    return {
        "count": share["of"] - share["count"],
        "of": share["of"],
        "share": 1.0 - share["share"],
        "low": 1.0 - share["high"],
        "high": 1.0 - share["low"],
    }


@dataclass(frozen=True)
class Chart:
    """A chart with the section that it stands in: `alt` says in words what it shows; left out where the table has
    nothing under `needs`."""

    name: str
    title: str
    draw: Callable[[Table, Colours], Figure]
    needs: str
    alt: str


CHARTS: tuple[Chart, ...] = (
    Chart(
        "shares",
        "How often it is right",
        shares,
        "flights",
        "Dots with intervals: the share of flights whose hidden effects were all named, alone or in a group, and "
        "nothing false beside them; all flights, flights with nothing hidden, and by kind. The numbers stand in the "
        "table.",
    ),
    Chart(
        "confusion",
        "What became of each effect",
        confusion,
        "confusion",
        "Matrix: hidden effects in rows; called missing, named in a group, said not to be excited, and denied in "
        "columns, then the effects called missing in their place. The numbers stand in the table.",
    ),
    Chart(
        "coverage",
        "Do the intervals hold the truth",
        coverage,
        "coverage",
        "Dots with intervals: the share of 95 % intervals that hold the true value, of all and by effect, with a line "
        "at 95 %. The numbers stand in the table.",
    ),
    Chart(
        "error",
        "Error against excitation",
        error,
        "estimates",
        "Scatter, both axes logarithmic: relative error of each estimate over how far its effect stands out of the "
        "noise floor, with a line at 10 %.",
    ),
    Chart(
        "reliability",
        "Is it as sure as it should be",
        reliability,
        "claims",
        "Two panels, verdicts that an effect is there and that it is not: by how sure they say they are, the share "
        "that is right, with intervals, beside the dashed line of what they say. The numbers stand in the table.",
    ),
)


def render_calibration(table: Table) -> str:
    """The page as HTML. `table` is the JSON of the study."""
    html, told = environment(True, __package__), CitedValue(table)
    bodies = []
    with style():
        for chart in CHARTS:
            if table[chart.needs]:
                drawn = to_svg(Drawing(chart.draw(table, COLOURS), chart.name, chart.alt))
                body = html.get_template(f"calibration/{chart.name}.html").render(t=told, chart=drawn)
                bodies.append(({"name": chart.name, "title": chart.title}, Markup(body)))
    body = html.get_template("calibration/wrong.html").render(t=told)
    bodies.append(({"name": "wrong", "title": "What was wrong"}, Markup(body)))
    lines = html.get_template("calibration/verdict.txt").render(t=told).splitlines()
    verdict = [Markup(" ".join(line.split())) for line in lines if line.strip()]
    return html.get_template("report.html").render(
        t={}, verdict=verdict, title=f"{table['vehicle']}: is the diagnosis right", sections=bodies
    )


def write_calibration(folder: Path, table: Table) -> Path:
    """Write page, charts as PNG and `calibration.json` into `folder`; returns the page. Raises `InputError` where it
    cannot be written."""
    page = folder / "report.html"
    write_report(page, render_calibration(table))
    write_report(folder / "calibration.json", json.dumps(table, indent=1, allow_nan=False) + "\n")
    with light_style():
        for chart in CHARTS:
            if table[chart.needs]:
                made = chart.draw(table, LIGHT)
                with whole_file(
                    folder / f"{chart.name}.png", "a chart", "choose another --output"
                ) as partial:
                    made.savefig(partial, dpi=110, facecolor="white")
    return page
