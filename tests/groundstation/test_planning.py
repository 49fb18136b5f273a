"""A planned flight keeps its limits, says what it will tell, and tells it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated import VEHICLE, fly

from trueflight.groundstation.identify.planning import Limits, plan_flight, setpoints
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.reading import read_flight
from trueflight.models.design import load_design
from trueflight.models.errors import InputError
from trueflight.models.model import rigid_body_model
from trueflight.models.reference import trajectory, trajectory_from_csv
from trueflight.models.vehicle import load_vehicle

SAMPLES = Path(__file__).parents[2] / "samples"
BELIEVED = load_vehicle(VEHICLE)
DESIGN = load_design(VEHICLE.with_name("design.json"), BELIEVED)


def diagnosis_of(path, hidden, seed, flown):
    fly(path, (hidden,), seed, flown)
    flight = read_flight(path)
    return diagnose(flight, rigid_body_model(flight.vehicle))


@pytest.mark.parametrize(
    ("hidden", "truth", "rivals", "first"),
    [
        (
            "parasitic_drag:0.05",
            "parasitic_drag",
            {"parasitic_drag", "rotor_drag"},
            trajectory("circle", laps=3, speed=1.5),
        ),
        (
            "thrust_gain:1.01",
            "thrust_gain",
            {"thrust_gain", "accelerometer_bias"},
            trajectory("hover", duration=15),
        ),
    ],
    ids=["drag in a circle", "gain in a hover"],
)
@pytest.mark.parametrize("seed", [5, pytest.param(6, marks=pytest.mark.long)])
def test_the_planned_flight_tells_what_the_first_one_could_not(
    tmp_path, hidden, truth, rivals, first, seed
) -> None:
    before = diagnosis_of(tmp_path / "first.mcap", hidden, seed, first)
    # a hover does not rule out a ceiling just above it either, nor a circle that a wind helps one drag for the other
    assert rivals <= set(before.named("possible")) <= {*rivals, "ceiling_effect", "wind"}
    assert before.named("missing") == ()

    plan = plan_flight(DESIGN, BELIEVED, Limits(), before)
    asked = next(q for q in plan.questions if {*q.one, *q.other} == rivals)
    assert asked.before < 6.0 < asked.after
    assert asked.answered

    after = diagnosis_of(
        tmp_path / "second.mcap", hidden, seed + 100, trajectory_from_csv(setpoints(plan.trajectory))
    )
    assert after.named("missing") == (truth,)
    assert after.named("possible") == ()
    # the interval that was promised is the interval that comes out, within a factor of three
    found = next(e for e in after.effects if e.name == truth)
    for promised in (p for p in plan.precision if p.effect == truth):
        measured = next(p for p in found.parameters if p.name == promised.parameter)
        assert 0.33 < 0.5 * (measured.high - measured.low) / promised.after < 3.0


def test_the_flight_keeps_its_limits() -> None:
    limits = Limits(radius=1.5, low=0.6, high=2.0, speed=2.0, acceleration=3.0, duration=20.0)
    plan = plan_flight(DESIGN, BELIEVED, limits, between=("wind", "accelerometer_bias", "rotor_drag"))
    flown = trajectory_from_csv(setpoints(plan.trajectory))
    assert flown.duration == pytest.approx(plan.trajectory.duration)
    assert flown.duration <= 20.0
    t = np.arange(0.0, flown.duration, 0.01)
    columns = flown.sample(t)
    assert np.hypot(columns.position[:, 0], columns.position[:, 1]).max() <= 1.51
    assert columns.position[:, 2].min() >= 0.59
    assert columns.position[:, 2].max() <= 2.01
    assert np.linalg.norm(columns.velocity, axis=1).max() <= 2.05
    # jolts, where they are needed, go to twice the limit of the transfers but leave thrust to fly with
    assert np.linalg.norm(columns.acceleration, axis=1).max() <= 6.5
    assert np.linalg.norm(columns.velocity[[0, -1]]) < 1e-6


def test_what_no_flight_within_the_limits_can_tell_stays_open() -> None:
    plan = plan_flight(DESIGN, BELIEVED, Limits(low=1.2), between=("ground_effect", "thrust_gain"))
    asked = next(q for q in plan.questions if q.one == ("ground_effect",) and q.other == ())
    assert not asked.answered


def test_what_the_flight_tells_already_is_not_asked_again() -> None:
    """The curve of thrust is too small a part of this flight's error to be judged there, and yet would have shown."""
    flight = read_flight(SAMPLES / "rotorpy" / "rotor_drag" / "validate.parquet")
    before = diagnose(flight, rigid_body_model(flight.vehicle))
    assert "thrust_curve" in before.named("not_excited")
    gains = replace(DESIGN, vehicle=flight.vehicle.name)
    plan = plan_flight(gains, flight.vehicle, Limits(duration=10.0), before)
    assert "tells already" in plan.left_out["thrust_curve"]
    assert all(q.before is None or q.before < 6.0 for q in plan.questions)


def test_nothing_open_is_said_in_one_line() -> None:
    with pytest.raises(InputError, match="--between"):
        plan_flight(DESIGN, BELIEVED, Limits())
    with pytest.raises(InputError, match="did you mean"):
        plan_flight(DESIGN, BELIEVED, Limits(), between=("rotor_drak",))
