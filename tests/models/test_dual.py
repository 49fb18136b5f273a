"""Derivatives that formulas carry along are those of the formulas."""

import numpy as np
import pytest

from trueflight.models import dual
from trueflight.models.effect import Effect
from trueflight.models.effects import catalogue
from trueflight.models.prediction import error_acceleration, motion_of_features
from trueflight.models.vehicle import load_vehicle

VEHICLE = load_vehicle("models/vehicles/quad5/vehicle.toml")
LEARNT = [e for e in catalogue().values() if any(p.drifts for p in e.parameters)]


def _columns(count: int) -> dict[str, np.ndarray]:
    g = np.random.default_rng(3)
    roll, pitch, yaw = g.uniform(-0.4, 0.4, (3, count))
    return {
        "z": g.uniform(0.3, 3.0, count),
        **{"cos_phi": np.cos(roll), "sin_phi": np.sin(roll), "cos_theta": np.cos(pitch)},
        **{"sin_theta": np.sin(pitch), "cos_psi": np.cos(yaw), "sin_psi": np.sin(yaw)},
        **{axis: g.uniform(-4.0, 4.0, count) for axis in ("vx", "vy", "vz")},
        "u_batt": g.uniform(13.0, 16.8, count),
        "T": g.uniform(0.5, 1.5, count) * VEHICLE.weight,
    }


@pytest.mark.parametrize("effect", LEARNT, ids=lambda e: e.name)
def test_what_can_be_learnt_has_the_derivatives_that_differences_show(effect: Effect) -> None:
    columns = _columns(40)
    drag = catalogue()["rotor_drag"]
    beside = [(drag, {"x": 0.3, "y": 0.2})] if effect.acts_through else []
    names = [p.name for p in effect.parameters_of(VEHICLE)]
    values = {p.name: p.typical * 0.7 for p in effect.parameters_of(VEHICLE)}

    def answer(numbers: dict[str, object], wrap: bool) -> object:
        given = {k: dual.fixed(v, len(names)) if wrap else v for k, v in columns.items()}
        return error_acceleration(motion_of_features(given, VEHICLE), [*beside, (effect, numbers)])  # type: ignore[arg-type]

    carried = dual.parameters([np.full(40, values[n]) for n in names])
    found = answer(dict(zip(names, carried, strict=True)), True)
    assert isinstance(found, dual.Dual)
    np.testing.assert_allclose(found.value, answer(values, False), atol=1e-12)
    for k, name in enumerate(names):
        h = 1e-6
        up, down = (answer({**values, name: values[name] + s * h}, False) for s in (1, -1))
        np.testing.assert_allclose(found.slopes[k], (up - down) / (2 * h), atol=1e-6)  # type: ignore[operator]


def test_functions_know_their_derivatives_and_say_where_they_have_none() -> None:
    x = np.linspace(0.21, 0.91, 8)
    (one,) = dual.parameters([x])
    xp = one.__array_namespace__()
    for name, slope in {
        "sqrt": 0.5 / np.sqrt(x),
        "exp": np.exp(x),
        "log": 1 / x,
        "sin": np.cos(x),
        "cos": -np.sin(x),
        "asin": 1 / np.sqrt(1 - x * x),
        "tanh": 1 - np.tanh(x) ** 2,
        "square": 2 * x,
        "abs": np.ones(8),
    }.items():
        np.testing.assert_allclose(getattr(xp, name)(one).slopes[0], slope)
    np.testing.assert_allclose((2.0 / one - one**3).slopes[0], -2 / x**2 - 3 * x**2)
    np.testing.assert_allclose(xp.clip(one, 0.4, 0.6).slopes[0], (x > 0.4) & (x < 0.6))
    np.testing.assert_allclose(xp.where(one > 0.5, one * 2.0, one).slopes[0], np.where(x > 0.5, 2, 1))
    np.testing.assert_allclose(xp.minimum(one, 0.5).slopes[0], x < 0.5)
    np.testing.assert_allclose(xp.maximum(0.5, one).slopes[0], x > 0.5)
    with pytest.raises(dual.NoSlope, match="floor"):
        xp.floor(one)
    with pytest.raises(dual.NoSlope, match="exponent"):
        one**one
