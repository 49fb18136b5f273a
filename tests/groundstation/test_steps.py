"""The course of an effect over a flight, where the effect does nothing there."""

import numpy as np
import pytest
from dropped import dropped_payload

from trueflight.groundstation.identify.fitting import MeasuredFlights
from trueflight.groundstation.identify.force import ForceProblem
from trueflight.groundstation.identify.steps import Course
from trueflight.groundstation.measured.measurement import measure
from trueflight.groundstation.reading import read_flight
from trueflight.models.model import rigid_body_model


@pytest.mark.parametrize("correlation", [np.inf, 3.0])
def test_an_effect_that_does_nothing_neither_wanders_nor_ends_the_diagnosis(correlation, tmp_path):
    flight = read_flight(dropped_payload(tmp_path / "flown.mcap"))
    problem = ForceProblem(MeasuredFlights((measure(flight),)), rigid_body_model(flight.vehicle))
    here = problem.fit((), None)
    course = Course(problem, here, np.zeros((here.residual.size, 1)))
    wander = course.wander(course.unit(np.zeros_like(here.residual), here.residual), correlation)
    assert np.all(np.isfinite(wander.spread)) and np.all(wander.course == 0.0)
