"""What begins, ends, changes or drifts in flight is told with its moment, and what does not change is not said to."""

import io

import numpy as np
import pytest
from changing import as_if, gusty, lagged_noise, ramp, step
from rich.console import Console
from simulated import simulated

from trueflight.groundstation.identify.gusts import process_of
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.output.ranking import print_diagnosis
from trueflight.groundstation.results import Diagnosis, EffectVerdict
from trueflight.groundstation.versions.several import add_effect_to
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.model import rigid_body_model

MOMENT = 23.0


def said_of(flight: Flight) -> Diagnosis:
    return diagnose(flight, rigid_body_model(flight.vehicle))


def of(found: Diagnosis, name: str) -> EffectVerdict:
    (verdict,) = (e for e in found.effects if e.name == name)
    return verdict


def sizes(verdict: EffectVerdict, parameter: str) -> list[float]:
    """The parameter in each stretch of the flight."""
    assert verdict.over_time is not None
    return [p.value for s in verdict.over_time.stretches for p in s.parameters if p.name == parameter]


@pytest.mark.parametrize(("moment", "gain"), [(12.0, 0.87), (30.0, 1.08)])
def test_a_load_that_falls_is_a_gain_until_a_moment_and_no_curve(moment: float, gain: float) -> None:
    flight = simulated(3, "none")
    found = said_of(as_if(flight, {"thrust_gain": {"gain": step(flight, moment, gain, 1.0)}}))
    assert found.named("missing") == ("thrust_gain",)
    verdict = of(found, "thrust_gain")
    before, after = sizes(verdict, "gain")
    assert (before, after) == (pytest.approx(gain, abs=0.01), 1.0)
    (change,) = verdict.over_time.changes
    assert change.low <= moment <= change.high
    assert change.time == pytest.approx(moment, abs=1.0)
    assert "there is nothing to add" in verdict.advice
    assert "thrust_gain" not in found.model.names()
    assert not found.unexplained.verdict
    # whole on 80 columns
    console = Console(width=80, record=True, file=io.StringIO())
    print_diagnosis(console, found)
    assert f"until {change.time:.2f} s [{change.low:.2f}, {change.high:.2f}]" in " ".join(
        console.export_text().split()
    )


def test_a_change_beside_what_is_always_there_leaves_that_alone() -> None:
    flight = simulated(5, "none")
    gain = step(flight, MOMENT, 1.0, 0.95)
    found = said_of(as_if(flight, {"rotor_drag": {"x": 0.4, "y": 0.3}, "thrust_gain": {"gain": gain}}))
    assert set(found.named("missing")) == {"rotor_drag", "thrust_gain"}
    drag, thrust = of(found, "rotor_drag"), of(found, "thrust_gain")
    assert drag.over_time is None
    assert [p.value for p in drag.parameters] == pytest.approx([0.4, 0.3], abs=0.02)
    assert sizes(thrust, "gain") == pytest.approx([1.0, 0.95], abs=0.01)
    # the model keeps what holds for the vehicle now
    (kept,) = (t for t in found.model.terms if t.effect == "thrust_gain")
    assert kept.values["gain"] == pytest.approx(0.95, abs=0.01)
    assert thrust.parameters[0].value == kept.values["gain"]


def test_drag_that_begins_and_a_load_that_falls_later_are_two_changes() -> None:
    flight = simulated(3, "none")
    drag, gain = step(flight, 14.0, 0.0, 0.35), step(flight, 30.0, 0.9, 1.0)
    found = said_of(as_if(flight, {"rotor_drag": {"x": drag, "y": drag}, "thrust_gain": {"gain": gain}}))
    assert set(found.named("missing")) == {"rotor_drag", "thrust_gain"}
    for name, moment in (("rotor_drag", 14.0), ("thrust_gain", 30.0)):
        (change,) = of(found, name).over_time.changes
        assert change.low <= moment <= change.high, name
    assert sizes(of(found, "rotor_drag"), "x") == pytest.approx([0.0, 0.35], abs=0.02)


def test_wind_that_turns_at_once_and_wind_that_turns_by_and_by() -> None:
    flight = simulated(3, "none")
    blows = {"rotor_drag": {"x": 0.3, "y": 0.3}}
    turned = {"x": step(flight, MOMENT, 2.0, 0.0), "y": step(flight, MOMENT, 0.0, 2.0)}
    found = said_of(as_if(flight, {**blows, "wind": turned}))
    assert {"rotor_drag", "wind"} <= set(found.named("missing"))
    assert sizes(of(found, "wind"), "y") == pytest.approx([0.0, 2.0], abs=0.1)

    drifts = {"x": ramp(flight, 2.0, -1.0), "y": ramp(flight, 0.0, 2.0)}
    found = said_of(as_if(flight, {**blows, "wind": drifts}))
    wind = of(found, "wind")
    assert wind.verdict == "missing" and not wind.over_time.changes
    for d in wind.over_time.drift:
        truth = np.interp(d.times, flight.t, drifts[d.name])
        held = (d.low <= truth) & (truth <= d.high)
        assert held.mean() > 0.8, d.name
        np.testing.assert_allclose(d.value, truth, atol=0.15)
    assert not found.unexplained.misfit


def test_a_model_gets_what_holds_now_and_nothing_of_what_has_ended() -> None:
    flight = simulated(3, "none")
    base = rigid_body_model(flight.vehicle)
    weaker = as_if(flight, {"thrust_gain": {"gain": step(flight, MOMENT, 1.05, 0.93)}})
    made = add_effect_to(base, "thrust_gain", [weaker])
    assert made.model.terms[-1].values["gain"] == pytest.approx(0.93, abs=0.005)
    low, high = made.model.terms[-1].intervals["gain"]
    assert low < 0.93 < high < 0.95
    assert made.courses["thrust_gain"].changes[0].time == pytest.approx(MOMENT, abs=0.2)
    fallen = as_if(flight, {"thrust_gain": {"gain": step(flight, MOMENT, 0.87, 1.0)}})
    with pytest.raises(InputError, match="thrust_gain ended at 23"):
        add_effect_to(base, "thrust_gain", [fallen])
    assert add_effect_to(base, "thrust_gain", [flight]).courses == {}


@pytest.mark.parametrize("hidden", ["none", "rotor_drag", "thrust_curve", "battery_sag"])
def test_what_does_not_change_is_not_said_to(hidden: str) -> None:
    found = said_of(simulated(6, hidden))
    assert [e.name for e in found.effects if e.over_time is not None] == []


def test_gusts_are_told_by_size_and_time_constant_and_are_no_effect() -> None:
    still = simulated(3, "none")
    found = said_of(gusty(as_if(still, {"rotor_drag": {"x": 0.4, "y": 0.4}}), 1.5, 1.0, 0.4))
    assert found.gusts is not None
    assert found.gusts.time_constant.value == pytest.approx(1.0, rel=0.5)
    assert found.gusts.acceleration.value == pytest.approx(0.4 * 1.5, rel=0.3)
    assert found.unexplained.where == (found.gusts.text,)
    assert [e.name for e in found.effects if e.over_time is not None] == []
    assert set(found.named("missing")) <= {"rotor_drag"}


def test_a_process_is_known_within_its_interval_and_a_line_is_none() -> None:
    rng = np.random.default_rng(2)
    period, count, held = 0.02, 4500, []

    def spectrum(column: np.ndarray) -> np.ndarray:
        power = np.abs(np.fft.rfft(column - column.mean())) ** 2
        return power / power.sum() * column.var()

    f = np.fft.rfftfreq(count, period)
    noise = [np.full(len(f), 0.05**2 / len(f))] * 2
    for _ in range(20):
        columns = lagged_noise(rng, count, period, 0.5, 1.5) + rng.normal(0.0, 0.05, (count, 2))
        found = process_of(f, [spectrum(c) for c in columns.T], noise, np.ones(len(f)))
        assert found is not None
        held.append(found.low <= 1.5 <= found.high)
    assert np.mean(held) >= 0.75
    swings = 0.5 * np.sin(2.0 * np.pi * 0.6 * period * np.arange(count)) + rng.normal(0.0, 0.05, count)
    assert process_of(f, [spectrum(swings)] * 2, noise, np.ones(len(f))) is None
