"""The error as effects are added: on the fitted and on the held-out flight, and the paths before and after."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.evaluate.error_over_time import error_over_time
from trueflight.groundstation.results import Comparison, WaterfallStep
from trueflight.groundstation.views.bars import bar_groups
from trueflight.groundstation.views.colour import NEWEST, Colour, of_version
from trueflight.groundstation.views.error import error_curves, error_legend, error_path
from trueflight.groundstation.views.recording import page, recording, text

SMOOTHING = 0.5  # s
HELD_OUT: Colour = (0, 158, 115)


def write_before_after(
    path: Path, before: Comparison, after: Comparison, steps: Sequence[WaterfallStep]
) -> None:
    """Write the recording of the first and the last model on one flight (the held-out one, where there is one), and
    the waterfall `steps` of all."""
    with recording(
        path, "before and after", f"{after.flight.name}: {before.label} and {after.label}"
    ) as stream:
        stream.send_blueprint(page(waterfall_panel(stream, before, after, steps)))


def waterfall_panel(
    stream: rr.RecordingStream,
    before: Comparison,
    after: Comparison,
    steps: Sequence[WaterfallStep],
    root: str = "",
) -> rrb.Container:
    """Bars of the residual over the model versions beside the path of the first and of the last, in one scale."""
    held_out = all(step.held_out is not None for step in steps)
    highest = max(error_over_time(c, SMOOTHING).highest for c in (before, after))
    first = error_over_time(before, SMOOTHING, highest)
    errors = [("before", first), ("after", error_over_time(after, SMOOTHING, highest))]
    text(stream, f"{root}steps", _summary(before, after, steps, held_out))
    which = "held-out flight" if held_out else "fitted flight"
    right = rrb.Vertical(
        rrb.TextDocumentView(origin=f"{root}steps", name=f"{before.label} → {after.label}"),
        waterfall_bars(stream, steps, root),
        error_curves(
            stream,
            f"{root}versions",
            [(e.comparison.label, e, of_version(k, 2)) for k, (_, e) in enumerate(errors)],
            f"residual on the {which}, RMS over {SMOOTHING:g} s, m/s²",
            height=262.0,
        ),
        row_shares=[2.4, 3, 3],
    )
    views = [
        error_path(
            stream, f"{root}space_{name}", e, f"{name}: {e.comparison.label}, {e.comparison.rms:.3f} m/s²",
            distance=1.1,
        )
        for name, e in errors
    ]  # fmt: skip
    shown = [v for v in views if v is not None]
    if not shown:
        return rrb.Vertical(right, name="before and after")
    scale = error_legend(stream, f"{root}scale", first, "residual on both paths")
    left = rrb.Vertical(*shown, scale, row_shares=[*[4] * len(shown), 1.2])
    return rrb.Horizontal(left, right, column_shares=[1, 1], name="before and after")


def waterfall_bars(
    stream: rr.RecordingStream, steps: Sequence[WaterfallStep], root: str = ""
) -> rrb.Spatial2DView:
    """One group of bars a model version: fitted, held out, noise floor."""
    groups: list[tuple[str, Colour, list[float | None]]] = [
        ("fitted flight", NEWEST, [step.fitted for step in steps])
    ]
    if all(step.held_out is not None for step in steps):
        groups.append(("held-out flight", HELD_OUT, [step.held_out for step in steps]))
    labels = [step.label for step in steps]
    return bar_groups(
        stream,
        "residual RMS of each model, m/s²",
        labels,
        groups,
        f"{root}bars/",
        ("noise floor", steps[-1].noise_floor),
    )


def _summary(before: Comparison, after: Comparison, steps: Sequence[WaterfallStep], held_out: bool) -> str:
    lines = [
        "| residual RMS, m/s² | fitted | held out |" if held_out else "| residual RMS, m/s² | fitted |",
        "|---|---|---|" if held_out else "|---|---|",
    ]
    for index, step in enumerate(steps):
        cells = [step.fitted] + ([step.held_out or np.nan] if held_out else [])
        was = [steps[0].fitted] + ([steps[0].held_out or np.nan] if held_out else [])
        told = [
            f"{c:.3f}" + (f" ({100 * (c / w - 1):+.0f} %)" if index else "")
            for c, w in zip(cells, was, strict=True)
        ]
        lines.append(f"| {step.label} | " + " | ".join(told) + " |")
    lines.append(
        f"| *noise floor* | {steps[-1].noise_floor:.3f} |"
        + (f" {after.noise_floor:.3f} |" if held_out else "")
    )
    return "\n".join(lines)
