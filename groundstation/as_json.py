"""The JSON that every report prints with `--json`, made from the result objects."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from groundstation.results import Comparison, Diagnosis, WaterfallStep, WhereItFails
from models.model import Model
from models.network import Network

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
