"""The charts of the report. What has a number in the JSON is drawn from that: a `table` is what `output.as_json` makes
of a result."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from trueflight.groundstation.evaluate.error_over_time import error_over_time
from trueflight.groundstation.evaluate.side_by_side import SideBySide
from trueflight.groundstation.evaluate.tracking import Tracking
from trueflight.groundstation.output.cited import unit
from trueflight.groundstation.report.svg import BESIDE, COLOURS, LEVELS, Colours, Drawing, figure, level
from trueflight.groundstation.results import Comparison, EffectVerdict, Moment
from trueflight.models.trajectory import Trajectory

WIDTH = 7.4
WINDOW = 12.0
"""s of flight around the worst moment."""
MOST = 1400
"""Points of a curve: more cannot be told apart on paper."""
SEGMENTS = 900
SMOOTHING = 0.5  # s

Table = dict[str, Any]


def waterfall(steps: Sequence[Table], colours: Colours = COLOURS) -> Drawing:
    """The residual as effects are added, fitted and held out; `steps` as in the JSON's "waterfall"."""
    held = all(s["held_out"] is not None for s in steps)
    made, axes = figure(1, 1, WIDTH, 0.55 + 0.42 * len(steps))
    ax, height = axes[0, 0], 0.38 if held else 0.6
    y = np.arange(len(steps), dtype=float)
    ax.barh(
        y - (0.2 if held else 0.0),
        [s["fitted"] for s in steps],
        height,
        color=colours["after"],
        label="fitted flight",
    )
    if held:
        ax.barh(
            y + 0.2, [s["held_out"] for s in steps], height, color=colours["held"], label="held-out flight"
        )
    ax.axvline(
        steps[-1]["noise_floor"], color=colours["ink"], linewidth=1.2, dashes=(4, 2), label="noise floor"
    )
    ax.set_yticks(y, [s["label"] for s in steps])
    ax.invert_yaxis()
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("residual RMS, m/s²")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.2)
    told = "; ".join(
        f"{s['label']} {s['fitted']:.3f}" + (f", held out {s['held_out']:.3f}" if held else "") for s in steps
    )
    return Drawing(made, "waterfall", f"Bars of the residual RMS in m/s² by model version: {told}.")


def prediction(
    before: Comparison, after: Comparison, worst: Sequence[Moment], colours: Colours = COLOURS
) -> Drawing:
    """Measured and predicted acceleration around the worst moment, per axis; `after` may be `before` itself."""
    flight = before.flight
    middle = 0.5 * (worst[0].start + worst[0].end) if worst else float(np.median(flight.t))
    last = max(float(flight.t[0]), float(flight.t[-1]) - WINDOW)
    start = float(np.clip(middle - 0.5 * WINDOW, flight.t[0], last))
    rows = np.flatnonzero((flight.t >= start) & (flight.t <= start + WINDOW))[:: max(1, len(flight) // 20000)]
    shown = [k for k in range(3) if np.any(np.isfinite(before.measured[rows, k]))]
    made, axes = figure(len(shown), 1, WIDTH, 0.5 + 1.35 * len(shown), sharex=True)
    t = flight.t[rows]
    for ax, k in zip(axes[:, 0], shown, strict=True):
        ax.plot(t, before.measured[rows, k], color=colours["measured"], linewidth=2.4, label="measured")
        curves = [(before, colours["before"])]
        if after is not before:
            curves.append((after, colours["after"]))
        for c, colour in curves:
            ax.plot(t, c.predicted[rows, k], color=colour, linewidth=1.1, label=c.label)
        ax.set_ylabel(f"{'xyz'[k]}, m/s²")
        for m in worst:
            if m.start < t[-1] and m.end > t[0]:
                ax.axvspan(
                    max(m.start, t[0]), min(m.end, t[-1]), color=colours["worst"], alpha=0.18, linewidth=0
                )
    axes[-1, 0].set_xlabel("time, s (worst moments shaded)")
    axes[0, 0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.2)
    names = " and ".join(c.label for c, _ in curves)
    return Drawing(
        made,
        "prediction",
        f"Measured acceleration in the heading frame and that of {names}, from {start:.0f} to "
        f"{start + WINDOW:.0f} s of the flight, around its worst moment.",
    )


def over_time(
    before: Comparison, after: Comparison, worst: Sequence[Moment], colours: Colours = COLOURS
) -> Drawing:
    """The residual over the whole flight, the worst moments marked; `after` may be `before` itself."""
    made, axes = figure(1, 1, WIDTH, 1.9)
    ax = axes[0, 0]
    curves = [(before, colours["before"])]
    if after is not before:
        curves.append((after, colours["after"]))
    for c, colour in curves:
        _residual(ax, c, colour, c.label)
    ax.axhline(before.noise_floor, color=colours["ink"], linewidth=1.0, dashes=(4, 2), label="noise floor")
    for number, m in enumerate(worst, 1):
        ax.axvspan(m.start, m.end, color=colours["worst"], alpha=0.3, linewidth=0)
        ax.annotate(
            str(number), (0.5 * (m.start + m.end), 1.0), xycoords=("data", "axes fraction"),
            ha="center", va="bottom", fontsize=7.0, color=colours["ink"],
        )  # fmt: skip
    ax.set_ylim(bottom=0.0)
    ax.set_xlim(before.flight.t[0], before.flight.t[-1])
    ax.set_xlabel("time, s")
    ax.set_ylabel("m/s²")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.08), ncols=3, borderaxespad=0.2)
    return Drawing(
        made,
        "overtime",
        f"Residual RMS over {SMOOTHING:g} s along the flight, worst moments numbered and shaded.",
    )


def courses(effects: Sequence[EffectVerdict], colours: Colours = COLOURS) -> Drawing | None:
    """The parameters that change in flight, one under the other, with their 95 % intervals and the moments; None where
    none does."""
    told = [
        (e, e.over_time, c)
        for e in effects
        if e.over_time is not None and e.rank
        for c in e.over_time.courses
    ]
    if not told:
        return None
    made, axes = figure(len(told), 1, WIDTH, 0.5 + 1.1 * len(told))
    for ax, (e, over, c) in zip(axes[:, 0], told, strict=True):
        ax.plot(c.times, c.value, color=colours["after"], linewidth=1.4)
        ax.fill_between(c.times, c.low, c.high, color=colours["after"], alpha=0.25, linewidth=0)
        for change in over.changes:
            ax.axvspan(change.low, change.high, color=colours["worst"], alpha=0.3, linewidth=0)
            ax.axvline(change.time, color=colours["worst"], linewidth=1.0)
        ax.set_ylabel(f"{e.name}\n{c.name}" + ("" if c.unit == "1" else f",{unit(c.unit)}"), fontsize=7.0)
    axes[-1, 0].set_xlabel("time, s")
    return Drawing(made, "courses", "Parameters that change in flight, over time, with their moments.")


def _residual(ax: Any, c: Comparison, colour: str, label: str, clock: float | None = None) -> None:
    values = error_over_time(c, SMOOTHING).values
    t = c.flight.t if clock is None else c.flight.t - c.flight.t[0] + clock
    step = max(1, len(t) // MOST)
    ax.plot(t[::step], values[::step], color=colour, linewidth=1.1, label=label)


def maps(table: Table, left_table: Table, names: tuple[str, str], colours: Colours = COLOURS) -> Drawing:
    """The residual over each variable, before and after, in the same bins; tables as in the JSON's "where". With both
    `names` the same, before alone."""
    before = [m for m in table["maps"] if m["variable"] != "time"]
    left = {m["variable"]: m for m in left_table["maps"]}
    made, axes = _grid(len(before))
    for ax, m in zip(axes, before, strict=False):
        edges = np.array(m["edges"])
        _stairs(ax, edges, m["rms"], colours["before"], names[0], filled=True)
        if names[1] != names[0]:
            _stairs(ax, edges, left[m["variable"]]["rms"], colours["after"], names[1], filled=False)
        _label(ax, m)
    _names(made, axes[0], colours)
    told = ", ".join(m["variable"] for m in before)
    return Drawing(made, "maps", f"Residual RMS in m/s² over {told}; the numbers stand in the tables below.")


def _grid(count: int) -> tuple[Any, list[Any]]:
    rows = -(-count // 3)
    made, axes = figure(rows, 3, WIDTH, 1.75 * rows)
    for ax in axes[:, 0]:
        ax.set_ylabel("m/s²")
    flat = list(axes.flat)
    for ax in flat[count:]:
        ax.set_visible(False)
    return made, flat


def _names(made: Any, ax: Any, colours: Colours) -> None:
    """One legend for all panels, above them."""
    handles, labels = ax.get_legend_handles_labels()
    made.legend(handles, labels, loc="outside upper right", ncols=4, frameon=False, labelcolor=colours["ink"])


def _stairs(
    ax: Any, edges: np.ndarray, rms: list[float | None], colour: str, name: str, filled: bool
) -> None:
    values = np.array([np.nan if v is None else v for v in rms])
    if filled:
        ax.bar(
            edges[:-1],
            np.nan_to_num(values),
            np.diff(edges),
            align="edge",
            color=colour,
            alpha=0.55,
            label=name,
        )
    else:
        middle = 0.5 * (edges[1:] + edges[:-1])
        ax.plot(middle, values, color=colour, linewidth=1.6, marker="o", markersize=2.8, label=name)


def _label(ax: Any, m: Table) -> None:
    words = {"hover": ", times hover"}
    ax.set_xlabel(m["variable"] + words.get(m["unit"], f",{unit(m['unit'])}" if unit(m["unit"]) else ""))
    ax.set_ylim(bottom=0.0)
    ax.set_xlim(m["edges"][0], m["edges"][-1])
    ax.grid(axis="x", visible=False)
    ax.xaxis.set_major_locator(MaxNLocator(4))


def path(c: Comparison, worst: Sequence[Moment], colours: Colours = COLOURS) -> Drawing | None:
    """The path from above and from the south, coloured by the residual of `c`; None without position."""
    flight = c.flight
    if flight.position is None:
        return None
    error = error_over_time(c, SMOOTHING)
    good = np.all(np.isfinite(flight.position), axis=1)
    if not np.any(good & np.isfinite(error.values)):
        return None
    span = np.maximum(np.ptp(flight.position[good], axis=0), 0.4)
    tall = 3.0 * max(span[1], span[2]) / span[0]
    made, axes = figure(1, 2, WIDTH, 1.2 + float(np.clip(tall, 1.6, 3.4)))
    rows = np.flatnonzero(good)[:: max(1, int(good.sum()) // SEGMENTS)]
    steps = level(error.values[rows], error.highest)
    for ax, (across, up), names in (
        (axes[0, 0], (0, 1), ("east, m", "north, m")),
        (axes[0, 1], (0, 2), ("east, m", "height, m")),
    ):
        points = flight.position[rows][:, [across, up]]
        _coloured(ax, points, steps, colours)
        for number, m in enumerate(worst[:3], 1):
            k = int(np.argmin(np.abs(flight.t - 0.5 * (m.start + m.end))))
            place = flight.position[k, [across, up]]
            ax.plot(
                *place, marker="o", markersize=9, markerfacecolor="none", color=colours["ink"], linewidth=1
            )
            ax.annotate(str(number), place, xytext=(6, 6), textcoords="offset points", color=colours["ink"])
        ax.set_aspect("equal", adjustable="datalim")
        ax.autoscale_view()
        ax.set_xlabel(names[0])
        ax.set_ylabel(names[1])
    axes[0, 0].set_title("from above")
    axes[0, 1].set_title("from the south")
    bounds = np.linspace(0.0, error.highest, LEVELS + 1)
    patches = [
        Patch(color=colours[f"e{k}"], label=f"{bounds[k]:.2g}–{bounds[k + 1]:.2g}") for k in range(0, LEVELS)
    ]
    made.legend(
        handles=patches, loc="outside lower center", ncols=LEVELS, frameon=False, fontsize=7.5,
        title="residual RMS, m/s²", labelcolor=colours["ink"], handlelength=1.0, columnspacing=0.9,
    )  # fmt: skip
    return Drawing(
        made,
        "path",
        f"The path from above and from the south, coloured by the residual of {c.label}; dark, thick parts are worst, "
        "the three worst moments are numbered.",
    )


def _coloured(ax: Any, points: np.ndarray, steps: np.ndarray, colours: Colours) -> None:
    """A path (N, 2) in the colours of its steps (N,), the worst on top."""
    for k in range(-1, LEVELS):
        chosen = np.flatnonzero(steps[:-1] == k)
        if not len(chosen):
            continue
        lines = np.stack([points[chosen], points[chosen + 1]], axis=1)
        colour = colours["grid" if k < 0 else f"e{k}"]
        # round caps close the joints between differently coloured pieces
        ax.add_collection(
            LineCollection(
                list(lines),
                colors=[colour],
                linewidths=0.8 if k < 0 else 0.9 + 0.3 * k,
                capstyle="round",
                zorder=2 + k,
            )
        )
    ax.plot(points[:, 0], points[:, 1], alpha=0.0)


def place(c: Comparison, table: Table, colours: Colours = COLOURS) -> Drawing | None:
    """The residual of `c` over the ground, in cells and in the colours of the path; None without position. `table` as
    in the JSON's "where"."""
    told = table["place"]
    if told is None:
        return None
    centres, rms = np.array(told["centres"]), np.array(told["rms"], dtype=float)
    made, axes = figure(1, 1, 4.2, 3.4)
    ax, cell = axes[0, 0], told["cell"]
    steps = level(rms, error_over_time(c, SMOOTHING).highest)
    for k in range(LEVELS):
        cells = [Rectangle((x - cell / 2, y - cell / 2), cell, cell) for x, y in centres[steps == k]]
        if cells:
            ax.add_collection(
                PatchCollection(cells, facecolors=[colours[f"e{k}"]], edgecolors="none", antialiased=False)
            )
    ax.plot(centres[:, 0], centres[:, 1], alpha=0.0)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("east, m")
    ax.set_ylabel("north, m")
    return Drawing(
        made,
        "place",
        f"Residual RMS over the ground in cells of {cell:g} m, from {rms.min():.2f} to {rms.max():.2f} m/s².",
    )


def tracking(t: Tracking, colours: Colours = COLOURS) -> Drawing:
    """Distance to the expected linear behaviour, per axis."""
    made, axes = figure(3, 1, WIDTH, 3.4, sharex=True)
    gaps = np.concatenate([[False], np.diff(t.t) > 0.2])
    step = max(1, len(t.t) // MOST)
    for k, ax in enumerate(axes[:, 0]):
        error = 100 * np.where(gaps, np.nan, t.position[:, k] - t.expected[:, k])
        ax.plot(t.t[::step], error[::step], color=colours["after"], linewidth=1.1)
        ax.set_ylabel(f"{'xyz'[k]}, cm")
        ax.axhline(0.0, color=colours["muted"], linewidth=0.7)
    axes[-1, 0].set_xlabel("time, s")
    return Drawing(
        made, "tracking", "Flown minus expected position of the linear design along each world axis, cm."
    )


def beside_maps(beside: Table, colours: Colours = COLOURS) -> Drawing:
    """The residual of every comparison over the same bins; `beside` as in the JSON's "side_by_side"."""
    shown = [m for m in beside["maps"] if m["variable"] != "time"]
    made, axes = _grid(len(shown))
    for ax, m in zip(axes, shown, strict=False):
        for k, row in enumerate(beside["rows"]):
            if m["rms"][k] is not None:
                colour = colours[f"s{k % BESIDE}"]
                _stairs(ax, np.array(m["edges"]), m["rms"][k], colour, row["name"], filled=False)
        _label(ax, m)
    _names(made, axes[0], colours)
    names = " and ".join(row["name"] for row in beside["rows"])
    return Drawing(
        made, "beside", f"Residual RMS of {names} over the same bins; the numbers stand in the tables below."
    )


def beside_over_time(beside: SideBySide, colours: Colours = COLOURS) -> Drawing:
    """The residual of every comparison over time, flights from their start."""
    made, axes = figure(1, 1, WIDTH, 1.9)
    ax = axes[0, 0]
    for k, (name, c) in enumerate(zip(beside.names, beside.comparisons, strict=True)):
        _residual(ax, c, colours[f"s{k % BESIDE}"], name, clock=0.0)
    ax.set_ylim(bottom=0.0)
    ax.set_xlabel("time since the start of the flight, s")
    ax.set_ylabel("m/s²")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.2)
    return Drawing(
        made,
        "besidetime",
        f"Residual RMS over {SMOOTHING:g} s of {' and '.join(beside.names)} along the flight.",
    )


def planned(trajectory: Trajectory, colours: Colours = COLOURS) -> Drawing:
    """A planned flight: from above, from the south, and its speed over time; home frame."""
    t = np.linspace(0.0, trajectory.duration, MOST)
    c = trajectory.sample(t)
    made, axes = figure(1, 3, WIDTH, 2.7)
    for ax, (across, up), names in (
        (axes[0, 0], (0, 1), ("x, m", "y, m")),
        (axes[0, 1], (0, 2), ("x, m", "height, m")),
    ):
        ax.plot(c.position[:, across], c.position[:, up], color=colours["after"], linewidth=1.3)
        ax.plot(*c.position[0, [across, up]], marker="o", color=colours["ink"], markersize=5)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_xlabel(names[0])
        ax.set_ylabel(names[1])
    axes[0, 0].set_title("from above")
    axes[0, 1].set_title("from the side")
    axes[0, 2].plot(t, np.linalg.norm(c.velocity, axis=1), color=colours["after"], linewidth=1.1)
    axes[0, 2].set_xlabel("time, s")
    axes[0, 2].set_ylabel("speed, m/s")
    axes[0, 2].set_ylim(bottom=0.0)
    return Drawing(made, "planned", f"The planned flight of {trajectory.duration:.0f} s: path and speed.")
