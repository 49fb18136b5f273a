"""A number that differs between spans of a flight, or between flights, is fitted once for each."""

from dataclasses import replace

import numpy as np
import pytest
from test_fitting import DRAG, flight

from trueflight.groundstation.identify.fitting import Fit, MeasuredFlights, fit
from trueflight.groundstation.identify.force import ForceProblem
from trueflight.groundstation.identify.search import Choice, Search
from trueflight.groundstation.identify.spans import EVERYWHERE, Piecewise, Span, cut_at, held, number
from trueflight.groundstation.measured.measurement import measure
from trueflight.models.effects import effect_named
from trueflight.models.flight import Flight
from trueflight.models.model import Term, rigid_body_model
from trueflight.models.prediction import apply_effects, motion_of_flight, specific_force

MOMENT = 17.3
BEFORE, AFTER = Span(stop=MOMENT), Span(start=MOMENT)


def with_(made: Flight, name: str, values: dict[str, float], rows: slice) -> Flight:
    """The flight with one effect more on what its accelerometer read in `rows`."""
    motion = motion_of_flight(made)
    rigid = (effect_named("rigid_body"), {})
    more = specific_force(apply_effects(motion, [rigid, (effect_named(name), values)]))
    less = specific_force(apply_effects(motion, [rigid]))
    assert made.specific_force is not None
    felt = made.specific_force.copy()
    felt[rows] += (more - less)[rows]
    return replace(made, specific_force=felt)


def dropped(seed: int = 1) -> Flight:
    """A flight whose thrust is weaker by 12 % until `MOMENT`."""
    made = flight(seed, 0.9, noise=0.03)
    return with_(made, "thrust_gain", {"gain": 0.88}, slice(0, round(MOMENT / made.dt)))


def estimates(fitted: Fit, effect: str) -> list[float]:
    return [float(fitted.estimate[i]) for i in fitted.of(effect)]


def test_a_gain_that_changes_at_a_moment_has_a_value_before_and_after() -> None:
    problem = MeasuredFlights((measure(dropped()),))
    terms = [Term("rigid_body", {}), Term("rotor_drag", {}), Term("thrust_gain", {})]
    fitted = fit(problem, terms, spans={("thrust_gain", "gain"): (BEFORE, AFTER)})
    np.testing.assert_allclose(estimates(fitted, "thrust_gain"), [0.88, 1.0], atol=0.005)
    np.testing.assert_allclose(estimates(fitted, "rotor_drag")[:2], DRAG, atol=0.02)
    # the term tells what holds at the end, the values all of it
    assert fitted.terms[-2].values["gain"] == pytest.approx(1.0, abs=0.005)
    gain = fitted.values["thrust_gain"]["gain"]
    assert isinstance(gain, Piecewise)
    assert gain.at(0, MOMENT - 0.01) == pytest.approx(0.88, abs=0.005)
    # one gain for both leaves a misfit that two do not
    assert fitted.sse < 0.8 * fit(problem, terms).sse


def test_what_is_the_same_in_every_span_is_fitted_as_one_number() -> None:
    problem = MeasuredFlights((measure(flight(2, 0.5, noise=0.03)),))
    terms = [Term("rigid_body", {}), Term("rotor_drag", {})]
    whole = fit(problem, terms)
    split = fit(problem, terms, spans={("rotor_drag", "x"): (BEFORE, AFTER)})
    np.testing.assert_allclose(
        estimates(split, "rotor_drag")[:2], estimates(whole, "rotor_drag")[0], atol=0.03
    )
    at = {f.number: DRAG for f in split.free if f.parameter.name == "x"}
    held_there = fit(problem, terms, spans={("rotor_drag", "x"): (BEFORE, AFTER)}, pinned=at)
    plain = fit(problem, terms, pinned={("rotor_drag", "x", EVERYWHERE): DRAG})
    np.testing.assert_allclose(held_there.residual, plain.residual, atol=1e-9)


def test_wind_of_each_flight_beside_one_drag() -> None:
    calm, windy = flight(3, 0.5, noise=0.03), flight(4, 0.5)
    # wind acts through drag: the force is that of a drag at the air's speed
    windy = with_(windy, "accelerometer_bias", {"x": 0.3, "y": 0.0, "z": 0.0}, slice(None))
    problem = MeasuredFlights((measure(calm), measure(windy)))
    terms = [Term("rigid_body", {}), Term("rotor_drag", {}), Term("accelerometer_bias", {})]
    each = (Span(flight=0), Span(flight=1))
    fitted = fit(problem, terms, spans={("accelerometer_bias", "x"): each})
    bias = [
        fitted.estimate[i] for i in fitted.of("accelerometer_bias") if fitted.free[i].parameter.name == "x"
    ]
    np.testing.assert_allclose(bias, [0.0, 0.3], atol=0.02)
    # what belongs to one flight moves nothing in the other
    (second,) = [i for i, f in enumerate(fitted.free) if f.span == each[1]]
    assert not np.any(fitted.jacobian[: int(problem.measurements[0].used.sum()), :, second])


def test_a_prediction_that_keeps_its_pieces_is_the_same_prediction() -> None:
    problem = MeasuredFlights((measure(dropped()), measure(flight(5, 0.5, noise=0.03))))
    effects = [effect_named("rigid_body"), effect_named("thrust_gain")]
    keeping = problem.predictor(effects, keep=3)
    for gain in (0.9, 0.95, 0.9, 1.0):
        values = [{}, {"gain": number([(Span(0, stop=MOMENT), gain), (Span(0, start=MOMENT), 1.1)], 1.0)}]
        np.testing.assert_array_equal(
            keeping(values), problem.predict(list(zip(effects, values, strict=True)))
        )


def test_a_change_competes_as_any_other_candidate() -> None:
    problem = ForceProblem(MeasuredFlights((measure(dropped()),)), rigid_body_model(dropped().vehicle))
    search = Search(problem)
    drag = Choice("rotor_drag", ("x", "y"))
    curve, change = Choice("thrust_curve", ("curvature",)), Choice("thrust_gain", ("gain",), (BEFORE, AFTER))
    here = search.state([drag]).fit
    assert problem.linearised_gain(here, (change,)) > 2.0 * problem.linearised_gain(here, (curve,))
    beside = problem.beside(here, change)
    assert beside is not None
    np.testing.assert_allclose(estimates(beside, "thrust_gain"), [0.88, 1.0], atol=0.01)
    assert search.state([drag, change]).cv_total < search.state([drag, curve]).cv_total


def test_flights_are_cut_where_a_number_changes_there() -> None:
    t = np.arange(0.0, 10.0, 0.5)
    gain = number([(Span(1, 2.0, 4.0), 0.5), (Span(1, 4.0), 0.7)], 1.0)
    assert cut_at([{"gain": gain}], 0, t) == [slice(0, 20)]
    assert cut_at([{"gain": gain}], 1, t) == [slice(0, 4), slice(4, 8), slice(8, 20)]
    assert [held({"gain": gain}, 1, x)["gain"] for x in (1.5, 2.0, 3.5, 4.0)] == [1.0, 0.5, 0.5, 0.7]
    assert number([(EVERYWHERE, 0.5)], 1.0) == 0.5
