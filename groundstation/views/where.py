"""Where a model fails: the path coloured by the error, the error against each variable, the worst moments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from trueflight.groundstation.evaluate.error_over_time import ErrorOverTime, error_over_time
from trueflight.groundstation.results import Comparison, ErrorMap, PlaceMap, WhereItFails
from trueflight.groundstation.views import scene
from trueflight.groundstation.views.bars import bars_over
from trueflight.groundstation.views.colour import FLOOR, NEWEST, REFERENCE, of_error
from trueflight.groundstation.views.error import (
    error_curves,
    error_legend,
    error_path,
    moments_log,
)
from trueflight.groundstation.views.recording import page, recording, text, thin

MAPS = 6
SMOOTHING = 0.3  # s


def write_where(path: Path, comparison: Comparison, where: WhereItFails) -> None:
    """Write the recording of where `comparison` fails."""
    with recording(path, "where", f"{comparison.flight.name}: where {comparison.label} fails") as stream:
        stream.send_blueprint(page(where_panel(stream, comparison, where)))


def where_panel(
    stream: rr.RecordingStream,
    comparison: Comparison,
    where: WhereItFails,
    left: tuple[str, WhereItFails] | None = None,
    root: str = "",
) -> rrb.Container:
    """Path, residual over time and worst moments beside the maps of the error.

    `left` (label, where) is what another model leaves in the same bins: a second bar in every map.
    """
    error = error_over_time(comparison, SMOOTHING)
    views: list[rrb.View] = []
    shares: list[float] = []
    name = f"path, coloured by the residual of {comparison.label}"
    space = error_path(stream, f"{root}space", error, name, where.worst, vehicle=True)
    if space is not None:
        views += [space, error_legend(stream, f"{root}legend", error, f"residual of {comparison.label}")]
        shares += [7.0, 1.6]
    views.append(
        error_curves(
            stream,
            f"{root}over_time",
            [(comparison.label, error, NEWEST)],
            "residual over time, m/s² (worst moments marked)",
            where.worst,
        )
    )
    shares.append(3.0)
    if where.worst:
        views.append(
            moments_log(stream, f"{root}moments", where.worst, "worst moments (click on a time to go there)")
        )
        shares.append(2.3)
    text(stream, f"{root}regions", _regions(comparison, where, left))
    maps: list[rrb.View] = [
        _map(stream, m, None if left is None else left[1], f"{root}maps")
        for m in where.maps
        if m.variable != "time"
    ][:MAPS]
    told: rrb.View | rrb.Container = rrb.TextDocumentView(
        origin=f"{root}regions", name="where the error sits"
    )
    if where.place is not None and space is not None:
        place = _place(stream, where.place, error, f"{root}place")
        told = rrb.Horizontal(told, place, column_shares=[3, 2])
    rows = [rrb.Horizontal(*maps[k : k + 2]) for k in range(0, len(maps), 2)]
    return rrb.Horizontal(
        rrb.Vertical(*views, row_shares=shares),
        rrb.Vertical(
            told,
            *rows,
            row_shares=[1.5, *[1.0] * len(rows)],
        ),
        column_shares=[1, 1],
        name="where it fails",
    )


def _map(
    stream: rr.RecordingStream, error_map: ErrorMap, left: WhereItFails | None, root: str
) -> rrb.Spatial2DView:
    rest = None if left is None else next((m for m in left.maps if m.variable == error_map.variable), None)
    bars = [("before", NEWEST, error_map.rms)] + ([] if rest is None else [("left", REFERENCE, rest.rms)])
    unit = "" if error_map.unit == "1" else f" ({error_map.unit})"
    name = f"RMS (m/s²) over {error_map.variable}{unit}"
    return bars_over(stream, name, error_map.edges, bars, f"{root}/{error_map.variable.replace(' ', '_')}")


def _place(stream: rr.RecordingStream, place: PlaceMap, error: ErrorOverTime, root: str) -> rrb.Spatial3DView:
    """The error over the ground, seen from above, the path in grey over it."""
    centres = np.column_stack([place.centres, np.zeros(len(place.centres))])
    half = np.full((len(centres), 3), [0.5 * place.cell, 0.5 * place.cell, 0.002])
    colours = of_error(np.asarray(place.rms, dtype=float), error.highest)
    stream.log(root, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log(
        f"{root}/cells",
        rr.Boxes3D(centers=centres, half_sizes=half, colors=colours, fill_mode="solid"),
        static=True,
    )
    position = error.comparison.flight.position
    assert position is not None
    flown = position[np.isfinite(error.values)]
    line = flown[thin(len(flown), scene.PATH_POINTS)]
    low, high = centres.min(axis=0), centres.max(axis=0)
    middle = 0.5 * (low + high)
    size = max(1.0, float(np.max(high - low)))
    stream.log(f"{root}/path", rr.LineStrips3D([line], colors=[FLOOR], radii=0.002 * size), static=True)
    return rrb.Spatial3DView(
        origin=root,
        name=f"north up, cells {place.cell:g} m",
        eye_controls=rrb.EyeControls3D(
            position=middle + [0.0, -0.01 * size, 1.25 * size], look_target=middle, eye_up=[0.0, 1.0, 0.0]
        ),
    )


def _regions(comparison: Comparison, where: WhereItFails, left: tuple[str, WhereItFails] | None) -> str:
    head = f"**{comparison.label}: {comparison.rms:.3f} m/s²**, noise floor {comparison.noise_floor:.3f} m/s²"
    lines = [head, ""]
    if where.regions:
        lines += [
            f"- **{region.text}**" if n == 0 else f"- {region.text}" for n, region in enumerate(where.regions)
        ]
    else:
        lines.append("The error is spread over the flight: no part of it holds much more than its share.")
    if left is not None:
        lines += ["", f"Bars: blue {comparison.label}, green what {left[0]} leaves."]
    return "\n".join(lines)
