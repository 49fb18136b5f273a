"""A design file is read only if it is one, stable, and made for this vehicle."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest

from trueflight.models.design import design_to_json, hover_input_matrix, load_design, save_design
from trueflight.models.errors import InputError
from trueflight.models.vehicle import load_vehicle

QUAD5 = Path(__file__).parents[2] / "models" / "vehicles" / "quad5"


def test_the_shipped_design_is_the_lqr_of_its_own_weights() -> None:
    vehicle = load_vehicle(QUAD5 / "vehicle.toml")
    design = load_design(QUAD5 / "design.json", vehicle)
    a = np.zeros((6, 6))
    a[:3, 3:] = np.eye(3)
    b = np.vstack([np.zeros((3, 3)), hover_input_matrix(vehicle.mass)])
    for key, system in (("position", (a, b)), ("attitude", (np.zeros((3, 3)), np.eye(3)))):
        weights = design.weights[key]
        gain, _, poles = control.lqr(*system, np.diag(weights["Q"]), np.diag(weights["R"]))
        np.testing.assert_allclose(design.K_eta if key == "position" else design.K_zeta, gain, atol=1e-5)
        assert poles.real.max() < -1.0


def test_it_survives_its_own_file(tmp_path: Path) -> None:
    design = load_design(QUAD5 / "design.json")
    save_design(design, tmp_path / "design.json")
    assert load_design(tmp_path / "design.json") == design


def test_a_design_for_another_vehicle_is_refused() -> None:
    vehicle = load_vehicle(QUAD5 / "vehicle.toml")
    with pytest.raises(InputError, match="made for vehicle 'quad5', not 'quad7'"):
        load_design(QUAD5 / "design.json", replace(vehicle, name="quad7"))
    with pytest.raises(InputError, match=r"0\.75 kg, the vehicle file says 0\.9 kg"):
        load_design(QUAD5 / "design.json", replace(vehicle, mass=0.9))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": -1}, "positive"),
        ({"mass": "heavy"}, "positive"),
        ({"K_zeta": [[1, 0, 0], [0, 1, 0]]}, "3 rows of 3"),
        ({"K_eta": [[0] * 6] * 2 + [["a"] * 6]}, "3 rows of 6"),
        ({"K_zeta": [[-8, 0, 0], [0, 8, 0], [0, 0, 3]]}, "unstable"),
        ({"K_eta": [[0, 0.4, 0, 0, 0.35, 0], [0.4, 0, 0, 0.35, 0, 0], [0, 0, 3.75, 0, 0, 3]]}, "unstable"),
        ({"K_eat": []}, "unknown key 'K_eat'"),
        ({"weights": 3}, "object"),
        ({"rate": 0}, "positive"),
    ],
)
def test_what_is_no_design_is_told(change: dict[str, object], message: str, tmp_path: Path) -> None:
    table = json.loads(design_to_json(load_design(QUAD5 / "design.json")))
    (tmp_path / "design.json").write_text(json.dumps({**table, **change}))
    with pytest.raises(InputError, match=message):
        load_design(tmp_path / "design.json")


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00\xff", '{"vehicle": "quad5"}'])
def test_garbage_is_told(text: str, tmp_path: Path) -> None:
    (tmp_path / "design.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"design\.json"):
        load_design(tmp_path / "design.json")
    with pytest.raises(InputError, match="cannot read"):
        load_design(tmp_path / "none.json")


def test_a_design_without_integral_is_one_too(tmp_path: Path) -> None:
    plain = replace(load_design(QUAD5 / "design.json"), integral=None)
    assert "integral" not in json.loads(design_to_json(plain))
    save_design(plain, tmp_path / "design.json")
    assert load_design(tmp_path / "design.json") == plain


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda i: 3, "'integral' must be an object with K_eta and K_i"),
        (lambda i: {"K_eta": i["K_eta"]}, "'integral' must be an object with K_eta and K_i"),
        (lambda i: {**i, "limit": 1}, "and nothing else"),
        (lambda i: {**i, "K_i": [[0, 0, 0]]}, r"'integral\.K_i' must be 3 rows of 3"),
        (lambda i: {**i, "K_i": (-np.array(i["K_i"])).tolist()}, "integral gives an unstable loop"),
        (lambda i: {**i, "K_i": (20 * np.array(i["K_i"])).tolist()}, "integral gives an unstable loop"),
        (lambda i: {**i, "K_i": np.zeros((3, 3)).tolist()}, "integral gives an unstable loop"),
    ],
)
def test_an_integral_that_cannot_fly_is_told(change: Any, message: str, tmp_path: Path) -> None:
    table = json.loads(design_to_json(load_design(QUAD5 / "design.json")))
    table["integral"] = change(table["integral"])
    (tmp_path / "design.json").write_text(json.dumps(table))
    with pytest.raises(InputError, match=message):
        load_design(tmp_path / "design.json")
