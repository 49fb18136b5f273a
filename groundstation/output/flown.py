"""What tracking and the tube of a flight look like in a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from rich.console import Console
from rich.markup import escape

from trueflight.groundstation.evaluate.bound import Tube
from trueflight.groundstation.evaluate.tracking import Tracking
from trueflight.models.terminal import Table

MOST_LEAVINGS = 8
PARTS: tuple[Literal["total", "model", "attitude"], ...] = ("total", "model", "attitude")


def print_tracking(console: Console, tracked: Sequence[Tracking]) -> None:
    """Mean squared error per axis, one column a flight, and the change from the first to the last."""
    table = Table(title="mean squared error against the expected linear behaviour")
    table.add_column("axis", no_wrap=True)
    for t in tracked:
        table.add_column(escape(t.label), justify="right", overflow="fold")
    if len(tracked) > 1:
        table.add_column("change", justify="right")
    rows = [(f"{axis} (m²)", [t.mse[k] for t in tracked]) for k, axis in enumerate("xyz")]
    rows += [
        (f"{axis} (rad²)", [t.mse_zeta[k] for t in tracked])
        for k, axis in enumerate(("roll", "pitch", "yaw"))
    ]
    rows += [("distance, rms (m)", [t.rms for t in tracked])]
    for what, values in rows:
        change = (
            [f"{100 * (values[-1] / values[0] - 1):+.0f} %"] if len(tracked) > 1 and values[0] > 0 else []
        )
        table.add_row(what, *(f"{v:.3g}" for v in values), *change)
    console.print(table)


def print_tube(console: Console, tube: Tube) -> None:
    """What disturbed the flight, how wide its tube is, and where it was left."""
    d = tube.disturbance
    beyond = "that of the linear design" if d.around == "design" else "what the position loop asks for"
    table = Table(title=f"{escape(tube.label)}: acceleration d beyond {beyond} (m/s²)")
    for heading in ("axis", "largest |d|", "over memory", "model alone", "attitude alone", "radius of tube"):
        table.add_column(heading, justify="left" if heading == "axis" else "right")
    parts = [abs(d.total).max(axis=0), *(d.radius(tube.balls, part) for part in PARTS), tube.radius]
    for k, axis in enumerate("xyz"):
        table.add_row(axis, *(f"{part[k]:.2f}" for part in parts))
    console.print(table)
    table = Table(title=f"the tube around the {d.around}, world axes")
    for heading in ("axis", "decay", "position", "flown", "velocity", "flown ", "inside"):
        table.add_column(heading, justify="left" if heading == "axis" else "right")
    most, ball, inside = abs(tube.distance).max(axis=0), tube.ball, tube.inside
    for k, axis in enumerate("xyz"):
        table.add_row(
            axis,
            f"{tube.balls[k].decay:.2f} 1/s",
            f"± {ball[k, 0]:.2f} m",
            f"{most[k, 0]:.2f} m",
            f"± {ball[k, 1]:.2f} m/s",
            f"{most[k, 1]:.2f} m/s",
            f"{100 * inside[k]:.2f} %",
        )
    console.print(table)
    memories = sorted({f"{0.5 / ball.decay:.1f}" for ball in tube.balls})
    console.print(
        f"radius: the most that d of {escape(tube.bound_from)} has as RMS over the loop's memory of "
        f"{' to '.join(memories)} s, below {d.bandwidth:g} Hz; the sensors resolve {tube.resolution.max():.2f} m/s²",
        highlight=False,
    )
    if len(tube.jumps):
        console.print(
            f"the reference jumps {len(tube.jumps)} times: the tube widens there by as much", highlight=False
        )
    for leaving in tube.leavings[:MOST_LEAVINGS]:
        console.print(
            f"[yellow]leaves the tube[/yellow] in {leaving.axis} at t = {leaving.start:.2f} s, for "
            f"{leaving.end - leaving.start:.2f} s: V^(1/2) {leaving.level:.2f} m/s², allowed {leaving.allowed:.2f}",
            highlight=False,
        )
    if len(tube.leavings) > MOST_LEAVINGS:
        console.print(f"and {len(tube.leavings) - MOST_LEAVINGS} times more", highlight=False)
    if not tube.leavings:
        console.print("the flight never leaves the tube")
