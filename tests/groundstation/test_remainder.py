"""What no effect explains is described, made a formula, and never seen where there is nothing."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from simulated import simulated

from trueflight.groundstation.identify.fitting import MeasuredFlights, fit
from trueflight.groundstation.identify.remainder import unexplained
from trueflight.groundstation.identify.sparse import TERMS, effect_source, unit_of
from trueflight.groundstation.identify.translation import diagnose
from trueflight.groundstation.measured.measurement import measure
from trueflight.groundstation.results import Unexplained
from trueflight.groundstation.versions.effect_file import write_effect_file
from trueflight.groundstation.versions.store import add_effect
from trueflight.models.effects import effect_named
from trueflight.models.errors import InputError
from trueflight.models.flight import Flight
from trueflight.models.frames import rotate_inverse
from trueflight.models.model import Term, rigid_body_model


def remainder(flight: Flight) -> Unexplained:
    """What exact rotation alone leaves."""
    measurement = measure(flight)
    fitted = fit(MeasuredFlights((measurement,)), [Term("rigid_body", {})])
    return unexplained(measurement, fitted.residual)


def with_force(flight: Flight, axis: int, force: np.ndarray) -> Flight:
    """The flight as its accelerometer reads it with one more force over mass, body axes."""
    felt = flight.specific_force.copy()
    felt[:, axis] += force
    return replace(flight, specific_force=felt, data_hash="0123456789abcdef0123")


def body_velocity(flight: Flight) -> np.ndarray:
    return rotate_inverse(flight.quaternion, flight.velocity)


@pytest.mark.parametrize("kind", ["excitation", "lemniscate", "steps", "spiral"])
@pytest.mark.parametrize("seed", [201, *(pytest.param(s, marks=pytest.mark.long) for s in (202, 203))])
def test_nothing_hidden_leaves_nothing_unexplained(kind, seed) -> None:
    left = remainder(simulated(seed, kind=kind))
    assert not left.verdict
    assert left.where == left.lines == ()
    assert left.formula is None


@pytest.mark.parametrize(("seeds", "most"), [(2, 1), pytest.param(10, 2, marks=pytest.mark.long)])
def test_slow_wander_and_bursts_are_no_structure(seeds, most) -> None:
    flight = simulated(201)
    m = measure(flight)
    period, n = float(np.median(np.diff(m.t))), len(m.t)
    speed = np.linalg.norm(flight.velocity[m.rows], axis=1)[:, None]
    alarms = 0
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        noise = rng.normal(0.0, 1.0, (n, 3))
        for correlation, size in ((5.0, 0.05), (0.2, 0.07 * speed)):
            a = np.exp(-period / correlation)
            coloured = signal.lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], noise, axis=0)
            residual = size * coloured + rng.normal(0.0, 0.05, (n, 3))
            left = unexplained(m, residual[m.used])
            alarms += bool(left.variables or left.formula or left.lines)
    assert alarms <= most


def test_a_force_of_no_catalogue_entry_becomes_an_effect_that_explains_it(tmp_path) -> None:
    flight = simulated(201)
    hidden = with_force(flight, 1, 0.12 * body_velocity(flight)[:, 0] ** 2)
    result = diagnose(hidden, rigid_body_model(hidden.vehicle))
    left = result.unexplained
    assert left.verdict
    assert left.p_value <= 0.01
    assert left.variance_share > 0.8
    assert left.axes["y"] > 0.95
    assert "forward speed" in list(left.variables)[:2]
    (term,) = left.formula.terms
    assert (term.axis, term.term, term.unit) == ("y", "u u", "1/m")
    assert term.low < 0.12 < term.high
    assert "a_y = 0.12 u²" in left.where[0]

    write_effect_file(
        "side_force", effect_source(left.formula, "side_force", hidden.name, hidden.data_hash), tmp_path
    )
    effect = effect_named("side_force", str(tmp_path))
    assert "0123456789abcdef" in effect.citation
    base = rigid_body_model(hidden.vehicle, str(tmp_path))
    made = add_effect(base, "side_force", [hidden])
    assert made.terms[-1].values["c1"] == pytest.approx(0.12, abs=0.003)
    again = diagnose(hidden, base)
    assert again.named("missing") == ("side_force",)
    assert again.rms_after < 1.1 * again.noise_floor
    assert not again.unexplained.verdict
    with pytest.raises(InputError, match="exists already"):
        write_effect_file("side_force", effect_source(left.formula, "side_force", hidden.name, ""), tmp_path)


def test_a_constant_force_is_told() -> None:
    flight = simulated(201)
    left = remainder(with_force(flight, 0, np.full(len(flight), 0.9)))
    assert left.verdict
    assert left.where[0].startswith("a constant 0.90 m/s² on body x")


def test_a_draught_at_a_place_is_told_as_one() -> None:
    flight = simulated(201)
    x, y, _ = flight.position.T
    left = remainder(with_force(flight, 2, np.exp(-((x - 1.0) ** 2 + y**2) / (2 * 0.8**2))))
    assert left.verdict
    assert left.formula is None
    assert next(iter(left.variables)) in ("east", "north")
    assert "place" in left.advice


def test_a_swinging_force_is_a_line_of_its_frequency() -> None:
    flight = simulated(201)
    left = remainder(with_force(flight, 2, 0.15 * np.sin(2 * np.pi * 6.2 * flight.t)))
    assert left.verdict
    assert [(line.axis, round(line.frequency, 1)) for line in left.lines] == [("z", 6.2)]
    assert left.lines[0].rms == pytest.approx(0.15 / np.sqrt(2.0), rel=0.15)
    assert left.lines[0].in_band


def test_vibration_above_the_band_is_told_but_no_fault_of_the_model() -> None:
    flight = simulated(201)
    left = remainder(with_force(flight, 0, 0.5 * np.sin(2 * np.pi * 37.0 * flight.t)))
    assert not left.verdict
    assert [round(line.frequency) for line in left.lines] == [37]
    assert not left.lines[0].in_band


def test_every_term_has_the_unit_of_an_acceleration() -> None:
    assert [unit_of(t) for t in ("u", "u u", "T u", "1/h", "p q", "T T")] == [
        "1/s", "1/m", "s/m", "m^2/s^2", "m", "s^2/m",
    ]  # fmt: skip
    assert len(set(TERMS)) == len(TERMS)
