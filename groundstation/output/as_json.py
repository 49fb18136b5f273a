"""The JSON that every report prints with `--json`, made from the result objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from trueflight.groundstation.results import Comparison, Diagnosis, WaterfallStep, WhereItFails
from trueflight.models.effects import effect_named
from trueflight.models.model import Model
from trueflight.models.network import Network

if TYPE_CHECKING:
    from trueflight.groundstation.evaluate.analysis import Analysis
    from trueflight.groundstation.evaluate.calibration import Calibration, Case
    from trueflight.groundstation.evaluate.side_by_side import SideBySide
    from trueflight.groundstation.evaluate.tracking import Tracking

UNIT = "m/s^2"


def plain(value: Any) -> Any:
    """Numpy numbers and arrays, tuples and NaN as JSON has them, floats to six digits."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value


def diagnosis_table(d: Diagnosis) -> dict[str, Any]:
    """The JSON of a diagnosis."""
    table: dict[str, Any] = {
        "flight": d.flight.name,
        "vehicle": d.flight.vehicle.name,
        "base": list(d.base.names()),
        "bandwidth_hz": d.bandwidth,
        "axes": ["xyz"[i] for i in d.axes],
        "residual_rms": {
            "before": d.rms_before,
            "after": d.rms_after,
            "noise_floor": d.noise_floor,
            "unit": UNIT,
        },
        "effects": [
            {
                "name": e.name,
                "verdict": e.verdict,
                "rank": e.rank,
                "variance_share": e.variance_share,
                "p_value": e.p_value,
                "parameters": {
                    p.name: {"value": p.value, "low": p.low, "high": p.high, "unit": p.unit}
                    for p in e.parameters
                },
                "indistinguishable_from": list(e.indistinguishable_from),
                "advice": e.advice,
                "seen_in": e.seen_in,
            }
            for e in d.effects
        ],
        "unexplained": asdict(d.unexplained),
        "nuisance": {"clock_shift": {"value": d.clock_shift, "unit": "s"}},
        "left_out": d.left_out,
        "notes": list(d.flight.notes),
    }
    if d.rotational is not None:
        table["rotational_rms"] = {**asdict(d.rotational), "unit": "rad/s^2"}
    if d.validation_before is not None:
        table["validation_rms"] = {"before": d.validation_before, "after": d.validation_after, "unit": UNIT}
    return plain(table)


def comparison_table(c: Comparison) -> dict[str, Any]:
    """The JSON of a comparison, without its time series."""
    return plain(
        {
            "flight": c.flight.name,
            "model": c.label,
            "bandwidth_hz": c.bandwidth,
            "rms": c.rms,
            "noise_floor": c.noise_floor,
            "unit": UNIT,
            "frame": "heading",
            "share_of_samples": float(c.used.mean()),
            "axes": {
                a.axis: {"rms": a.rms, "noise_floor": a.noise_floor, "share_explained": a.share_explained}
                for a in c.axes
            },
            "open_loop": [asdict(h) for h in c.horizons],
            "notes": list(c.flight.notes),
        }
    )


def where_table(w: WhereItFails) -> dict[str, Any]:
    """The JSON of where a model fails."""
    return plain(
        {
            "regions": [asdict(r) for r in w.regions],
            "worst": [asdict(m) for m in w.worst],
            "maps": [asdict(m) for m in w.maps],
            "place": None if w.place is None else asdict(w.place),
        }
    )


def model_table(model: Model) -> dict[str, Any]:
    """The JSON of a model version."""
    return plain(
        {
            "vehicle": model.vehicle.name,
            "version": model.version,
            "parent": model.parent,
            "label": model.label,
            "effects": [
                {"name": t.effect, "parameters": dict(t.values), "intervals": dict(t.intervals)}
                for t in model.terms
            ],
            "created": model.created,
            "data_hash": model.data_hash,
            "fit": dict(model.fit),
            "network": None if model.network is None else network_summary(model.network),
        }
    )


def network_summary(network: Network) -> dict[str, Any]:
    """The JSON of a network, without its weights."""
    ranges = zip(network.features, network.low, network.high, strict=True)
    return plain(
        {
            "hash": network.hash,
            "layers": list(network.widths),
            "parameters": network.parameters,
            "features": {name: {"low": low, "high": high} for name, low, high in ranges},
            "recipe": network.recipe,
            "seed": network.seed,
            "data_hash": network.data_hash,
            "fit": dict(network.fit),
        }
    )


def waterfall_table(steps: tuple[WaterfallStep, ...]) -> list[dict[str, Any]]:
    """The JSON of a waterfall."""
    return plain([asdict(s) for s in steps])


def side_by_side_table(s: SideBySide) -> dict[str, Any]:
    """The JSON of comparisons side by side; the RMS of a map has one row a comparison."""
    rows = [
        {"name": name, "change": change, **comparison_table(c), **_regions(w)}
        for name, change, c, w in zip(s.names, s.change, s.comparisons, s.where, strict=True)
    ]
    first = s.where[0]
    maps = []
    for m in first.maps:
        all_ = [next((x for x in w.maps if x.variable == m.variable), None) for w in s.where]
        maps.append(
            {
                "variable": m.variable,
                "unit": m.unit,
                "edges": m.edges,
                "rms": [None if x is None else x.rms for x in all_],
                "share_of_time": [None if x is None else x.share_of_time for x in all_],
            }
        )
    flights = len({id(c.flight) for c in s.comparisons}) > 1
    return plain({"of": "flights" if flights else "models", "rows": rows, "maps": maps})


def _regions(w: WhereItFails) -> dict[str, Any]:
    return {"regions": [asdict(r) for r in w.regions], "worst": [asdict(m) for m in w.worst]}


def tracking_table(t: Tracking) -> dict[str, Any]:
    """The JSON of how a flight was tracked."""
    return plain(
        {
            "label": t.label,
            "seconds": len(t.t) * t.flight.dt,
            "mse": dict(zip("xyz", t.mse, strict=True)),
            "unit": "m^2",
            "mse_zeta": dict(zip(("roll", "pitch", "yaw"), t.mse_zeta, strict=True)),
            "rms": t.rms,
        }
    )


def analysis_table(a: Analysis) -> dict[str, Any]:
    """The JSON of a whole analysis: that of its diagnosis, and all that report and recording show beside."""
    d, flight = a.diagnosis, a.flight
    table = {
        **diagnosis_table(d),
        "duration": flight.duration,
        "rate": 1.0 / flight.dt,
        "comparison": {
            "first": a.first,
            "models": [comparison_table(c) for c in a.comparisons],
            "held_out": [comparison_table(c) for c in a.held_out],
        },
        "waterfall": waterfall_table(a.waterfall),
        "where": where_table(a.where),
        "where_left": where_table(a.where_left),
        "tracking": None if a.tracking is None else tracking_table(a.tracking),
        "reference": None
        if a.reference is None
        else {
            "rms": dict(zip("xyz", a.reference.rms, strict=True)),
            "seconds": a.reference.seconds,
            "unit": "m",
        },
        "side_by_side": None if a.side_by_side is None else side_by_side_table(a.side_by_side),
        "titles": {e.name: effect_named(e.name, d.base.effects_directory).title for e in d.effects},
        "provenance": asdict(a.provenance),
    }
    return plain(table)


def calibration_table(calibration: Calibration, cases: Sequence[Case]) -> dict[str, Any]:
    """The JSON of a study: the tallies, every estimate with its truth, and every flight."""
    return plain(
        {
            **asdict(calibration),
            "estimates": [
                {
                    "number": c.number,
                    "effect": s.name,
                    "error": s.error,
                    "excitation": c.excitation(s),
                    "inside": all(e.inside for e in s.estimates if e.truth is not None),
                }
                for c in cases
                for s in c.named()
                if s.name in c.truth and s.error is not None
            ],
            "cases": [asdict(c) for c in cases],
        }
    )
