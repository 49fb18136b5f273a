"""The JSON that every report prints with `--json`, made from the result objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from trueflight.groundstation.results import (
    Comparison,
    Diagnosis,
    EffectVerdict,
    FullState,
    Gusts,
    Identified,
    IdentifiedVehicle,
    MotorShares,
    OverTime,
    ParameterEstimate,
    SharedNumber,
    WaterfallStep,
    WhereItFails,
)
from trueflight.models.effect import Effect
from trueflight.models.effects import effect_named
from trueflight.models.flight import Flight
from trueflight.models.model import Model
from trueflight.models.network import Network
from trueflight.models.outside import toml_table

if TYPE_CHECKING:
    from trueflight.groundstation.design.integral_design import IntegralLoop
    from trueflight.groundstation.design.linear_design import Loop
    from trueflight.groundstation.evaluate.analysis import Analysis
    from trueflight.groundstation.evaluate.bound import Tube
    from trueflight.groundstation.evaluate.calibration import Calibration, Case
    from trueflight.groundstation.evaluate.side_by_side import SideBySide
    from trueflight.groundstation.evaluate.survey import Fleet
    from trueflight.groundstation.evaluate.tracking import Tracking
    from trueflight.groundstation.identify.planning import FlightPlan
    from trueflight.groundstation.learn.training import Training
    from trueflight.groundstation.learn.training_data import Samples
    from trueflight.groundstation.versions.vehicle_draft import Draft
    from trueflight.models.design import Design
    from trueflight.models.flight import Flight

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
        "effects": [effect_found_table(e) for e in d.effects],
        "remarks": list(d.remarks),
        "alternatives": [list(names) for names in d.alternatives],
        "unexplained": asdict(d.unexplained),
        "gusts": None if d.gusts is None else gusts_table(d.gusts),
        "nuisance": {"clock_shift": {"value": d.clock_shift, "unit": "s"}},
        "left_out": d.left_out,
        **_several_tables(d),
        "notes": list(d.flight.notes),
        "consistency": consistency_table(d.flight),
    }
    if d.rotational is not None:
        table["rotational_rms"] = {**asdict(d.rotational), "unit": "rad/s^2"}
    if d.shares is not None:
        table["motor_shares"] = shares_table(d.shares)
    if d.validation_before is not None:
        table["validation_rms"] = {"before": d.validation_before, "after": d.validation_after, "unit": UNIT}
    return plain(table)


def effect_found_table(e: EffectVerdict) -> dict[str, Any]:
    """The JSON of what a diagnosis says of one effect."""
    return {
        "name": e.name,
        "verdict": e.verdict,
        "rank": e.rank,
        "variance_share": e.variance_share,
        "p_value": e.p_value,
        "parameters": {p.name: interval_table(p) for p in e.parameters if not p.flight},
        "per_flight": _per_flight(e),
        "indistinguishable_from": list(e.indistinguishable_from),
        "advice": e.advice,
        "seen_in": e.seen_in,
        "confidence": e.confidence,
        "rests_on": e.rests_on,
        "undetermined": list(e.undetermined),
        "products": {p.name: interval_table(p) for p in e.products},
        "changes": [] if e.over_time is None else [asdict(c) for c in e.over_time.changes],
        "when": "" if e.over_time is None else "; ".join(e.over_time.lines),
        "over_time": None if e.over_time is None else over_time_table(e.over_time),
    }


def interval_table(p: ParameterEstimate) -> dict[str, Any]:
    """The JSON of a parameter with its interval."""
    return {"value": p.value, "low": p.low, "high": p.high, "unit": p.unit}


def _per_flight(e: EffectVerdict) -> dict[str, Any]:
    """The numbers of an effect that are each flight's own, by flight."""
    flights = dict.fromkeys(p.flight for p in e.parameters if p.flight)
    return {name: {p.name: interval_table(p) for p in e.parameters if p.flight == name} for name in flights}


def _several_tables(d: Diagnosis) -> dict[str, Any]:
    """What several flights say together; empty for one."""
    flights = [
        {
            "name": f.flight.name,
            "duration": f.flight.duration,
            "residual_rms": {
                "before": f.rms_before,
                "after": f.rms_after,
                "noise_floor": f.noise_floor,
                "unit": UNIT,
            },
            "clock_shift": {"value": f.clock_shift, "unit": "s"},
            "unexplained": list(f.unexplained.where) if f.unexplained.verdict else [],
            "left_out": f.left_out,
            "notes": list(f.flight.notes),
        }
        for f in d.flights
    ]
    return {
        "flights": flights,
        "shared": [shared_table(n) for n in d.shared],
        "set_aside": list(d.set_aside),
    }


def shared_table(n: SharedNumber) -> dict[str, Any]:
    """The JSON of a number of the vehicle over several flights."""
    return {
        "effect": n.effect,
        "parameter": n.parameter,
        "likelihood_ratio": n.ratio,
        "p_value": n.p_value,
        "differs": n.differs,
        "apart": list(n.apart),
        "common": None if n.common is None else interval_table(n.common),
        "values": {v.flight: interval_table(v) for v in n.values},
    }


def left_out_table(
    left_out: Mapping[str, Sequence[ParameterEstimate]], differing: Sequence[SharedNumber]
) -> dict[str, Any]:
    """The JSON of what a model of the vehicle did not take from several flights."""
    own = {
        effect: {
            name: {p.name: interval_table(p) for p in numbers if p.flight == name}
            for name in dict.fromkeys(p.flight for p in numbers)
        }
        for effect, numbers in left_out.items()
    }
    return plain({"set_aside": own, "differing": [shared_table(n) for n in differing]})


def fleet_table(fleet: Fleet) -> dict[str, Any]:
    """The JSON of what holds of all flights of a survey."""
    vehicles = [
        {
            **{k: getattr(h, k) for k in ("vehicle", "flights", "left_out", "missing", "error")},
            "numbers": [shared_table(n) for n in h.numbers],
            "changes": [
                {**asdict(c), "before": interval_table(c.before), "after": interval_table(c.after)}
                for c in h.changes
            ],
        }
        for h in fleet.histories
    ]
    return {**asdict(fleet), "histories": vehicles}


def numbers_table(found: Identified) -> dict[str, Any]:
    """The JSON of a vehicle's numbers as one flight shows them."""
    return {
        "flight": found.flight,
        "source": found.source,
        "bandwidth_hz": found.bandwidth,
        "explained": dict(zip(found.axes, found.explained, strict=True)),
        "undetermined": list(found.undetermined),
        "numbers": {
            n.name: {
                "value": n.value,
                "low": n.low,
                "high": n.high,
                "unit": n.unit,
                "believed": n.believed,
                "rests_on": n.told,
            }
            for n in found.numbers
        },
    }


def full_state_table(found: FullState) -> dict[str, Any]:
    """The JSON of the full state predicted on one flight."""
    return {
        "flight": found.flight,
        "model": found.label,
        "inputs": found.inputs,
        "errors": [asdict(e) for e in found.errors],
        "unit": {"position": "m", "velocity": "m/s", "attitude": "rad", "rate": "rad/s"},
    }


def identified_table(found: IdentifiedVehicle) -> dict[str, Any]:
    """The JSON of an identified vehicle."""
    return plain(
        {
            "vehicle": found.model.vehicle.name,
            "numbers": [numbers_table(n) for n in found.numbers],
            "model": found.model.label,
            "effects": list(found.model.names()),
            "inputs": found.inputs,
            "delay": {"value": found.delay, "unit": "s"},
            "lag": {"value": found.lag, "unit": "s"},
            "fitted": [full_state_table(f) for f in found.fitted],
            "held_out": None if found.held_out is None else full_state_table(found.held_out),
        }
    )


def shares_table(shares: MotorShares) -> dict[str, Any]:
    """The JSON of what each rotor carries."""
    return {
        "shares": list(shares.shares),
        "half_widths": list(shares.errors),
        "uneven": shares.uneven,
        "compared_with": list(shares.compared_with),
        "changes": list(shares.changes),
        "collective": shares.collective,
        "rotor": shares.rotor or None,
        "excess": {"value": shares.excess, "low": shares.excess_low, "high": shares.excess_high},
        "text": shares.told,
    }


def gusts_table(g: Gusts) -> dict[str, Any]:
    """The JSON of gusts."""
    return {
        "acceleration": interval_table(g.acceleration),
        "time_constant": interval_table(g.time_constant),
        "speed": g.speed,
        "text": g.text,
    }


def over_time_table(o: OverTime) -> dict[str, Any]:
    """The JSON of an effect that changes in flight."""
    return plain(
        {
            "changes": [asdict(c) for c in o.changes],
            "stretches": [
                {
                    "start": s.start,
                    "stop": s.stop,
                    "absent": s.absent,
                    "parameters": {p.name: interval_table(p) for p in s.parameters},
                }
                for s in o.stretches
            ],
            "drift": {
                d.name: {"unit": d.unit, "t": d.times, "value": d.value, "low": d.low, "high": d.high}
                for d in o.drift
            },
            "ended": o.ended,
            "text": list(o.lines),
        }
    )


def consistency_table(flight: Flight) -> list[dict[str, Any]]:
    """The JSON of what the reader held against each other."""
    return [
        {
            "pair": c.pair,
            "verdict": c.verdict,
            "left": plain(c.left),
            "text": c.text,
            "mapping": c.mapping,
            "angle_deg": plain(float(np.degrees(c.angle))),
            "late_s": plain(c.late),
        }
        for c in flight.consistency
    ]


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
            "consistency": consistency_table(c.flight),
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
            "fitted_to": list(model.fitted_to),
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
    if a.identified is not None:
        table["identify"] = numbers_table(a.identified)
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


def beside_table(s: SideBySide) -> dict[str, Any]:
    """The JSON of a page of comparisons side by side: theirs, and how to make them again."""
    from trueflight.groundstation.evaluate.analysis import provenance

    made = provenance(*(("flight", c.flight) for c in s.comparisons))
    return {"side_by_side": side_by_side_table(s), "provenance": asdict(made)}


def effect_table(e: Effect) -> dict[str, Any]:
    """The JSON of an effect of the catalogue."""
    return {
        "name": e.name,
        "title": e.title,
        "formula": " ".join((e.formula.__doc__ or "").split()),
        "parameters": {
            p.name: {
                "unit": p.unit,
                "meaning": p.meaning,
                "low": p.low,
                "high": p.high,
                "belongs_to": p.belongs_to,
            }
            for p in e.parameters
        },
        "needs": list(e.needs),
        "needs_any": list(e.needs_any),
        "needs_accelerometer": e.needs_accelerometer,
        "seen_in": "rotation" if e.rotational else "acceleration",
        "manoeuvre": e.manoeuvre,
        "confounded_with": list(e.confounded_with),
        "citation": e.citation,
        "exports": e.exports,
    }


def remainder_table(d: Diagnosis, written: Path | None) -> dict[str, Any]:
    """The JSON of what no effect explains; `written` is the effect made of it."""
    return plain(
        {
            "flight": d.flight.name,
            "explained_by": list(d.model.names()),
            "residual_rms": {"value": d.rms_after, "noise_floor": d.noise_floor, "unit": "m/s^2"},
            "unexplained": asdict(d.unexplained),
            "written": None if written is None else str(written),
        }
    )


def plan_table(plan: FlightPlan, path: Path) -> dict[str, Any]:
    """The JSON of a planned flight, written at `path`."""
    return plain(
        {
            "path": str(path),
            "duration": plan.trajectory.duration,
            "manoeuvres": plan.manoeuvres,
            "questions": [{**asdict(q), "answered": q.answered} for q in plan.questions],
            "precision": [asdict(p) for p in plan.precision],
            "left_out": plan.left_out,
        }
    )


def tube_table(tube: Tube) -> dict[str, Any]:
    """The JSON of a stability tube."""
    from trueflight.groundstation.output.flown import PARTS

    d = tube.disturbance
    most, inside = abs(tube.distance).max(axis=0), tube.inside
    radii = {part: d.radius(tube.balls, part) for part in PARTS}
    return {
        "flight": tube.flight.origin,
        "label": tube.label,
        "seconds": round(len(tube.t) * tube.flight.dt, 2),
        "around": d.around,
        "bound_from": tube.bound_from,
        "bandwidth": d.bandwidth,
        "axes": {
            axis: {
                "P": tube.balls[k].P.tolist(),
                "decay": tube.balls[k].decay,
                "bound": float(tube.bound[k]),
                "radius": float(tube.radius[k]),
                "resolution": float(tube.resolution[k]),
                "ball_position": float(tube.ball[k, 0]),
                "ball_velocity": float(tube.ball[k, 1]),
                "d": float(abs(d.total[:, k]).max()),
                "d_over_memory": {part: float(radii[part][k]) for part in PARTS},
                "flown_position": float(most[k, 0]),
                "flown_velocity": float(most[k, 1]),
                "flown_level": float(tube.level[:, k].max()),
                "inside": float(inside[k]),
            }
            for k, axis in enumerate("xyz")
        },
        "units": {"decay": "1/s", "bound": "m/s^2", "radius": "m/s^2", "position": "m", "velocity": "m/s"},
        "jumps": tube.jumps.tolist(),
        "leavings": [
            {"axis": w.axis, "start": w.start, "end": w.end, "level": w.level, "allowed": w.allowed}
            for w in tube.leavings
        ],
    }


def training_table(made: Model, done: Training, samples: Samples, path: Path) -> dict[str, Any]:
    """The JSON of a training, whose model version `made` was written at `path`."""
    from trueflight.groundstation.learn.training import memory_share

    return plain(
        {
            "vehicle": made.vehicle.name,
            "version": made.version,
            "parent": made.parent,
            "path": str(path),
            "flights": list(samples.flights),
            "left_out": list(samples.left_out),
            "minutes": samples.seconds / 60.0,
            "best_epoch": done.best,
            "memory_share": memory_share(samples, done),
            "network": network_summary(done.network),
        }
    )


def design_table(
    design: Design, path: Path, loops: Sequence[Loop], integral: Sequence[IntegralLoop]
) -> dict[str, Any]:
    """The JSON of a design that was written at `path`, and of what its closed loops do."""
    return {
        "design": str(path),
        "K_zeta": design.K_zeta,
        "K_eta": design.K_eta,
        "integral": None if design.integral is None else asdict(design.integral),
        "loops": [_loop(loop) for loop in loops],
        "integral_loops": [
            {
                **_loop(i.loop),
                "disturbance_removed_after": i.removal,
                "disturbance_allowed": i.allowed,
                "disturbance_peak": i.peak,
                "step_distance_to_lqr": i.step_distance,
                "translation_distance_to_lqr": i.translation_distance,
            }
            for i in integral
        ],
    }


def _loop(loop: Loop) -> dict[str, Any]:
    return {
        "name": loop.name,
        "poles": [[p.real, p.imag] for p in loop.poles],
        "crossover": loop.crossover,
        "phase_margin_deg": loop.phase_margin,
        "rise_time": loop.rise_time,
        "settling_time": loop.settling_time,
        "overshoot": loop.overshoot,
    }


def tracked_table(tracking: Tracking, first: Tracking) -> dict[str, Any]:
    """The JSON of one of several tracked flights, beside the first of them."""
    return {
        "flight": tracking.flight.origin,
        "label": tracking.label,
        "seconds": round(len(tracking.t) * tracking.flight.dt, 2),
        "mse": dict(zip("xyz", tracking.mse, strict=True)),
        "unit": "m^2",
        "mse_zeta": dict(zip(("roll", "pitch", "yaw"), tracking.mse_zeta, strict=True)),
        "rms": tracking.rms,
        "change": sum(tracking.mse) / sum(first.mse) - 1.0,
    }


def imported_table(flight: Flight, path: Path, vehicle: Path) -> dict[str, Any]:
    """The JSON of a flight that was written at `path`, its vehicle beside it."""
    from trueflight.groundstation.reading.writing import own_table

    return {
        "flight": str(path),
        "vehicle": str(vehicle),
        "samples": len(flight),
        "duration": round(flight.duration, 3),
        "columns": list(own_table(flight)),
        "notes": list(flight.notes),
        "consistency": consistency_table(flight),
    }


def draft_table(draft: Draft, path: Path) -> dict[str, Any]:
    """The JSON of a vehicle file drafted at `path`."""
    return {
        "vehicle_draft": str(path),
        "values": toml_table(draft.text, str(path)),
        "sources": {line.key: line.source for line in draft.lines},
        "to_complete": list(draft.to_complete),
    }
