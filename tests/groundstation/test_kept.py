"""What a fit keeps of its predictions changes none of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from simulated import simulated

from trueflight.groundstation.identify.actuation import respond
from trueflight.groundstation.identify.fitting import MeasuredFlights
from trueflight.groundstation.identify.spectrum import peaks
from trueflight.groundstation.measured.low_pass import density, gain, low_pass
from trueflight.groundstation.measured.measurement import measure
from trueflight.models.effect import Motion, Stage
from trueflight.models.effects import catalogue
from trueflight.models.prediction import Chain, apply_effects, motion_of_flight, specific_force

PROBLEM = MeasuredFlights((measure(simulated(3)),))
USABLE = [e for e in catalogue().values() if not e.rotational and not e.lacks(PROBLEM.measurements[0].flight)]


def plainly(chain: Chain) -> np.ndarray:
    (m,), (motion,) = PROBLEM.measurements, PROBLEM.motions
    return m.see(specific_force(apply_effects(motion, chain)))[m.used][:, m.axes]


def test_predictions_do_not_depend_on_those_before() -> None:
    rng = np.random.default_rng(5)
    values = {e.name: e.typical(PROBLEM.survey) for e in USABLE}
    for _ in range(150):
        moved = USABLE[rng.integers(len(USABLE))]
        for p in moved.parameters:
            if rng.random() < 0.5:
                values[moved.name] |= {p.name: rng.uniform(p.low, min(p.high, p.low + 1.0))}
        chosen = [e for e in USABLE if e.exact_rotation or rng.random() < 0.5]
        chain = [(e, dict(values[e.name])) for e in chosen if e.exact_rotation <= (rng.random() < 0.9)]
        np.testing.assert_allclose(PROBLEM.predict(chain), plainly(chain), rtol=0, atol=1e-9)


def squeezed(motion: Motion, *, by: float) -> Motion:
    return motion.with_(force=by * motion.force)


def pushed_by_thrust(motion: Motion, *, by: float) -> Motion:
    return motion.with_(force=motion.force + by * motion.thrust_acceleration)


@pytest.mark.parametrize("formula", [squeezed, pushed_by_thrust])
def test_a_formula_that_asks_for_what_others_do_is_seen_beside_them(formula: Callable[..., Motion]) -> None:
    drag = catalogue()["rotor_drag"]
    (parameter, _) = drag.parameters
    own = replace(
        drag,
        name=formula.__name__,
        formula=formula,
        parameters=(replace(parameter, name="by"),),
        stage=Stage.SENSOR,
    )
    chain = [(catalogue()["rigid_body"], {}), (drag, {"x": 0.3, "y": 0.4}), (own, {"by": 0.5})]
    np.testing.assert_allclose(PROBLEM.predict(chain), plainly(chain), rtol=0, atol=1e-9)


def test_a_motion_has_no_other_fields() -> None:
    with pytest.raises(TypeError, match="thurst"):
        motion_of_flight(PROBLEM.measurements[0].flight).with_(thurst=1.0)


@pytest.mark.parametrize(("fs", "bandwidth"), [(100.0, 20.0), (100.0, 5.0), (250.0, 20.0), (25.0, 8.0)])
def test_low_pass_is_a_butterworth_filter_forward_and_backward(fs: float, bandwidth: float) -> None:
    rng = np.random.default_rng(1)
    columns = np.cumsum(rng.normal(size=(3000, 3)), axis=0) + rng.normal(size=(3000, 3))
    columns[:, 1] = 0.0
    sos = signal.butter(4, bandwidth, fs=fs, output="sos")
    theirs = signal.sosfiltfilt(sos, columns, axis=0, padlen=int(fs))
    inside = slice(int(fs), -int(fs))
    np.testing.assert_allclose(low_pass(columns, bandwidth, fs)[inside], theirs[inside], atol=1e-5)
    np.testing.assert_array_equal(low_pass(columns, bandwidth, fs, 3), low_pass(columns, bandwidth, fs)[::3])
    w, h = signal.sosfreqz(sos, worN=512, fs=fs)
    np.testing.assert_allclose(gain(w, bandwidth, fs), np.abs(h) ** 2, atol=1e-9)


@pytest.mark.parametrize("length", [200, 201])
def test_density_is_that_of_welch(length: int) -> None:
    columns = np.random.default_rng(1).normal(size=(3000, 2))
    frequency, theirs = signal.welch(columns, fs=50.0, nperseg=length, axis=0)
    mine = density(columns, 50.0, length)
    np.testing.assert_allclose(mine[0], frequency)
    np.testing.assert_allclose(mine[1], theirs, rtol=1e-9)


def test_peaks_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        values, distance = np.maximum(rng.normal(size=200), 0.0), int(rng.integers(1, 20))
        assert peaks(values, distance) == list(signal.find_peaks(values, distance=distance)[0])


@pytest.mark.parametrize(
    ("lag", "integral"), [(0.05, 0.0), (0.05, 1e-6), (0.05, 2.0), (0.05, 5.0), (0.4, 3.0)]
)
def test_answer_of_the_loop_is_that_of_its_difference_equation(lag: float, integral: float) -> None:
    command = np.random.default_rng(0).normal(size=(2000, 2))
    state, held = np.array([[-1.0 / lag, 1.0], [-integral / lag, 0.0]]), np.array([[1.0], [integral]]) / lag
    a, b, c, d, _ = signal.cont2discrete((state, held, np.array([[1.0, 0.0]]), np.zeros((1, 1))), 0.01)
    numerator, denominator = signal.ss2tf(a, b, c, d)
    theirs = signal.lfilter(numerator[0], denominator, command, axis=0)
    np.testing.assert_allclose(respond(command, 0.01, 0.0, lag, integral), theirs, atol=1e-7)
