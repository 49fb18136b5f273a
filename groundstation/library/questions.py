"""What one asks of a flight. Each function is the command of the same name, and takes its arguments in the same order:
the flight, what is asked of it, and by name which model, which flight held out, which design, how fine."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from trueflight.groundstation.library.models import as_model
from trueflight.groundstation.library.shown import answering
from trueflight.groundstation.reading.several import check_held_out
from trueflight.groundstation.versions.choice import choose_design, choose_line, choose_model
from trueflight.groundstation.versions.store import DEFAULT_STORE
from trueflight.models.design import Design
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.model import Model

if TYPE_CHECKING:
    from trueflight.groundstation.evaluate.bound import Around
    from trueflight.groundstation.library.answers import (
        Comparison,
        Diagnosis,
        SideBySide,
        Tracking,
        Tube,
        WhereItFails,
    )

Which = Model | str | int | Path | None
"""A model: itself, its number in the store, its file, "linear"; None is the newest in the store, else exact
rotation."""


def compare(
    flight: Flight,
    *,
    model: Which = None,
    bandwidth: float | None = None,
    store: str | Path = DEFAULT_STORE,
    effects: str | Path | None = None,
) -> Comparison:
    """The acceleration that a model predicts, against the measured one: residual, noise floor, open-loop error.

    `flight` has N samples. `model` is a model itself, its number in `store` (a folder of versions), its file, or
    "linear" for the hover linearisation alone; None takes the newest version or, where there is none, the hover
    linearisation with exact rotation. `bandwidth` is that of the low-pass on both accelerations, Hz (None: chosen
    from the flight). `effects` is a folder of your own effects. Accelerations (N, 3) come back in m/s², heading
    frame.

    Raises `InputError` where the flight lacks what a comparison needs, and for a model of another vehicle.
    """
    from trueflight.groundstation.evaluate.compare import compare
    from trueflight.groundstation.library.answers import Comparison

    return answering(Comparison, compare(flight, choose_model(flight, model, store, effects), bandwidth))


def side_by_side(
    flights: Sequence[Flight],
    *,
    models: Sequence[Which] = (None,),
    bandwidth: float | None = None,
    store: str | Path = DEFAULT_STORE,
    effects: str | Path | None = None,
) -> SideBySide:
    """Several `flights`, each with each of `models`, over the same bins: errors in m/s², heading frame.

    Each of `models` is what `compare` takes as `model`; `bandwidth` (Hz), `store` and `effects` as for `compare`.
    Raises `InputError` as `compare` does.
    """
    from trueflight.groundstation.evaluate.side_by_side import side_by_side
    from trueflight.groundstation.library.answers import SideBySide
    from trueflight.groundstation.reading.several import told_apart

    chosen = [[choose_model(f, which, store, effects) for which in models] for f in flights]
    return answering(SideBySide, side_by_side(told_apart(flights), chosen, bandwidth))


def where(
    flight: Flight,
    *,
    model: Which = None,
    bandwidth: float | None = None,
    store: str | Path = DEFAULT_STORE,
    effects: str | Path | None = None,
) -> WhereItFails:
    """Where in the `flight` a model fails: the residual (m/s²) over height, speed, tilt, thrust, voltage, time, place.

    `model`, `bandwidth` (Hz), `store` and `effects` as for `compare`. Raises `InputError` as `compare` does.
    """
    return compare(flight, model=model, bandwidth=bandwidth, store=store, effects=effects).where


def diagnose(
    flight: Flight | Sequence[Flight],
    *,
    model: Which = None,
    validate: Flight | None = None,
    bandwidth: float | None = None,
    per_flight: Sequence[str] = (),
    shared: Sequence[str] = (),
    store: str | Path = DEFAULT_STORE,
    effects: str | Path | None = None,
) -> Diagnosis:
    """Which effect is missing from a model: ranked, with parameters and 95 % intervals, checked on held-out data.

    `flight` is what effects are fitted to, `validate` another flight of the same vehicle, held out of every fit.
    `model`, `bandwidth` (Hz), `store` and `effects` as for `compare`; exact rotation is always part of the model.
    Errors come back in m/s²; docs/diagnosis.md tells how verdicts are reached.

    `flight` may be several flights of one vehicle, in the order of time: they are fitted together, with one value for
    what is the vehicle's and one each for what is the flight's. `per_flight` and `shared` say otherwise of effects or
    single parameters: `per_flight=["thrust_gain", "rotor_drag.x"]`. `flights`, `shared` and `differing` of the
    diagnosis tell what they say together.

    Raises `InputError` where a flight lacks what a comparison needs or is too short, for a model of another vehicle,
    and for flights that do not belong together.
    """
    from trueflight.groundstation.identify.flights import diagnose_flights
    from trueflight.groundstation.library.answers import Diagnosis

    flights = [flight] if isinstance(flight, Flight) else list(flight)
    if not flights:
        raise InputError("diagnose: no flight; pass one, or several of one vehicle")
    if validate is not None:
        check_held_out(validate, flights)
    line = choose_line(flights[0], model, store, effects)
    found = diagnose_flights(flights, line[-1], validate, bandwidth, per_flight, shared)
    return answering(
        Diagnosis,
        found,
        model=as_model(found.model),
        held_out=validate,
        line=tuple(line),
        asked_bandwidth=bandwidth,
    )


def report(
    flight: Flight | Sequence[Flight],
    output: str | Path,
    *,
    model: Which = None,
    validate: Flight | None = None,
    design: Design | str | Path | None = None,
    bandwidth: float | None = None,
    store: str | Path = DEFAULT_STORE,
    effects: str | Path | None = None,
) -> Diagnosis:
    """Diagnose a `flight`, or several together, and write it to `output` as one HTML page that opens offline.

    `model`, `validate`, `bandwidth` (Hz), `store` and `effects` as for `diagnose`; `design` as for `track`, for the
    page's part on tracking. Returns the diagnosis. Raises `InputError` as `diagnose` does, and where the page cannot be
    written.
    """
    found = diagnose(
        flight, model=model, validate=validate, bandwidth=bandwidth, store=store, effects=effects
    )
    found.report(output, _design(found.flight, design))
    return found


def track(flight: Flight, *, design: Design | str | Path | None = None) -> Tracking:
    """How far a `flight` was from its linear design: mean squared error per axis (m², rad²) against what the design
    would have flown from the same start, world ENU (Carvalho et al. 2022, tables I and II).

    `design` holds the gains, or is their file; None takes those that the flight's record carries.

    Raises `InputError` where there is no design, where references or states are missing, or no stretch is long enough.
    """
    from trueflight.groundstation.evaluate.tracking import track
    from trueflight.groundstation.library.answers import Tracking

    return answering(Tracking, track(flight, _needed(flight, design)))


def bound(
    flight: Flight,
    *,
    design: Design | str | Path | None = None,
    earlier: Flight | None = None,
    around: Around = "design",
) -> Tube:
    """The tube that the stability bound predicts for a `flight`, and whether it stayed inside (m, m/s, world ENU).

    `design` as for `track`. The bound on disturbances is taken from the flight `earlier`, with None from this flight
    itself. The tube lies `around` the flight of the linear design ("design") or around the "reference".
    docs/control.md derives it.

    Raises `InputError` where a flight lacks what this needs.
    """
    from trueflight.groundstation.evaluate.bound import predict_tube
    from trueflight.groundstation.library.answers import Tube

    return answering(
        Tube, predict_tube(flight, _needed(flight, design), flight.name, around, bound_from=earlier)
    )


def _design(flight: Flight, design: Design | str | Path | None) -> Design | None:
    if not isinstance(design, Design):
        return choose_design(flight, design)
    design.check(flight.vehicle)
    return design


def _needed(flight: Flight, design: Design | str | Path | None) -> Design:
    found = _design(flight, design)
    if found is None:
        raise InputError(
            f"{flight.origin or flight.name}: the flight carries no design; pass design=FILE, or what "
            "tf.design(vehicle) makes"
        )
    return found
