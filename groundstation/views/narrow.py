"""A flight in a narrow frame, as beside a page: the path in space over the residual; measured and predicted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import rerun.blueprint as rrb

from trueflight.groundstation.evaluate.error_over_time import error_over_time
from trueflight.groundstation.results import Comparison, WhereItFails
from trueflight.groundstation.views.colour import of_version
from trueflight.groundstation.views.comparison import SMOOTHING, acceleration_views
from trueflight.groundstation.views.error import error_curves, error_legend, error_path
from trueflight.groundstation.views.recording import page, recording


def write_narrow(path: Path, comparisons: Sequence[Comparison], where: WhereItFails) -> None:
    """Write the recording of model versions (the newest last) against one flight, for a narrow frame."""
    last, flight = comparisons[-1], comparisons[-1].flight
    shown = comparisons[-2:]
    with recording(path, "flight", f"{flight.name}: {last.label}") as stream:
        error = error_over_time(last, SMOOTHING)
        views: list[rrb.View] = []
        shares: list[float] = []
        space = error_path(
            stream,
            "space",
            error,
            f"path, coloured by the residual of {last.label}",
            where.worst,
            vehicle=True,
        )
        if space is not None:
            views += [space, error_legend(stream, "legend", error, f"residual of {last.label}")]
            shares += [6.0, 1.3]
        errors = [
            (c.label, error_over_time(c, SMOOTHING), of_version(k, len(shown))) for k, c in enumerate(shown)
        ]
        views.append(error_curves(stream, "residual", errors, "residual, m/s²", where.worst))
        shares.append(3.0)
        axes = acceleration_views(stream, shown, where)
        stream.send_blueprint(
            page(
                rrb.Tabs(
                    rrb.Vertical(*views, row_shares=shares, name="flight"),
                    rrb.Vertical(*axes, name="measured and predicted"),
                    active_tab=0,
                )
            )
        )
