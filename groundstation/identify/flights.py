"""One flight or several: which effect is missing."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from trueflight.groundstation.identify.ownership import needs_several, ownership
from trueflight.groundstation.identify.together import check_together, diagnose_together
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.results import Diagnosis
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.model import Model


def diagnose_flights(
    flights: Sequence[Flight],
    base: Model,
    validation: Flight | None = None,
    bandwidth: float | None = None,
    per_flight: Sequence[str] = (),
    shared: Sequence[str] = (),
    progress: Callable[[str], None] = lambda _: None,
    healthy: Sequence[Flight] = (),
) -> Diagnosis:
    """Find the effects that `base` lacks: on one flight, or on several of one vehicle in one fit.

    `per_flight` and `shared` name effects or single parameters ("rotor_drag.x") that are each flight's own, or one for
    all, whatever their files say; with `healthy` flights, what each rotor carries in one is compared. Raises
    `InputError` as `diagnose` and `diagnose_together`.
    """
    whose = ownership(per_flight, shared, base.effects_directory)
    if len(flights) > 1:
        if healthy:
            raise InputError("--healthy goes with one flight; give one, and the others with --healthy")
        if validation is not None:
            check_together([*flights, validation])
        return diagnose_together(flights, base, validation, bandwidth, whose, progress)
    needs_several(per_flight, shared)
    return diagnose(flights[0], base, validation, bandwidth, progress, healthy)
