"""The flights of a study, as the tally of the calibration counts them: from what was flown and what was said of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from trueflight.groundstation.evaluate.calibration import Case, Estimated, Said
from trueflight.models.effects import catalogue
from trueflight.models.vehicle import Vehicle


def case_from_table(flown: Mapping[str, Any], diagnosis: Mapping[str, Any] | None, vehicle: Vehicle) -> Case:
    """A case from what was flown with `vehicle` and what the diagnosis' JSON says of it (None where the flight was not
    finished)."""
    sortie = flown["sortie"]
    hidden = truth_of(flown["hidden"], vehicle)
    begins = begins_of(flown["hidden"], tuple(hidden))
    error = "" if diagnosis is None else str(diagnosis.get("error", ""))
    case = Case(
        number=sortie["number"],
        kind=sortie["kind"],
        seconds=flown["seconds"],
        noise=sortie["noise"],
        rotor_speeds=sortie["rotor_speeds"],
        truth=tuple(sorted(hidden)),
        error=error,
        controller=sortie["controller"],
        vehicle=flown["vehicle"],
        begins=begins,
        strength=sortie["strength"],
        late=sortie["late"],
        rate=sortie["rate"],
    )
    if diagnosis is None or error:
        return case
    rms, turning = diagnosis["residual_rms"], diagnosis.get("rotational_rms")
    return Case(
        **{
            **case.__dict__,
            "said": tuple(
                _said(row, hidden.get(row["name"], {}))
                for row in diagnosis["effects"]
                if row["verdict"] != "included"
            ),
            "rms": (rms["before"], rms["after"], rms["noise_floor"]),
            "rotational": (turning["before"], turning["after"], turning["noise_floor"])
            if turning
            else case.rotational,
            "unexplained": bool(diagnosis["unexplained"]["verdict"]),
            "diagnosis_seconds": diagnosis["diagnosis_seconds"],
        }
    )


def truth_of(hidden: Sequence[Mapping[str, Any]], vehicle: Vehicle) -> dict[str, dict[str, float]]:
    """True values by effect and parameter of what the simulator hid; empty for an effect whose parameters have none.

    An effect that acts through others brings the first of them along where none of them is hidden with it.
    """
    known = catalogue()
    numbers = {h["name"]: {k: v["value"] for k, v in h["parameters"].items()} for h in hidden}
    true = {n: known[n].truth(values, vehicle) if n in known else {} for n, values in numbers.items()}
    for effect in (known[n] for n in numbers if n in known):
        if effect.carrier_truth and not set(effect.acts_through) & set(numbers):
            carrier = known[effect.acts_through[0]]
            size = numbers[effect.name][effect.carrier_truth]
            true[carrier.name] = {p.name: size for p in carrier.parameters}
    return true


def begins_of(hidden: Sequence[Mapping[str, Any]], true: Sequence[str]) -> dict[str, float]:
    """When effects begin that do so in flight, s after take-off; what an effect brings along begins with it."""
    begins = {h["name"]: float(h["begins"]["value"]) for h in hidden if "begins" in h}
    known = catalogue()
    here = {h["name"] for h in hidden}
    for name, moment in list(begins.items()):
        brought = (
            [n for n in known[name].acts_through if n in true and n not in here] if name in known else []
        )
        begins |= dict.fromkeys(brought, moment)
    return begins


def _said(row: Mapping[str, Any], true: Mapping[str, float]) -> Said:
    estimates = tuple(
        Estimated(name, p["value"], p["low"], p["high"], true.get(name))
        for name, p in row["parameters"].items()
    )
    return Said(
        name=row["name"],
        verdict=row["verdict"],
        rank=row["rank"],
        share=row["variance_share"] or 0.0,
        p_value=1.0 if row["p_value"] is None else row["p_value"],
        group=tuple(row["indistinguishable_from"]),
        estimates=estimates,
        seen_in=row.get("seen_in", "acceleration"),
        confidence=row.get("confidence"),
        moments=tuple(change["time"] for change in (row.get("over_time") or {}).get("changes", [])),
    )
