"""Training: the loss falling epoch by epoch, the predicted against the measured remainder; and the ablation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.views.bars import words
from trueflight.groundstation.views.colour import AXES, FLOOR, LINEAR, NEWEST, WARNING, Colour
from trueflight.groundstation.views.recording import recording, text
from trueflight.models.network import error_acceleration_of

if TYPE_CHECKING:  # torch: what only draws a comparison does not wait for it
    from trueflight.groundstation.learn.ablation import Ablation, Architecture
    from trueflight.groundstation.learn.training import Training
    from trueflight.groundstation.learn.training_data import Samples

EPOCH = "epoch"
"""The timeline of a training."""
SHOWN = 1500
"""Held-out samples in each scatter."""
PLANE = 100.0
"""Side of a drawn diagram, in units of its plane."""
DEPTH_COLOURS: tuple[Colour, ...] = (WARNING, NEWEST, (204, 121, 167), (0, 158, 115))


def write_training(path: Path, training: Training, samples: Samples, label: str) -> None:
    """Write the recording of a training on `samples`."""
    with recording(path, "training", f"{label}: training") as stream:
        stream.send_blueprint(_blueprint(stream, training, samples, label))


def _blueprint(stream: rr.RecordingStream, training: Training, samples: Samples, label: str) -> rrb.Blueprint:
    history = training.history
    count = len(history)
    validation, train = (np.array([getattr(e, k) for e in history]) for k in ("validation_rms", "train_rms"))
    _curve(stream, "loss/training", train, "training", LINEAR, 1.5)
    _curve(stream, "loss/validation", validation, "held out", NEWEST, 2.5)
    _curve(stream, "loss/floor", np.full(count, samples.noise_floor), "noise floor", FLOOR, 1.5)
    _mark(stream, "loss/kept", training.best, float(validation[training.best - 1]))
    axes = np.array([e.validation for e in history])
    for axis, name in enumerate("xyz"):
        _curve(stream, f"axes/{name}", axes[:, axis], name, AXES[axis], 2.0)
        floor = np.full(count, samples.noise[axis])
        _curve(stream, f"axes/floor_{name}", floor, f"noise floor {name}", FLOOR, 1.0)
    _curve(stream, "rate", np.array([e.rate for e in history]), "learning rate", NEWEST, 2.0)
    text(stream, "summary", _summary(training, samples, label))
    losses = rrb.TimeSeriesView(
        origin="loss",
        name="RMS of the remainder, m/s², over the epochs",
        axis_y=rrb.ScalarAxis(range=_range(np.concatenate([train, validation]), samples.noise_floor)),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightBottom),
    )
    by_axis = rrb.TimeSeriesView(
        origin="axes",
        name="held out, by axis of the heading frame, m/s²",
        axis_y=rrb.ScalarAxis(range=_range(axes.ravel(), float(samples.noise.min()))),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightBottom),
    )
    rate = rrb.TimeSeriesView(origin="rate", name="learning rate", plot_legend=rrb.PlotLegend(visible=False))
    scatters = _scatters(stream, training, samples)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(losses, by_axis, rate, row_shares=[3, 2.4, 1.2]),
            rrb.Vertical(
                rrb.TextDocumentView(origin="summary", name="training"),
                rrb.Horizontal(*scatters),
                row_shares=[1, 1.2],
            ),
            column_shares=[1, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline=EPOCH),
        collapse_panels=True,
    )


def _curve(
    stream: rr.RecordingStream, path: str, values: np.ndarray, name: str, colour: Colour, width: float
) -> None:
    stream.log(path, rr.SeriesLines(colors=[colour], names=name, widths=[width]), static=True)
    epochs = rr.TimeColumn(EPOCH, sequence=np.arange(1, len(values) + 1))
    stream.send_columns(path, indexes=[epochs], columns=rr.Scalars.columns(scalars=np.asarray(values, float)))


def _mark(stream: rr.RecordingStream, path: str, epoch: int, value: float) -> None:
    """Mark the epoch whose weights were kept."""
    stream.log(path, rr.SeriesPoints(colors=[WARNING], names="kept", marker_sizes=[6.0]), static=True)
    at = rr.TimeColumn(EPOCH, sequence=[epoch])
    stream.send_columns(path, indexes=[at], columns=rr.Scalars.columns(scalars=[value]))


def _range(values: np.ndarray, floor: float) -> tuple[float, float]:
    """From nothing to where all but the first epochs lie."""
    return 0.0, float(max(1.15 * np.quantile(values, 0.9), 1.5 * floor))


def _scatters(stream: rr.RecordingStream, training: Training, samples: Samples) -> list[rrb.Spatial2DView]:
    """Predicted over measured remainder of held-out samples, by axis, with the diagonal."""
    held = samples.only(training.validation).with_features(training.network.features)
    step = max(1, len(held) // SHOWN)
    predicted = error_acceleration_of(training.network, held.features[::step])
    measured = held.target[::step]
    views = []
    for axis, name in enumerate("xyz"):
        most = float(np.quantile(np.abs(measured[:, axis]), 0.998)) or 1.0
        x, y = (PLANE / 2 * np.clip(v[:, axis] / most, -1.2, 1.2) for v in (measured, predicted))
        root, half = f"scatter/{name}", PLANE / 2
        stream.log(
            f"{root}/points", rr.Points2D(np.stack([x, -y], -1), colors=AXES[axis], radii=0.5), static=True
        )
        lines = [[[-half, half], [half, -half]], [[-half, 0], [half, 0]], [[0, -half], [0, half]]]
        stream.log(f"{root}/lines", rr.LineStrips2D(lines, colors=[FLOOR], radii=0.2), static=True)
        along = [(half, 8.0), (-half, 8.0), (7.0, 8.0)]
        up = [(0.0, -half - 8.0), (0.0, half + 8.0)]
        words(stream, f"{root}/words", [*along, *up], [f"{x:.2g}" for x in (most, -most, 0.0, most, -most)])
        views.append(
            rrb.Spatial2DView(
                origin=root,
                name=f"{name}: learnt over measured, m/s²",
                visual_bounds=rrb.VisualBounds2D(x_range=[-68, 68], y_range=[-68, 68]),
            )
        )
    return views


def _summary(training: Training, samples: Samples, label: str) -> str:
    network, fit = training.network, training.network.fit
    before = samples.only(training.validation).target
    rows = [
        f"**{label}**: {network.parameters} parameters, recipe {network.recipe}, seed {network.seed}",
        "",
        "| held-out flight, m/s² | before | with the network | noise floor |",
        "|---|---|---|---|",
    ]
    for axis, name in enumerate("xyz"):
        was = float(np.sqrt(np.mean(before[:, axis] ** 2)))
        now, floor = fit[f"validation_rms_{name}"], fit[f"noise_floor_{name}"]
        rows.append(f"| {name} | {was:.3f} | {now:.3f} | {floor:.3f} |")
    rows.append(
        f"| **all** | {fit['before_rms']:.3f} | **{fit['validation_rms']:.3f}** | {fit['noise_floor']:.3f} |"
    )
    minutes = samples.seconds / 60.0
    rows += [
        "",
        f"{minutes:.1f} minutes of {len(samples.flights)} flights, {training.train.mean():.0%} trained on and "
        f"{training.validation.mean():.0%} held out; {len(training.history)} epochs in {training.seconds:.1f} s, "
        f"weights of epoch {training.best} kept.",
        "",
        f"Inputs: {', '.join(network.features)}",
    ]
    left = [n for n in samples.names if n not in network.features]
    if left:
        rows.append(f"Not used, for they did not vary: {', '.join(left)}")
    return "\n".join(rows)


# --- the ablation ---------------------------------------------------------------------------------------------------


def write_ablation(path: Path, ablation: Ablation) -> None:
    """Write the recording of an ablation: error and inference time over the number of parameters."""
    with recording(path, "ablation", "ablation of the network") as stream:
        stream.log("note", rr.TextDocument(_table(ablation), media_type="text/markdown"), static=True)
        error = _diagram(
            stream, "error", ablation.networks, [r.validation_rms for r in ablation.networks], ablation.noise_floor,
            "held-out RMS (m/s²) over parameters",
        )  # fmt: skip
        inference = _diagram(
            stream, "inference", ablation.networks, [1e6 * r.inference for r in ablation.networks], None,
            "one inference (µs) over parameters",
        )  # fmt: skip
        stream.send_blueprint(
            rrb.Blueprint(
                rrb.Horizontal(
                    rrb.Vertical(error, inference),
                    rrb.TextDocumentView(origin="note", name="ablation"),
                    column_shares=[3, 2],
                ),
                rrb.TimePanel(state="hidden"),
                collapse_panels=True,
            )
        )


def _diagram(
    stream: rr.RecordingStream,
    root: str,
    networks: Sequence[Architecture],
    values: Sequence[float],
    floor: float | None,
    name: str,
) -> rrb.Spatial2DView:
    """`values` over the number of parameters on a logarithmic axis, one line a depth; the chosen network ringed."""
    width, height = 2.0 * PLANE, PLANE
    logs = np.log10([r.parameters for r in networks])
    left, right = float(logs.min()), float(max(logs.max(), logs.min() + 0.1))
    low = min(values) if floor is None else min(floor, *values)
    low, high = (0.0, 1.1 * max(values)) if floor is None else (0.97 * low, 1.03 * max(values))
    x = width * (logs - left) / (right - left)
    y = -height * (np.asarray(values) - low) / (high - low)
    frame = [[[0, 0], [width, 0]], [[0, 0], [0, -height]]]
    stream.log(f"{root}/frame", rr.LineStrips2D(frame, colors=[FLOOR], radii=0.3), static=True)
    if floor is not None:
        at = -height * (floor - low) / (high - low)
        stream.log(
            f"{root}/floor", rr.LineStrips2D([[[0, at], [width, at]]], colors=[FLOOR], radii=0.4), static=True
        )
        words(stream, f"{root}/floor_word", [(0.93 * width, at + 3.5)], ["noise floor"])
    marks = [low + share * (high - low) for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    words(
        stream, f"{root}/marks", [(-9.0, -height * (m - low) / (high - low)) for m in marks],
        [f"{m:.3g}" for m in marks],
    )  # fmt: skip
    places = [n for n in (100, 300, 1000, 3000, 10000, 30000, 100000) if 10**left <= n <= 10**right]
    words(
        stream, f"{root}/sizes", [(width * (np.log10(n) - left) / (right - left), 5.0) for n in places],
        [str(n) for n in places],
    )  # fmt: skip
    for depth in sorted({len(r.widths) for r in networks}):
        chosen = [i for i, r in enumerate(networks) if len(r.widths) == depth]
        points = np.stack([x[chosen], y[chosen]], -1)
        colour = DEPTH_COLOURS[(depth - 1) % len(DEPTH_COLOURS)]
        path = f"{root}/{depth}_hidden"
        if len(chosen) > 1:
            stream.log(f"{path}/line", rr.LineStrips2D([points], colors=[colour], radii=0.5), static=True)
        stream.log(
            f"{path}/points",
            rr.Points2D(points, colors=[colour], radii=1.4, labels=[networks[i].label for i in chosen]),
            static=True,
        )
    ring = next(i for i, r in enumerate(networks) if r.smallest)
    around = np.linspace(0.0, 2 * np.pi, 40)
    circle = np.stack([x[ring] + 4.0 * np.cos(around), y[ring] + 4.0 * np.sin(around)], -1)
    stream.log(
        f"{root}/smallest", rr.LineStrips2D([circle], colors=[(255, 255, 255)], radii=0.5), static=True
    )
    return rrb.Spatial2DView(
        origin=root,
        name=f"{name} (ringed: smallest within 5 % of the best)",
        visual_bounds=rrb.VisualBounds2D(x_range=[-18, width + 14], y_range=[-height - 6, 11]),
    )


def _table(ablation: Ablation) -> str:
    rows = [
        f"Held-out RMS before any network {ablation.before_rms:.3f} m/s², noise floor {ablation.noise_floor:.3f} m/s².",
        "",
        "| hidden layers | parameters | held out, m/s² | ONNX, kB | inference, µs | |",
        "|---|---|---|---|---|---|",
    ]
    for r in ablation.networks:
        mark = " and ".join(w for w, is_it in (("best", r.best), ("**embed this**", r.smallest)) if is_it)
        rows.append(
            f"| {r.label} | {r.parameters} | {r.validation_rms:.4f} | {r.onnx_bytes / 1000:.1f} | "
            f"{1e6 * r.inference:.1f} | {mark} |"
        )
    if ablation.features:
        rows += ["", f"Features, by what {ablation.reference} loses without them:", ""]
        rows += ["| feature | shuffled, m/s² | trained without, m/s² |", "|---|---|---|"]
        for f in ablation.features:
            without = "" if f.without_rms is None else f"{f.without_rms:.4f}"
            rows.append(f"| {f.feature} | {f.shuffled_rms:.4f} | {without} |")
    return "\n".join(rows)
